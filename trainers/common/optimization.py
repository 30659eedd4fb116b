"""Optimiser steps that are guarded against NaN and infinity."""

from __future__ import annotations

import warnings

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from modgnn_rl.configs.schema import TrainerConfig
from modgnn_rl.errors import NotFinite
from modgnn_rl.trainers.common import distributed

__all__ = ["GuardedOptimizer", "describe_nonfinite"]

MAX_SKIPPED = 20  # consecutive updates that may be skipped


class GuardedOptimizer:
    """Clips gradients and takes optimiser steps; a loss or gradient that is NaN or infinite never reaches the weights.

    Args:
        module: the module that is trained.
        optimizer: the gradients of each of its parameter groups are clipped to ``settings.max_grad_norm``.
        settings: of the trainer; ``on_nonfinite`` says whether training stops or the update is skipped.

    Attributes:
        gradient_norm: of the last step, before clipping; the largest of the parameter groups.
    """

    def __init__(self, module: nn.Module, optimizer: torch.optim.Optimizer, settings: TrainerConfig) -> None:
        self.module, self.optimizer, self.settings = module, optimizer, settings
        self.gradient_norm = 0.0
        self._skipped = 0

    def step(self, update: int, loss: Tensor, batch: TensorDictBase, weight: Tensor) -> bool:
        """Take one step along the gradients of the parameters, averaged over processes in distributed training.

        Args:
            update: number of the update, for messages.
            loss: the loss whose gradients they are, [].
            batch: the data of that loss, for messages.
            weight: number of agents in the loss, by which processes are weighted, [].

        Returns:
            whether the step was taken.

        Raises:
            NotFinite: loss or gradient is NaN or infinite, and ``trainer.on_nonfinite`` is ``stop`` or too many updates
                in a row were skipped.
        """
        groups = [group["params"] for group in self.optimizer.param_groups]
        mean_loss = distributed.reduce_gradients([p for group in groups for p in group], loss, weight)
        norms = [nn.utils.get_total_norm([p.grad for p in group if p.grad is not None]) for group in groups]
        if not torch.stack([*norms, mean_loss]).isfinite().all():
            self._skip(update, describe_nonfinite(loss, batch, self.module))
            return False
        for group, norm in zip(groups, norms, strict=True):  # only now: clipping would spread NaN to all gradients
            nn.utils.clip_grads_with_norm_(group, self.settings.max_grad_norm, norm)
        self.gradient_norm = float(torch.stack(norms).max())
        self._skipped = 0
        self.optimizer.step()
        return True

    def _skip(self, update: int, reason: str) -> None:
        """Warn about an update that is skipped, or raise `NotFinite`."""
        self._skipped += 1
        reasons = distributed.texts(reason)
        # All processes have the gradient that is not finite, but only one has the data that are the cause.
        message = f"update {update} was not made {min(reasons, key=lambda text: 'gradient' in text)}"
        if self.settings.on_nonfinite == "stop":
            raise NotFinite(f"{message}; with trainer.on_nonfinite=skip training continues without such updates")
        if self._skipped >= MAX_SKIPPED:
            raise NotFinite(f"{message}, nor were the {MAX_SKIPPED - 1} before it; resume with smaller steps")
        if distributed.is_first():
            warnings.warn(f"{message}; training continues", RuntimeWarning, stacklevel=3)


def describe_nonfinite(loss: Tensor, batch: TensorDictBase, module: nn.Module) -> str:
    """Say what is NaN or infinite: an entry of the data, the loss, or the gradient of a parameter.

    Args:
        loss: [].
        batch: windows [S, W].
        module: the parameters with the gradients of the loss.
    """
    for key, value in batch["agents"].items():  # messages, which lie elsewhere, may be NaN for agents without any
        bad = ~value.isfinite()
        if bad.any():
            window, step, agent = bad.nonzero()[0, :3].tolist()
            found = float(value[window, step, agent].sum())
            where = f"agent {agent} at step {step} of window {window} of its data"
            return f"because ('agents', '{key}') of {where} is {found}"
    if not loss.isfinite().all():
        return (
            f"because its loss is {float(loss.detach())} although its data are finite: weights or learning rate are "
            "too large"
        )
    for name, parameter in module.named_parameters():
        if parameter.grad is not None and not parameter.grad.isfinite().all():
            return f"because the gradient of {name} is not finite"
    return "because its gradient is not finite"
