"""Who flies while data are collected: policy, expert, or whichever is safe; modules to put behind both in a sequence.

A sequence ``policy, expert, BetaMixture, SafetyGate, ActionNoise`` lets the policy's messages advance in any case,
labels every state, and then chooses which action is flown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.nn.primer import RecurrentStatePrimer

__all__ = ["ActionNoise", "BetaMixture", "Ensemble", "SafetyGate", "beta_schedule", "disagreement", "ensemble_std"]


def beta_schedule(schedule: str, round_index: int, *, start: float, decay: float, last_round: int) -> float:
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


class BetaMixture(TensorDictModuleBase):
    """DAgger's behaviour policy: overwrites the policy's action by the expert's, flock by flock, for stretches of time.

    It stands behind the policy and the expert in a sequence, so that the policy's messages advance in any case. At
    each stretch a coin is tossed for each flock; within the stretch the same one flies all its agents.

    Args:
        share: probability that the expert flies a flock; may be set anew at any time, for the tosses that follow.
        hold_steps: steps between two tosses.
        generator: source of randomness.
        action: key of the policy's action, overwritten [*B, N, 3].
        expert_action: key of the expert's action [*B, N, 3].
        expert_flies: key that tells who flew, bool [*B, 1].
    """

    def __init__(
        self,
        beta: float,
        hold_steps: int,
        generator: torch.Generator,
        *,
        action: NestedKey = ("agents", "action"),
        expert_action: NestedKey = ("agents", "expert_action"),
        expert_flies: NestedKey = "expert_flies",
    ) -> None:
        super().__init__()
        self.beta = beta
        self.hold_steps = hold_steps
        self.generator = generator
        self.in_keys: list[Any] = [action, expert_action]
        self.out_keys: list[Any] = [action, expert_flies]
        self._steps = 0
        self._restarts = 0
        self._expert_flies: Tensor | None = None

    def restart(self) -> None:
        """Toss at the next step."""
        self._expert_flies = None
        self._restarts += 1

    def state(self) -> dict[str, Tensor]:
        """Who flies now and for how long already, as named tensors."""
        flies = {} if self._expert_flies is None else {"expert_flies": self._expert_flies}
        return {"steps": torch.tensor(self._steps), **flies}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on from what `state` gave; the generator is the caller's."""
        flies = state.get("expert_flies")
        self._steps = int(state["steps"])
        self._expert_flies = None if flies is None else flies.to(self.generator.device)

    def get_extra_state(self) -> dict[str, Any]:
        """What a copy in another process must hear of, as a part of the module's state."""
        return {"share": self.beta, "restarts": self._restarts}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over share and restarts."""
        self.beta = state["share"]
        if state["restarts"] != self._restarts:
            self.restart()
            self._restarts = state["restarts"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the action of each flock."""
        action, expert_action = (tensordict[key] for key in self.in_keys)
        flocks = tensordict.batch_size
        if self._expert_flies is None or self._steps % self.hold_steps == 0:
            coin = torch.rand(flocks, generator=self.generator, device=self.generator.device)
            self._expert_flies, self._steps = (coin < self.beta).unsqueeze(-1).to(action.device), 0
        self._steps += 1
        chosen = torch.where(self._expert_flies.unsqueeze(-1), expert_action, action)
        return tensordict.set(self.out_keys[0], chosen).set(self.out_keys[1], self._expert_flies.clone())


def disagreement(tensordict: TensorDictBase) -> Tensor:
    """How far policy and expert are apart: root mean square over the flown agents of ``|a - a*|``, m/s [*B]."""
    agents = tensordict["agents"]
    difference = (agents["action"] - agents["expert_action"]).square().sum(-1)
    return _root_mean(difference, agents["controlled"])


def ensemble_std(tensordict: TensorDictBase) -> Tensor:
    """How far the members of an `Ensemble` are apart: root mean square over the flown agents, m/s [*B]."""
    agents = tensordict["agents"]
    return _root_mean(agents["ensemble_std"].square(), agents["controlled"])


def _root_mean(values: Tensor, counted: Tensor) -> Tensor:
    """Root of the mean of [*B, N] over the agents that count, bool [*B, N]; 0 where none does."""
    return (torch.where(counted, values, 0.0).sum(-1) / counted.sum(-1).clamp(min=1)).sqrt()


