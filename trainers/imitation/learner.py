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
from modgnn_rl.models.blocks import is_equivariant
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.collectors.windows import are_alike
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.optimization import GuardedOptimizer
from modgnn_rl.trainers.common.sampling import random_receivers
from modgnn_rl.trainers.common.state import TensorGroups, optimizer_state, restore_optimizer
from modgnn_rl.trainers.imitation.loss import hide_velocities, imitation_loss, random_rotations, rotate, stacked_losses
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["ImitationLearner", "cosine_learning_rate", "fit_together", "validate_together"]

STACKED_PAIRS = 2048  # up to this many pairs of agents in a batch, several seeds learn faster as one


class ImitationLearner:
    """Fits a policy to labelled rollouts.

    Args:
        policy: the policy that is trained.
        settings: how it is trained.
        updates: updates until the first cosine of the learning rate ends, and of the whole run.
        seed: seeds receivers, rotations and what is hidden.
    """

    def __init__(self, policy: ModGNN, settings: ImitationConfig, updates: tuple[int, int], seed: int) -> None:
        self.policy = policy
        self.settings = settings
        self.averaged = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(settings.ema_decay))
        self.generator = torch.Generator().manual_seed(derive_seed(seed, "learner"))
        self.validating = torch.Generator().manual_seed(derive_seed(seed, "learner", "validation"))
        self.optimizer = torch.optim.Adam([{"params": list(policy.parameters())}], lr=1.0)
        self.scheduler = LambdaLR(
            self.optimizer, lambda step: cosine_learning_rate(step, settings.learning_rates, updates)
        )
        self.guarded_optimizer = GuardedOptimizer(policy, self.optimizer, settings)
        self.turns = settings.rotate and not is_equivariant(policy)
        self.updates_done = 0

    @property
    def ema_policy(self) -> ModGNN:
        """The moving average of the policy: it collects, is evaluated and is what a run ends with."""
        return cast(ModGNN, self.averaged.module)

    @property
    def learning_rate(self) -> float:
        """The learning rate of the next update."""
        return float(self.scheduler.get_last_lr()[0])

    def fit(self, buffer: ReplayBuffer, updates: int) -> float:
        """Take optimiser steps on batches of the buffer; returns their mean loss."""
        return fit_together([self], buffer, updates)[0]

    def validate(self, buffer: ReplayBuffer) -> float:
        """The loss of the averaged policy on a batch of held-out data."""
        return validate_together([self], buffer)[0]

    def prepare(self, batch: TensorDictBase, generator: torch.Generator, *, turn: bool) -> Tensor:
        """Rotate and hide in a batch of windows [S, W], in place, and choose the agents that count, bool [S, N].

        Args:
            batch: the windows.
            generator: source of randomness.
            turn: whether to rotate.
        """
        settings = self.settings
        if turn:
            rotations = random_rotations(len(batch), batch["agents", "observation"], generator)
            vectors: list[NestedKey] = [("agents", "observation"), ("agents", "expert_action")]
            # Messages are kept in the data of such policies only where they are sums of observations.
            vectors += [self.policy.messages_key] if self.policy.messages_key in batch else []
            for key in vectors:
                batch[key] = rotate(batch[key], rotations)
        if settings.hide_velocity:
            hide_velocities(batch, settings.hide_velocity, generator)
        controlled = batch["agents", "controlled"][:, -1]
        # At any size as many links as at 32 agents, so that an update takes as long.
        count = max(1, round(settings.agents_per_state * REFERENCE_SIZE / controlled.shape[-1]))
        return random_receivers(controlled, count, generator)

    def step(self, loss: Tensor, batch: TensorDictBase, receivers: Tensor) -> None:
        """Take an optimiser step along the gradients that the weights hold, those of a loss on a batch.

        Args:
            loss: the mean over its receivers.
            batch: windows [S, W].
            receivers: the agents that count, bool [S, N].
        """
        self.updates_done += 1
        if self.guarded_optimizer.step(self.updates_done, loss, batch, receivers.sum()):
            self.scheduler.step()
            self.averaged.update_parameters(self.policy)

    @property
    def gradient_norm(self) -> float:
        """Norm of the last gradient, before it was clipped."""
        return self.guarded_optimizer.gradient_norm

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random here, by name."""
        return {"learner": self.generator, "validation": self.validating}

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """What a checkpoint holds of the learner: named tensors, and plain values."""
        tensors = {
            "policy": self.ema_policy.state_dict(),
            "trained": self.policy.state_dict(),
            "optimizer": optimizer_state(self.optimizer),
        }
        averaged, scheduled = int(self.averaged.n_averaged), self.scheduler.last_epoch
        return tensors, {"updates": self.updates_done, "averaged": averaged, "scheduled": scheduled}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Go on from what `state` gave; the learning rate is that of the run as it is planned now.

        Raises:
            KeyError, RuntimeError: it is that of another policy.
        """
        self.policy.load_state_dict(tensors["trained"])
        self.ema_policy.load_state_dict(tensors["policy"])
        self.averaged.n_averaged.fill_(values["averaged"])
        restore_optimizer(self.optimizer, tensors["optimizer"])
        self.updates_done = int(values["updates"])
        self.scheduler.last_epoch = int(values["scheduled"])
        rate = self.optimizer.param_groups[0]["lr"] = self.scheduler.lr_lambdas[0](self.scheduler.last_epoch)
        self.scheduler._last_lr = [rate]


