"""Random choice of the agents that count in an update."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["random_receivers"]


def random_receivers(controlled: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Choose ``count`` of the controlled agents of each flock, or all where there are fewer; bool [S, N] -> [S, N]."""
    lot = torch.rand(controlled.shape, generator=generator, device=generator.device).to(controlled.device)
    lot = lot.masked_fill(~controlled, 2.0)
    chosen = torch.zeros_like(controlled)
    chosen.scatter_(-1, lot.topk(min(count, controlled.shape[-1]), largest=False).indices, True)
    return chosen & controlled
