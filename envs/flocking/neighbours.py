"""Pairs of agents that are near each other, with memory for these pairs alone."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.utils.tensors import (
    PAIRS_IN_BLOCK,
    PAIRS_IN_BLOCK_ELSEWHERE,
    pair_blocks,
    pair_differences,
    squared_norm,
)

__all__ = ["link_list", "near_pairs"]

MANY = 512  # agents of a flock from which on sorting them into cells can pay
GAIN = 16  # comparing a pair found through cells costs as much as this many pairs of a block
SLACK = 1.001  # cells are this much wider than the radius, so that rounding puts no pair two cells apart


def near_pairs(position: Tensor, radius: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All ordered pairs of agents of one flock that are within a radius of each other.

    Where flocks are large and wide, agents are sorted into cells of the width of the radius, and compared with those of
    neighbouring cells; elsewhere all pairs are compared, in blocks. Both give the same, bit for bit: the pairs whose
    `modgnn_rl.utils.tensors.pair_distances` are at most the radius.

    Args:
        position: m [B, N, 3]; agents whose position is not finite are near nobody.
        radius: finite, m.

    Returns:
        flock, receiver and sender of each pair, int64 [E] each, and their distance, m [E]; sorted by flock, receiver
        and sender.
    """
    flocks, agents = position.shape[:2]
    cells = _Cells(position, radius) if agents >= MANY else None
    if cells is not None and GAIN * cells.num_candidates < flocks * agents**2:
        place, distance = cells.near_pairs()
    else:
        place, distance = _compare_all(position, radius)
    receiver = place.div(agents, rounding_mode="floor")  # numbered through all flocks
    return receiver.div(agents, rounding_mode="floor"), receiver % agents, place % agents, distance


def _compare_all(position: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Places of the near pairs in the matrices of all flocks [B, N, N], flattened, ascending; their distances."""
    agents = position.shape[1]
    places, distances = [], []
    for flocks, receivers in pair_blocks(position):
        distance = squared_norm(pair_differences(position[flocks], receivers)).sqrt()
        near = distance <= radius
        near.diagonal(receivers.start, -2, -1).fill_(False)
        place = near.flatten().nonzero().squeeze(-1)
        distances.append(distance.flatten()[place])
        places.append(place + (flocks.start * agents + receivers.start) * agents)
    return torch.cat(places), torch.cat(distances)


class _Cells:
    """The agents of all flocks sorted into cubic cells.

    Along z the cells of a column have successive numbers, so that the 27 cells around an agent are 9 ranges of the
    sorted agents.

    Args:
        position: m [B, N, 3].
        radius: m.
    """

    def __init__(self, position: Tensor, radius: float) -> None:
        flocks, self.num_agents = position.shape[:2]
        self.radius = radius
        nodes = position.flatten(0, 1)
        finite = nodes.isfinite().all(-1).nonzero().squeeze(-1)
        self.component = nodes.t().contiguous()
        inside = nodes[finite].double()
        if len(finite):
            inside -= inside.amin(0)
        # So far apart that numbers would overflow, agents share the last cell; whoever is near stays in the next or it.
        last = int((2**62 / max(1, flocks)) ** (1 / 3)) - 8
        cell = (inside / (SLACK * max(radius, 1e-9))).clamp(max=last).long() + 1
        tall, wide, deep = (cell.amax(0) + 2).tolist() if len(finite) else (0, 0, 0)
        flock = finite.div(self.num_agents, rounding_mode="floor")
        number, order = (((flock * tall + cell[:, 0]) * wide + cell[:, 1]) * deep + cell[:, 2]).sort()
        column = torch.tensor([(x * wide + y) * deep for x in (-1, 0, 1) for y in (-1, 0, 1)], device=number.device)
        middle = number.unsqueeze(-1) + column
        self.node = finite[order]  # agents, numbered through all flocks, in the order of their cells [M]
        self.begin = torch.searchsorted(number, middle - 1)  # of the ranges of this order around each of them [M, 9]
        self.count = torch.searchsorted(number, middle + 1, right=True) - self.begin
        self.candidates = self.count.sum(-1).cumsum(0)
        self.num_candidates = int(self.candidates[-1]) if len(finite) else 0

    def near_pairs(self) -> tuple[Tensor, Tensor]:
        """See `_compare_all`."""
        places, distances = [self.node[:0]], [self.component[0, :0]]
        for rows in self._blocks():
            receiver, sender = self._pairs(rows)
            difference = self.component[:, sender] - self.component[:, receiver]
            distance = squared_norm(difference.unbind()).sqrt()
            near = ((distance <= self.radius) & (sender != receiver)).nonzero().squeeze(-1)
            places.append(receiver[near] * self.num_agents + sender[near] % self.num_agents)
            distances.append(distance[near])
        place, order = torch.cat(places).sort()
        return place, torch.cat(distances)[order]

    def _blocks(self) -> Iterator[slice]:
        """Rows with a bounded number of candidates together, at least one row each."""
        if self.num_candidates == 0:
            return
        size = PAIRS_IN_BLOCK.get(self.node.device.type, PAIRS_IN_BLOCK_ELSEWHERE)
        marks = torch.arange(0, self.num_candidates, size, device=self.node.device)
        starts = torch.searchsorted(self.candidates, marks, right=True).unique().tolist()
        for start, stop in zip(starts, [*starts[1:], len(self.node)], strict=True):
            yield slice(start, stop)

    def _pairs(self, rows: slice) -> tuple[Tensor, Tensor]:
        """Agents and those in the cells around them, numbered through all flocks."""
        count = self.count[rows].flatten()
        receiver = self.node[rows].repeat_interleave(self.count[rows].sum(-1))
        skipped = self.begin[rows].flatten() - (count.cumsum(0) - count)
        sender = self.node[skipped.repeat_interleave(count) + torch.arange(len(receiver), device=count.device)]
        return receiver, sender


def link_list(flock: Tensor, receiver: Tensor, sender: Tensor, num_envs: int, room: int) -> Tensor:
    """Links [L] of all flocks, sorted by flock, as one list for each.

    Args:
        flock: flock of each link, int64 [L].
        receiver: agent that hears, int64 [L].
        sender: agent that is heard, int64 [L].
        num_envs: flocks B.
        room: length of a list, E.

    Returns:
        int64 [B, 2, E]: senders, below them receivers, filled up with -1.

    Raises:
        InputError: where a flock has more links than there is room for.
    """
    counts = torch.bincount(flock, minlength=num_envs)
    if bool((counts > room).any()):
        worst = int(counts.argmax())
        raise InputError(
            f"flock {worst} has {int(counts[worst])} links, and its list has room for {room}: raise env.max_links, "
            "or use env.graph=matrix"
        )
    place = torch.arange(len(flock), device=flock.device) - (counts.cumsum(0) - counts)[flock]
    links = torch.full((num_envs, 2, room), -1, dtype=torch.long, device=flock.device)
    links[flock, 0, place] = sender
    links[flock, 1, place] = receiver
    return links
