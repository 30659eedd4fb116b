"""What flocking is for, as a reward: stay with the leader, move as one, do not collide."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["flocking_reward"]

LEADER_WEIGHT = 0.1  # 1/m
ALIGNMENT_WEIGHT = 0.1  # s/m
COLLISION_WEIGHT = 1.0


def flocking_reward(position: Tensor, velocity: Tensor, touching: Tensor) -> Tensor:
    """Reward of each agent for one step; it knows nothing of the expert.

    ``r_i = -0.1 |p_i - p_leader| - 0.1 |v_i - mean(v)| - 1.0 [i touches another agent]``, the leader being agent 0.

    Args:
        position: m [B, N, 3].
        velocity: m/s [B, N, 3].
        touching: pairs that collide, bool [B, N, N].

    Returns:
        reward [B, N, 1].
    """
    leader = torch.linalg.vector_norm(position - position[..., :1, :], dim=-1)
    alignment = torch.linalg.vector_norm(velocity - velocity.mean(-2, keepdim=True), dim=-1)
    collision = touching.any(-1).to(position.dtype)
    reward = -LEADER_WEIGHT * leader - ALIGNMENT_WEIGHT * alignment - COLLISION_WEIGHT * collision
    return reward.unsqueeze(-1)
