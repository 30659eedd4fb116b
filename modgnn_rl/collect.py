"""``python -m modgnn_rl.collect episodes=1000``: collect expert rollouts into a dataset."""

from __future__ import annotations

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import CollectConfig


def main(config: CollectConfig) -> None:
    """Collect expert rollouts into a dataset for trainer=bc; re-running resumes an unfinished dataset.

    Examples::

        python -m modgnn_rl.collect episodes=100 steps=500
        python -m modgnn_rl.collect env=paper env.compile=true threads=2
        python -m modgnn_rl.collect env.num_agents=16 output=datasets/small-flocks
    """
    from modgnn_rl.data.collect import collect_dataset, describe_dataset

    print(describe_dataset(collect_dataset(config)))


if __name__ == "__main__":
    run_command(main, CollectConfig, "collect")
