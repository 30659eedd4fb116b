"""Metrics of the rollouts that trainers collect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.metrics import action_error
from modgnn_rl.envs.flocking.rewards import flocking_costs
from modgnn_rl.metrics import compute_metrics, over_flocks
from modgnn_rl.registry import METRICS
from modgnn_rl.utils.tensors import pair_distances

__all__ = ["mean_over_sizes", "reward_metrics", "rollout_metrics"]

FRAMES = 4  # steps of a rollout at which distances are measured


def rollout_metrics(rollouts: TensorDictBase, env_config: FlockingConfig) -> dict[str, float]:
    """Metrics of rollouts that a trainer has collected.

    Args:
        rollouts: [B, T]; if the expert acted in some, ``expert_acts`` [B, T, 1] tells in which.
        env_config: defines when a flock has diverged or lost its leader.

    Returns:
        by name, which begins with the number of agents: the error of the actions of the policy (NaN if the expert acted
        throughout), the fraction of steps in which the expert acted, and at a few steps, whoever acted, the other
        metrics of `modgnn_rl.envs.flocking.metrics`.
    """
    agents = rollouts["agents"]
    counted, expert_acts = agents["controlled"], rollouts.get("expert_acts", None)
    if expert_acts is not None:
        counted = counted & ~expert_acts
    error = action_error(agents.get("loc", agents["action"]), agents["expert_action"], counted).nanmean()
    frames = torch.linspace(0, rollouts.shape[1] - 1, FRAMES).long()
    position = rollouts[env_config.state_key][:, frames, :, :3]
    of_positions = [name for name, entry in METRICS.items() if "inputs" not in entry.options]
    values = compute_metrics(of_positions, env_config, {"position": position})
    measured = {"error": float(error)} | {name: over_flocks(name, value) for name, value in values.items()}
    if expert_acts is not None:
        measured["expert_fraction"] = float(expert_acts.double().mean())
    return {f"{position.shape[-2]}/{name}": value for name, value in measured.items()}


def reward_metrics(rollouts: TensorDictBase, env_config: FlockingConfig) -> dict[str, float]:
    """Mean reward per step and controlled agent, and each of its costs, unweighted.

    Args:
        rollouts: [B, T].
        env_config: defines collisions and crowding.

    Returns:
        by name, which begins with the number of agents.
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
    counted = rollouts["agents", "controlled"]
    measured = {f"cost/{name}": cost[counted].mean() for name, cost in costs.items()}
    measured["reward"] = rollouts["next", "agents", "reward"][counted].mean()
    return {f"{position.shape[-2]}/{name}": float(value) for name, value in measured.items()}


def mean_over_sizes(metrics: Mapping[str, float], name: str, sizes: Sequence[int]) -> float:
    """The mean of the metrics ``<size>/<name>``."""
    return sum(metrics[f"{size}/{name}"] for size in sizes) / len(sizes)
