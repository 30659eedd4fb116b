"""Policies that explore: actions sampled from a normal distribution, or from a categorical one."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, OneHotCategorical

from modgnn_rl.actions import ActionSpace, Discrete

__all__ = ["CategoricalActor", "GaussianActor", "make_actor"]


class GaussianActor(ProbabilisticTensorDictSequential):
    """Samples actions around those of a policy: ``a ~ N(policy(o), sigma^2)`` in each component.

    Samples are not clipped: the environment does that, so that collection and loss agree on their probability. Sigma is
    learned, and the same for all agents. With ``set_exploration_type(DETERMINISTIC)`` it acts like the policy.

    Args:
        policy: writes its action under its first out-key; not copied.
        noise: initial sigma, in the unit of the action (m/s).
        loc, scale, log_prob: keys for mean and sigma [*B, N, A] and the log-probability of the action [*B, N].
        receivers: key of the agents whose action counts, bool [*B, N]. If the data have it, the mean of the others is
            not computed (the policy is called with ``receivers=``) and is zero.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        noise: float = 0.3,
        *,
        loc: NestedKey = ("agents", "loc"),
        scale: NestedKey = ("agents", "scale"),
        log_prob: NestedKey = ("agents", "action_log_prob"),
        receivers: NestedKey = ("agents", "receivers"),
    ) -> None:
        mean = _Mean(policy, noise, loc, scale, receivers)
        sample = ProbabilisticTensorDictModule(
            in_keys={"loc": loc, "scale": scale},
            out_keys=[policy.out_keys[0]],
            distribution_class=IndependentNormal,
            return_log_prob=True,
            log_prob_key=log_prob,
            default_interaction_type=InteractionType.RANDOM,
        )
        super().__init__(mean, sample)

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy whose action is the mean."""
        return self.module[0].policy

    @property
    def noise(self) -> float:
        """The current sigma."""
        return float(self.module[0].log_scale.detach().exp())


class _Output(TensorDictModuleBase):
    """Writes a policy's action under another key."""

    def __init__(self, policy: TensorDictModuleBase, output: NestedKey, receivers: NestedKey) -> None:
        super().__init__()
        self.policy, self.receivers = policy, receivers
        self.in_keys: list[Any] = list(policy.in_keys)
        self.out_keys: list[Any] = [output, *policy.out_keys[1:]]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        receivers = tensordict.get(self.receivers, None)
        options = {} if receivers is None else {"receivers": receivers}
        result = self.policy(tensordict.copy(), **options)
        tensordict.set(self.out_keys[0], result[self.policy.out_keys[0]])
        for key in self.policy.out_keys[1:]:
            tensordict.set(key, result[key])
        return tensordict


class _Mean(_Output):
    """Writes the policy's action as the mean of a distribution, and sigma beside it."""

    def __init__(
        self, policy: TensorDictModuleBase, noise: float, loc: NestedKey, scale: NestedKey, receivers: NestedKey
    ) -> None:
        super().__init__(policy, loc, receivers)
        self.log_scale = nn.Parameter(torch.tensor(math.log(noise)))
        self.out_keys = [loc, scale, *policy.out_keys[1:]]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = super().forward(tensordict)
        return tensordict.set(self.out_keys[1], self.log_scale.exp().expand_as(tensordict[self.out_keys[0]]))


class CategoricalActor(ProbabilisticTensorDictSequential):
    """Samples one of several actions, with the policy's output as the logits of their probabilities.

    The sample is one-hot. With ``set_exploration_type(DETERMINISTIC)`` it acts like the policy.

    Args:
        policy: writes scores under its first out-key; not copied.
        logits, log_prob: keys of the scores [*B, N, A] and of the log-probability of the action [*B, N].
        receivers: see `GaussianActor`.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        *,
        logits: NestedKey = ("agents", "logits"),
        log_prob: NestedKey = ("agents", "action_log_prob"),
        receivers: NestedKey = ("agents", "receivers"),
    ) -> None:
        sample = ProbabilisticTensorDictModule(
            in_keys={"logits": logits},
            out_keys=[policy.out_keys[0]],
            distribution_class=_OneHot,
            return_log_prob=True,
            log_prob_key=log_prob,
            default_interaction_type=InteractionType.RANDOM,
        )
        super().__init__(_Output(policy, logits, receivers), sample)

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy whose output are the logits."""
        return self.module[0].policy


class _OneHot(OneHotCategorical):
    """TorchRL's distribution with samples of the type of the logits, as policies write them."""

    def sample(self, *arguments: Any, **options: Any) -> Tensor:
        return super().sample(*arguments, **options).to(self.logits.dtype)

    @property
    def deterministic_sample(self) -> Tensor:
        return super().deterministic_sample.to(self.logits.dtype)


def make_actor(policy: TensorDictModuleBase, actions: ActionSpace, noise: float) -> GaussianActor | CategoricalActor:
    """The actor for a kind of actions; ``noise`` is the initial standard deviation of continuous ones."""
    return CategoricalActor(policy) if isinstance(actions, Discrete) else GaussianActor(policy, noise)
