"""What is measured on the rollouts that trainers collect."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.metrics import (
    action_error,
    cohesion,
    is_diverged,
    leader_distance,
    leader_lost,
    min_distance,
    separation,
)
from modgnn_rl.envs.flocking.rewards import flocking_costs
from modgnn_rl.utils.tensors import pair_distances

__all__ = ["reward_metrics", "rollout_metrics"]

FRAMES = 4  # steps of a batch of rollouts at which the geometry is measured


def rollout_metrics(rollouts: TensorDictBase, env_config: FlockingConfig) -> dict[str, float]:
    """Metrics of rollouts that a trainer collected; names begin with the number of agents.

    Args:
        rollouts: [B, T]; where the expert flew some, with who did under ``expert_flies`` [B, T, 1].
        env_config: says when a flock has diverged or is lost.

    Returns:
        the error of the actions where the policy flew (NaN where the expert flew throughout), and at a few steps,
        whoever flew, the other metrics of `modgnn_rl.envs.flocking.metrics`.
    """
    agents = rollouts["agents"]
    flown, expert_flies = agents["controlled"], rollouts.get("expert_flies", None)
    if expert_flies is not None:
        flown = flown & ~expert_flies
    error = action_error(agents.get("loc", agents["action"]), agents["expert_action"], flown).nanmean()
    frames = torch.linspace(0, rollouts.shape[1] - 1, FRAMES).long()
    position = rollouts[env_config.state_key][:, frames, :, :3]
    measured = {
        "error": error,
        "leader_distance": leader_distance(position).mean(),
        "cohesion": cohesion(position).mean(),
        "separation": separation(position).mean(),
        "min_distance": min_distance(position).min(),
        "lost": leader_lost(position, env_config.comm_range).double().mean(),
        "diverged": is_diverged(position, env_config.max_distance).double().mean(),
    }
    if expert_flies is not None:
        measured["expert_flew"] = expert_flies.double().mean()
    return {f"{position.shape[-2]}/{name}": float(value) for name, value in measured.items()}


def reward_metrics(rollouts: TensorDictBase, env_config: FlockingConfig) -> dict[str, float]:
    """Mean reward of a step and of an agent that is flown, and each cost that makes it up, unweighted.

    Args:
        rollouts: [B, T].
        env_config: its weights.

    Returns:
        by name; names begin with the number of agents.
    """
    state = rollouts["next", *env_config.state_key]
    position, velocity = state.split(3, -1)
    exists = rollouts.get(("agents", "mask"), None)
    costs = flocking_costs(
        position,
        velocity,
        rollouts["agents", "action"],
        pair_distances(position.flatten(0, 1)).amin(-1).view(position.shape[:-1]),
        crowding_distance=env_config.crowding_distance,
        collision_distance=env_config.collision_distance,
        exists=exists,
    )
    flown = rollouts["agents", "controlled"]
    measured = {f"cost/{name}": cost[flown].mean() for name, cost in costs.items()}
    measured["reward"] = rollouts["next", "agents", "reward"][flown].mean()
    return {f"{position.shape[-2]}/{name}": float(value) for name, value in measured.items()}
