"""The loss of MAPPO with a KL penalty towards a reference policy."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Categorical, kl_divergence
from torchrl.modules import PopArtValueNorm
from torchrl.objectives import MAPPOLoss

from modgnn_rl.trainers.common import distributed

__all__ = ["REFERENCE_ACTION", "KLPenaltyMAPPOLoss", "SharedValueNorm"]

REFERENCE_ACTION = ("agents", "reference_action")
MASK = ("collector", "mask")  # which entries of the data count, in TorchRL's losses too


class KLPenaltyMAPPOLoss(MAPPOLoss):
    """TorchRL's `MAPPOLoss` with a penalty for the divergence from a reference policy.

    Where the data have the reference policy's actions ``a_ref``, the result also has ``loss_kl``: `kl_coef` times
    the Kullback-Leibler divergence, ``|mu - a_ref|^2 / (2 sigma^2)`` of two normal distributions of equal sigma.

    Args:
        arguments, options: see `torchrl.objectives.multiagent.MAPPOLoss`. The last but one module of the actor's
            sequence writes the parameters of its distribution.
        reference_action: key of the reference policy's actions [*B, N, A].
        kl_coef: weight of the penalty; the attribute may be changed at any time.
    """

    def __init__(
        self, *arguments: Any, reference_action: Any = REFERENCE_ACTION, kl_coef: float = 0.0, **options: Any
    ) -> None:
        super().__init__(*arguments, **options)
        self.reference_action_key, self.kl_coef = reference_action, kl_coef

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute all losses, see `MAPPOLoss`; unlike there, ``kl_approx`` and ``clip_fraction`` respect the mask."""
        # The distribution that the loss computes is needed here too, and a second forward pass would double the time.
        outputs: list[TensorDictBase] = []
        parameters = self.actor_network[-2]
        with parameters.register_forward_hook(lambda module, inputs, output: outputs.append(output)):
            losses = super().forward(tensordict)
        dist = self.actor_network.build_dist_from_params(outputs[0])
        mask = tensordict.get(MASK, None)
        reference = tensordict.get(self.reference_action_key, None)
        if reference is not None:
            divergence = divergence_from(dist, reference).unsqueeze(-1)
            losses.set("loss_kl", self.kl_coef * masked_mean(divergence, mask))
        with torch.no_grad():
            action, before = (tensordict[key] for key in (self.tensor_keys.action, self.tensor_keys.sample_log_prob))
            log_ratio = (dist.log_prob(action) - before).unsqueeze(-1)
            low, high = (-self.clip_epsilon).log1p(), self.clip_epsilon.log1p()
            clipped = ((log_ratio < low) | (log_ratio > high)).to(log_ratio.dtype)
            losses.set("kl_approx", masked_mean(log_ratio.exp() - 1 - log_ratio, mask))
            losses.set("clip_fraction", masked_mean(clipped, mask))
        return losses


def divergence_from(dist: Any, reference: Tensor) -> Tensor:
    """Kullback-Leibler divergence from a reference policy, [*B, N].

    Args:
        dist: distribution of the actions: normal, or categorical, which has logits.
        reference: actions of the reference policy [*B, N, A]: mean of a normal distribution of equal sigma, or logits.
    """
    if hasattr(dist, "logits"):
        return kl_divergence(Categorical(logits=dist.logits), Categorical(logits=reference))
    return ((dist.mean - reference) / dist.stddev).square().sum(-1) / 2


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """The mean of values [*B] where a mask, bool [*B], is true; of all values without a mask."""
    if mask is None:
        return values.mean()
    # Entries that are masked out may be NaN, so they are not multiplied by zero.
    return torch.where(mask, values, torch.zeros_like(values)).sum() / mask.sum().clamp_min(1)


class SharedValueNorm(PopArtValueNorm):
    """TorchRL's `PopArtValueNorm` over the batches of all processes in distributed training, equally large each."""

    def update(self, value_target: Tensor) -> None:
        """Update the running moments with a batch of value targets [*B, 1] of each process."""
        super().update(value_target)
        distributed.average(self.running_mean, self.running_mean_sq)
