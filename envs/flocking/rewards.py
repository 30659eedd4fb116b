"""What flocking is for, as a reward: follow the leader, keep together, keep apart, move as one, with little effort.

It knows nothing of the expert. Each purpose is a cost of its own, zero at best; the reward is their weighted sum below
zero. `judge` adds whether a rollout is over.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.metrics import is_diverged
from modgnn_rl.utils.tensors import squared_norm

__all__ = ["COSTS", "LIMITS", "flocking_costs", "flocking_reward", "judge", "reward_weights"]

LIMITS = ("max_distance", "max_colliding", "collision_distance", "crowding_distance")  # settings that `judge` reads
COSTS = {
    "leader": "distance from the leader, m",
    "cohesion": "distance from the flock's centre of mass, m",
    "crowding": "(1 - d / crowding_distance)^2 where the nearest agent is at d < crowding_distance, else 0",
    "collision": "1 where the nearest agent is closer than collision_distance, else 0",
    "alignment": "difference of the velocity from the flock's mean velocity, m/s",
    "effort": "difference of the target velocity from the velocity, m/s: with k_p, the acceleration asked for",
}


def reward_weights(config: FlockingConfig) -> dict[str, float]:
    """The weights ``<name>_cost`` of the costs that count in a world; those of zero are left out."""
    weights = {name: float(getattr(config, f"{name}_cost")) for name in COSTS}
    return {name: weight for name, weight in weights.items() if weight}


def flocking_costs(
    position: Tensor,
    velocity: Tensor,
    target_velocity: Tensor,
    nearest: Tensor,
    *,
    crowding_distance: float,
    collision_distance: float,
    exists: Tensor | None = None,
) -> dict[str, Tensor]:
    """All costs of one step, see `COSTS`; the leader is agent 0.

    Args:
        position: m [*B, N, 3].
        velocity: m/s [*B, N, 3].
        target_velocity: what the agents were told, m/s [*B, N, 3].
        nearest: distance of the nearest other agent, m [*B, N]; infinite where there is none.
        crowding_distance: distance below which agents are in each other's way, m.
        collision_distance: distance below which they touch, m.
        exists: agents that exist, bool [*B, N]; the others do not count in means. Default: all.

    Returns:
        by name [*B, N]; whatever the data for agents that do not exist.
    """
    return {
        "leader": _norm(position - position[..., :1, :]),
        "cohesion": _norm(position - _mean_of(position, exists)),
        "crowding": (1 - nearest / crowding_distance).clamp(min=0).square(),
        "collision": (nearest < collision_distance).to(position.dtype),
        "alignment": _norm(velocity - _mean_of(velocity, exists)),
        "effort": _norm(target_velocity - velocity),
    }


def flocking_reward(costs: Mapping[str, Tensor], weights: Mapping[str, float], exists: Tensor | None = None) -> Tensor:
    """Reward of each agent for one step: ``r_i = - sum over the costs c of weight_c cost_c,i``.

    Args:
        costs: by name [*B, N].
        weights: by name; costs without one do not count.
        exists: agents that exist, bool [*B, N]; the others get 0. Default: all.

    Returns:
        reward [*B, N, 1].
    """
    reward = torch.zeros_like(next(iter(costs.values())))
    for name, weight in weights.items():
        reward = reward - weight * costs[name]
    return (reward if exists is None else torch.where(exists, reward, 0.0)).unsqueeze(-1)


def judge(
    position: Tensor,
    velocity: Tensor,
    target_velocity: Tensor,
    nearest: Tensor,
    sizes: Tensor,
    exists: Tensor | None,
    limits: Mapping[str, float],
    weights: Mapping[str, float],
) -> tuple[Tensor, Tensor, Tensor]:
    """What a step has brought.

    Args:
        position: m [B, N, 3].
        velocity: m/s [B, N, 3].
        target_velocity: what the agents were told, m/s [B, N, 3].
        nearest: distance of the nearest other agent, m [B, N].
        sizes: agents of each flock [B].
        exists: agents that exist, bool [B, N]; default: all.
        limits: the settings named in `LIMITS`.
        weights: of the costs, see `reward_weights`.

    Returns:
        state [B, N, 6], reward [B, N, 1], and whether the rollout is over [B, 1].
    """
    touching = nearest < limits["collision_distance"]
    colliding = touching.sum(-1) > limits["max_colliding"] * sizes
    terminated = (is_diverged(position, limits["max_distance"], exists) | colliding).unsqueeze(-1)
    costs = flocking_costs(
        position,
        velocity,
        target_velocity,
        nearest,
        crowding_distance=limits["crowding_distance"],
        collision_distance=limits["collision_distance"],
        exists=exists,
    )
    return torch.cat((position, velocity), -1), flocking_reward(costs, weights, exists), terminated


def _norm(vectors: Tensor) -> Tensor:
    """Euclidean norm of [..., 3], much faster on a CPU than torch.linalg.vector_norm."""
    return squared_norm(vectors.unbind(-1)).sqrt()


def _mean_of(vectors: Tensor, exists: Tensor | None) -> Tensor:
    """Mean [*B, 1, 3] of the vectors [*B, N, 3] of agents that exist."""
    if exists is None:
        return vectors.mean(-2, keepdim=True)
    there = exists.unsqueeze(-1)
    return torch.where(there, vectors, 0.0).sum(-2, keepdim=True) / there.sum(-2, keepdim=True)
