"""What a trainer is given: settings, task, callbacks, and where to write and to start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from modgnn_rl.configs.schema import TrainConfig
from modgnn_rl.task import Task
from modgnn_rl.tracking.checkpoint import Checkpoint
from modgnn_rl.tracking.loggers import LoggerGroup
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.utils.signals import GracefulInterrupt

__all__ = ["TrainContext"]


@dataclass(frozen=True)
class TrainContext:
    """One training run.

    A trainer reads `config` and `task`; the rest is for
    `modgnn_rl.trainers.loop.training_loop.TrainingLoop`.

    Attributes:
        config: all settings, checked; in distributed training those of this process.
        task: makes environments (``task.training_env``), and labels states (``task.teacher``) if it has an expert.
        run: folder for metrics and checkpoints.
        loggers: where metrics go in addition to ``metrics.jsonl``.
        callbacks: called at the start, after every collection of rollouts, after every round, and at the end.
        checkpoint: where the run resumes from; None at the start.
        restore_rollouts: whether to resume environments and training data from the checkpoint too.
        interrupt: signals from outside, such as Ctrl-C.
    """

    config: TrainConfig
    task: Task
    run: RunFolder
    loggers: LoggerGroup
    callbacks: Sequence[Callback] = ()
    checkpoint: Checkpoint | None = None
    restore_rollouts: bool = True
    interrupt: GracefulInterrupt = field(default_factory=GracefulInterrupt)
