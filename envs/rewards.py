"""What flocking is for, as a reward: stay with the leader, move as one, do not collide."""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.tensors import squared_norm

__all__ = ["flocking_reward"]

LEADER_WEIGHT = 0.1  # 1/m
ALIGNMENT_WEIGHT = 0.1  # s/m
COLLISION_WEIGHT = 1.0


def flocking_reward(position: Tensor, velocity: Tensor, touching: Tensor, exists: Tensor | None = None) -> Tensor:
    """Reward of each agent for one step; it knows nothing of the expert.

    ``r_i = -0.1 |p_i - p_leader| - 0.1 |v_i - mean(v)| - 1.0 [i touches another agent]``, the leader being agent 0.

    Args:
        position: m [B, N, 3].
        velocity: m/s [B, N, 3].
        touching: agents that collide with another, bool [B, N].
        exists: agents that exist, bool [B, N]; the others get 0 and do not count in the mean. Default: all.

    Returns:
        reward [B, N, 1].
    """
    leader = _norm(position - position[..., :1, :])
    mean = velocity.mean(-2, keepdim=True) if exists is None else _mean_of(velocity, exists)
    alignment = _norm(velocity - mean)
    reward = -LEADER_WEIGHT * leader - ALIGNMENT_WEIGHT * alignment - COLLISION_WEIGHT * touching.to(position.dtype)
    return (reward if exists is None else torch.where(exists, reward, 0.0)).unsqueeze(-1)


def _norm(vectors: Tensor) -> Tensor:
    """Euclidean norm of [..., 3], much faster on a CPU than torch.linalg.vector_norm."""
    return squared_norm(vectors.unbind(-1)).sqrt()


def _mean_of(vectors: Tensor, exists: Tensor) -> Tensor:
    """Mean [B, 1, 3] of the vectors [B, N, 3] of agents that exist."""
    there = exists.unsqueeze(-1)
    return torch.where(there, vectors, 0.0).sum(-2, keepdim=True) / there.sum(-2, keepdim=True)
