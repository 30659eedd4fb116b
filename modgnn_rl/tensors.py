"""Small tensor functions that the environment, the expert and the policies share."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["clip_to_ball", "pair_distances", "pair_differences"]


def clip_to_ball(vector: Tensor, radius: float) -> Tensor:
    """Project vectors [..., D] onto the ball of the given radius: ``x min(1, radius / |x|)``.

    Its gradient exists everywhere, also at the origin.
    """
    norm = vector.square().sum(-1, keepdim=True).clamp(min=1e-16).sqrt()
    return vector * (radius / norm).clamp(max=1.0)


def pair_differences(vector: Tensor) -> Tensor:
    """Differences of all pairs, components first: entry c, i, j is ``x_j - x_i``; [..., N, D] -> [D, ..., N, N]."""
    components = vector.movedim(-1, 0)
    return components.unsqueeze(-2) - components.unsqueeze(-1)


def pair_distances(position: Tensor) -> Tensor:
    """Distances of all pairs [..., N, 3] -> [..., N, N]; infinite on the diagonal, so that nobody is its own neighbour."""
    distance = pair_differences(position).square().sum(0).sqrt()
    infinite = torch.full((), torch.inf, dtype=distance.dtype, device=distance.device)
    return torch.where(torch.eye(position.shape[-2], dtype=torch.bool, device=distance.device), infinite, distance)
