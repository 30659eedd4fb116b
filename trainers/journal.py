"""What a training run leaves behind while it goes on: metrics, a progress bar, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from modgnn_rl.checkpoint import save_checkpoint
from modgnn_rl.configs.schema import FlockingConfig, TrainerConfig
from modgnn_rl.envs.rewards import flocking_costs
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
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.progress import Progress
from modgnn_rl.run_folder import RunFolder
from modgnn_rl.tensors import pair_distances
from modgnn_rl.trainers.callbacks import Callback
from modgnn_rl.trainers.collection import FlockCollector

__all__ = ["Journal", "Learns", "flight_metrics", "reward_metrics"]

FRAMES = 4  # steps of a batch of flights at which the geometry is measured


class Learns(Protocol):
    """What a checkpoint is made of: a learner."""

    updates_done: int

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random there, by name."""

    @property
    def flown(self) -> ModGNN:
        """The policy so far."""

    def state(self) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
        """What a checkpoint holds of the learner: named tensors, and plain values."""


class Journal:
    """Writes a run's metrics to its folder, its dashboard and the terminal, its checkpoints, and calls the callbacks.

    Args:
        run: the run folder.
        logger: the dashboard.
        learners: what the checkpoints hold; the first is the one that `modgnn_rl.load_policy` finds.
        flocks: the flocks flown; their generators are in the checkpoints too, and they are closed at the end.
        total: updates, or what else ``unit`` says, of the whole run.
        settings: name the trainer, and say how often to write a checkpoint.
        callbacks: people's own code.
        unit: what is counted.
    """

    def __init__(
        self,
        run: RunFolder,
        logger: GuardedLogger,
        learners: Mapping[str, Learns],
        flocks: Sequence[FlockCollector],
        total: int,
        settings: TrainerConfig,
        callbacks: Sequence[Callback] = (),
        *,
        unit: str = "updates",
    ) -> None:
        self.run, self.logger, self.learners, self.flocks = run, logger, learners, flocks
        self.callbacks = callbacks
        self.progress = Progress(settings.name, total, unit=unit)
        self.period = 60 * settings.checkpoint_minutes
        self.saved = time.monotonic()

    @property
    def policies(self) -> dict[str, ModGNN]:
        """The policies so far, by the learners' names."""
        return {name: learner.flown for name, learner in self.learners.items()}

    def __enter__(self) -> Journal:
        """Start the progress bar."""
        for callback in self.callbacks:
            callback.on_start(self.policies)
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
        if kind is None:
            for callback in self.callbacks:
                callback.on_end(self.policies)

    def show(self, index: int, flights: TensorDictBase) -> TensorDictBase:
        """Show flights of a round to the callbacks before they are learned from; returns them."""
        for callback in self.callbacks:
            callback.on_flights(index, flights)
        return flights

    def note(self, step: int, metrics: Mapping[str, float], count: int, **figures: float | str) -> bool:
        """Record the metrics of a round.

        Args:
            step: number of the round.
            metrics: its metrics.
            count: how much of the total was done in it.
            figures: what the progress bar shows.

        Returns:
            whether a callback wants to stop here.
        """
        self.run.log(step, metrics)
        self.logger.log(step, metrics)
        self.progress.update(count, **figures)
        if time.monotonic() - self.saved > self.period:
            self.save()
        wishes = [callback.on_round(step, metrics) for callback in self.callbacks]  # all are called
        return any(wishes)

    def save(self) -> None:
        """Write a checkpoint."""
        tensors: dict[str, dict[str, Tensor]] = {}
        state: dict[str, Any] = {"config": self.run.config, "learners": list(self.learners)}
        generators: dict[str, torch.Generator] = {}
        for number, (name, learner) in enumerate(self.learners.items()):
            of_learner, further = learner.state()
            prefix = f"{name}." if number else ""
            tensors |= {f"{prefix}{group}": values for group, values in of_learner.items()}
            state |= {f"{prefix}{key}": value for key, value in further.items()}
            generators |= {f"{prefix}{role}": generator for role, generator in learner.generators.items()}
        for number, group in enumerate(self.flocks):
            generators |= {f"{number}.{name}": generator for name, generator in group.generators.items()}
        tensors["generators"] = {name: generator.get_state() for name, generator in generators.items()}
        step = next(iter(self.learners.values())).updates_done
        save_checkpoint(self.run.checkpoints, step, tensors, state)
        self.saved = time.monotonic()


def flight_metrics(flights: TensorDictBase, world: FlockingConfig) -> dict[str, float]:
    """Metrics of flights that a trainer collected; names begin with the number of agents.

    Args:
        flights: [B, T]; where the expert flew some, with who did under ``expert_flies`` [B, T, 1].
        world: says when a flock has diverged or is lost.

    Returns:
        the error of the actions where the policy flew (NaN where the expert flew throughout), and at a few steps,
        whoever flew, the other metrics of `modgnn_rl.metrics`.
    """
    agents = flights["agents"]
    flown, expert_flies = agents["controlled"], flights.get("expert_flies", None)
    if expert_flies is not None:
        flown = flown & ~expert_flies
    error = action_error(agents.get("loc", agents["action"]), agents["expert_action"], flown).nanmean()
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
    if expert_flies is not None:
        measured["expert_flew"] = expert_flies.double().mean()
    return {f"{position.shape[-2]}/{name}": float(value) for name, value in measured.items()}


def reward_metrics(flights: TensorDictBase, world: FlockingConfig) -> dict[str, float]:
    """Mean reward of a step and of an agent that is flown, and each cost that makes it up, unweighted.

    Args:
        flights: [B, T].
        world: its weights.

    Returns:
        by name; names begin with the number of agents.
    """
    state = flights["next", *world.state_key]
    position, velocity = state.split(3, -1)
    exists = flights.get(("agents", "mask"), None)
    costs = flocking_costs(
        position,
        velocity,
        flights["agents", "action"],
        pair_distances(position.flatten(0, 1)).amin(-1).view(position.shape[:-1]),
        crowding_distance=world.crowding_distance,
        collision_distance=world.collision_distance,
        exists=exists,
    )
    flown = flights["agents", "controlled"]
    measured = {f"cost/{name}": cost[flown].mean() for name, cost in costs.items()}
    measured["reward"] = flights["next", "agents", "reward"][flown].mean()
    return {f"{position.shape[-2]}/{name}": float(value) for name, value in measured.items()}
