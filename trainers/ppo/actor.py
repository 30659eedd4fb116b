"""A policy with exploration noise: its action is the mean of a normal distribution."""

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
from torch import nn
from torchrl.modules import IndependentNormal

__all__ = ["GaussianActor"]


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


class _Mean(TensorDictModuleBase):
    """Writes the policy's action as the mean of a distribution, and sigma beside it."""

    def __init__(
        self, policy: TensorDictModuleBase, noise: float, loc: NestedKey, scale: NestedKey, receivers: NestedKey
    ) -> None:
        super().__init__()
        self.policy = policy
        self.log_scale = nn.Parameter(torch.tensor(math.log(noise)))
        self.receivers = receivers
        self.in_keys: list[Any] = list(policy.in_keys)
        self.out_keys: list[Any] = [loc, scale, *policy.out_keys[1:]]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        receivers = tensordict.get(self.receivers, None)
        options = {} if receivers is None else {"receivers": receivers}
        result = self.policy(tensordict.copy(), **options)
        loc = result[self.policy.out_keys[0]]
        tensordict.set(self.out_keys[0], loc)
        tensordict.set(self.out_keys[1], self.log_scale.exp().expand_as(loc))
        for key in self.out_keys[2:]:
            tensordict.set(key, result[key])
        return tensordict
