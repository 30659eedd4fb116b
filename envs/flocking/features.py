"""Features of a flock for the central critic: what matters of the state of each agent, whatever the flock's pose."""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.utils.tensors import pair_distances

__all__ = ["FEATURES", "flock_features"]

FEATURES = 15  # number of features
NEAR = 0.4  # m; length scale of the crowding feature


def flock_features(state: Tensor, mask: Tensor | None = None) -> Tensor:
    """Features of each agent that do not depend on the flock's position, attitude and order, of magnitude one.

    Distance (scaled, and its logarithm), closing speed and velocity difference, each with respect to the leader
    (agent 0) and to the flock's mean, and of the leader with respect to that mean; distance of the nearest agent;
    crowding ``sum_j exp(-d_ij / 0.4 m)``; speed.

    Args:
        state: position (m) and velocity (m/s) [*B, N, 6].
        mask: agents that exist, bool [*B, N]. Default: all.

    Returns:
        features [*B, N, 15].
    """
    position, velocity = state.split(3, -1)
    there = None if mask is None else mask.unsqueeze(-1)
    count = state.shape[-2] if there is None else there.sum(-2, keepdim=True).clamp(min=1)
    shown = state if there is None else torch.where(there, state, 0.0)
    mean = shown.sum(-2, keepdim=True) / count
    centre, drift = mean.split(3, -1)
    leader, led = position[..., :1, :], velocity[..., :1, :]
    columns = []
    for offset, relative in (
        (leader - position, led - velocity),
        (centre - position, drift - velocity),
        ((centre - leader).expand_as(position), (drift - led).expand_as(velocity)),
    ):
        distance = _norm(offset)
        closing = (offset * relative).sum(-1, keepdim=True) / distance
        columns += [distance / 3, (distance + 0.1).log(), closing, _norm(relative)]
    distance = pair_distances(position)
    if mask is not None:
        distance = distance.masked_fill(~(mask.unsqueeze(-2) & mask.unsqueeze(-1)), torch.inf)
    nearest = distance.amin(-1, keepdim=True).clamp(max=1.0)
    crowd = torch.exp(-distance / NEAR).sum(-1, keepdim=True)
    return torch.cat([*columns, nearest, crowd, _norm(velocity)], -1)


def _norm(vectors: Tensor) -> Tensor:
    return (vectors.square().sum(-1, keepdim=True) + 1e-8).sqrt()
