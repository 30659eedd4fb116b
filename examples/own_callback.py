"""Train from Python, with a custom expert and custom callbacks.

    python examples/own_callback.py

The expert below keeps more distance than the default one. `modgnn_rl.experiment.training.train` does the same as
``python -m modgnn_rl.train`` and leaves the same folder. Callbacks are called during training: one prints metrics, the
other stops training as soon as the policy is good enough.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensordict.nn import TensorDictModule
from torch import Tensor

from modgnn_rl.configs.schema import DAggerConfig, EvaluationConfig, FlockingConfig, TrainConfig
from modgnn_rl.envs.flocking.expert import reynolds
from modgnn_rl.experiment.training import train
from modgnn_rl.trainers.loop.callbacks import Callback


def spacious(observation: Tensor) -> Tensor:
    """Target velocities (m/s) [*B, N, 3] by Reynolds' rule with three times the default separation."""
    position, velocity = observation.split(3, -1)
    return reynolds(position, velocity, cohesion=0.06, separation=2.4, alignment=0.02, max_speed=0.92)


class Print(Callback):
    """Prints error and separation after each round."""

    def on_round(self, index: int, metrics: Mapping[str, float]) -> None:
        """Print two of the metrics, as they are in ``metrics.jsonl``."""
        if "8/error" in metrics:
            print(f"round {index}: error {metrics['8/error']:.4f} m²/s², nearest {metrics['8/separation']:.2f} m")


class StopWhenGood(Callback):
    """Stops as soon as the policy, acting alone, has an error below this (m²/s²)."""

    def __init__(self, error: float) -> None:
        self.error = error

    def on_round(self, index: int, metrics: Mapping[str, float]) -> bool:
        """Whether to stop."""
        return metrics.get("beta") == 0 and metrics["8/error"] < self.error


def main(error: float = 0.02, runs: Path = Path("runs"), steps: int = 480, **trainer: Any) -> dict[str, Any]:
    """Train.

    Args:
        error: at which to stop (m²/s²).
        runs: folder for the run folder.
        steps: of the evaluation rollouts.
        trainer: settings of `DAggerConfig`.

    Returns:
        the content of ``evaluation.json``.
    """
    config = TrainConfig(
        env=FlockingConfig(num_agents=8, comm_range=6.0),
        trainer=DAggerConfig(num_envs=8, **trainer),
        evaluation=EvaluationConfig(num_flocks=20, steps=steps),
        runs=str(runs),
        name="spacious",
    )
    expert = TensorDictModule(spacious, [("agents", "observation")], [("agents", "expert_action")])
    run = train(config, expert=expert, callbacks=[Print(), StopWhenGood(error)])
    figures: dict[str, Any] = json.loads((run.path / "evaluation.json").read_text())
    return figures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--error", type=float, default=0.02, help="error at which to stop (m²/s²)")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder for the run folder")
    main(**vars(parser.parse_args()))
