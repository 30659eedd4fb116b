"""Pairs of agents within a radius of each other, with memory proportional to the number of these pairs."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from modgnn_rl.utils.tensors import (
    PAIRS_IN_BLOCK,
    PAIRS_IN_BLOCK_ELSEWHERE,
    pair_blocks,
    pair_differences,
    squared_norm,
)

__all__ = ["near_pairs"]

MANY = 512  # agents per flock above which sorting them into cells may be faster
GAIN = 16  # comparing a pair found through cells costs as much as comparing this many pairs in a block
SLACK = 1.001  # cell width over radius, so that rounding puts no pair two cells apart


def near_pairs(position: Tensor, radius: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find all ordered pairs of agents of the same flock that are within a radius of each other.

    In large, spread-out flocks, agents are sorted into cells as wide as the radius and compared with those in adjacent
    cells; otherwise all pairs are compared, in blocks. Both give the same pairs, bit for bit: those whose
    `modgnn_rl.utils.tensors.pair_distances` are at most the radius.

    Args:
        position: m [B, N, 3]; agents with a position that is NaN or infinite are in no pair.
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
    receiver = place.div(agents, rounding_mode="floor")  # index over all flocks
    return receiver.div(agents, rounding_mode="floor"), receiver % agents, place % agents, distance


def _compare_all(position: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Indices of the near pairs in the flattened matrices of all flocks [B, N, N], ascending; their distances."""
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
    """The agents of all flocks, sorted into cubic cells.

    Cells are numbered consecutively along z, so the 27 cells around an agent are 9 ranges of the sorted agents.

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
        # Agents so far away that indices would overflow share the last cell; near agents stay in it or the one before.
        last = int((2**62 / max(1, flocks)) ** (1 / 3)) - 8
        cell = (inside / (SLACK * max(radius, 1e-9))).clamp(max=last).long() + 1
        tall, wide, deep = (cell.amax(0) + 2).tolist() if len(finite) else (0, 0, 0)
        flock = finite.div(self.num_agents, rounding_mode="floor")
        number, order = (((flock * tall + cell[:, 0]) * wide + cell[:, 1]) * deep + cell[:, 2]).sort()
        column = torch.tensor([(x * wide + y) * deep for x in (-1, 0, 1) for y in (-1, 0, 1)], device=number.device)
        middle = number.unsqueeze(-1) + column
        self.node = finite[order]  # agents, indexed over all flocks, in the order of their cells [M]
        self.begin = torch.searchsorted(number, middle - 1)  # start of each of the 9 ranges around each of them [M, 9]
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
        """Yield ranges of rows, at least one row each, whose numbers of candidates add up to a bounded size."""
        if self.num_candidates == 0:
            return
        size = PAIRS_IN_BLOCK.get(self.node.device.type, PAIRS_IN_BLOCK_ELSEWHERE)
        marks = torch.arange(0, self.num_candidates, size, device=self.node.device)
        starts = torch.searchsorted(self.candidates, marks, right=True).unique().tolist()
        for start, stop in zip(starts, [*starts[1:], len(self.node)], strict=True):
            yield slice(start, stop)

    def _pairs(self, rows: slice) -> tuple[Tensor, Tensor]:
        """Agents and those in the cells around them, indexed over all flocks."""
        count = self.count[rows].flatten()
        receiver = self.node[rows].repeat_interleave(self.count[rows].sum(-1))
        skipped = self.begin[rows].flatten() - (count.cumsum(0) - count)
        sender = self.node[skipped.repeat_interleave(count) + torch.arange(len(receiver), device=count.device)]
        return receiver, sender
