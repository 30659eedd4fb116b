"""The communication graph: who receives from whom, as an adjacency matrix or as an edge list.

Both functions also return each agent's distance to the nearest other agent, which rewards and collisions need.
"""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.envs.flocking.perturbations import Perturbations
from modgnn_rl.errors import InputError
from modgnn_rl.utils.neighbours import near_pairs
from modgnn_rl.utils.tensors import pair_distances

__all__ = ["adjacency_matrix", "edge_list", "padded_edge_list"]


def adjacency_matrix(position: Tensor, send_range: Tensor | float) -> tuple[Tensor, Tensor]:
    """Compute the graph from all pairs of agents.

    Args:
        position: m [B, N, 3].
        send_range: distance within which an agent is heard, m; for each sender [B, N], or one for all.

    Returns:
        the adjacency, bool [B, N, N], whose entry i, j says that i receives from j; the distance to the nearest other
        agent, m [B, N].
    """
    distance = pair_distances(position)  # infinite on the diagonal, so the range must be finite
    largest = torch.finfo(position.dtype).max
    if isinstance(send_range, Tensor):
        send_range = send_range.clamp(max=largest).unsqueeze(-2)
    else:
        send_range = min(send_range, largest)
    return distance <= send_range, distance.amin(-1)


def edge_list(
    position: Tensor, perturbations: Perturbations, present: Tensor | None, nearest_range: float, capacity: int
) -> tuple[Tensor, Tensor]:
    """Compute the graph with memory proportional to the number of edges, perturbations included.

    Args:
        position: m [B, N, 3].
        perturbations: radio ranges and packet loss.
        present: agents that send and receive, bool [B, N]; default: all.
        nearest_range: distance up to which the nearest agent is found, m.
        capacity: length E of each flock's list.

    Returns:
        the edges, int64 [B, 2, E], senders in the first row, receivers in the second, padded with -1; the distance to
        the nearest other agent, m [B, N], infinite where it is beyond both ranges.

    Raises:
        InputError: a flock has more edges than its list can hold.
    """
    flocks, agents = position.shape[:2]
    config = perturbations.config
    flock, receiver, sender, distance = near_pairs(
        position, max(config.comm_range * (1 + config.range_spread), nearest_range)
    )
    nearest = torch.full((flocks * agents,), torch.inf, dtype=position.dtype, device=position.device)
    nearest.scatter_reduce_(0, flock * agents + receiver, distance, "amin")
    send_range = perturbations.send_range
    is_edge = distance <= (config.comm_range if send_range is None else send_range[flock, sender])
    if present is not None:
        is_edge &= present[flock, sender] & present[flock, receiver]
    delivered = perturbations.sample_delivered(len(is_edge))
    if delivered is not None:
        is_edge &= delivered
    edges = padded_edge_list(flock[is_edge], receiver[is_edge], sender[is_edge], flocks, capacity)
    return edges, nearest.view(flocks, agents)


def padded_edge_list(flock: Tensor, receiver: Tensor, sender: Tensor, num_envs: int, capacity: int) -> Tensor:
    """Split edges of all flocks, sorted by flock, into one list per flock.

    Args:
        flock: flock of each edge, int64 [L].
        receiver: agent that receives, int64 [L].
        sender: agent that sends, int64 [L].
        num_envs: flocks B.
        capacity: length E of a list.

    Returns:
        int64 [B, 2, E]: senders in the first row, receivers in the second, padded with -1.

    Raises:
        InputError: a flock has more than E edges.
    """
    counts = torch.bincount(flock, minlength=num_envs)
    if bool((counts > capacity).any()):
        worst = int(counts.argmax())
        raise InputError(
            f"flock {worst} has {int(counts[worst])} edges, but its list holds only {capacity}: raise env.max_links, "
            "or use env.graph=matrix"
        )
    place = torch.arange(len(flock), device=flock.device) - (counts.cumsum(0) - counts)[flock]
    edges = torch.full((num_envs, 2, capacity), -1, dtype=torch.long, device=flock.device)
    edges[flock, 0, place] = sender
    edges[flock, 1, place] = receiver
    return edges
