"""The learner: one policy, its optimiser over the whole run, and the moving average of its weights that flies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import ReplayBuffer

from modgnn_rl.configs.schema import REFERENCE_SIZE, ImitationConfig
from modgnn_rl.modgnn import ModGNN
from modgnn_rl.seeds import derive_seed
from modgnn_rl.trainers.imitation import imitation_loss, random_receivers, random_rotations, rotate

__all__ = ["Learner", "cosine_learning_rate"]


class Learner:
    """Fits a policy to labelled flights.

    Args:
        policy: the policy that is trained.
        settings: how it is trained.
        updates: updates until the first cosine of the learning rate ends, and of the whole run.
        seed: seeds receivers and rotations.
    """

    def __init__(self, policy: ModGNN, settings: ImitationConfig, updates: tuple[int, int], seed: int) -> None:
        self.policy = policy
        self.settings = settings
        self.averaged = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(settings.averaging))
        self.generator = torch.Generator().manual_seed(derive_seed(seed, "learner"))
        self.optimizer = torch.optim.Adam([{"params": list(policy.parameters())}], lr=1.0)
        self.scheduler = LambdaLR(
            self.optimizer, lambda step: cosine_learning_rate(step, settings.learning_rates, updates)
        )
        self.updates_done = 0

    @property
    def flown(self) -> ModGNN:
        """The moving average of the policy: it collects, is evaluated and is what a run ends with."""
        return cast(ModGNN, self.averaged.module)

    @property
    def learning_rate(self) -> float:
        """The learning rate of the next update."""
        return float(self.scheduler.get_last_lr()[0])

    def fit(self, buffer: ReplayBuffer, updates: int) -> float:
        """Take optimiser steps on batches of the buffer; returns their mean loss."""
        losses = []
        for _ in range(updates):
            loss = self._loss(self.policy, buffer.sample())
            self.optimizer.zero_grad()
            loss.backward()
            # The optimiser never steps on a gradient that is not finite.
            torch.nn.utils.clip_grad_norm_(
                self.policy.parameters(), self.settings.max_gradient, error_if_nonfinite=True
            )
            self.optimizer.step()
            self.scheduler.step()
            self.averaged.update_parameters(self.policy)
            losses.append(loss.detach())
        self.updates_done += updates
        return float(torch.stack(losses).mean()) if losses else math.nan

    @torch.no_grad()
    def validate(self, buffer: ReplayBuffer) -> float:
        """The loss of the averaged policy on a batch of held-out data."""
        return float(self._loss(self.flown, buffer.sample()))

    def _loss(self, policy: ModGNN, batch: TensorDictBase) -> Tensor:
        settings = self.settings
        if settings.rotate:
            rotations = random_rotations(len(batch), batch["agents", "observation"], self.generator)
            vectors: list[NestedKey] = [("agents", "observation"), ("agents", "expert_action")]
            # Messages are kept in the data only where they are sums of observations.
            vectors += [policy.messages_key] if policy.messages_key in batch else []
            for key in vectors:
                batch[key] = rotate(batch[key], rotations)
        controlled = batch["agents", "controlled"][:, -1]
        # At any size as many links as at 32 agents, so that an update takes as long.
        count = max(1, round(settings.receivers * REFERENCE_SIZE / controlled.shape[-1]))
        return imitation_loss(policy, batch, random_receivers(controlled, count, self.generator))

    def state(self) -> tuple[dict[str, dict[str, Tensor]], dict[str, Any]]:
        """What a checkpoint holds of the learner: named tensors, and plain values."""
        moments = self.optimizer.state_dict()["state"]
        optimizer = {f"{index}.{name}": value for index, entry in moments.items() for name, value in entry.items()}
        tensors = {
            "policy": self.flown.state_dict(),
            "trained": self.policy.state_dict(),
            "optimizer": optimizer,
        }
        averaged = int(self.averaged.n_averaged)
        return tensors, {"updates": self.updates_done, "averaged": averaged, "learning_rate": self.learning_rate}


def cosine_learning_rate(step: int, rates: Sequence[float], updates: tuple[int, int]) -> float:
    """Two half cosines: rates[0] to rates[1] over the first updates, then to rates[2] at the end of the run."""
    (start, middle, end), (first, total) = rates, updates
    if step < first:
        return _cosine(start, middle, step / first)
    return _cosine(middle, end, min(1.0, (step - first) / max(1, total - first)))


def _cosine(start: float, end: float, fraction: float) -> float:
    return end + 0.5 * (start - end) * (1 + math.cos(math.pi * fraction))
