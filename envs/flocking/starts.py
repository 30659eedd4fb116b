"""Initial positions of flocks."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.utils.neighbours import near_pairs

__all__ = ["clusters", "grid", "start_positions", "uniform_ball"]

MAX_SAMPLES = 1000
BALL_AS_CUBE = (4 / 3 * math.pi) ** (1 / 3)  # side of the cube with the volume of a ball of radius 1
CLUSTER_SPACING = 2.4  # distance between the centres of adjacent clusters, in cluster radii


def start_positions(
    kind: str,
    flocks: int,
    agents: int,
    radius: float | Tensor,
    min_distance: float,
    num_clusters: int,
    *,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
    exists: Tensor | None = None,
) -> Tensor:
    """Sample the initial positions of flocks.

    Args:
        kind: ``ball``, see `uniform_ball`; ``grid``, see `grid`; ``clusters``, see `clusters`.
        flocks: number of flocks B.
        agents: number of agents N in each.
        radius: of the ball, m, or of each flock's ball [B]; grid and clusters have the same volume.
        min_distance: minimum distance between two agents, m.
        num_clusters: number of clusters.
        generator: source of randomness; positions are on its device.
        dtype: floating-point type.
        exists: agents that exist, bool [B, N]; the positions of the others are arbitrary. Default: all.

    Returns:
        positions, m [B, N, 3].

    Raises:
        InputError: the agents do not fit.
    """
    if kind == "grid":
        return grid(flocks, agents, radius, min_distance, generator=generator, dtype=dtype, exists=exists)
    if kind == "clusters":
        return clusters(
            flocks, agents, radius, min_distance, num_clusters, generator=generator, dtype=dtype, exists=exists
        )
    return uniform_ball(flocks, agents, radius, min_distance, generator=generator, dtype=dtype, exists=exists)


def uniform_ball(
    flocks: int,
    agents: int,
    radius: float | Tensor,
    min_distance: float,
    *,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
    exists: Tensor | None = None,
) -> Tensor:
    """Agents uniform in a ball around the origin, resampled where two are too close; see `start_positions`."""
    size = _by_flock(radius, generator, dtype)
    return _apart(lambda: _in_ball(flocks, agents, size, generator, dtype), min_distance, radius, exists)


def grid(
    flocks: int,
    agents: int,
    radius: float | Tensor,
    min_distance: float,
    *,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
    exists: Tensor | None = None,
) -> Tensor:
    """Agents at random sites of a cubic grid around the origin, with small random offsets; see `start_positions`."""
    device = generator.device
    exists = torch.ones(flocks, agents, dtype=torch.bool, device=device) if exists is None else exists
    side = _side(exists.sum(-1, keepdim=True))
    spacing = BALL_AS_CUBE * _by_flock(radius, generator, dtype) / side.unsqueeze(-1)
    if (spacing < min_distance).any():
        raise _too_crowded(agents, min_distance, radius)
    site = torch.arange(int(_side(torch.tensor(agents))) ** 3, device=device)
    priority = torch.rand(flocks, len(site), generator=generator, device=device)
    order = priority.masked_fill(site >= side**3, torch.inf).argsort(-1)
    site = order.gather(-1, (exists.cumsum(-1) - 1).clamp(min=0))
    # Offsets of half the free space would allow the minimum distance; a quarter keeps the grid recognisable.
    max_offset = (spacing - min_distance) / 4
    offset = 2 * torch.rand(flocks, agents, 3, generator=generator, device=device, dtype=dtype) - 1
    return (_place(site, side).to(dtype) - (side.unsqueeze(-1) - 1) / 2) * spacing + max_offset * offset


def clusters(
    flocks: int,
    agents: int,
    radius: float | Tensor,
    min_distance: float,
    num_clusters: int,
    *,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
    exists: Tensor | None = None,
) -> Tensor:
    """Agents in several balls whose total volume is that of one ball of ``radius``; see `start_positions`.

    The balls lie close together, without overlap, on a cubic grid in a random orientation. Agents are assigned to them
    in turn, the leader to a random one.
    """
    device = generator.device
    size = _by_flock(radius, generator, dtype) * num_clusters ** (-1 / 3)
    site = torch.arange(num_clusters, device=device)
    place = _place(site, _side(torch.tensor(num_clusters, device=device))).to(dtype)
    turn = torch.linalg.qr(torch.randn(flocks, 3, 3, generator=generator, device=device, dtype=dtype))[0]
    centre = CLUSTER_SPACING * size * ((place - place.mean(0)) @ turn)
    home = torch.arange(agents, device=device) + torch.randint(
        num_clusters, (flocks, 1), generator=generator, device=device
    )
    centre = centre.gather(1, (home % num_clusters).unsqueeze(-1).expand(-1, -1, 3))
    return _apart(lambda: centre + _in_ball(flocks, agents, size, generator, dtype), min_distance, radius, exists)


def _by_flock(radius: float | Tensor, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """The radius [B or 1, 1, 1]."""
    return torch.as_tensor(radius, dtype=dtype, device=generator.device).view(-1, 1, 1)


def _side(count: Tensor) -> Tensor:
    """Sites along the side of the smallest cubic grid with at least ``count`` sites."""
    return (count.double() ** (1 / 3)).sub(1e-6).ceil().clamp(min=1).long()


def _place(site: Tensor, side: Tensor) -> Tensor:
    """Coordinates [..., 3] of sites of a cubic grid [...]; consecutive sites are adjacent along a row."""
    return torch.stack((site // side**2, site // side % side, site % side), -1)


def _in_ball(flocks: int, agents: int, radius: Tensor, generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Points uniform in a ball around the origin [B, N, 3]."""
    device = generator.device
    direction = torch.randn(flocks, agents, 3, generator=generator, device=device, dtype=dtype)
    fraction = torch.rand(flocks, agents, 1, generator=generator, device=device, dtype=dtype)
    return radius * fraction.pow(1 / 3) * direction / direction.norm(dim=-1, keepdim=True)


def _apart(sample: Callable[[], Tensor], min_distance: float, radius: float | Tensor, exists: Tensor | None) -> Tensor:
    """Sample positions [B, N, 3]; of each pair that is too close, resample the agent with the larger index."""
    position = sample()
    if not min_distance:
        return position
    for _ in range(MAX_SAMPLES):
        candidates = position if exists is None else position.masked_fill(~exists.unsqueeze(-1), torch.nan)
        flock, later, earlier, distance = near_pairs(candidates, min_distance)
        close = (distance < min_distance) & (earlier < later)
        if not close.any():
            return position
        resample = torch.zeros(position.shape[:2], dtype=torch.bool, device=position.device)
        resample[flock[close], later[close]] = True
        position = torch.where(resample.unsqueeze(-1), sample(), position)
    raise _too_crowded(position.shape[1], min_distance, radius)


def _too_crowded(agents: int, min_distance: float, radius: float | Tensor) -> InputError:
    return InputError(
        f"{agents} agents at least {min_distance} m apart do not fit into a ball of radius "
        f"{float(torch.as_tensor(radius).max()):.3g} m; lower env.start_distance or raise env.start_radius"
    )
