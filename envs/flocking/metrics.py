"""Metrics of a flock: those of the paper (section Results) and safety, as functions of tensors.

A flock is ``position [*B, N, 3]`` in metres, with any leading dimensions ``*B`` (flocks, time steps, seeds); the
result has one value per flock, ``[*B]``, unless it says otherwise. Distances are computed from coordinate differences
in the given dtype, never by expanding the square, which loses close pairs far from the origin.

Each is registered with what tables and dashboards need to know of it; `modgnn_rl.metrics` explains the options.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from modgnn_rl.envs.flocking.spheres import smallest_enclosing_sphere
from modgnn_rl.errors import InputError
from modgnn_rl.registry import METRICS
from modgnn_rl.utils.tensors import pair_blocks, pair_differences, squared_norm

__all__ = [
    "cohesion",
    "collision_rate",
    "is_diverged",
    "leader_distance",
    "leader_lost",
    "min_distance",
    "separation",
]


@METRICS.register(
    "leader_distance",
    task="flocking",
    title="leader distance",
    unit="m",
    better="lower",
    about="distance from the leader to the centre of mass of the others",
    over_time="mean",
    cell="{mean:.2f} ± {std:.2f} [{low:.2f}, {high:.2f}]",
    replay=True,
)
def leader_distance(position: Tensor, leader: int = 0) -> Tensor:
    """Distance from the leader to the centre of mass of the others, ``|p_l - mean_{i != l} p_i|``.

    Args:
        position: ``[*B, N, 3]``, m.
        leader: index of the leader.

    Returns:
        ``[*B]`` in m; 0 for a leader without followers.

    Raises:
        InputError: there is no agent ``leader``.
    """
    lead, rest = _split(position, leader)
    if rest.shape[-2] == 0:
        return position.new_zeros(position.shape[:-2])
    distance: Tensor = torch.linalg.vector_norm(lead - rest.mean(-2), dim=-1)
    return distance


@METRICS.register(
    "cohesion",
    task="flocking",
    title="cohesion",
    unit="m",
    better="lower",
    about="diameter of the smallest sphere that encloses all agents",
    over_time="mean",
    cell="{mean:.2f} ± {std:.2f} [{low:.2f}, {high:.2f}]",
    every=10,
    replay=True,
)
def cohesion(position: Tensor) -> Tensor:
    """Diameter of the smallest sphere that encloses all agents.

    Args:
        position: ``[*B, N, 3]``, m.

    Returns:
        ``[*B]`` in m, without gradient; NaN for a flock with a coordinate that is NaN or infinite.
    """
    return 2 * smallest_enclosing_sphere(position)[1]


@METRICS.register(
    "separation",
    task="flocking",
    title="separation",
    unit="m",
    better="higher",
    about="distance from an agent to its nearest neighbour",
    over_time="mean",
    cell="{mean:.2f} ± {std:.2f} [{low:.2f}, {high:.2f}]",
    replay=True,
)
def separation(position: Tensor) -> Tensor:
    """Distance from each agent to its nearest neighbour, ``min_{j != i} |p_i - p_j|``.

    Its mean over the agents and flocks is what the paper's tables report, its standard deviation how regular the
    formation is.

    Args:
        position: ``[*B, N, 3]``, m.

    Returns:
        ``[*B, N]`` in m; NaN for a flock of one, and for all agents of a flock that contains a NaN.
    """
    if position.shape[-2] == 1:
        return torch.full_like(position[..., 0], torch.nan)
    nearest = torch.cat([block.amin(-1).flatten() for block in _squared_distances(position)])
    return nearest.sqrt().reshape(position.shape[:-1])


@METRICS.register(
    "min_distance",
    task="flocking",
    title="minimum distance",
    unit="m",
    better="higher",
    about="smallest distance between two agents at any step of any episode",
    over_time="min",
    cell="{min:.2f}",
)
def min_distance(position: Tensor) -> Tensor:
    """Distance of the closest pair, ``min_{i < j} |p_i - p_j|``.

    Args:
        position: ``[*B, N, 3]``, m.

    Returns:
        ``[*B]`` in m; NaN for a flock of one or one that contains a NaN.
    """
    return separation(position).amin(-1)


@METRICS.register(
    "collision_rate",
    task="flocking",
    title="collision rate",
    unit="pairs",
    better="lower",
    about="number of pairs of agents closer than env.collision_distance, mean over the steps",
    settings=("collision_distance",),
    over_time="mean",
    cell="{mean:.2g}",
)
def collision_rate(position: Tensor, distance: float) -> Tensor:
    """Number of colliding pairs: ``i < j`` with ``|p_i - p_j| < distance``.

    Args:
        position: ``[*B, N, 3]``, m.
        distance: below which two agents collide, m.

    Returns:
        ``[*B]``, int64. A pair with a NaN or infinite coordinate does not count.
    """
    close = torch.cat([(block.sqrt() < distance).sum(-1).flatten() for block in _squared_distances(position)])
    return close.reshape(position.shape[:-1]).sum(-1) // 2


@METRICS.register(
    "leader_lost",
    task="flocking",
    title="leader lost",
    unit="%",
    better="lower",
    about="fraction of episodes that end with the leader out of everyone's range (env.comm_range)",
    settings=("comm_range",),
    over_time="last",
    cell="{mean:.0%}",
)
def leader_lost(position: Tensor, comm_range: float, leader: int = 0) -> Tensor:
    """Whether the flock has lost its leader: no agent is within ``comm_range`` of it.

    Args:
        position: ``[*B, N, 3]``, m.
        comm_range: distance up to which agents communicate, m.
        leader: index of the leader.

    Returns:
        ``[*B]`` bool; False for a leader without followers, True for one whose position is NaN or infinite.

    Raises:
        InputError: there is no agent ``leader``.
    """
    lead, rest = _split(position, leader)
    if rest.shape[-2] == 0:
        return torch.zeros(position.shape[:-2], dtype=torch.bool, device=position.device)
    distance: Tensor = torch.linalg.vector_norm(rest - lead[..., None, :], dim=-1)
    return ~(distance <= comm_range).any(-1)


@METRICS.register(
    "diverged",
    task="flocking",
    title="diverged",
    unit="%",
    better="lower",
    about="fraction of episodes in which an agent is farther than env.max_distance from the centre of mass",
    settings=("max_distance",),
    over_time="any",
    cell="{mean:.0%}",
)
def is_diverged(position: Tensor, max_distance: float, exists: Tensor | None = None) -> Tensor:
    """Whether the flock has fallen apart: some agent is too far from the centre of mass, or NaN or infinite.

    Args:
        position: ``[*B, N, 3]``, m.
        max_distance: largest distance from the centre of mass of all agents, m.
        exists: ``[*B, N]`` bool, the agents that count; default: all.

    Returns:
        ``[*B]`` bool.
    """
    if exists is not None:
        there = exists.unsqueeze(-1)
        centre = torch.where(there, position, 0.0).sum(-2, keepdim=True) / there.sum(-2, keepdim=True)
        position = torch.where(there, position, centre)
    distance = squared_norm((position - position.mean(-2, keepdim=True)).unbind(-1)).sqrt()
    return ~(distance <= max_distance).all(-1)  # written so that a NaN counts as diverged


def _split(position: Tensor, leader: int) -> tuple[Tensor, Tensor]:
    """Return the leader's position ``[*B, 3]`` and the others' ``[*B, N - 1, 3]``."""
    num_agents = position.shape[-2]
    if not 0 <= leader < num_agents:
        raise InputError(f"leader={leader} is not an agent of a flock of {num_agents}; give 0 to {num_agents - 1}")
    return position[..., leader, :], torch.cat([position[..., :leader, :], position[..., leader + 1 :, :]], -2)


def _squared_distances(position: Tensor) -> Iterator[Tensor]:
    """Yield the squared distances of all pairs in blocks that stay small.

    A block ``[flocks, agents, N]`` holds several whole flocks, or some agents of one large flock against all; the
    blocks follow the order of ``position.flatten(0, -2)``. An agent's distance to itself is infinite.
    """
    position = position.reshape(-1, *position.shape[-2:])
    for flocks, agents in pair_blocks(position):
        squared = squared_norm(pair_differences(position[flocks], agents))
        squared.diagonal(agents.start, 1, 2).fill_(torch.inf)
        yield squared
