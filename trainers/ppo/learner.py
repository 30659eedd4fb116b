"""The learner of MAPPO (Yu et al. 2022): advantages, loss and optimiser steps."""

from __future__ import annotations

import copy
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ValueEstimators

from modgnn_rl.configs.schema import MAPPOConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.task import Task
from modgnn_rl.trainers.collectors.windows import slice_windows
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.optimization import GuardedOptimizer
from modgnn_rl.trainers.common.sampling import random_receivers, receivers_per_state
from modgnn_rl.trainers.common.state import TensorGroups, optimizer_state, restore_optimizer
from modgnn_rl.trainers.ppo.actor import CategoricalActor, GaussianActor, make_actor
from modgnn_rl.trainers.ppo.critic import CentralCritic
from modgnn_rl.trainers.ppo.loss import MASK, REFERENCE_ACTION, KLPenaltyMAPPOLoss, SharedValueNorm
from modgnn_rl.utils.seeds import derive_seed, seeded

__all__ = ["PPOLearner", "ppo_window"]

RECEIVERS = ("agents", "receivers")


def ppo_window(policy: ModGNN, settings: MAPPOConfig) -> tuple[int, int]:
    """Burn-in and length (steps) of the windows that a policy is updated on.

    Messages are recomputed in a window; after the burn-in they are exact whatever the weights were when the window was
    collected. Where stored messages are exact, a window is one step.
    """
    return (0, 1) if policy.sends_plain_data else (policy.hops, policy.hops + settings.window)


