"""Who hears whom, and how near the nearest is, as matrices or as lists."""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.envs.flocking.perturbations import Perturbations
from modgnn_rl.envs.flocking.neighbours import link_list, near_pairs
from modgnn_rl.utils.tensors import pair_distances

__all__ = ["hear_all_pairs", "hear_near_pairs"]


def hear_all_pairs(position: Tensor, reach: Tensor | float) -> tuple[Tensor, Tensor]:
    """Compare all pairs of agents.

    Args:
        position: m [B, N, 3].
        reach: distance within which agents are heard, m; of each sender [B, N] or of all.

    Returns:
        the adjacency, bool [B, N, N], whose entry i, j says that i hears j; the distance of the nearest other agent,
        m [B, N].
    """
    distance = pair_distances(position)  # infinite to oneself, so that no reach may be
    farthest = torch.finfo(position.dtype).max
    reach = reach.clamp(max=farthest).unsqueeze(-2) if isinstance(reach, Tensor) else min(reach, farthest)
    return distance <= reach, distance.amin(-1)


def hear_near_pairs(
    position: Tensor, perturbations: Perturbations, heard: Tensor | None, nearby: float, room: int
) -> tuple[Tensor, Tensor]:
    """The same with memory for the links alone, faults included.

    Args:
        position: m [B, N, 3].
        faults: radios and losses.
        heard: agents that take part, bool [B, N]; default: all.
        nearby: distance up to which the nearest agent is looked for, m.
        room: links that each flock's list has room for, E.

    Returns:
        the links, int64 [B, 2, E], senders above receivers, filled up with -1; the distance of the nearest other agent,
        m [B, N], infinite where none is near.

    Raises:
        InputError: where a flock has more links.
    """
    flocks, agents = position.shape[:2]
    reach = perturbations.config.comm_range * (1 + perturbations.config.range_spread)
    flock, receiver, sender, distance = near_pairs(position, max(reach, nearby))
    nearest = torch.full((flocks * agents,), torch.inf, dtype=position.dtype, device=position.device)
    nearest.scatter_reduce_(0, flock * agents + receiver, distance, "amin")
    hears = distance <= (
        perturbations.config.comm_range if perturbations.reach is None else perturbations.reach[flock, sender]
    )
    if heard is not None:
        hears &= heard[flock, sender] & heard[flock, receiver]
    arrived = perturbations.arrived(len(hears))
    if arrived is not None:
        hears &= arrived
    links = link_list(flock[hears], receiver[hears], sender[hears], flocks, room)
    return links, nearest.view(flocks, agents)
