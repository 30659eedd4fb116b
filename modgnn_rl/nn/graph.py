"""Graphs of links between agents, in two forms with one interface: a list of links, or all pairs with a mask.

The nodes of all graphs of a batch are numbered through: agent i of graph g is node ``g N + i``. `EdgeList` computes
only what is linked; `DenseGraph` computes all pairs, in shapes that do not depend on the data, as compilers and
``vmap`` need. `modgnn_rl.nn.topology.Topology` reads what a user has and chooses the form.
"""

from __future__ import annotations

import abc

import torch
from torch import Tensor

from modgnn_rl.utils.tensors import flatnonzero

__all__ = ["AGGREGATIONS", "DenseGraph", "EdgeList", "Graph"]

AGGREGATIONS = ("sum", "mean", "max")
BLOCK = {"cpu": 8192}  # links worked on at once: their activations stay in the processor's cache
BLOCK_ELSEWHERE = 1 << 20


class Graph(abc.ABC):
    """Links from S senders to R receivers; a value of the links is a tensor [E, ...] in the graph's own order.

    Attributes:
        num_senders: S.
        num_receivers: R.
        weight: weights of the links [E], or None.
        feature: features of the links [E, F], or None.
    """

    num_senders: int
    num_receivers: int
    weight: Tensor | None
    feature: Tensor | None

    @abc.abstractmethod
    def gather_senders(self, table: Tensor) -> Tensor:
        """The senders' rows of a table of nodes: [S, ...] -> [E, ...]."""

    @abc.abstractmethod
    def gather_receivers(self, table: Tensor) -> Tensor:
        """The receivers' rows of a table of nodes: [R, ...] -> [E, ...]."""

    @abc.abstractmethod
    def degree(self) -> Tensor:
        """Number of links that each receiver receives on, integer [R]."""

    @abc.abstractmethod
    def scatter_sum(self, values: Tensor) -> Tensor:
        """Sum over each receiver's links: [E, F] -> [R, F]; zero without links."""

    @abc.abstractmethod
    def scatter_max(self, values: Tensor) -> Tensor:
        """Maximum over each receiver's links: [E, F] -> [R, F]; zero without links."""

    @abc.abstractmethod
    def between(self, senders: Tensor, receivers: Tensor) -> Graph:
        """The graph with the links only whose ends are among the given ones, bool [S] and [R]."""

    def aggregate(self, values: Tensor, aggregation: str = "sum") -> Tensor:
        """Aggregate over each receiver's links: [E, F] -> [R, F]; ``sum``, ``mean`` or ``max``, zero without links."""
        if aggregation == "max":
            return self.scatter_max(values)
        total = self.scatter_sum(values)
        return total / self.degree().clamp(min=1).unsqueeze(-1) if aggregation == "mean" else total

    def softmax(self, logits: Tensor) -> Tensor:
        """Softmax over each receiver's links: [E, H] -> [E, H]."""
        shifted = (logits - self.gather_receivers(self.scatter_max(logits.detach()))).exp()
        # The largest contributes 1, so that less stands only where there is no link.
        return shifted / self.gather_receivers(self.scatter_sum(shifted)).clamp(min=1)


class EdgeList(Graph):
    """A list of links, ordered by receiver.

    Args:
        sender: numbers of the senders [E].
        receiver: numbers of the receivers [E], ascending.
        num_senders: S.
        num_receivers: R.
        weight: weights [E].
        feature: features [E, F].
        position: where each link lies in what the user gave, flattened [E].
    """

    def __init__(
        self,
        sender: Tensor,
        receiver: Tensor,
        num_senders: int,
        num_receivers: int,
        weight: Tensor | None = None,
        feature: Tensor | None = None,
        position: Tensor | None = None,
    ) -> None:
        self.sender, self.receiver = sender, receiver
        self.num_senders, self.num_receivers = num_senders, num_receivers
        self.weight, self.feature, self.position = weight, feature, position
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

    def first(self) -> Tensor:
        """Where each receiver's links begin [R]."""
        degree = self.degree()
        return degree.cumsum(0) - degree

    def scatter_sum(self, values: Tensor) -> Tensor:
        """See `Graph.total`."""
        return values.new_zeros(self.num_receivers, *values.shape[1:]).index_add(0, self.receiver, values)

    def scatter_max(self, values: Tensor) -> Tensor:
        """See `Graph.largest`."""
        zeros = values.new_zeros(self.num_receivers, *values.shape[1:])
        index = self.receiver.view(-1, *[1] * (values.ndim - 1)).expand_as(values)
        return zeros.scatter_reduce(0, index, values, "amax", include_self=False)

    def between(self, senders: Tensor, receivers: Tensor) -> EdgeList:
        """See `Graph.between`."""
        if senders.all() and receivers.all():
            return self
        # index_select takes a third of the time of indexing.
        return self.only(flatnonzero(senders.index_select(0, self.sender) & receivers.index_select(0, self.receiver)))

    def only(self, chosen: Tensor) -> EdgeList:
        """The links of the given numbers, ascending [E']."""
        taken = {
            name: value if value is None else value.index_select(0, chosen) for name, value in self._of_links().items()
        }
        return EdgeList(
            self.sender.index_select(0, chosen),
            self.receiver.index_select(0, chosen),
            self.num_senders,
            self.num_receivers,
            **taken,
        )

    def _of_links(self) -> dict[str, Tensor | None]:
        return {"weight": self.weight, "feature": self.feature, "position": self.position}

    def blocks(self) -> list[tuple[slice, slice]]:
        """Cut the graph into blocks that hold whole neighbourhoods: slices of receivers, and of their links."""
        size = BLOCK.get(self.sender.device.type, BLOCK_ELSEWHERE)
        if len(self) <= size:
            return [(slice(0, self.num_receivers), slice(0, len(self)))]
        ends = self.degree().cumsum(0)
        targets = torch.arange(size, len(self), size, device=ends.device)
        cuts = sorted({0, *torch.searchsorted(ends, targets).tolist(), self.num_receivers})
        starts = [*self.first()[cuts[:-1]].tolist(), len(self)]
        return [
            (slice(cuts[index], cuts[index + 1]), slice(starts[index], starts[index + 1]))
            for index in range(len(cuts) - 1)
        ]

    def block(self, receivers: slice, links: slice) -> EdgeList:
        """The links of some receivers as a graph with these receivers only, numbered from 0."""
        attributes = {name: None if value is None else value[links] for name, value in self._of_links().items()}
        return EdgeList(
            self.sender[links],
            self.receiver[links] - receivers.start,
            self.num_senders,
            receivers.stop - receivers.start,
            **attributes,
        )


