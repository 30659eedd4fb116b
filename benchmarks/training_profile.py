"""Profile of a training run: ``python benchmarks/training_profile.py`` profiles the default run.

Takes the settings of ``python -m modgnn_rl.train``, as in ``trainer.rounds=20 logger=tensorboard``. Each line of the
table is the wall-clock and the processor time of one part without that of other lines; where they differ, the process
waited for others or the disk.
"""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import numpy as np

from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import TrainConfig

WHOLE = ("forward", "logging", "logging: reference rollouts, once")


class Clock:
    """Sums up the time of each part, without the parts inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(2))  # wall clock, processor
        self._parts: list[str] = ["the rest"]
        self._since = _now()

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Count the calls of a function as a part, or as part of one of `WHOLE` inside it."""
        function = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            self._switch(self._parts[-1] if self._parts[-1] in WHOLE else part)
            try:
                return function(*arguments, **options)
            finally:
                self._switch(None)

        setattr(owner, name, timed)

    def _switch(self, part: str | None) -> None:
        now = _now()
        self.seconds[self._parts[-1]] += now - self._since
        self._since = now
        if part is None:
            self._parts.pop()
        else:
            self._parts.append(part)


def _now() -> np.ndarray:
    return np.array([time.perf_counter(), time.process_time()])


def watched() -> Clock:
    """A clock that watches all parts of a run."""
    import torch
    from torch.optim.swa_utils import AveragedModel
    from torchrl.data import ReplayBuffer

    from modgnn_rl.envs import FlockingEnv
    from modgnn_rl.envs.flocking.expert import Reynolds
    from modgnn_rl.nn.modgnn import ModGNN
    from modgnn_rl.trainers.collectors.local import LocalCollector
    from modgnn_rl.trainers.collectors.rollout_buffer import WindowBuffer
    from modgnn_rl.trainers.common.optimization import GuardedOptimizer
    from modgnn_rl.trainers.imitation import learner
    from modgnn_rl.trainers.loop.checkpointer import BestPolicies, Checkpointer
    from modgnn_rl.trainers.loop.dashboard_callback import DashboardCallback
    from modgnn_rl.trainers.loop.metrics_writer import MetricsWriter

    clock = Clock()
    clock.watch(FlockingEnv, "_step", "environment: physics and graph")
    clock.watch(FlockingEnv, "_reset", "environment: physics and graph")
    clock.watch(Reynolds, "forward", "expert")
    clock.watch(ModGNN, "forward", "policy, acting")
    clock.watch(LocalCollector, "collect", "collector")
    clock.watch(WindowBuffer, "extend", "data: windows into the buffer")
    clock.watch(ReplayBuffer, "sample", "batch assembly")
    clock.watch(learner.ImitationLearner, "prepare", "batch assembly")
    clock.watch(learner, "imitation_loss", "forward")
    clock.watch(torch.Tensor, "backward", "backward")
    clock.watch(GuardedOptimizer, "step", "optimiser and moving average")
    clock.watch(AveragedModel, "update_parameters", "optimiser and moving average")
    clock.watch(MetricsWriter, "write", "logging")
    clock.watch(DashboardCallback, "on_round", "logging")
    clock.watch(DashboardCallback, "on_collect", "logging")
    clock.watch(DashboardCallback, "on_start", "logging: reference rollouts, once")
    clock.watch(Checkpointer, "save", "checkpoints")
    clock.watch(BestPolicies, "save", "checkpoints")
    return clock


def main(config: TrainConfig) -> None:
    """Train without evaluation, and print a table of the time that each part took."""
    from modgnn_rl.experiment.training import train

    clock = watched()
    train(config, evaluate=False)
    total = np.sum(list(clock.seconds.values()), axis=0)
    print("\n| part | wall clock (s) | fraction | processor (s) | fraction |\n|---|---:|---:|---:|---:|")
    for part, seconds in sorted([*clock.seconds.items(), ("all", total)], key=lambda entry: -entry[1][1]):
        (wall, busy), (wall_share, share) = seconds, seconds / total
        print(f"| {part} | {wall:.1f} | {wall_share:.1%} | {busy:.1f} | {share:.1%} |")


if __name__ == "__main__":
    run_command(main, TrainConfig, "train")
