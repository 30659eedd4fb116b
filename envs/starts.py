"""Starting positions of flocks."""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.errors import InputError

__all__ = ["uniform_ball"]

MAX_DRAWS = 1000


def uniform_ball(
    flocks: int,
    agents: int,
    radius: float,
    min_distance: float,
    *,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Agents uniform in a ball about the origin, redrawn where two of them are closer than ``min_distance``.

    Args:
        flocks: number of flocks B.
        agents: number of agents N in each.
        radius: radius of the ball, m.
        min_distance: smallest distance between two agents, m.
        generator: source of randomness; its device is where the positions are made.
        dtype: floating-point type.

    Returns:
        positions, m [B, N, 3].

    Raises:
        InputError: when the agents do not fit.
    """

    def draw() -> Tensor:
        device = generator.device
        direction = torch.randn(flocks, agents, 3, generator=generator, device=device, dtype=dtype)
        share = torch.rand(flocks, agents, 1, generator=generator, device=device, dtype=dtype)
        return radius * share.pow(1 / 3) * direction / direction.norm(dim=-1, keepdim=True)

    position = draw()
    for _ in range(MAX_DRAWS):
        difference = position.unsqueeze(-2) - position.unsqueeze(-3)
        close = difference.square().sum(-1) < min_distance**2
        # Of each pair that is too close, only the later agent is drawn again.
        redraw = close.tril(-1).any(-1, keepdim=True)
        if not redraw.any():
            return position
        position = torch.where(redraw, draw(), position)
    raise InputError(
        f"{agents} agents at least {min_distance} m apart do not fit into a ball of radius {radius:.3g} m; "
        "lower env.start_distance or raise env.start_radius"
    )
