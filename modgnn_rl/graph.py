"""Graphs of links between agents, in two forms with one interface: a list of links, or all pairs with a mask.

The nodes of all graphs of a batch are numbered through: agent i of graph g is node ``g N + i``. `Links` computes only
what is linked; `Pairs` computes all pairs, in shapes that do not depend on the data, as compilers and ``vmap`` need.
`Topology` reads what a user has (dense adjacency, weights or edge list) and chooses the form.
"""

from __future__ import annotations

import abc
import copy

import torch
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.tensors import is_transformed

__all__ = ["AGGREGATIONS", "FORMS", "Graph", "Links", "Pairs", "Topology"]

AGGREGATIONS = ("sum", "mean", "max")
FORMS = ("auto", "links", "pairs")
BLOCK = {"cpu": 8192}  # links worked on at once: their activations stay in the processor's cache
BLOCK_ELSEWHERE = 1 << 20
FEW_PAIRS = 2048  # up to here computing all pairs costs no more than listing the links


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
    def at_senders(self, table: Tensor) -> Tensor:
        """The senders' rows of a table of nodes: [S, ...] -> [E, ...]."""

    @abc.abstractmethod
    def at_receivers(self, table: Tensor) -> Tensor:
        """The receivers' rows of a table of nodes: [R, ...] -> [E, ...]."""

    @abc.abstractmethod
    def degree(self) -> Tensor:
        """Number of links that each receiver receives on, integer [R]."""

    @abc.abstractmethod
    def total(self, values: Tensor) -> Tensor:
        """Sum over each receiver's links: [E, F] -> [R, F]; zero without links."""

    @abc.abstractmethod
    def largest(self, values: Tensor) -> Tensor:
        """Maximum over each receiver's links: [E, F] -> [R, F]; zero without links."""

    @abc.abstractmethod
    def between(self, senders: Tensor, receivers: Tensor) -> Graph:
        """The graph with the links only whose ends are among the given ones, bool [S] and [R]."""

    def aggregate(self, values: Tensor, aggregation: str = "sum") -> Tensor:
        """Aggregate over each receiver's links: [E, F] -> [R, F]; ``sum``, ``mean`` or ``max``, zero without links."""
        if aggregation == "max":
            return self.largest(values)
        total = self.total(values)
        return total / self.degree().clamp(min=1).unsqueeze(-1) if aggregation == "mean" else total

    def softmax(self, logits: Tensor) -> Tensor:
        """Softmax over each receiver's links: [E, H] -> [E, H]."""
        shifted = (logits - self.at_receivers(self.largest(logits.detach()))).exp()
        # The largest contributes 1, so that less stands only where there is no link.
        return shifted / self.at_receivers(self.total(shifted)).clamp(min=1)


