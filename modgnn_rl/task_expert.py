"""A task's expert as the library uses it: it labels states under one key, in one form."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from modgnn_rl.actions import Discrete
from modgnn_rl.errors import InputError
from modgnn_rl.nn.keys import as_tuple, dotted
from modgnn_rl.task_env import EXPERT_ACTION, OBSERVATION

if TYPE_CHECKING:
    from modgnn_rl.task import Task

__all__ = ["ExpertLabels"]


class ExpertLabels(TensorDictModuleBase):
    """A task's expert as the library uses it: it writes `EXPERT_ACTION` [*B, N, A].

    Args:
        expert: writes `EXPERT_ACTION` or `ACTION`, under ``agents`` or under the environment's own group.
        task: says what actions are.

    Raises:
        InputError: the expert writes other keys, or, when it is called, actions of another shape.
    """

    def __init__(self, expert: TensorDictModuleBase, task: Task) -> None:
        super().__init__()
        self.expert, self._task = expert, task
        names = {key: as_tuple(key)[-1] for key in expert.out_keys}
        self._key = next((key for name in ("expert_action", "action") for key in names if names[key] == name), None)
        if self._key is None:
            raise InputError(
                f"task '{task.name}': the expert writes {', '.join(map(dotted, expert.out_keys))}; expected "
                f"'{dotted(EXPERT_ACTION)}'"
            )
        keys = [unravel_key(key) for key in (*expert.in_keys, *expert.out_keys)]
        groups = {key[0] for key in keys if isinstance(key, tuple)} - {"agents", "next"}
        self._groups = groups if groups == {task.group_name} else set()
        self.in_keys: list[Any] = [self._standard(key) for key in expert.in_keys]
        self.out_keys: list[Any] = [EXPERT_ACTION, *(key for key in expert.out_keys if key != self._key)]

    def _standard(self, key: NestedKey) -> NestedKey:
        """The library's name of a key of the environment's group."""
        return ("agents", *key[1:]) if isinstance(key, tuple) and key[0] in self._groups else key

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the expert's actions."""
        data = tensordict.copy()
        for group in self._groups:
            data.set(group, data["agents"])
        result = self.expert(data)
        tensordict.set(EXPERT_ACTION, self._as_numbers(result[self._key], tensordict))
        for key in self.out_keys[1:]:
            tensordict.set(key, result[key])
        return tensordict

    def _as_numbers(self, action: Tensor, tensordict: TensorDictBase) -> Tensor:
        """The action as numbers [*B, N, A]; of discrete ones an index becomes one-hot."""
        actions, observation = self._task.actions, tensordict[OBSERVATION]
        agents = tuple(observation.shape[: tensordict.ndim + 1])
        if isinstance(actions, Discrete) and not action.is_floating_point() and tuple(action.shape) == agents:
            return torch.nn.functional.one_hot(action.long(), actions.width).to(observation.dtype)
        if tuple(action.shape) != (*agents, actions.width):
            raise InputError(
                f"task '{self._task.name}': the expert writes '{dotted(self._key)}' with shape {tuple(action.shape)}; "
                f"expected {(*agents, actions.width)}"
            )
        return action.to(observation.dtype)
