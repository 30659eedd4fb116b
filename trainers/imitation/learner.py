"""The learner of imitation: one policy, its optimiser, and the moving average of its weights."""

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

from modgnn_rl.configs.schema import ImitationConfig
from modgnn_rl.models.blocks import is_equivariant
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.task import EXPERT_ACTION, OBSERVATION, Task
from modgnn_rl.trainers.collectors.windows import have_same_architecture
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.optimization import GuardedOptimizer
from modgnn_rl.trainers.common.sampling import random_receivers, receivers_per_state
from modgnn_rl.trainers.common.state import TensorGroups, optimizer_state, restore_optimizer
from modgnn_rl.trainers.imitation.loss import hide_velocities, imitation_loss, random_rotations, rotate, stacked_losses
from modgnn_rl.utils.seeds import derive_seed

__all__ = ["ImitationLearner", "cosine_learning_rate", "fit_together", "validate_together"]

MAX_STACKED_PAIRS = 2048  # pairs of agents in a batch up to which several seeds train faster stacked into one


class ImitationLearner:
    """Fits a policy to rollouts with expert labels.

    Args:
        policy: the policy to train.
        task: says what observations and actions are.
        settings: how.
        updates: updates until the first cosine of the learning rate ends, and of the whole run.
        seed: seeds the choice of agents and the augmentations.

    Attributes:
        updates_done: number of optimiser steps so far, skipped ones included.
    """

    def __init__(
        self, policy: ModGNN, task: Task, settings: ImitationConfig, updates: tuple[int, int], seed: int
    ) -> None:
        self.policy, self.task, self.settings = policy, task, settings
        self.averaged = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(settings.ema_decay))
        self.generator = torch.Generator().manual_seed(derive_seed(seed, "learner"))
        self.validation_generator = torch.Generator().manual_seed(derive_seed(seed, "learner", "validation"))
        self.optimizer = torch.optim.Adam([{"params": list(policy.parameters())}], lr=1.0)
        self.scheduler = LambdaLR(
            self.optimizer, lambda step: cosine_learning_rate(step, settings.learning_rates, updates)
        )
        self.guarded_optimizer = GuardedOptimizer(policy, self.optimizer, settings)
        self.rotates = settings.rotate and task.can_rotate and not is_equivariant(policy)
        self.updates_done = 0

    @property
    def ema_policy(self) -> ModGNN:
        """The policy with the moving average of the weights, which acts and is evaluated."""
        return cast(ModGNN, self.averaged.module)

    @property
    def learning_rate(self) -> float:
        """The learning rate of the next update."""
        return float(self.optimizer.param_groups[0]["lr"])

    @property
    def gradient_norm(self) -> float:
        """Norm of the last gradient, before clipping."""
        return self.guarded_optimizer.gradient_norm

    def fit(self, buffer: ReplayBuffer, updates: int) -> float:
        """Take optimiser steps on batches of the buffer; returns their mean loss."""
        return fit_together([self], buffer, updates)[0]

    def validate(self, buffer: ReplayBuffer) -> float:
        """The loss of the averaged policy on one batch of validation data."""
        return validate_together([self], buffer)[0]

    def prepare(self, batch: TensorDictBase, generator: torch.Generator, *, with_rotation: bool) -> Tensor:
        """Augment a batch in place and choose the agents that count.

        Args:
            batch: windows [S, W].
            generator: source of randomness.
            with_rotation: whether to rotate each window at random.

        Returns:
            the receivers, bool [S, N].
        """
        settings = self.settings
        if with_rotation:
            rotations = random_rotations(len(batch), self.task.layout, batch[OBSERVATION], generator)
            vectors: list[NestedKey] = [OBSERVATION, EXPERT_ACTION]
            # Messages of policies that need rotations are in the data only if they are sums of observations.
            vectors += [self.policy.messages_key] if self.policy.messages_key in batch else []
            for key in vectors:
                batch[key] = rotate(batch[key], rotations, self.task.layout.vectors if key != EXPERT_ACTION else 1)
        if settings.hide_velocity:
            hide_velocities(batch, self.task.layout, settings.hide_velocity, generator)
        controlled = batch["agents", "controlled"][:, -1]
        count = receivers_per_state(settings, self.task.config.reference_size, controlled.shape[-1])
        return random_receivers(controlled, count, generator)

    def step(self, loss: Tensor, batch: TensorDictBase, receivers: Tensor) -> None:
        """Take an optimiser step along the gradients of the weights.

        Args:
            loss: the loss whose gradients they are, the mean over its receivers, [].
            batch: windows [S, W].
            receivers: the agents that count, bool [S, N].
        """
        self.updates_done += 1
        if self.guarded_optimizer.step(self.updates_done, loss, batch, receivers.sum()):
            self.scheduler.step()
            self.averaged.update_parameters(self.policy)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random number generators, by name."""
        return {"learner": self.generator, "validation": self.validation_generator}

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The state for a checkpoint: named tensors, and plain values."""
        tensors = {
            "policy": self.ema_policy.state_dict(),
            "trained": self.policy.state_dict(),
            "optimizer": optimizer_state(self.optimizer),
        }
        averaged, scheduled = int(self.averaged.n_averaged), self.scheduler.last_epoch
        return tensors, {"updates": self.updates_done, "averaged": averaged, "scheduled": scheduled}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Return to what `state` returned; the learning rate is that of the run as it is planned now.

        Raises:
            KeyError, RuntimeError: the state is that of another policy.
        """
        self.policy.load_state_dict(tensors["trained"])
        self.ema_policy.load_state_dict(tensors["policy"])
        self.averaged.n_averaged.fill_(values["averaged"])
        restore_optimizer(self.optimizer, tensors["optimizer"])
        self.updates_done = int(values["updates"])
        self.scheduler.last_epoch = int(values["scheduled"])
        self.optimizer.param_groups[0]["lr"] = self.scheduler.lr_lambdas[0](self.scheduler.last_epoch)


def fit_together(learners: Sequence[ImitationLearner], buffer: ReplayBuffer, updates: int) -> list[float]:
    """Let several learners take optimiser steps on the same batches, augmentations and agents.

    The data are read once. All random numbers come from the first learner. Seeds of one model are computed stacked
    where the batch is so small that this is faster; the steps are the same up to rounding.

    Args:
        learners: they have the same settings and need the same keys of the data.
        buffer: windows [S, W], as long as any of the policies needs.
        updates: number of steps.

    Returns:
        the mean loss of each learner; NaN without updates.
    """
    first, policies = learners[0], [learner.policy for learner in learners]
    with_rotation = any(learner.rotates for learner in learners)
    alike = len(learners) > 1 and have_same_architecture(policies)
    records = []
    for _ in range(updates):
        batch = buffer.sample()
        receivers = first.prepare(batch, first.generator, with_rotation=with_rotation)
        for learner in learners:
            learner.optimizer.zero_grad()
        if alike and batch["agents", "controlled"].numel() * receivers.shape[-1] <= MAX_STACKED_PAIRS:
            losses = stacked_losses(policies, batch, receivers, loss=first.task.actions.loss)
        else:
            losses = [imitation_loss(policy, batch, receivers, loss=first.task.actions.loss) for policy in policies]
            for loss in losses:
                loss.backward()
        for learner, loss in zip(learners, losses, strict=True):
            learner.step(loss, batch, receivers)
        records.append(torch.stack([loss.detach() for loss in losses]))
    return torch.stack(records).nanmean(0).tolist() if records else [math.nan] * len(learners)


@torch.no_grad()
def validate_together(learners: Sequence[ImitationLearner], buffer: ReplayBuffer) -> list[float]:
    """The loss of the averaged policy of each learner on one batch of validation data, averaged over processes."""
    batch, first = buffer.sample(), learners[0]
    with_rotation = any(learner.rotates for learner in learners)
    receivers = first.prepare(batch, first.validation_generator, with_rotation=with_rotation)
    loss = first.task.actions.loss
    losses = [float(imitation_loss(learner.ema_policy, batch, receivers, loss=loss)) for learner in learners]
    return list(distributed.mean(dict(enumerate(losses))).values())


def cosine_learning_rate(step: int, rates: Sequence[float], updates: tuple[int, int]) -> float:
    """The learning rate as two half cosines.

    Args:
        step: number of the update, from 0.
        rates: at the start, between the cosines, and at the end.
        updates: where the first cosine ends, and where the second does.
    """
    (start, middle, end), (first, total) = rates, updates
    if step < first:
        return _cosine(start, middle, step / first)
    return _cosine(middle, end, min(1.0, (step - first) / max(1, total - first)))


def _cosine(start: float, end: float, fraction: float) -> float:
    return end + 0.5 * (start - end) * (1 + math.cos(math.pi * fraction))
