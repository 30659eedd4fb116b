"""Proximal policy optimisation of a flock's policy (MAPPO, Yu et al. 2022): advantages, loss, optimiser steps."""

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

from modgnn_rl.configs.schema import REFERENCE_SIZE, MAPPOConfig
from modgnn_rl.nn.modgnn import ModGNN
from modgnn_rl.trainers.collectors.windows import as_windows
from modgnn_rl.trainers.common import distributed
from modgnn_rl.trainers.common.optimization import GuardedOptimizer
from modgnn_rl.trainers.common.sampling import random_receivers
from modgnn_rl.trainers.common.state import TensorGroups, optimizer_state, restore_optimizer
from modgnn_rl.trainers.ppo.actor import GaussianActor
from modgnn_rl.trainers.ppo.critic import FlockCritic
from modgnn_rl.trainers.ppo.loss import ANCHOR, KLPenaltyMAPPOLoss, SharedValueNorm
from modgnn_rl.utils.seeds import derive_seed, seeded

__all__ = ["PPOLearner", "ppo_window"]

RECEIVERS = ("agents", "receivers")


def ppo_window(policy: ModGNN, settings: MAPPOConfig) -> tuple[int, int]:
    """Burn-in and length of the windows that a policy is improved on, in steps.

    After the burn-in messages are exact whatever the weights were. Where stored ones are exact, a window is one step.
    """
    return (0, 1) if policy.sends_plain_data else (policy.hops, policy.hops + settings.window)


