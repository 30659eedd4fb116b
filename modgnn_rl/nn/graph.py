"""Directed graphs between agents in two representations with one interface: a list of edges, or all pairs with a mask.

The nodes of all graphs of a batch are numbered consecutively: agent i of graph g is node ``g N + i``. `EdgeList`
computes existing edges only. `DenseGraph` computes all pairs, in shapes that do not depend on the data, as compilers
and ``vmap`` require. `modgnn_rl.nn.topology.Topology` reads the user's adjacency and chooses the representation.
"""

from __future__ import annotations

import abc

import torch
from torch import Tensor

from modgnn_rl.utils.tensors import flatnonzero

__all__ = ["AGGREGATIONS", "DenseGraph", "EdgeList", "Graph"]

AGGREGATIONS = ("sum", "mean", "max")
BLOCK = {"cpu": 8192}  # edges computed at a time, by device: their activations stay in the processor's cache
BLOCK_ELSEWHERE = 1 << 20


class Graph(abc.ABC):
    """Edges from S senders to R receivers; edge values are tensors [E, ...] in the graph's own order of edges.

    Attributes:
        num_senders: S.
        num_receivers: R.
        weight: edge weights [E], or None.
        feature: edge features [E, F], or None.
    """

    num_senders: int
    num_receivers: int
    weight: Tensor | None
    feature: Tensor | None

    @abc.abstractmethod
    def gather_senders(self, table: Tensor) -> Tensor:
        """The sender's row for every edge: [S, ...] -> [E, ...]."""

    @abc.abstractmethod
    def gather_receivers(self, table: Tensor) -> Tensor:
        """The receiver's row for every edge: [R, ...] -> [E, ...]."""

    @abc.abstractmethod
    def degree(self) -> Tensor:
        """Number of incoming edges of each receiver, integer [R]."""

    @abc.abstractmethod
    def scatter_sum(self, values: Tensor) -> Tensor:
        """Sum over each receiver's incoming edges: [E, F] -> [R, F]; zero without edges."""

    @abc.abstractmethod
    def scatter_max(self, values: Tensor) -> Tensor:
        """Maximum over each receiver's incoming edges: [E, F] -> [R, F]; zero without edges."""

    @abc.abstractmethod
    def subgraph(self, senders: Tensor, receivers: Tensor) -> Graph:
        """The same nodes with only the edges whose two ends are selected, bool [S] and [R]."""

    def aggregate(self, values: Tensor, aggregation: str = "sum") -> Tensor:
        """Aggregate over incoming edges: [E, F] -> [R, F]; ``sum``, ``mean`` or ``max``, zero without edges."""
        if aggregation == "max":
            return self.scatter_max(values)
        total = self.scatter_sum(values)
        return total / self.degree().clamp(min=1).unsqueeze(-1) if aggregation == "mean" else total

    def softmax(self, logits: Tensor) -> Tensor:
        """Softmax over each receiver's incoming edges: [E, H] -> [E, H]."""
        shifted = (logits - self.gather_receivers(self.scatter_max(logits.detach()))).exp()
        # The largest logit contributes 1, so the sum is below 1 only where there is no edge.
        return shifted / self.gather_receivers(self.scatter_sum(shifted)).clamp(min=1)


class EdgeList(Graph):
    """A list of edges, sorted by receiver.

    Args:
        sender: node number of each edge's sender [E].
        receiver: node number of each edge's receiver [E], ascending.
        num_senders: S.
        num_receivers: R.
        weight: edge weights [E].
        feature: edge features [E, F].
    """

    def __init__(
        self,
        sender: Tensor,
        receiver: Tensor,
        num_senders: int,
        num_receivers: int,
        weight: Tensor | None = None,
        feature: Tensor | None = None,
    ) -> None:
        self.sender, self.receiver = sender, receiver
        self.num_senders, self.num_receivers = num_senders, num_receivers
        self.weight, self.feature = weight, feature
        self._degree: Tensor | None = None

    def __len__(self) -> int:
        return len(self.sender)

    def gather_senders(self, table: Tensor) -> Tensor:
        """See `Graph.gather_senders`."""
        return table.index_select(0, self.sender)

    def gather_receivers(self, table: Tensor) -> Tensor:
        """See `Graph.gather_receivers`."""
        return table.index_select(0, self.receiver)

    def degree(self) -> Tensor:
        """See `Graph.degree`."""
        if self._degree is None:
            self._degree = torch.bincount(self.receiver, minlength=self.num_receivers)
        return self._degree

    def offsets(self) -> Tensor:
        """Index of each receiver's first edge [R]."""
        degree = self.degree()
        return degree.cumsum(0) - degree

    def scatter_sum(self, values: Tensor) -> Tensor:
        """See `Graph.scatter_sum`."""
        return values.new_zeros(self.num_receivers, *values.shape[1:]).index_add(0, self.receiver, values)

    def scatter_max(self, values: Tensor) -> Tensor:
        """See `Graph.scatter_max`."""
        zeros = values.new_zeros(self.num_receivers, *values.shape[1:])
        index = self.receiver.view(-1, *[1] * (values.ndim - 1)).expand_as(values)
        return zeros.scatter_reduce(0, index, values, "amax", include_self=False)

    def subgraph(self, senders: Tensor, receivers: Tensor) -> EdgeList:
        """See `Graph.subgraph`."""
        if senders.all() and receivers.all():
            return self
        # index_select takes a third of the time of indexing.
        return self.select(flatnonzero(senders.index_select(0, self.sender) & receivers.index_select(0, self.receiver)))

    def select(self, index: Tensor) -> EdgeList:
        """The same nodes with only the edges of the given numbers, ascending [E']."""
        return EdgeList(
            self.sender.index_select(0, index),
            self.receiver.index_select(0, index),
            self.num_senders,
            self.num_receivers,
            None if self.weight is None else self.weight.index_select(0, index),
            None if self.feature is None else self.feature.index_select(0, index),
        )

    def blocks(self) -> list[tuple[slice, slice]]:
        """Cut the graph into blocks of whole neighbourhoods: a slice of receivers and the slice of their edges."""
        size = BLOCK.get(self.sender.device.type, BLOCK_ELSEWHERE)
        if len(self) <= size:
            return [(slice(0, self.num_receivers), slice(0, len(self)))]
        ends = self.degree().cumsum(0)
        targets = torch.arange(size, len(self), size, device=ends.device)
        cuts = sorted({0, *torch.searchsorted(ends, targets).tolist(), self.num_receivers})
        starts = [*self.offsets()[cuts[:-1]].tolist(), len(self)]
        return [
            (slice(cuts[index], cuts[index + 1]), slice(starts[index], starts[index + 1]))
            for index in range(len(cuts) - 1)
        ]

    def block(self, receivers: slice, edges: slice) -> EdgeList:
        """One block as a graph of its own, whose receivers are numbered from 0."""
        return EdgeList(
            self.sender[edges],
            self.receiver[edges] - receivers.start,
            self.num_senders,
            receivers.stop - receivers.start,
            None if self.weight is None else self.weight[edges],
            None if self.feature is None else self.feature[edges],
        )


