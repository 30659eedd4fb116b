"""Settings that all tasks share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from omegaconf import MISSING

from modgnn_rl.configs.settings import as_list, setting
from modgnn_rl.registry import TASKS

__all__ = ["TaskConfig"]


@dataclass
class TaskConfig:
    """Settings that all tasks share; a task derives its own from them, see `modgnn_rl.task.Task`.

    Attributes:
        irrelevant_to_data: settings on which neither stored states nor the expert's labels depend, so that a dataset
            serves for all their values.
    """

    irrelevant_to_data: ClassVar[tuple[str, ...]] = ("max_steps",)

    name: str = setting(MISSING, "task", choices=TASKS)
    num_agents: Any = setting(8, "agents; a list trains on several numbers at once", ge=1, whole=True)
    max_steps: int = setting(200, "steps after which an episode is truncated", ge=1)

    @property
    def sizes(self) -> list[int]:
        """``num_agents`` as a list."""
        return as_list(self.num_agents)

    @property
    def reference_size(self) -> int:
        """The number of agents that ``trainer.num_envs`` and ``trainer.agents_per_state`` refer to."""
        return int(self.sizes[0])

    @property
    def not_in_data(self) -> list[str]:
        """Settings, as ``name=value``, whose effect a dataset of states does not contain."""
        return []
