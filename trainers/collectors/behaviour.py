"""Behaviour policies of imitation learning: modules that choose between the actions of policy and expert.

In a sequence ``policy, expert, BetaMixture, SafetyGate, ActionNoise`` the policy always updates its messages, the
expert labels every state, and the last modules choose the action that is executed.
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
from modgnn_rl.task import ACTION, EXPERT_ACTION

__all__ = ["ActionNoise", "BetaMixture", "Ensemble", "SafetyGate", "beta_schedule", "disagreement", "ensemble_std"]


def beta_schedule(schedule: str, round_index: int, *, start: float, decay: float, last_round: int) -> float:
    """DAgger's beta, the probability that the expert acts, in one round; 0 from ``last_round`` on.

    Args:
        schedule: ``constant`` (start), ``linear`` (start (1 - k / last_round)) or ``exponential`` (start decay^k).
        round_index: the round k, counted from 0.
        start: beta in round 0.
        decay: factor between rounds of the exponential schedule.
        last_round: first round in which only the policy acts.

    Raises:
        InputError: unknown schedule.
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
    """DAgger's behaviour policy: in each environment the expert acts with probability beta, otherwise the policy.

    It follows the policy and the expert in a sequence and replaces the policy's action by the expert's. The choice
    holds for all agents of an environment and for ``hold_steps`` steps.

    Args:
        beta: probability that the expert acts; may be changed at any time, and applies from the next choice on.
        hold_steps: steps between two choices.
        generator: source of randomness.
        action: key of the policy's action, overwritten [*B, N, A].
        expert_action: key of the expert's action [*B, N, A].
        expert_acts: key that tells where the expert acts, bool [*B, 1].
    """

    seed_role = "mixture"

    def __init__(
        self,
        beta: float,
        hold_steps: int,
        generator: torch.Generator,
        *,
        action: NestedKey = ACTION,
        expert_action: NestedKey = EXPERT_ACTION,
        expert_acts: NestedKey = "expert_acts",
    ) -> None:
        super().__init__()
        self.beta = beta
        self.hold_steps = hold_steps
        self.generator = generator
        self.in_keys: list[Any] = [action, expert_action]
        self.out_keys: list[Any] = [action, expert_acts]
        self._steps = 0
        self._restarts = 0
        self._expert_acts: Tensor | None = None

    def restart(self) -> None:
        """Choose again at the next step."""
        self._expert_acts = None
        self._restarts += 1

    def state(self) -> dict[str, Tensor]:
        """The current choice and the number of steps since, as named tensors."""
        choice = {} if self._expert_acts is None else {"expert_acts": self._expert_acts}
        return {"steps": torch.tensor(self._steps), **choice}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Resume from the result of `state`; the caller restores the generator."""
        choice = state.get("expert_acts")
        self._steps = int(state["steps"])
        self._expert_acts = None if choice is None else choice.to(self.generator.device)

    def get_extra_state(self) -> dict[str, Any]:
        """Beta and the number of restarts, which copies in other processes receive with the weights."""
        return {"beta": self.beta, "restarts": self._restarts}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Set beta, and restart if the original did."""
        self.beta = state["beta"]
        if state["restarts"] != self._restarts:
            self.restart()
            self._restarts = state["restarts"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the action in each environment."""
        action, expert_action = (tensordict[key] for key in self.in_keys)
        if self._expert_acts is None or self._steps % self.hold_steps == 0:
            chance = torch.rand(tensordict.batch_size, generator=self.generator, device=self.generator.device)
            self._expert_acts, self._steps = (chance < self.beta).unsqueeze(-1).to(action.device), 0
        self._steps += 1
        chosen = torch.where(_over(self._expert_acts, action), expert_action, action)
        return tensordict.set(self.out_keys[0], chosen).set(self.out_keys[1], self._expert_acts.clone())


def _over(chosen: Tensor, action: Tensor) -> Tensor:
    """A choice for each environment [*B, 1], shaped to broadcast with actions [*B, N] or [*B, N, A]."""
    return chosen.view(*chosen.shape, *[1] * (action.ndim - chosen.ndim))


def disagreement(tensordict: TensorDictBase) -> Tensor:
    """Distance between policy and expert: root mean square of ``|a - a*|`` over the controlled agents [*B]."""
    difference = (tensordict[ACTION] - tensordict[EXPERT_ACTION]).square().sum(-1)
    return _root_mean(difference, tensordict.get(("agents", "controlled"), None))


def ensemble_std(tensordict: TensorDictBase) -> Tensor:
    """Standard deviation between the members of an `Ensemble`: root mean square over controlled agents [*B]."""
    controlled = tensordict.get(("agents", "controlled"), None)
    return _root_mean(tensordict["agents", "ensemble_std"].square(), controlled)


def _root_mean(values: Tensor, counted: Tensor | None) -> Tensor:
    """Square root of the mean of [*B, N] over the counted agents, bool [*B, N]; 0 if there are none; default: all."""
    if counted is None:
        return values.mean(-1).sqrt()
    return (torch.where(counted, values, 0.0).sum(-1) / counted.sum(-1).clamp(min=1)).sqrt()


class SafetyGate(TensorDictModuleBase):
    """Lets the expert act in each environment in which a measure of the policy's error exceeds a threshold.

    With `disagreement` as measure this is the rule that SafeDAgger (Zhang and Cho 2017) learns to predict, here
    computed from the expert itself; with `ensemble_std`, which needs no expert, EnsembleDAgger (Menda et al. 2019).

    Args:
        measure: maps the data of a step to the error in each environment [*B].
        threshold: the expert acts above it.
        action: key of the action to be executed, overwritten [*B, N, A].
        expert_action: key of the expert's action [*B, N, A].
        expert_acts: key that tells where the expert acts, bool [*B, 1]: due to the gate or a `BetaMixture` before it.
    """

    def __init__(
        self,
        measure: Callable[[TensorDictBase], Tensor],
        threshold: float,
        *,
        action: NestedKey = ACTION,
        expert_action: NestedKey = EXPERT_ACTION,
        expert_acts: NestedKey = "expert_acts",
    ) -> None:
        super().__init__()
        self.measure, self.threshold = measure, threshold
        self.in_keys: list[Any] = [action, expert_action]
        self.out_keys: list[Any] = [action, expert_acts]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Choose the action in each environment."""
        action, expert_action = (tensordict[key] for key in self.in_keys)
        is_above = (self.measure(tensordict) > self.threshold).unsqueeze(-1)
        acts = tensordict.get(self.out_keys[1], None)
        tensordict.set(self.out_keys[0], torch.where(_over(is_above, action), expert_action, action))
        return tensordict.set(self.out_keys[1], is_above if acts is None else acts | is_above)


class ActionNoise(TensorDictModuleBase):
    """Adds noise to the executed action, so that the data show how the expert recovers (DART, Laskey et al. 2017).

    ``a + N(0, scale^2)`` in each component, independent in each step; labels do not change.

    Args:
        scale: standard deviation, in the unit of the action; may be changed at any time. DART uses the root of the
            policy's mean squared error.
        generator: source of randomness.
        action: key of the action to be executed, overwritten [*B, N, A].
    """

    seed_role = "disturbance"

    def __init__(self, scale: float, generator: torch.Generator, *, action: NestedKey = ACTION) -> None:
        super().__init__()
        self.scale, self.generator = scale, generator
        self.in_keys: list[Any] = [action]
        self.out_keys: list[Any] = [action]

    def get_extra_state(self) -> dict[str, Any]:
        """The scale, which copies in other processes receive with the weights."""
        return {"scale": self.scale}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Set the scale."""
        self.scale = state["scale"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Add noise to the action."""
        action = tensordict[self.in_keys[0]]
        if self.scale == 0:
            return tensordict
        generator = self.generator
        noise = torch.randn(action.shape, generator=generator, device=generator.device, dtype=action.dtype)
        return tensordict.set(self.out_keys[0], action + self.scale * noise.to(action.device))


class Ensemble(TensorDictModuleBase):
    """Several policies: the first acts, and the standard deviation of all their actions is written beside its action.

    Each has its own messages. For single steps, not for windows.

    Args:
        members: the policies; they read and write the same keys.
        ensemble_std: key of the root mean square distance of the members' actions from their mean [*B, N].
    """

    def __init__(self, members: Sequence[ModGNN], *, ensemble_std: NestedKey = ("agents", "ensemble_std")) -> None:
        super().__init__()
        self.first = members[0]
        # Not registered as submodules, so that TorchRL creates a primer for the first member's messages only.
        self._others = tuple(members[1:])
        self._messages = [f"{self.first.messages_key}_{number}" for number in range(1, len(members))]
        self.in_keys: list[Any] = [*self.first.in_keys, *self._messages]
        self.out_keys: list[Any] = [*self.first.out_keys, *(("next", key) for key in self._messages), ensemble_std]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the first member's action and messages, the others' messages, and the standard deviation."""
        key, messages = self.first.out_keys[0], self.first.messages_key
        given = tensordict.copy()
        actions = [self.first(tensordict)[key]]
        for member, own in zip(self._others, self._messages, strict=True):
            inputs = given.copy()
            received = given.get(own, None)
            if received is not None:
                inputs[messages] = received
            elif messages in inputs:
                del inputs[messages]
            result = member(inputs)
            actions.append(result[key])
            tensordict.set(("next", own), result["next", messages])
        stacked = torch.stack(actions)
        distance = (stacked - stacked.mean(0)).square().sum(-1).mean(0).sqrt()
        return tensordict.set(self.out_keys[-1], distance)

    def get_extra_state(self) -> list[dict[str, Tensor]]:
        """The weights of the other members, which copies in other processes receive, too."""
        return [member.state_dict() for member in self._others]

    def set_extra_state(self, state: list[dict[str, Tensor]]) -> None:
        """Set the weights of the other members."""
        for member, weights in zip(self._others, state, strict=True):
            member.load_state_dict(weights)

    def make_tensordict_primer(self) -> RecurrentStatePrimer:
        """The transform that adds the other members' messages to an environment; the first member has its own."""
        return RecurrentStatePrimer(self, self._messages, is_init=self.first.in_keys[2])
