"""``python -m modgnn_rl.train``: train a policy and see how well it flies."""

from __future__ import annotations

import shlex

from modgnn_rl.command import run_command
from modgnn_rl.configs.schema import BCConfig, DAggerConfig, MAPPOConfig, TrainConfig


def main(config: TrainConfig) -> None:
    """Train a decentralised flocking policy from the Reynolds expert, and compare it with the expert."""
    from modgnn_rl.training import train

    run = train(config)
    print(f"Policy, metrics and table are in {run.path}")
    print(f"Next: python -m modgnn_rl.evaluate {shlex.quote(f'run={run.path}')} 'evaluation.num_agents=[8,16,64]'")


if __name__ == "__main__":
    run_command(
        main,
        TrainConfig,
        "train",
        nodes={"trainer/dagger": DAggerConfig, "trainer/bc": BCConfig, "trainer/mappo": MAPPOConfig},
    )