class SafetyGate(TensorDictModuleBase):
    """Let the expert fly a flock as long as the policy strays there.

    With `disagreement` as measure this is the rule that SafeDAgger (Zhang and Cho 2017) learns to predict, here taken
    from the expert itself; with `ensemble_std`, which asks no expert, EnsembleDAgger (Menda et al. 2019).

    Args:
        measure: from the data of a step to how much each flock strays [*B].
        threshold: the expert flies above it.
        action: key of the action to be flown, overwritten [*B, N, 3].
        expert_action: key of the expert's action [*B, N, 3].
        expert_flies: key that tells who flew, bool [*B, 1]; where a `BetaMixture` stands before the gate, both count.
    """

    def __init__(
        self,
        measure: Callable[[TensorDictBase], Tensor],
        threshold: float,
        *,
        action: NestedKey = ("agents", "action"),
        expert_action: NestedKey = ("agents", "expert_action"),
        expert_flies: NestedKey = "expert_flies",
    ) -> None:
        super().__init__()
        self.measure, self.threshold = measure, threshold
        self.in_keys: list[Any] = [action, expert_action]
        self.out_keys: list[Any] = [action, expert_flies]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the action of each flock."""
        action, expert_action = (tensordict[key] for key in self.in_keys)
        strays = (self.measure(tensordict) > self.threshold).unsqueeze(-1)
        flies = tensordict.get(self.out_keys[1], None)
        tensordict.set(self.out_keys[0], torch.where(strays.unsqueeze(-1), expert_action, action))
        return tensordict.set(self.out_keys[1], strays if flies is None else flies | strays)


class ActionNoise(TensorDictModuleBase):
    """Noise in what is flown, so that the expert shows how it recovers (DART, Laskey et al. 2017).

    ``a + N(0, scale^2)`` in each component, at every step anew; labels are left as they are.

    Args:
        scale: standard deviation, m/s; may be set anew at any time. DART takes the root of the policy's mean squared
            error.
        generator: source of randomness.
        action: key of the action to be flown, overwritten [*B, N, 3].
    """

    def __init__(self, scale: float, generator: torch.Generator, *, action: NestedKey = ("agents", "action")) -> None:
        super().__init__()
        self.scale, self.generator = scale, generator
        self.in_keys: list[Any] = [action]
        self.out_keys: list[Any] = [action]

    def get_extra_state(self) -> dict[str, Any]:
        """What a copy in another process must hear of, as a part of the module's state."""
        return {"scale": self.scale}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Take over the scale."""
        self.scale = state["scale"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Disturb the action."""
        action = tensordict[self.in_keys[0]]
        if self.scale == 0:
            return tensordict
        generator = self.generator
        noise = torch.randn(action.shape, generator=generator, device=generator.device, dtype=action.dtype)
        return tensordict.set(self.out_keys[0], action + self.scale * noise.to(action.device))


class Ensemble(TensorDictModuleBase):
    """Several policies, of which the first flies; how far they are apart is written beside its action.

    Each keeps messages of its own. For single steps, not for windows.

    Args:
        members: the policies; they read and write the same keys.
        spread: key of the root mean square distance of the members' actions from their mean, m/s [*B, N].
    """

    def __init__(self, members: Sequence[ModGNN], *, ensemble_std: NestedKey = ("agents", "ensemble_std")) -> None:
        super().__init__()
        self.first = members[0]
        # Not registered: the first member's messages are the ones that an environment's primer is made for.
        self._others = tuple(members[1:])
        self._messages = [f"{self.first.messages_key}_{number}" for number in range(1, len(members))]
        self.in_keys: list[Any] = [*self.first.in_keys, *self._messages]
        self.out_keys: list[Any] = [*self.first.out_keys, *(("next", key) for key in self._messages), ensemble_std]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the first member's action and messages, the others' messages, and the spread."""
        key, messages = self.first.out_keys[0], self.first.messages_key
        given = tensordict.copy()
        actions = [self.first(tensordict)[key]]
        for member, own in zip(self._others, self._messages, strict=True):
            seen = given.copy()
            remembered = given.get(own, None)
            if remembered is not None:
                seen[messages] = remembered
            elif messages in seen:
                del seen[messages]
            result = member(seen)
            actions.append(result[key])
            tensordict.set(("next", own), result["next", messages])
        stacked = torch.stack(actions)
        distance = (stacked - stacked.mean(0)).square().sum(-1).mean(0).sqrt()
        return tensordict.set(self.out_keys[-1], distance)

    def get_extra_state(self) -> list[dict[str, Tensor]]:
        """The weights of the other members, as a part of the module's state."""
        return [member.state_dict() for member in self._others]

    def set_extra_state(self, state: list[dict[str, Tensor]]) -> None:
        """Take over the weights of the other members."""
        for member, weights in zip(self._others, state, strict=True):
            member.load_state_dict(weights)

    def make_tensordict_primer(self) -> RecurrentStatePrimer:
        """The transform that gives an environment the other members' messages; the first brings its own."""
        return RecurrentStatePrimer(self, self._messages, is_init=self.first.in_keys[2])
