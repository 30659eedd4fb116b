"""Where the time of a training run goes: ``python benchmarks/training_profile.py`` profiles the default run.

Takes the settings of ``python -m modgnn_rl.train``, as in ``trainer.rounds=20 logger=tensorboard``. A line is the time
without that of other lines, on the clock and on the processor; where they differ, this process waited for others or the
disk.
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
    """Adds up how long each part takes, without the parts inside it."""

    def __init__(self) -> None:
        self.seconds: dict[str, np.ndarray] = defaultdict(lambda: np.zeros(2))  # on the clock, on the processor
        self._parts: list[str] = ["the rest"]
        self._since = _now()

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Count the calls of a function as a part; inside one of `WHOLE` they count as that."""
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
    """A clock on all that a run does."""
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
    """Train, and print where the time went; there is no evaluation at the end."""
    from modgnn_rl.experiment.training import train

    clock = watched()
    train(config, evaluate=False)
    total = np.sum(list(clock.seconds.values()), axis=0)
    print("\n| part | clock, s | share | processor, s | share |\n|---|---:|---:|---:|---:|")
    for part, seconds in sorted([*clock.seconds.items(), ("all", total)], key=lambda entry: -entry[1][1]):
        (wall, busy), (wall_share, share) = seconds, seconds / total
        print(f"| {part} | {wall:.1f} | {wall_share:.1%} | {busy:.1f} | {share:.1%} |")


if __name__ == "__main__":
    run_command(main, TrainConfig, "train")