class Links(Graph):
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

    def at_senders(self, table: Tensor) -> Tensor:
        """See `Graph.at_senders`."""
        return table.index_select(0, self.sender)

    def at_receivers(self, table: Tensor) -> Tensor:
        """See `Graph.at_receivers`."""
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

    def total(self, values: Tensor) -> Tensor:
        """See `Graph.total`."""
        return values.new_zeros(self.num_receivers, *values.shape[1:]).index_add(0, self.receiver, values)

    def largest(self, values: Tensor) -> Tensor:
        """See `Graph.largest`."""
        zeros = values.new_zeros(self.num_receivers, *values.shape[1:])
        index = self.receiver.view(-1, *[1] * (values.ndim - 1)).expand_as(values)
        return zeros.scatter_reduce(0, index, values, "amax", include_self=False)

    def between(self, senders: Tensor, receivers: Tensor) -> Links:
        """See `Graph.between`."""
        if senders.all() and receivers.all():
            return self
        return self.only((senders[self.sender] & receivers[self.receiver]).nonzero().squeeze(-1))

    def only(self, chosen: Tensor) -> Links:
        """The links of the given numbers, ascending [E']."""
        attributes = {name: None if value is None else value[chosen] for name, value in self._of_links().items()}
        return Links(
            self.sender[chosen],
            self.receiver[chosen],
            self.num_senders,
            self.num_receivers,
            **attributes,
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

    def block(self, receivers: slice, links: slice) -> Links:
        """The links of some receivers as a graph with these receivers only, numbered from 0."""
        attributes = {name: None if value is None else value[links] for name, value in self._of_links().items()}
        return Links(
            self.sender[links],
            self.receiver[links] - receivers.start,
            self.num_senders,
            receivers.stop - receivers.start,
            **attributes,
        )


class Pairs(Graph):
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

    def at_senders(self, table: Tensor) -> Tensor:
        """See `Graph.at_senders`."""
        graphs, receivers, senders = self.mask.shape
        spread = table.unflatten(0, (graphs, 1, senders)).expand(-1, receivers, -1, *table.shape[1:])
        return self._or_of_a_link(spread.flatten(0, 2), without_any=1)

    def at_receivers(self, table: Tensor) -> Tensor:
        """See `Graph.at_receivers`."""
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

    def total(self, values: Tensor) -> Tensor:
        """See `Graph.total`."""
        return self._by_receiver(self.only_linked(values)).sum(1)

    def largest(self, values: Tensor) -> Tensor:
        """See `Graph.largest`."""
        if self.mask.shape[-1] == 0:
            return self.total(values)
        largest = self._by_receiver(self.only_linked(values, -torch.inf)).amax(1)
        return torch.where(self.degree().view(-1, *[1] * (values.ndim - 1)) > 0, largest, 0.0)

    def softmax(self, logits: Tensor) -> Tensor:
        """See `Graph.softmax`."""
        return super().softmax(self._or_of_a_link(logits))

    def _by_receiver(self, values: Tensor) -> Tensor:
        return values.unflatten(0, (self.num_receivers, self.mask.shape[-1]))

    def between(self, senders: Tensor, receivers: Tensor) -> Pairs:
        """See `Graph.between`."""
        graphs, of_receivers, of_senders = self.mask.shape
        mask = self.mask & senders.view(graphs, 1, of_senders) & receivers.view(graphs, of_receivers, 1)
        return Pairs(mask, self.weight, self.feature)


class Topology:
    """Who hears whom at every step of a batch: the graphs that a policy's layers work on, made once for all of them.

    Args:
        adjacency: one of

            - bool, or numbers other than int64, [*B, N, N]: entry i, j, unless zero, says that i receives from j;
              floating-point numbers are also the weights of the links;
            - an edge list, int64 [*B, 2, E]: senders, and below them receivers, each link once; -1 fills up the lists
              that are shorter.
        num_agents: N.
        receivers: the agents whose output is wanted, bool [*B, N]; default: all.
        mask: the agents that exist, bool [*B, N]; nobody hears of the others. Default: all.
        weight: weights of the links: [*B, N, N] or [*B, E].
        feature: features of the links: [*B, N, N, F] or [*B, E, F].
        form: ``links``, ``pairs``, or ``auto``: pairs where shapes must not depend on data (``torch.compile``,
            ``torch.export``, ``torch.func.vmap``) and for a few agents most of which are linked, else links.
        keep_positions: let links know where they lie in ``adjacency``.

    Raises:
        InputError: on a shape that is none of these, or the number of an agent that is not there.
    """

    def __init__(
        self,
        adjacency: Tensor,
        num_agents: int,
        *,
        receivers: Tensor | None = None,
        mask: Tensor | None = None,
        weight: Tensor | None = None,
        feature: Tensor | None = None,
        form: str = "auto",
        keep_positions: bool = False,
    ) -> None:
        self.num_agents = num_agents
        self.is_edge_list = adjacency.dtype == torch.int64
        _check_shape(adjacency, num_agents, is_edge_list=self.is_edge_list)
        self.adjacency = adjacency.reshape(adjacency.shape[:-2].numel(), *adjacency.shape[-2:])
        if self.is_edge_list and not is_transformed():
            _check_numbers(adjacency, num_agents)
        if weight is None and adjacency.is_floating_point():
            weight = adjacency
        self.weight = None if weight is None else weight.reshape(-1)
        self.feature = None if feature is None else feature.reshape(-1, feature.shape[-1])
        for name, value in (("weights", self.weight), ("features", self.feature)):
            _check_count(name, value, self.adjacency[:, 0].numel() if self.is_edge_list else self.adjacency.numel())
        self.keep_positions = keep_positions
        self.exists = None if mask is None else mask.reshape(-1)
        self.as_pairs = form == "pairs" or (form == "auto" and self._suits_pairs(some=receivers is not None))
        self._everyone: Graph | None = None
        self._wanted: Graph | None = None
        self._want(receivers)

    @property
    def num_nodes(self) -> int:
        """Agents of all graphs together."""
        return self.adjacency.shape[0] * self.num_agents

    def everyone(self) -> Graph:
        """The graph of all agents."""
        if self._everyone is None:
            self._everyone = self._make_pairs() if self.as_pairs else self._make_links(self.exists_rows())
        return self._everyone

    def wanted(self) -> Graph:
        """The graph of the links to the wanted receivers; as links, its receivers are `rows`."""
        if self._wanted is None:
            if self.wanted_nodes is None:
                self._wanted = self.everyone()
            elif self.rows is None:
                self._wanted = self.everyone().between(torch.ones_like(self.wanted_nodes), self.wanted_nodes)
            else:
                self._wanted = self._make_links(self.rows, compact=True)
        return self._wanted

    def towards(self, receivers: Tensor | None) -> Topology:
        """The same graphs with other outputs wanted, bool [*B, N]; None: those of all agents that exist."""
        if receivers is None and self.wanted_nodes is self.exists:
            return self
        other = copy.copy(self)
        other._want(receivers)
        return other

    def _want(self, receivers: Tensor | None) -> None:
        wanted = None if receivers is None else receivers.reshape(-1)
        if wanted is None or self.exists is None:
            self.wanted_nodes = self.exists if wanted is None else wanted
        else:
            self.wanted_nodes = wanted & self.exists
        # Numbers of the wanted nodes, as long as shapes may depend on data.
        self.rows = None if self.as_pairs or self.wanted_nodes is None else self.wanted_nodes.nonzero().squeeze(-1)
        self._wanted = None

    def exists_rows(self) -> Tensor | None:
        """Numbers of the nodes that exist; None: all."""
        return None if self.exists is None else self.exists.nonzero().squeeze(-1)

    def _suits_pairs(self, *, some: bool) -> bool:
        if is_transformed():
            return True
        return (
            not self.is_edge_list
            and self.exists is None
            and not some
            and self.adjacency.numel() <= FEW_PAIRS
            and 2 * int(self.adjacency.count_nonzero()) >= self.adjacency.numel()
        )

    def _make_links(self, rows: Tensor | None, *, compact: bool = False) -> Links:
        """The links to some nodes, or to all; ``compact`` numbers the receivers by their place among the rows."""
        size, nodes = self.num_agents, self.num_nodes
        if self.is_edge_list:
            sender, receiver, position = self._listed_links(rows)
        else:
            linked = self.adjacency.reshape(nodes, size).bool()
            receiver, sender = (linked if rows is None else linked[rows]).nonzero().unbind(-1)
            receiver = receiver if rows is None else rows[receiver]
            position = receiver * size + sender
            sender = sender + receiver.div(size, rounding_mode="floor") * size
        if self.exists is not None:
            there = self.exists[sender]
            sender, receiver, position = sender[there], receiver[there], position[there]
        if rows is not None and compact:
            place = torch.empty(nodes, dtype=torch.long, device=rows.device)
            place[rows] = torch.arange(len(rows), device=rows.device)
            receiver = place[receiver]
        return Links(
            sender,
            receiver,
            nodes,
            len(rows) if rows is not None and compact else nodes,
            None if self.weight is None else self.weight[position],
            None if self.feature is None else self.feature[position],
            position if self.keep_positions else None,
        )

    def _listed_nodes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Senders and receivers of an edge list as numbers of nodes, and which entries are links; [G * E] each."""
        sender, receiver = self.adjacency.unbind(-2)
        offset = torch.arange(len(sender), device=sender.device).unsqueeze(-1) * self.num_agents
        return (sender + offset).flatten(), (receiver + offset).flatten(), (sender >= 0).flatten()

    def _listed_links(self, rows: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Senders, receivers and positions of an edge list's links to some nodes, ordered by receiver."""
        sender, receiver, valid = self._listed_nodes()
        if rows is not None:
            chosen = torch.zeros(self.num_nodes, dtype=torch.bool, device=rows.device)
            chosen[rows] = True
            valid = valid & chosen[receiver.clamp(min=0)]
        position = valid.nonzero().squeeze(-1)
        position = position[receiver[position].argsort(stable=True)]
        return sender[position], receiver[position], position

    def _make_pairs(self) -> Pairs:
        size = self.num_agents
        weight, feature = self.weight, self.feature
        if self.is_edge_list:
            sender, receiver, valid = self._listed_nodes()
            last = self.num_nodes * size  # one place more takes what fills up the lists
            place = torch.where(valid, receiver * size + sender % size, last)
            mask = valid.new_zeros(last + 1).index_fill(0, place, True)[:-1]
            weight = None if weight is None else weight.new_zeros(last + 1).index_copy(0, place, weight)[:-1]
            if feature is not None:
                empty = feature.new_zeros(last + 1, feature.shape[-1])
                feature = empty.index_copy(0, place, feature)[:-1]
        else:
            mask = self.adjacency.bool()
        mask = mask.reshape(len(self.adjacency), size, size)
        if self.exists is not None:
            exists = self.exists.view(len(self.adjacency), size)
            mask = mask & exists.unsqueeze(-1) & exists.unsqueeze(-2)
        return Pairs(mask, weight, feature)

    def spread_links(self, values: Tensor, graph: Graph) -> Tensor:
        """Values of links [E, F] where the user gave them: [G, N, N, F], or [G, E, F] of an edge list; else zero."""
        shape = (len(self.adjacency), *((self.adjacency.shape[-1],) if self.is_edge_list else (self.num_agents,) * 2))
        if isinstance(graph, Links):
            assert graph.position is not None
            everywhere = values.new_zeros(torch.Size(shape).numel(), values.shape[-1])
            return everywhere.index_copy(0, graph.position, values).unflatten(0, shape)
        assert isinstance(graph, Pairs)
        values = graph.only_linked(values)
        if self.is_edge_list:
            sender, receiver, valid = self._listed_nodes()
            found = values[(receiver * self.num_agents + sender % self.num_agents).clamp(min=0)]
            values = torch.where(valid.unsqueeze(-1), found, 0.0)
        return values.unflatten(0, shape)


def _check_shape(adjacency: Tensor, num_agents: int, *, is_edge_list: bool) -> None:
    shape = tuple(adjacency.shape)
    if is_edge_list and (adjacency.ndim < 2 or shape[-2] != 2):
        raise InputError(
            f"an adjacency of int64 is an edge list [..., 2, E] (senders, receivers), and this one has shape {shape}; "
            "give a dense one as bool"
        )
    if not is_edge_list and shape[-2:] != (num_agents, num_agents):
        raise InputError(f"the adjacency of {num_agents} agents must be [..., {num_agents}, {num_agents}], not {shape}")


def _check_count(name: str, values: Tensor | None, count: int) -> None:
    if values is not None and len(values) != count:
        raise InputError(f"there are {len(values)} {name} for {count} places of links; each place needs one")


def _check_numbers(edges: Tensor, num_agents: int) -> None:
    if edges.numel() and (
        edges.max() >= num_agents or edges.min() < -1 or ((edges < 0).any(-2) & (edges >= 0).any(-2)).any()
    ):
        raise InputError(
            f"an edge list of {num_agents} agents names agent {int(edges.max())} or {int(edges.min())}; expected "
            f"numbers from 0 to {num_agents - 1}, and -1 for both ends of what only fills up the list"
        )