class DenseGraph(Graph):
    """All pairs, and a mask that tells which are linked.

    Where gradients are wanted, a pair without a link gets the data of some link, or ones (the sender's) and zeros if
    there is none: what a module makes of it counts for nothing, but must not be NaN, which would reach the gradients as
    ``0 * NaN``.

    Args:
        mask: entry g, i, j says that receiver i of graph g receives from its sender j, bool [G, R, S].
        weight: weights [G, R, S].
        feature: features [G, R, S, F].
    """

    def __init__(self, mask: Tensor, weight: Tensor | None = None, feature: Tensor | None = None) -> None:
        self.mask = mask
        graphs, receivers, senders = mask.shape
        self.num_senders, self.num_receivers = graphs * senders, graphs * receivers
        self._some_link: Tensor | None = None
        self.weight = None if weight is None else self._or_of_a_link(weight.reshape(-1))
        self.feature = None if feature is None else self._or_of_a_link(feature.reshape(-1, feature.shape[-1]))

    def gather_senders(self, table: Tensor) -> Tensor:
        """See `Graph.gather_senders`."""
        graphs, receivers, senders = self.mask.shape
        spread = table.unflatten(0, (graphs, 1, senders)).expand(-1, receivers, -1, *table.shape[1:])
        return self._or_of_a_link(spread.flatten(0, 2), without_any=1)

    def gather_receivers(self, table: Tensor) -> Tensor:
        """See `Graph.gather_receivers`."""
        graphs, receivers, senders = self.mask.shape
        spread = table.unflatten(0, (graphs, receivers, 1)).expand(-1, -1, senders, *table.shape[1:])
        return self._or_of_a_link(spread.flatten(0, 2))

    def degree(self) -> Tensor:
        """See `Graph.degree`."""
        return self.mask.sum(-1).flatten()

    def only_linked(self, values: Tensor, other: float = 0.0) -> Tensor:
        """Values [E, ...] with ``other`` where there is no link."""
        linked = self.mask.reshape(-1, *[1] * (values.ndim - 1))
        return torch.where(linked, values, other)

    def _or_of_a_link(self, values: Tensor, without_any: int = 0) -> Tensor:
        """Values [E, ...] with those of some link where there is no link; ``without_any`` if there is none at all."""
        if not torch.is_grad_enabled():
            return values
        if self._some_link is None:
            linked = torch.cat((self.mask.flatten(), self.mask.new_ones(1)))
            self._some_link = linked.int().argmax().view(1)
        stand_in = values.new_full((1, *values.shape[1:]), without_any)
        some = torch.cat((values, stand_in)).index_select(0, self._some_link)
        return torch.where(self.mask.reshape(-1, *[1] * (values.ndim - 1)), values, some)

    def scatter_sum(self, values: Tensor) -> Tensor:
        """See `Graph.total`."""
        return self._by_receiver(self.only_linked(values)).sum(1)

    def scatter_max(self, values: Tensor) -> Tensor:
        """See `Graph.largest`."""
        if self.mask.shape[-1] == 0:
            return self.scatter_sum(values)
        largest = self._by_receiver(self.only_linked(values, -torch.inf)).amax(1)
        return torch.where(self.degree().view(-1, *[1] * (values.ndim - 1)) > 0, largest, 0.0)

    def softmax(self, logits: Tensor) -> Tensor:
        """See `Graph.softmax`."""
        return super().softmax(self._or_of_a_link(logits))

    def _by_receiver(self, values: Tensor) -> Tensor:
        return values.unflatten(0, (self.num_receivers, self.mask.shape[-1]))

    def between(self, senders: Tensor, receivers: Tensor) -> DenseGraph:
        """See `Graph.between`."""
        graphs, of_receivers, of_senders = self.mask.shape
        mask = self.mask & senders.view(graphs, 1, of_senders) & receivers.view(graphs, of_receivers, 1)
        return DenseGraph(mask, self.weight, self.feature)
