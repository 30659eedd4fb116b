"""Reward and termination: follow the leader, stay together, keep apart, move at the same velocity, with little effort.

Each goal is a nonnegative cost; the reward is minus their weighted sum. It does not depend on the expert.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.metrics import is_diverged
from modgnn_rl.utils.tensors import squared_norm

__all__ = ["COSTS", "LIMITS", "flocking_costs", "flocking_reward", "reward_weights", "step_outcome"]

LIMITS = ("max_distance", "max_colliding", "collision_distance", "crowding_distance")  # settings for `step_outcome`
COSTS = {
    "leader": "distance to the leader, m",
    "cohesion": "distance to the flock's centre of mass, m",
    "crowding": "(1 - d / crowding_distance)^2 where the nearest agent is at d < crowding_distance, else 0",
    "collision": "1 where the nearest agent is closer than collision_distance, else 0",
    "alignment": "difference between the velocity and the flock's mean velocity, m/s",
    "effort": "difference between target velocity and velocity, m/s; times k_p, the commanded acceleration",
}


def reward_weights(config: FlockingConfig) -> dict[str, float]:
    """The nonzero weights ``<name>_cost`` of the costs, by name."""
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
    """Compute all costs of one step, see `COSTS`; the leader is agent 0.

    Args:
        position: m [*B, N, 3].
        velocity: m/s [*B, N, 3].
        target_velocity: of all agents, including the leader, m/s [*B, N, 3].
        nearest: distance to the nearest other agent, m [*B, N]; infinite if there is none.
        crowding_distance: distance below which agents crowd each other, m.
        collision_distance: distance below which agents collide, m.
        exists: agents that exist, bool [*B, N]; means are over these. Default: all.

    Returns:
        costs by name [*B, N]; arbitrary values for agents that do not exist.
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
    """Reward of each agent for one step, ``r_i = - sum_c weight_c cost_c,i``.

    Args:
        costs: by name [*B, N].
        weights: by name; costs without a weight are ignored.
        exists: agents that exist, bool [*B, N]; the others get reward 0. Default: all.

    Returns:
        reward [*B, N, 1].
    """
    reward = torch.zeros_like(next(iter(costs.values())))
    for name, weight in weights.items():
        reward = reward - weight * costs[name]
    return (reward if exists is None else torch.where(exists, reward, 0.0)).unsqueeze(-1)


def step_outcome(
    position: Tensor,
    velocity: Tensor,
    target_velocity: Tensor,
    nearest: Tensor,
    sizes: Tensor,
    exists: Tensor | None,
    limits: Mapping[str, float],
    weights: Mapping[str, float],
) -> tuple[Tensor, Tensor, Tensor]:
    """Evaluate the state after a step, in one function so that it compiles into one.

    Args:
        position: m [B, N, 3].
        velocity: m/s [B, N, 3].
        target_velocity: of all agents, including the leader, m/s [B, N, 3].
        nearest: distance to the nearest other agent, m [B, N].
        sizes: number of agents of each flock [B].
        exists: agents that exist, bool [B, N]; None: all.
        limits: the settings named in `LIMITS`.
        weights: see `reward_weights`.

    Returns:
        positions and velocities [B, N, 6], reward [B, N, 1], and whether the episode terminates, bool [B, 1].
    """
    in_collision = nearest < limits["collision_distance"]
    colliding = in_collision.sum(-1) > limits["max_colliding"] * sizes
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
    """Euclidean norm of vectors [..., 3]; much faster on a CPU than torch.linalg.vector_norm."""
    return squared_norm(vectors.unbind(-1)).sqrt()


def _mean_of(vectors: Tensor, exists: Tensor | None) -> Tensor:
    """Mean [*B, 1, 3] of the vectors [*B, N, 3] of agents that exist."""
    if exists is None:
        return vectors.mean(-2, keepdim=True)
    there = exists.unsqueeze(-1)
    return torch.where(there, vectors, 0.0).sum(-2, keepdim=True) / there.sum(-2, keepdim=True)