class DenseGraph(Graph):
    """All pairs, and a mask that says which of them are edges.

    While gradients are recorded, a pair without an edge gets the data of some existing edge. If there is none, it gets
    ones for the sender and zeros for everything else. What a module computes from these placeholders is masked out, but
    it must not be NaN, which would reach the gradients as ``0 * NaN``.

    Args:
        mask: entry g, i, j says that receiver i of graph g receives from its sender j, bool [G, R, S].
        weight: edge weights [G, R, S].
        feature: edge features [G, R, S, F].
    """

    def __init__(self, mask: Tensor, weight: Tensor | None = None, feature: Tensor | None = None) -> None:
        self.mask = mask
        graphs, receivers, senders = mask.shape
        self.num_senders, self.num_receivers = graphs * senders, graphs * receivers
        self._some_edge: Tensor | None = None
        self.weight = None if weight is None else self._with_placeholders(weight.reshape(-1))
        self.feature = None if feature is None else self._with_placeholders(feature.reshape(-1, feature.shape[-1]))

    def gather_senders(self, table: Tensor) -> Tensor:
        """See `Graph.gather_senders`."""
        graphs, receivers, senders = self.mask.shape
        pairs = table.unflatten(0, (graphs, 1, senders)).expand(-1, receivers, -1, *table.shape[1:])
        return self._with_placeholders(pairs.flatten(0, 2), default=1)

    def gather_receivers(self, table: Tensor) -> Tensor:
        """See `Graph.gather_receivers`."""
        graphs, receivers, senders = self.mask.shape
        pairs = table.unflatten(0, (graphs, receivers, 1)).expand(-1, -1, senders, *table.shape[1:])
        return self._with_placeholders(pairs.flatten(0, 2))

    def degree(self) -> Tensor:
        """See `Graph.degree`."""
        return self.mask.sum(-1).flatten()

    def fill_non_edges(self, values: Tensor, fill: float = 0.0) -> Tensor:
        """Values [E, ...] with ``fill`` where there is no edge."""
        return torch.where(self._edge_mask(values), values, fill)

    def scatter_sum(self, values: Tensor) -> Tensor:
        """See `Graph.scatter_sum`."""
        return self._by_receiver(self.fill_non_edges(values)).sum(1)

    def scatter_max(self, values: Tensor) -> Tensor:
        """See `Graph.scatter_max`."""
        if self.mask.shape[-1] == 0:
            return self.scatter_sum(values)
        largest = self._by_receiver(self.fill_non_edges(values, -torch.inf)).amax(1)
        return torch.where(self.degree().view(-1, *[1] * (values.ndim - 1)) > 0, largest, 0.0)

    def softmax(self, logits: Tensor) -> Tensor:
        """See `Graph.softmax`."""
        return super().softmax(self._with_placeholders(logits))

    def subgraph(self, senders: Tensor, receivers: Tensor) -> DenseGraph:
        """See `Graph.subgraph`."""
        graphs, num_receivers, num_senders = self.mask.shape
        mask = self.mask & senders.view(graphs, 1, num_senders) & receivers.view(graphs, num_receivers, 1)
        return DenseGraph(mask, self.weight, self.feature)

    def _with_placeholders(self, values: Tensor, default: int = 0) -> Tensor:
        """Values [E, ...] with those of some edge where there is no edge, or ``default`` if the graph has no edges."""
        if not torch.is_grad_enabled():
            return values
        if self._some_edge is None:
            is_edge = torch.cat((self.mask.flatten(), self.mask.new_ones(1)))
            self._some_edge = is_edge.int().argmax().view(1)
        fallback = values.new_full((1, *values.shape[1:]), default)
        placeholder = torch.cat((values, fallback)).index_select(0, self._some_edge)
        return torch.where(self._edge_mask(values), values, placeholder)

    def _edge_mask(self, values: Tensor) -> Tensor:
        """The mask, shaped to broadcast with values [E, ...]."""
        return self.mask.reshape(-1, *[1] * (values.ndim - 1))

    def _by_receiver(self, values: Tensor) -> Tensor:
        return values.unflatten(0, (self.num_receivers, self.mask.shape[-1]))