def fit_together(learners: Sequence[ImitationLearner], buffer: ReplayBuffer, updates: int) -> list[float]:
    """Let learners take optimiser steps on the same batches, with the same rotations and agents that count.

    The data are read once. Of several learners the first draws. Seeds of one model are computed at once where the
    batch is so small that this is faster; the steps are the same within rounding.

    Args:
        learners: they share settings, and need the same keys of the data, whose windows are as long as any needs.
        buffer: windows [S, W].
        updates: number of steps.

    Returns:
        the mean loss of each.
    """
    first, policies = learners[0], [learner.policy for learner in learners]
    turn = any(learner.turns for learner in learners)
    alike = len(learners) > 1 and are_alike(policies)
    records = []
    for _ in range(updates):
        batch = buffer.sample()
        receivers = first.prepare(batch, first.generator, turn=turn)
        for learner in learners:
            learner.optimizer.zero_grad()
        if alike and batch["agents", "controlled"].numel() * receivers.shape[-1] <= STACKED_PAIRS:
            losses = stacked_losses(policies, batch, receivers)
        else:
            losses = [imitation_loss(policy, batch, receivers) for policy in policies]
            for loss in losses:
                loss.backward()
        for learner, loss in zip(learners, losses, strict=True):
            learner.step(loss, batch, receivers)
        records.append(torch.stack([loss.detach() for loss in losses]))
    return torch.stack(records).nanmean(0).tolist() if records else [math.nan] * len(learners)


@torch.no_grad()
def validate_together(learners: Sequence[ImitationLearner], buffer: ReplayBuffer) -> list[float]:
    """The loss of the averaged policy of each learner, on one batch of held-out data of each process."""
    batch = buffer.sample()
    first = learners[0]
    receivers = first.prepare(batch, first.validating, turn=any(learner.turns for learner in learners))
    losses = [float(imitation_loss(learner.ema_policy, batch, receivers)) for learner in learners]
    return list(distributed.mean(dict(enumerate(losses))).values())


def cosine_learning_rate(step: int, rates: Sequence[float], updates: tuple[int, int]) -> float:
    """Two half cosines: rates[0] to rates[1] over the first updates, then to rates[2] at the end of the run."""
    (start, middle, end), (first, total) = rates, updates
    if step < first:
        return _cosine(start, middle, step / first)
    return _cosine(middle, end, min(1.0, (step - first) / max(1, total - first)))


def _cosine(start: float, end: float, fraction: float) -> float:
    return end + 0.5 * (start - end) * (1 + math.cos(math.pi * fraction))