class PPOLearner:
    """Improves a policy on rollouts of its own: actor, critic, optimisers, and the moving average of the policy.

    Args:
        policy: the policy that is improved; it is also what the pull leads back to.
        settings: how.
        state: key of the true states, which the critic sees.
        seed: seeds the order of batches and the choice of receivers.

    Attributes:
        burn_in, window: see `ppo_window`.
    """

    def __init__(self, policy: ModGNN, settings: MAPPOConfig, state: Any, seed: int) -> None:
        self.settings = settings
        self.policy = policy
        self.anchor = copy.deepcopy(policy).requires_grad_(False)
        self.averaged = AveragedModel(policy, multi_avg_fn=get_ema_multi_avg_fn(settings.ema_decay))
        self.device = device = next(policy.parameters()).device
        self.generator = torch.Generator().manual_seed(derive_seed(seed, "receivers"))
        self.order = torch.Generator(device).manual_seed(derive_seed(seed, "order"))
        self.actor = GaussianActor(policy, settings.noise).to(device)
        with seeded(derive_seed(seed, "critic")):
            self.critic = FlockCritic(state, hidden=settings.critic_hidden).to(device)
        self.loss = KLPenaltyMAPPOLoss(
            self.actor,
            self.critic,
            value_norm=SharedValueNorm(beta=0.995, device=device),
            clip_epsilon=settings.clip_epsilon,
            entropy_coeff=settings.entropy_coef,
            normalize_advantage=False,  # done over whole rollouts, and over agents that are flown
            functional=False,
            log_explained_variance=False,
        )
        self.loss.set_keys(
            action=policy.out_keys[0],
            value=self.critic.out_keys[0],
            sample_log_prob=("agents", "action_log_prob"),
            reward=("agents", "reward"),
            advantage=("agents", "advantage"),
            value_target=("agents", "value_target"),
        )
        self.loss.make_value_estimator(ValueEstimators.MAGAE, gamma=settings.gamma, lmbda=settings.gae_lambda)
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
        """The moving average of the policy: it is evaluated and is what a run ends with."""
        return cast(ModGNN, self.averaged.module)

    @property
    def generators(self) -> dict[str, torch.Generator]:
        """All that draws at random here, by name."""
        return {"receivers": self.generator, "order": self.order}

    @torch.no_grad()
    def compute_advantages(self, rollouts: TensorDictBase) -> None:
        """Write advantages, value targets and the anchor's actions into rollouts [B, T].

        Rewards count ``1 - discount`` times, so that values are those of a mean step. The end of a rollout, whether
        truncated or terminated, does not end what it is worth: else flocks whose every step costs would do well to
        collide.
        """
        settings = self.settings
        judged = rollouts.copy()
        judged["next", "agents", "reward"] = (1 - settings.gamma) * rollouts["next", "agents", "reward"]
        judged["next", "terminated"] = torch.zeros_like(judged["next", "terminated"])
        self.loss.value_estimator(judged)
        controlled = rollouts["agents", "controlled"].unsqueeze(-1)
        advantage = judged["agents", "advantage"]
        mean, deviation = distributed.mean_and_std(advantage[controlled])
        rollouts["agents", "advantage"] = (advantage - mean) / deviation.clamp(min=1e-6)
        rollouts["agents", "value_target"] = judged["agents", "value_target"]
        if self.loss.anchor_coeff > 0:
            with set_recurrent_mode(True):
                rollouts[ANCHOR] = self.anchor(rollouts.select(*self.anchor.in_keys, strict=False))["agents", "action"]

    def update(self, rollouts: TensorDictBase, *, only_critic: bool = False, anchor: float = 0.0) -> dict[str, float]:
        """Take optimiser steps on rollouts [B, T] of the actor's own; the first ``burn_in`` steps are not trained on.

        Args:
            rollouts: as the actor flew them.
            only_critic: leave the policy as it is.
            anchor: weight of the pull towards the policy that this one began as.

        Returns:
            means of the losses and of what tells how they fare.
        """
        settings = self.settings
        self.loss.anchor_coeff = 0.0 if only_critic else anchor
        self.compute_advantages(rollouts)
        kept = [
            *self.policy.in_keys,
            *(("agents", name) for name in ("controlled", "action", "action_log_prob", "advantage", "value_target")),
            self.critic.state_key,
            ANCHOR,
        ]
        windows = as_windows(rollouts.select(*kept, strict=False), self.window, self.window - self.burn_in)
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(len(windows), device=self.device, compilable=True),
            sampler=SamplerWithoutReplacement(),
            batch_size=-(-len(windows) // settings.num_minibatches),
            generator=self.order,
        )
        buffer.extend(windows)
        records = []
        for _ in range(settings.epochs):
            for batch in buffer:
                records.append(self._update(batch, only_critic))
        names = records[0]
        means = {name: float(torch.stack([record[name] for record in records]).nanmean()) for name in names}
        return {**means, "gradient_norm": self.guarded_optimizer.gradient_norm}

    def _update(self, batch: TensorDictBase, only_critic: bool) -> dict[str, Tensor]:
        """One optimiser step on windows [S, W]."""
        settings = self.settings
        controlled = batch["agents", "controlled"]
        count = max(1, round(settings.agents_per_state * REFERENCE_SIZE / controlled.shape[-1]))
        chosen = random_receivers(controlled.flatten(0, 1), count, self.generator).view_as(controlled)
        chosen[:, : self.burn_in] = False
        batch = batch.copy()
        batch[RECEIVERS] = chosen
        batch["collector", "mask"] = chosen.unsqueeze(-1)
        losses = self.loss(batch)
        actor = losses["loss_objective"] + losses["loss_entropy"] + losses.get("loss_anchor", 0.0)
        loss = losses["loss_critic"] if only_critic else actor + losses["loss_critic"]
        self.optimizer.zero_grad()
        loss.backward()
        self.updates_done += 1
        if self.guarded_optimizer.step(self.updates_done, loss, batch, chosen.sum()) and not only_critic:
            self.averaged.update_parameters(self.policy)
        names = ("loss_objective", "loss_critic", "loss_anchor", "clip_fraction", "kl_approx", "entropy")
        return {name: losses[name].detach().mean() for name in names if name in losses}

    def state(self) -> tuple[TensorGroups, dict[str, Any]]:
        """What a checkpoint holds: named tensors, and plain values."""
        tensors = {
            "policy": self.ema_policy.state_dict(),
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "value_norm": self.loss.value_norm.state_dict(),
            "anchor": self.anchor.state_dict(),
            "optimizer": optimizer_state(self.optimizer),
        }
        return tensors, {"updates": self.updates_done, "averaged": int(self.averaged.n_averaged)}

    def restore(self, tensors: TensorGroups, values: dict[str, Any]) -> None:
        """Go on from what `state` gave.

        Raises:
            KeyError, RuntimeError: it is that of another policy or another critic.
        """
        parts = {
            "policy": self.ema_policy,
            "actor": self.actor,
            "critic": self.critic,
            "value_norm": self.loss.value_norm,
            "anchor": self.anchor,
        }
        for name, module in parts.items():
            module.load_state_dict(tensors[name])
        self.averaged.n_averaged.fill_(values["averaged"])
        restore_optimizer(self.optimizer, tensors["optimizer"])
        self.updates_done = int(values["updates"])
