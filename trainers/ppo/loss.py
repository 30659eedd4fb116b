"""The loss of MAPPO with a KL penalty towards the initial policy."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import PopArtValueNorm
from torchrl.objectives import MAPPOLoss

from modgnn_rl.trainers.common import distributed

__all__ = ["ANCHOR", "KLPenaltyMAPPOLoss", "SharedValueNorm"]

ANCHOR = ("agents", "anchor")


class KLPenaltyMAPPOLoss(MAPPOLoss):
    """TorchRL's `MAPPOLoss` with a pull towards the actions of another policy.

    Where the data have its actions under ``anchor`` [*B, N, A], the result has also ``loss_anchor``: ``anchor_coeff``
    times the Kullback-Leibler divergence ``|mu - anchor|^2 / (2 sigma^2)`` of two normal distributions of one width.

    Args:
        anchor: key of the other policy's actions.
        anchor_coeff: weight of the pull; an attribute, which may be changed at any time.
        arguments, options: see `torchrl.objectives.multiagent.MAPPOLoss`.
    """

    def __init__(self, *arguments: Any, anchor: Any = ANCHOR, anchor_coeff: float = 0.0, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.anchor_key, self.anchor_coeff = anchor, anchor_coeff
        self._dist: Any = None

    def _get_cur_log_prob(self, tensordict: TensorDictBase, params: Any = None) -> Any:
        found = super()._get_cur_log_prob(tensordict, params)
        self._dist = found[1]
        return found

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute all losses, see `MAPPOLoss`; unlike there, ``kl_approx`` and ``clip_fraction`` heed the mask."""
        losses = super().forward(tensordict)
        dist, self._dist = self._dist, None
        anchor = tensordict.get(self.anchor_key, None)
        if anchor is not None:
            divergence = ((dist.mean - anchor) / dist.stddev).square().sum(-1, keepdim=True) / 2
            losses.set("loss_anchor", self.anchor_coeff * self._reduce_loss(divergence, tensordict))
        with torch.no_grad():
            action, before = (tensordict[key] for key in (self.tensor_keys.action, self.tensor_keys.sample_log_prob))
            ratio = (dist.log_prob(action) - before).unsqueeze(-1)
            low, high = self._clip_bounds
            clipped = ((ratio < low) | (ratio > high)).to(ratio.dtype)
            losses.set("kl_approx", self._reduce_loss(ratio.exp() - 1 - ratio, tensordict))
            losses.set("clip_fraction", self._reduce_loss(clipped, tensordict))
        return losses


class SharedValueNorm(PopArtValueNorm):
    """TorchRL's `PopArtValueNorm` over the batches of all processes, which are equally large."""

    def update(self, value_target: Tensor) -> None:
        """Fold in a batch of value targets [*B, 1] of each process."""
        super().update(value_target)
        distributed.average(self.running_mean, self.running_mean_sq)