class PPOLearner:
    """Updates a policy on its own rollouts: actor, critic, loss, optimiser, and the moving average of the policy.

    Args:
        policy: the policy to train; a frozen copy is the reference policy of the KL penalty.
        task: says what actions are and what the critic sees.
        settings: how.
        seed: seeds the order of batches and the choice of agents.

    Attributes:
        actor: acts with noise; rolled out by the trainer.
        reference_policy: the policy at the start.
        burn_in, window: see `ppo_window`.
        updates_done: number of optimiser steps so far, skipped ones included.
    """

    def __init__(self, policy: ModGNN, task: Task, settings: MAPPOConfig, seed: int) -> None:
        self.settings, self.policy, self.task = settings, policy, task
        self.reference_policy = copy.deepcopy(policy).requires_grad_(False)
        self.averaged = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(settings.ema_decay))
        self.device = device = next(policy.parameters()).device
        self.generator = torch.Generator().manual_seed(derive_seed(seed, "receivers"))
        self.order = torch.Generator(device).manual_seed(derive_seed(seed, "order"))
        self.actor = make_actor(policy, task.actions, settings.noise).to(device)
        with seeded(derive_seed(seed, "critic")):
            self.critic = CentralCritic(task.critic_input(), hidden=settings.critic_hidden).to(device)
        self.loss = make_loss(self.actor, self.critic, settings)
        groups = [
            {"params": list(self.actor.parameters()), "lr": settings.learning_rate},
            {"params": list(self.critic.parameters()), "lr": settings.critic_learning_rate},
        ]
        self.optimizer = torch.optim.Adam(groups)
        self.guarded_optimizer = GuardedOptimizer(
            nn.ModuleDict({"actor": self.actor, "critic": self.critic}), self.optimizer, settings
        )
        self.burn_in, self.window = ppo_window(policy, settings)
        self.updates_done = 0

    @property
    def ema_policy(self) -> ModGNN:
        """The policy with the moving average of the weights, which is evaluated."""
        return cast(ModGNN, self.averaged.module)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All random number generators, by name."""
        return {"receivers": self.generator, "order": self.order}

    @torch.no_grad()
    def compute_advantages(self, rollouts: TensorDictBase) -> None:
        """Write advantages, value targets and actions of the reference policy into rollouts [B, T].

        Rewards are scaled by ``1 - gamma``, so that values are those of an average step. Values are bootstrapped at the
        end of a truncated episode, and if the task says so, of a terminated one.
        """
        data = rollouts.copy()
        data["next", "agents", "reward"] = (1 - self.settings.gamma) * rollouts["next", "agents", "reward"]
        if self.task.bootstraps_at_termination:
            data["next", "terminated"] = torch.zeros_like(data["next", "terminated"])
        self.loss.value_estimator(data)
        controlled = rollouts["agents", "controlled"].unsqueeze(-1)
        advantage = data["agents", "advantage"]
        mean, std = distributed.mean_and_std(advantage[controlled])
        rollouts["agents", "advantage"] = (advantage - mean) / std.clamp(min=1e-6)
        rollouts["agents", "value_target"] = data["agents", "value_target"]
        if self.loss.kl_coef > 0:
            observed = rollouts.select(*self.reference_policy.in_keys, strict=False)
            with set_recurrent_mode(True):
                rollouts[REFERENCE_ACTION] = self.reference_policy(observed)[self.policy.out_keys[0]]

    def update(self, rollouts: TensorDictBase, *, kl_coef: float = 0.0, critic_only: bool = False) -> dict[str, float]:
        """Take optimiser steps on rollouts of the actor; the first ``burn_in`` steps of a window do not count.

        Args:
            rollouts: as collected, [B, T].
            kl_coef: weight of the KL penalty towards the reference policy.
            critic_only: whether to leave the policy as it is.

        Returns:
            means of the losses, and diagnostics.
        """
        self.loss.kl_coef = 0.0 if critic_only else kl_coef
        self.compute_advantages(rollouts)
        windows = self._windows(rollouts)
        records = [self._step(batch, critic_only) for _ in range(self.settings.epochs) for batch in windows]
        means = {name: float(torch.stack([record[name] for record in records]).nanmean()) for name in records[0]}
        return {**means, "gradient_norm": self.guarded_optimizer.gradient_norm}

    def _windows(self, rollouts: TensorDictBase) -> ReplayBuffer:
        """Rollouts [B, T] as a buffer, every pass over which yields minibatches of windows [S, W] in random order."""
        names = ("controlled", "action", "action_log_prob", "advantage", "value_target")
        agents = [("agents", name) for name in names]
        kept = [*self.policy.in_keys, *agents, *self.critic.in_keys, REFERENCE_ACTION]
        windows = slice_windows(rollouts.select(*kept, strict=False), self.window, self.window - self.burn_in)
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(len(windows), device=self.device, compilable=True),
            sampler=SamplerWithoutReplacement(),
            batch_size=-(-len(windows) // self.settings.num_minibatches),
            generator=self.order,
        )
        buffer.extend(windows)
        return buffer

    def _step(self, batch: TensorDictBase, critic_only: bool) -> dict[str, Tensor]:
        """Take one optimiser step on windows [S, W]; returns losses and diagnostics, [] each."""
        controlled = batch["agents", "controlled"]
        count = receivers_per_state(self.settings, self.task.config.reference_size, controlled.shape[-1])
        chosen = random_receivers(controlled.flatten(0, 1), count, self.generator).view_as(controlled)
        chosen[:, : self.burn_in] = False
        batch = batch.copy()
        batch[RECEIVERS] = chosen
        batch[MASK] = chosen.unsqueeze(-1)
        losses = self.loss(batch)
        policy_loss = losses["loss_objective"] + losses["loss_entropy"] + losses.get("loss_kl", 0.0)
        loss = losses["loss_critic"] if critic_only else policy_loss + losses["loss_critic"]
        self.optimizer.zero_grad()
        loss.backward()
        self.updates_done += 1
        if self.guarded_optimizer.step(self.updates_done, loss, batch, chosen.sum()) and not critic_only:
            self.averaged.update_parameters(self.policy)
        names = ("loss_objective", "loss_critic", "loss_kl", "clip_fraction", "kl_approx", "entropy")
        return {name: losses[name].detach().mean() for name in names if name in losses}

    @property
    def _modules(self) -> dict[str, nn.Module]:
        """All modules with a state, by the names that they have in checkpoints."""
        return {
            "policy": self.ema_policy,
            "actor": self.actor,
            "critic": self.critic,
            "value_norm": self.loss.value_norm,
            "reference_policy": self.reference_policy,
        }

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """The state for a checkpoint: named tensors, and plain values."""
        tensors = {name: module.state_dict() for name, module in self._modules.items()}
        tensors["optimizer"] = optimizer_state(self.optimizer)
        return tensors, {"updates": self.updates_done, "averaged": int(self.averaged.n_averaged)}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Return to what `state` returned.

        Raises:
            KeyError, RuntimeError: the state is that of another policy or another critic.
        """
        for name, module in self._modules.items():
            module.load_state_dict(tensors[name])
        self.averaged.n_averaged.fill_(values["averaged"])
        restore_optimizer(self.optimizer, tensors["optimizer"])
        self.updates_done = int(values["updates"])


def make_loss(
    actor: GaussianActor | CategoricalActor, critic: CentralCritic, settings: MAPPOConfig
) -> KLPenaltyMAPPOLoss:
    """The loss, with the keys of `modgnn_rl.task_env.TaskEnv` and an estimator of advantages (multi-agent GAE)."""
    loss = KLPenaltyMAPPOLoss(
        actor,
        critic,
        value_norm=SharedValueNorm(beta=0.995, device=next(actor.parameters()).device),
        clip_epsilon=settings.clip_epsilon,
        entropy_coeff=settings.entropy_coef,
        normalize_advantage=False,  # the learner does it, over whole rollouts and over controlled agents only
        functional=False,
        log_explained_variance=False,
    )
    loss.set_keys(
        action=actor.policy.out_keys[0],
        value=critic.out_keys[0],
        sample_log_prob=("agents", "action_log_prob"),
        reward=("agents", "reward"),
        advantage=("agents", "advantage"),
        value_target=("agents", "value_target"),
    )
    loss.make_value_estimator(ValueEstimators.MAGAE, gamma=settings.gamma, lmbda=settings.gae_lambda)
    return loss
