"""How well a flock flies: the paper's metrics (section Results) and a few about safety, as functions of tensors.

A flock is ``position [*B, N, 3]`` in metres, with any leading dimensions ``*B`` (flocks, time steps, seeds); the
result has one number for each flock, ``[*B]``, unless it says otherwise. Distances are taken from coordinate
differences in the dtype given, never by the expansion of the square, which loses close pairs far from the origin.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from modgnn_rl.envs.flocking.spheres import smallest_enclosing_sphere
from modgnn_rl.errors import InputError
from modgnn_rl.utils.tensors import pair_blocks, pair_differences, squared_norm

__all__ = [
    "action_error",
    "cohesion",
    "collision_rate",
    "is_diverged",
    "leader_distance",
    "leader_lost",
    "min_distance",
    "separation",
]


def action_error(action: Tensor, expert_action: Tensor, controlled: Tensor) -> Tensor:
    """Mean squared error per component against the expert, over the agents that the policy flies.

    ``sum_i c_i |u_i - u*_i|^2 / (D sum_i c_i)`` with ``c = controlled``; the paper's "Error". What the other agents
    hold has no influence, not even a NaN.

    Args:
        action: ``[*B, N, D]``, target velocity in m/s.
        expert_action: ``[*B, N, D]``, m/s.
        controlled: ``[*B, N]`` bool, the agents that the policy flies.

    Returns:
        ``[*B]`` in (m/s)^2; NaN for a flock in which the policy flies nobody.
    """
    squared = (action - expert_action).square().mean(-1)
    return torch.where(controlled, squared, 0.0).sum(-1) / controlled.sum(-1)


def leader_distance(position: Tensor, leader: int = 0) -> Tensor:
    """Distance from the leader to the centre of mass of the rest, ``|p_l - mean_{i != l} p_i|``.

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


def cohesion(position: Tensor) -> Tensor:
    """Diameter of the smallest sphere that holds all agents.

    Args:
        position: ``[*B, N, 3]``, m.

    Returns:
        ``[*B]`` in m, without gradient; NaN for a flock with a coordinate that is not finite.
    """
    return 2 * smallest_enclosing_sphere(position)[1]


def separation(position: Tensor) -> Tensor:
    """Distance from each agent to its nearest neighbour, ``min_{j != i} |p_i - p_j|``.

    Its mean over the agents and flocks is what the paper's tables report, its standard deviation how regular the
    formation is.

    Args:
        position: ``[*B, N, 3]``, m.

    Returns:
        ``[*B, N]`` in m; NaN for an agent alone, and for all agents of a flock that holds a NaN.
    """
    if position.shape[-2] == 1:
        return torch.full_like(position[..., 0], torch.nan)
    nearest = torch.cat([block.amin(-1).flatten() for block in _squared_distances(position)])
    return nearest.sqrt().reshape(position.shape[:-1])


def min_distance(position: Tensor) -> Tensor:
    """Distance of the closest pair, ``min_{i < j} |p_i - p_j|``.

    Args:
        position: ``[*B, N, 3]``, m.

    Returns:
        ``[*B]`` in m; NaN where there is no pair, and for a flock that holds a NaN.
    """
    return separation(position).amin(-1)


def collision_rate(position: Tensor, distance: float) -> Tensor:
    """Number of pairs ``i < j`` with ``|p_i - p_j| < distance``.

    Args:
        position: ``[*B, N, 3]``, m.
        distance: m.

    Returns:
        ``[*B]``, int64. A pair with a coordinate that is not finite does not count.
    """
    close = torch.cat([(block.sqrt() < distance).sum(-1).flatten() for block in _squared_distances(position)])
    return close.reshape(position.shape[:-1]).sum(-1) // 2


def is_diverged(position: Tensor, max_distance: float, exists: Tensor | None = None) -> Tensor:
    """Whether the flock has fallen apart: some agent is too far from the centre of mass, or not finite.

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


def leader_lost(position: Tensor, comm_range: float, leader: int = 0) -> Tensor:
    """Whether the flock has lost its leader: nobody is within ``comm_range`` of it.

    Args:
        position: ``[*B, N, 3]``, m.
        comm_range: distance at which agents still hear each other, m.
        leader: index of the leader.

    Returns:
        ``[*B]`` bool; False for a leader without followers, True for one whose position is not finite.

    Raises:
        InputError: there is no agent ``leader``.
    """
    lead, rest = _split(position, leader)
    if rest.shape[-2] == 0:
        return torch.zeros(position.shape[:-2], dtype=torch.bool, device=position.device)
    distance: Tensor = torch.linalg.vector_norm(rest - lead[..., None, :], dim=-1)
    return ~(distance <= comm_range).any(-1)


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
