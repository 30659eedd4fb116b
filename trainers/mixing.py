"""Who flies while DAgger collects: the policy, or the expert with a share that falls from round to round."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from modgnn_rl.errors import InputError

__all__ = ["Mixture", "expert_share"]


def expert_share(schedule: str, round_index: int, *, start: float, decay: float, last_round: int) -> float:
    """The expert's share of the flying time in one round; with each schedule 0 from ``last_round`` on.

    Args:
        schedule: ``constant`` (start), ``linear`` (start (1 - k / last_round)) or ``exponential`` (start decay^k).
        round_index: the round k, counted from 0.
        start: share in round 0.
        decay: factor between rounds of the exponential schedule.
        last_round: first round in which the policy flies alone.

    Returns:
        probability between 0 and 1 that the expert flies a flock for a stretch of time.

    Raises:
        InputError: for another schedule.
    """
    if round_index >= last_round:
        return 0.0
    if schedule == "constant":
        return start
    if schedule == "linear":
        return start * (1 - round_index / last_round)
    if schedule == "exponential":
        return start * decay**round_index
    raise InputError(f"schedule '{schedule}' is not one of constant, linear, exponential")


class Mixture(TensorDictModuleBase):
    """DAgger's behaviour policy: overwrites the policy's action by the expert's, flock by flock, for stretches of time.

    It stands behind the policy and the expert in a sequence, so that the policy's messages advance in any case. At
    each stretch a coin is tossed for each flock; within the stretch the same one flies all its agents.

    Args:
        share: probability that the expert flies a flock; may be set anew at any time, for the tosses that follow.
        stretch: steps between two tosses.
        generator: source of randomness.
        action: key of the policy's action, overwritten [*B, N, 3].
        expert_action: key of the expert's action [*B, N, 3].
        expert_flies: key that tells who flew, bool [*B, 1].
    """

    def __init__(
        self,
        share: float,
        stretch: int,
        generator: torch.Generator,
        *,
        action: NestedKey = ("agents", "action"),
        expert_action: NestedKey = ("agents", "expert_action"),
        expert_flies: NestedKey = "expert_flies",
    ) -> None:
        super().__init__()
        self.share = share
        self.stretch = stretch
        self.generator = generator
        self.in_keys: list[Any] = [action, expert_action]
        self.out_keys: list[Any] = [action, expert_flies]
        self._steps = 0
        self._expert_flies: Tensor | None = None

    def restart(self) -> None:
        """Toss at the next step."""
        self._expert_flies = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the action of each flock."""
        action, expert_action = (tensordict[key] for key in self.in_keys)
        flocks = tensordict.batch_size
        if self._expert_flies is None or self._steps % self.stretch == 0:
            coin = torch.rand(flocks, generator=self.generator, device=self.generator.device)
            self._expert_flies, self._steps = (coin < self.share).unsqueeze(-1).to(action.device), 0
        self._steps += 1
        chosen = torch.where(self._expert_flies.unsqueeze(-1), expert_action, action)
        return tensordict.set(self.out_keys[0], chosen).set(self.out_keys[1], self._expert_flies.clone())
