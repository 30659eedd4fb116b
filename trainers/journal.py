"""What a training run leaves behind while it goes on: metrics, a progress bar, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType

import torch
from tensordict import TensorDictBase

from modgnn_rl.checkpoint import save_checkpoint
from modgnn_rl.configs.schema import ImitationConfig
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.metrics import cohesion, leader_distance, separation, smallest_distance
from modgnn_rl.progress import Progress
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.trainers.learner import Learner

__all__ = ["Journal", "flight_metrics"]

FRAMES = 4  # steps of a batch of flights at which the geometry is measured


class Journal:
    """Writes a run's metrics to its folder, its dashboard and the terminal, and its checkpoints now and then.

    Args:
        run: the run folder.
        logger: the dashboard.
        learner: what the checkpoints hold.
        updates: updates of the whole run.
        settings: name the trainer, and say how often to write a checkpoint.
    """

    def __init__(
        self,
        run: RunFolder,
        logger: GuardedLogger,
        learner: Learner,
        updates: int,
        settings: ImitationConfig,
    ) -> None:
        self.run, self.logger, self.learner = run, logger, learner
        self.progress = Progress(settings.name, updates, unit="updates")
        self.period = 60 * settings.checkpoint_minutes
        self.saved = time.monotonic()

    def __enter__(self) -> Journal:
        """Start the progress bar."""
        self.progress.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the progress bar; unless something went wrong, write the last checkpoint, after Ctrl-C too."""
        self.progress.__exit__(kind, error, trace)
        if kind is None or issubclass(kind, KeyboardInterrupt):
            self.save()

    def note(self, step: int, metrics: Mapping[str, float], updates: int, **figures: float | str) -> None:
        """Record the metrics of a round.

        Args:
            step: number of the round.
            metrics: its metrics.
            updates: updates it took.
            figures: what the progress bar shows.
        """
        self.run.log(step, metrics)
        self.logger.log(step, metrics)
        self.progress.update(updates, **figures)
        if time.monotonic() - self.saved > self.period:
            self.save()

    def save(self) -> None:
        """Write a checkpoint."""
        tensors, state = self.learner.state()
        save_checkpoint(self.run.checkpoints, self.learner.updates_done, tensors, state)
        self.saved = time.monotonic()


def flight_metrics(flights: TensorDictBase, prefix: str) -> dict[str, float]:
    """Metrics of flights that a trainer collected, over the steps that the policy flew.

    Args:
        flights: [B, T], with who flew under ``expert_flies`` [B, T, 1].
        prefix: goes before the names.

    Returns:
        the error of the policy's actions (NaN where the expert flew throughout), and at some steps the distances that
        `modgnn_rl.metrics` defines.
    """
    agents = flights["agents"]
    square = (agents["action"] - agents["expert_action"]).square().mean(-1)
    counted = agents["controlled"] & ~flights["expert_flies"]
    error = square[counted].mean()
    frames = torch.linspace(0, flights.shape[1] - 1, FRAMES).long()
    position = agents["observation"][:, frames, :, :3]
    measured = {
        "error": error,
        "leader_distance": leader_distance(position).mean(),
        "cohesion": cohesion(position).mean(),
        "separation": separation(position).mean(),
        "smallest_distance": smallest_distance(position).min(),
    }
    return {f"{prefix}/{name}": float(value) for name, value in measured.items()}
