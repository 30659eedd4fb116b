"""Who hears whom at every step of a batch, from what a user has: dense adjacency, weights, or edge list."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.nn.graph import DenseGraph, EdgeList, Graph
from modgnn_rl.utils.tensors import flatnonzero, is_transformed

__all__ = ["FORMS", "Topology", "as_matrix", "reachable"]

FORMS = ("auto", "links", "pairs")
FEW_PAIRS = 2048  # up to here computing all pairs costs no more than listing the links


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

    def all_edges(self) -> Graph:
        """The graph of all agents."""
        if self._everyone is None:
            self._everyone = self._make_pairs() if self.as_pairs else self._make_links(self.exists_rows())
        return self._everyone

    def target_edges(self) -> Graph:
        """The graph of the links to the wanted receivers; as links, its receivers are `rows`."""
        if self._wanted is None:
            if self.wanted_nodes is None:
                self._wanted = self.all_edges()
            elif self.rows is None:
                self._wanted = self.all_edges().between(torch.ones_like(self.wanted_nodes), self.wanted_nodes)
            else:
                self._wanted = self._make_links(self.rows, compact=True)
        return self._wanted

    def with_targets(self, receivers: Tensor | None) -> Topology:
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
        self.rows = None if self.as_pairs or self.wanted_nodes is None else flatnonzero(self.wanted_nodes)
        self._wanted = None

    def exists_rows(self) -> Tensor | None:
        """Numbers of the nodes that exist; None: all."""
        return None if self.exists is None else flatnonzero(self.exists)

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

    def _make_links(self, rows: Tensor | None, *, compact: bool = False) -> EdgeList:
        """The links to some nodes, or to all; ``compact`` numbers the receivers by their place among the rows."""
        size, nodes = self.num_agents, self.num_nodes
        if self.is_edge_list:
            sender, receiver, position = self._listed_links(rows)
        else:
            linked = self.adjacency.reshape(nodes, size).bool()
            linked = linked if rows is None else linked.index_select(0, rows)
            position = flatnonzero(linked.flatten())
            receiver = position.div(size, rounding_mode="floor")
            sender = position - receiver * size
            if rows is not None:
                receiver = rows.index_select(0, receiver)
                position = receiver * size + sender
            sender = sender + (receiver - receiver % size)
        if self.exists is not None:
            there = self.exists[sender]
            sender, receiver, position = sender[there], receiver[there], position[there]
        if rows is not None and compact:
            place = torch.empty(nodes, dtype=torch.long, device=rows.device)
            place[rows] = torch.arange(len(rows), device=rows.device)
            receiver = place[receiver]
        return EdgeList(
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
        position = flatnonzero(valid)
        position = position[receiver[position].argsort(stable=True)]
        return sender[position], receiver[position], position

    def _make_pairs(self) -> DenseGraph:
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
        return DenseGraph(mask, weight, feature)

    def spread_links(self, values: Tensor, graph: Graph) -> Tensor:
        """Values of links [E, F] where the user gave them: [G, N, N, F], or [G, E, F] of an edge list; else zero."""
        shape = (len(self.adjacency), *((self.adjacency.shape[-1],) if self.is_edge_list else (self.num_agents,) * 2))
        if isinstance(graph, EdgeList):
            assert graph.position is not None
            everywhere = values.new_zeros(torch.Size(shape).numel(), values.shape[-1])
            return everywhere.index_copy(0, graph.position, values).unflatten(0, shape)
        assert isinstance(graph, DenseGraph)
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


def as_matrix(adjacency: Tensor, num_agents: int) -> Tensor:
    """A graph as a bool matrix [..., N, N], from any form that `modgnn_rl.nn.topology.Topology` reads."""
    graph = Topology(adjacency, num_agents, form="pairs").all_edges()
    assert isinstance(graph, DenseGraph)
    return graph.mask.view(*adjacency.shape[:-2], num_agents, num_agents)


def reachable(adjacency: Tensor, hops: int) -> Tensor:
    """Who hears of whom over at most ``hops`` >= 1 links; bool [..., N, N] -> bool [..., N, N], zero diagonal."""
    reached = adjacency
    for _ in range(hops - 1):
        reached = reached | ((adjacency.float() @ reached.float()) > 0)
    return reached & ~torch.eye(adjacency.shape[-1], dtype=torch.bool, device=adjacency.device)
