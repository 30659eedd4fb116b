"""What a trainer works with: settings, where its work goes, what it goes on from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from tensordict.nn import TensorDictModuleBase

from modgnn_rl.configs.schema import TrainConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.tracking.checkpoint import Checkpoint
from modgnn_rl.tracking.loggers import LoggerGroup
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.utils.signals import GracefulInterrupt

__all__ = ["TrainContext"]


@dataclass
class TrainContext:
    """One training run, or what is left of it.

    Attributes:
        config: the run's settings.
        run: the folder to leave metrics and checkpoints in.
        loggers: where metrics go besides.
        expert: writes ``("agents", "expert_action")``; default: Reynolds flocking.
        callbacks: people's own code.
        checkpoint: what the run goes on from; None: it begins.
        keeps_flocks: whether flocks and data go on too, or begin anew.
        interruption: signals from outside.
    """

    config: TrainConfig
    run: RunFolder
    loggers: LoggerGroup
    expert: TensorDictModuleBase = None
    callbacks: Sequence[Callback] = ()
    checkpoint: Checkpoint | None = None
    keeps_flocks: bool = True
    interruption: GracefulInterrupt = field(default_factory=GracefulInterrupt)

    def __post_init__(self) -> None:
        """Choose the expert."""
        if self.expert is None:
            self.expert = Reynolds.for_env(self.config.env)
