"""Random choice of the agents whose loss counts in an update."""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.configs.schema import TrainerConfig

__all__ = ["random_receivers", "receivers_per_state"]


def receivers_per_state(settings: TrainerConfig, reference_size: int, num_agents: int) -> int:
    """How many agents of a flock count in an update.

    ``settings.agents_per_state`` of R agents, the reference size; of N agents R / N times as many, so that their edges
    are as many and an update takes as long.
    """
    return max(1, round(settings.agents_per_state * reference_size / num_agents))


def random_receivers(controlled: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Choose agents at random among the controlled ones.

    Args:
        controlled: the agents to choose from, bool [S, N].
        count: how many of each flock; where there are fewer, all are chosen.
        generator: source of randomness.

    Returns:
        the chosen agents, bool [S, N].
    """
    order = torch.rand(controlled.shape, generator=generator, device=generator.device).to(controlled.device)
    order = order.masked_fill(~controlled, 2.0)
    chosen = torch.zeros_like(controlled)
    chosen.scatter_(-1, order.topk(min(count, controlled.shape[-1]), largest=False).indices, True)
    return chosen & controlled
