"""Optimiser steps that are never taken along a gradient that is no number."""

from __future__ import annotations

import warnings

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from modgnn_rl.configs.schema import TrainerConfig
from modgnn_rl.errors import NotFinite
from modgnn_rl.trainers.common import distributed

__all__ = ["GuardedOptimizer", "describe_nonfinite"]

PATIENCE = 20  # updates in a row that may be left out


class GuardedOptimizer:
    """Clips gradients and steps along them; what is not finite stops the training or is left out.

    Args:
        module: its parameters are what the optimiser moves.
        optimizer: the gradients of each of its groups are clipped to ``settings.max_grad_norm``.
        settings: of the trainer.

    Attributes:
        gradient_norm: of the last step, before it was clipped; the largest of the groups.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer, settings: TrainerConfig) -> None:
        self.module, self.optimizer, self.settings = module, optimizer, settings
        self.gradient_norm = 0.0
        self._in_a_row = 0

    def step(self, update: int, loss: Tensor, batch: TensorDictBase, weight: Tensor) -> bool:
        """Take one step along the gradients that the parameters hold, or their mean where several processes train.

        Args:
            update: its number, for messages.
            loss: that they are the gradients of.
            batch: that it is the loss on.
            weight: agents that count in it, [].

        Returns:
            whether it was taken.

        Raises:
            NotFinite: loss or gradient is not finite, and ``trainer.on_nonfinite`` is ``stop``, or too many were.
        """
        groups = [group["params"] for group in self.optimizer.param_groups]
        mean_loss = distributed.reduce_gradients([p for group in groups for p in group], loss, weight)
        norms = [nn.utils.get_total_norm([p.grad for p in group if p.grad is not None]) for group in groups]
        if torch.stack([*norms, mean_loss]).isfinite().all():
            for group, norm in zip(groups, norms, strict=True):  # not before: it would spread what is not finite
                nn.utils.clip_grads_with_norm_(group, self.settings.max_grad_norm, norm)
            self.gradient_norm = float(torch.stack(norms).max())
            self._in_a_row = 0
            self.optimizer.step()
            return True
        self._in_a_row += 1
        found = distributed.texts(describe_nonfinite(loss, batch, self.module))
        # After the reduction all have the gradient that is not finite, only one has the data.
        reason = f"update {update} was not made, {min(found, key=lambda text: 'gradient' in text)}"
        if self.settings.on_nonfinite == "stop":
            raise NotFinite(f"{reason}; trainer.on_nonfinite=skip goes on without such updates")
        if self._in_a_row >= PATIENCE:
            raise NotFinite(f"{reason}, nor were the {PATIENCE - 1} before it; resume with smaller steps")
        if distributed.is_first():
            warnings.warn(f"{reason}; training goes on", RuntimeWarning, stacklevel=2)
        return False


def describe_nonfinite(loss: Tensor, batch: TensorDictBase, module: nn.Module) -> str:
    """Say what it is that is not finite: an entry of the data, the loss, or the gradient of a parameter."""
    for key, value in batch["agents"].items():  # messages elsewhere may be NaN: those that nobody holds
        bad = ~value.isfinite()
        if bad.any():
            window, step, agent = bad.nonzero()[0, :3].tolist()
            found = float(value[window, step, agent].sum())
            return (
                f"since ('agents', '{key}') of agent {agent} at step {step} of window {window} of its data is {found}"
            )
    if not loss.isfinite().all():
        return (
            f"since its loss is {float(loss.detach())} on data that are finite: weights or learning rate are too large"
        )
    for name, parameter in module.named_parameters():
        if parameter.grad is not None and not parameter.grad.isfinite().all():
            return f"since the gradient of {name} is not finite"
    return "since its gradient is not finite"
