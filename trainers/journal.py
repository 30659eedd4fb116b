"""What a training run leaves behind while it goes on: metrics, a progress bar, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType

import torch
from tensordict import TensorDictBase

from modgnn_rl.checkpoint import save_checkpoint
from modgnn_rl.configs.schema import FlockingConfig, ImitationConfig
from modgnn_rl.loggers import GuardedLogger
from modgnn_rl.metrics import (
    action_error,
    cohesion,
    is_diverged,
    is_lost,
    leader_distance,
    separation,
    smallest_distance,
)
from modgnn_rl.progress import Progress
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.trainers.collection import Flocks
from modgnn_rl.trainers.learner import Learner

__all__ = ["Journal", "flight_metrics"]

FRAMES = 4  # steps of a batch of flights at which the geometry is measured


class Journal:
    """Writes a run's metrics to its folder, its dashboard and the terminal, and its checkpoints now and then.

    Args:
        run: the run folder.
        logger: the dashboard.
        learner: what the checkpoints hold.
        flocks: the flocks flown; their generators are in the checkpoints too, and they are closed at the end.
        updates: updates of the whole run.
        settings: name the trainer, and say how often to write a checkpoint.
    """

    def __init__(
        self,
        run: RunFolder,
        logger: GuardedLogger,
        learner: Learner,
        flocks: Sequence[Flocks],
        updates: int,
        settings: ImitationConfig,
    ) -> None:
        self.run, self.logger, self.learner, self.flocks = run, logger, learner, flocks
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
        """Stop progress bar and flights; unless something went wrong, write the last checkpoint, after Ctrl-C too."""
        self.progress.__exit__(kind, error, trace)
        for group in self.flocks:
            group.close()
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
        generators = {"learner": self.learner.generator}
        for group in self.flocks:
            generators |= group.generators
        tensors["generators"] = {name: generator.get_state() for name, generator in generators.items()}
        save_checkpoint(self.run.checkpoints, self.learner.updates_done, tensors, {**state, "config": self.run.config})
        self.saved = time.monotonic()


def flight_metrics(flights: TensorDictBase, world: FlockingConfig) -> dict[str, float]:
    """Metrics of flights that a trainer collected; names begin with the number of agents.

    Args:
        flights: [B, T], with who flew under ``expert_flies`` [B, T, 1].
        world: says when a flock has diverged or is lost.

    Returns:
        the error of the actions where the policy flew (NaN where the expert flew throughout), and at a few steps,
        whoever flew, the other metrics of `modgnn_rl.metrics`.
    """
    agents = flights["agents"]
    flown = agents["controlled"] & ~flights["expert_flies"]
    error = action_error(agents["action"], agents["expert_action"], flown).nanmean()
    frames = torch.linspace(0, flights.shape[1] - 1, FRAMES).long()
    position = flights[world.state_key][:, frames, :, :3]
    measured = {
        "error": error,
        "leader_distance": leader_distance(position).mean(),
        "cohesion": cohesion(position).mean(),
        "separation": separation(position).mean(),
        "smallest_distance": smallest_distance(position).min(),
        "lost": is_lost(position, world.comm_range).double().mean(),
        "diverged": is_diverged(position, world.max_distance).double().mean(),
    }
    return {f"{position.shape[-2]}/{name}": float(value) for name, value in measured.items()}
