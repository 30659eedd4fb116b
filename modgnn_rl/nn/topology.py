"""The communication graphs of a batch, from what the user has: a dense adjacency, a weighted one, or an edge list."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from modgnn_rl.errors import InputError
from modgnn_rl.nn.graph import DenseGraph, EdgeList, Graph
from modgnn_rl.utils.tensors import flatnonzero, is_transformed

__all__ = ["FORMS", "Topology", "as_matrix", "reachable"]

FORMS = ("auto", "edges", "dense")
SMALL_GRAPH = 2048  # up to this many pairs, computing all of them costs no more than listing the edges


class Topology:
    """The communication graphs of a batch, built once for all layers of a policy.

    Nodes are the agents of all graphs: agent i of graph g is node ``g N + i``. Targets are the nodes whose output is
    wanted. With edge lists only their rows are computed; with dense graphs all rows are computed and then masked.

    Args:
        adjacency: one of

            - bool, or a number type other than int64, [*B, N, N]: entry i, j, unless zero, says that i receives from j;
              floating-point entries are also the edge weights;
            - an edge list, int64 [*B, 2, E]: senders in the first row, receivers in the second, each edge once. Shorter
              lists are padded with -1.
        num_agents: N.
        receivers: the agents whose output is wanted, bool [*B, N]; default: all.
        mask: the agents that exist, bool [*B, N]; nobody receives from the others. Default: all.
        weight: edge weights: [*B, N, N] or [*B, E].
        feature: edge features: [*B, N, N, F] or [*B, E, F].
        form: ``edges`` (`EdgeList`), ``dense`` (`DenseGraph`), or ``auto``: dense where shapes must not depend on data
            (``torch.compile``, ``torch.export``, ``torch.func.vmap``) and for a few agents most of which are connected,
            else edges.

    Attributes:
        exists: which nodes exist, bool [G N]; None: all.
        targets: which nodes are targets, bool [G N]; None: all.
        target_index: numbers of the targets whose rows are computed alone [R]; None: all rows are computed.
        is_dense: whether graphs are dense.

    Raises:
        InputError: the shape is none of these, or the edge list names an agent that does not exist.
    """

    exists: Tensor | None
    targets: Tensor | None
    target_index: Tensor | None
    _all_edges: Graph | None
    _target_edges: Graph | None

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
    ) -> None:
        if adjacency.layout != torch.strided:
            adjacency = adjacency.to_dense()
        self.num_agents = num_agents
        self.is_edge_list = adjacency.dtype == torch.int64
        _check_shape(adjacency, num_agents, is_edge_list=self.is_edge_list)
        if self.is_edge_list and not is_transformed():
            _check_numbers(adjacency, num_agents)
        self.adjacency = adjacency.reshape(adjacency.shape[:-2].numel(), *adjacency.shape[-2:])
        if weight is None and adjacency.is_floating_point():
            weight = adjacency
        self.weight = None if weight is None else weight.reshape(-1)
        self.feature = None if feature is None else feature.reshape(-1, feature.shape[-1])
        num_entries = self.adjacency[:, 0].numel() if self.is_edge_list else self.adjacency.numel()
        _check_count("weights", self.weight, num_entries)
        _check_count("features", self.feature, num_entries)
        self.exists = None if mask is None else mask.reshape(-1)
        self.is_dense = form == "dense" or (form == "auto" and self._prefers_dense(has_targets=receivers is not None))
        self._all_edges = None
        self._set_targets(receivers)

    @property
    def num_graphs(self) -> int:
        """Number of graphs G."""
        return len(self.adjacency)

    @property
    def num_nodes(self) -> int:
        """Number of agents in all graphs together, G N."""
        return self.num_graphs * self.num_agents

    def all_edges(self) -> Graph:
        """The edges between all agents that exist."""
        if self._all_edges is None:
            nodes = None if self.exists is None else flatnonzero(self.exists)
            self._all_edges = self._dense_graph() if self.is_dense else self._edge_list(nodes)
        return self._all_edges

    def target_edges(self) -> Graph:
        """The edges to the targets; receiver r of an edge list is the target of number ``target_index[r]``."""
        if self._target_edges is None:
            if self.targets is None:
                self._target_edges = self.all_edges()
            elif self.target_index is None:
                self._target_edges = self.all_edges().subgraph(torch.ones_like(self.targets), self.targets)
            else:
                self._target_edges = self._edge_list(self.target_index, renumber=True)
        return self._target_edges

    def with_targets(self, receivers: Tensor | None) -> Topology:
        """The same graphs with other targets, bool [*B, N]; None: all agents that exist."""
        if receivers is None and self.targets is self.exists:
            return self
        other = copy.copy(self)
        other._set_targets(receivers)
        return other

    def to_input_layout(self, values: Tensor, graph: Graph) -> Tensor:
        """Arrange edge values as in the user's adjacency, with zeros where there is no edge.

        Args:
            values: values of the edges of ``graph`` [E, F].
            graph: one of this topology's graphs, or a subgraph of one.

        Returns:
            [G, N, N, F], or [G, E, F] if the adjacency is an edge list.
        """
        if self.is_edge_list:
            return self._at_entries(values, graph).unflatten(0, (self.num_graphs, -1))
        if isinstance(graph, DenseGraph):
            pairs = graph.fill_non_edges(values)
        else:
            zeros = values.new_zeros(self.num_nodes * self.num_agents, values.shape[-1])
            pairs = zeros.index_copy(0, self._pairs_of(graph), values)
        return pairs.unflatten(0, (self.num_graphs, self.num_agents, self.num_agents))

    def _at_entries(self, values: Tensor, graph: Graph) -> Tensor:
        """Edge values [E, F] at the entries of the user's edge list, zero where the graph has no such edge."""
        sender, receiver, is_found = self._entries()
        pair = self._pair_index(sender, receiver)
        if isinstance(graph, DenseGraph):
            found = graph.fill_non_edges(values)[pair.clamp(min=0)]
        else:
            # A last pair that no entry has ends the search and stands for the entries that are not found.
            edge_pairs, edge = torch.cat((self._pairs_of(graph), pair.new_full((1,), self.num_nodes**2))).sort()
            place = torch.searchsorted(edge_pairs, pair)
            is_found = is_found & (edge_pairs[place] == pair)
            found = torch.cat((values, values.new_zeros(1, values.shape[-1])))[edge[place]]
        return torch.where(is_found.unsqueeze(-1), found, 0.0)

    def _set_targets(self, receivers: Tensor | None) -> None:
        targets = None if receivers is None else receivers.reshape(-1)
        if targets is None:
            self.targets = self.exists
        else:
            self.targets = targets if self.exists is None else targets & self.exists
        self.target_index = None if self.is_dense or self.targets is None else flatnonzero(self.targets)
        self._target_edges = None

    def _prefers_dense(self, *, has_targets: bool) -> bool:
        if is_transformed():
            return True
        return (
            not self.is_edge_list
            and self.exists is None
            and not has_targets
            and self.adjacency.numel() <= SMALL_GRAPH
            and 2 * int(self.adjacency.count_nonzero()) >= self.adjacency.numel()
        )

    def _edge_list(self, nodes: Tensor | None, *, renumber: bool = False) -> EdgeList:
        """The edges to some nodes, or to all; ``renumber`` counts receivers by their place among these nodes."""
        sender, receiver, entry = self._listed_edges(nodes) if self.is_edge_list else self._matrix_edges(nodes)
        if self.exists is not None:
            keep = self.exists[sender]
            sender, receiver, entry = sender[keep], receiver[keep], entry[keep]
        num_receivers = self.num_nodes
        if nodes is not None and renumber:
            number = torch.empty(self.num_nodes, dtype=torch.long, device=nodes.device)
            number[nodes] = torch.arange(len(nodes), device=nodes.device)
            receiver, num_receivers = number[receiver], len(nodes)
        weight = None if self.weight is None else self.weight[entry]
        feature = None if self.feature is None else self.feature[entry]
        return EdgeList(sender, receiver, self.num_nodes, num_receivers, weight, feature)

    def _matrix_edges(self, nodes: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Senders, receivers and matrix entries of the edges to some nodes, from a dense adjacency."""
        size = self.num_agents
        is_edge = self.adjacency.reshape(self.num_nodes, size).bool()
        is_edge = is_edge if nodes is None else is_edge.index_select(0, nodes)
        entry = flatnonzero(is_edge.flatten())
        receiver = entry.div(size, rounding_mode="floor")
        sender = entry - receiver * size
        if nodes is not None:
            receiver = nodes.index_select(0, receiver)
            entry = receiver * size + sender
        return sender + (receiver - receiver % size), receiver, entry

    def _listed_edges(self, nodes: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Senders, receivers and list entries of the edges to some nodes, sorted by receiver, from an edge list."""
        sender, receiver, is_edge = self._entries()
        if nodes is not None:
            is_node = torch.zeros(self.num_nodes, dtype=torch.bool, device=nodes.device)
            is_node[nodes] = True
            is_edge = is_edge & is_node[receiver.clamp(min=0)]
        entry = flatnonzero(is_edge)
        entry = entry[receiver[entry].argsort(stable=True)]
        return sender[entry], receiver[entry], entry

    def _entries(self) -> tuple[Tensor, Tensor, Tensor]:
        """Sender and receiver nodes of all entries of an edge list, and which entries are not padding [G E]."""
        sender, receiver = self.adjacency.unbind(-2)
        offset = torch.arange(len(sender), device=sender.device).unsqueeze(-1) * self.num_agents
        return (sender + offset).flatten(), (receiver + offset).flatten(), (sender >= 0).flatten()

    def _pair_index(self, sender: Tensor, receiver: Tensor) -> Tensor:
        """Where an edge lies among all pairs [G N N]."""
        return receiver * self.num_agents + sender % self.num_agents

    def _pairs_of(self, graph: Graph) -> Tensor:
        """Where the edges of an `EdgeList` lie among all pairs."""
        assert isinstance(graph, EdgeList)
        receiver = graph.receiver
        if self.target_index is not None and graph.num_receivers == len(self.target_index):
            receiver = self.target_index[receiver]
        return self._pair_index(graph.sender, receiver)

    def _dense_graph(self) -> DenseGraph:
        weight, feature = self.weight, self.feature
        mask = self.adjacency.bool()
        if self.is_edge_list:
            sender, receiver, is_edge = self._entries()
            num_pairs = self.num_nodes * self.num_agents
            # Padding is written to one extra place at the end, which is cut off.
            place = torch.where(is_edge, self._pair_index(sender, receiver), num_pairs)
            mask = is_edge.new_zeros(num_pairs + 1).index_fill(0, place, True)[:-1]
            if weight is not None:
                weight = weight.new_zeros(num_pairs + 1).index_copy(0, place, weight)[:-1]
            if feature is not None:
                feature = feature.new_zeros(num_pairs + 1, feature.shape[-1]).index_copy(0, place, feature)[:-1]
        mask = mask.reshape(self.num_graphs, self.num_agents, self.num_agents)
        if self.exists is not None:
            exists = self.exists.view(self.num_graphs, self.num_agents)
            mask = mask & exists.unsqueeze(-1) & exists.unsqueeze(-2)
        return DenseGraph(mask, weight, feature)


def _check_shape(adjacency: Tensor, num_agents: int, *, is_edge_list: bool) -> None:
    shape = tuple(adjacency.shape)
    if is_edge_list and (adjacency.ndim < 2 or shape[-2] != 2):
        raise InputError(
            f"an int64 adjacency is an edge list [..., 2, E] (senders, receivers), but this one has shape {shape}; "
            "give a dense adjacency as bool"
        )
    if not is_edge_list and shape[-2:] != (num_agents, num_agents):
        raise InputError(f"the adjacency of {num_agents} agents must be [..., {num_agents}, {num_agents}], not {shape}")


def _check_count(name: str, values: Tensor | None, count: int) -> None:
    if values is not None and len(values) != count:
        raise InputError(f"there are {len(values)} edge {name} for {count} entries of the adjacency; each needs one")


def _check_numbers(edges: Tensor, num_agents: int) -> None:
    if edges.numel() and (
        edges.max() >= num_agents or edges.min() < -1 or ((edges < 0).any(-2) & (edges >= 0).any(-2)).any()
    ):
        raise InputError(
            f"the edge list of {num_agents} agents contains numbers from {int(edges.min())} to {int(edges.max())}; "
            f"expected agents 0 to {num_agents - 1}, or -1 for both ends of a padding entry"
        )


def as_matrix(adjacency: Tensor, num_agents: int) -> Tensor:
    """The graph as a bool matrix [..., N, N], from any form of adjacency that `Topology` reads."""
    graph = Topology(adjacency, num_agents, form="dense").all_edges()
    assert isinstance(graph, DenseGraph)
    return graph.mask.view(*adjacency.shape[:-2], num_agents, num_agents)


def reachable(adjacency: Tensor, hops: int) -> Tensor:
    """Which agents receive data from which others over at most ``hops`` >= 1 edges.

    Args:
        adjacency: entry i, j says that i receives from j, bool [..., N, N].
        hops: number of hops.

    Returns:
        bool [..., N, N] with a zero diagonal.
    """
    reached = adjacency
    for _ in range(hops - 1):
        reached = reached | ((adjacency.float() @ reached.float()) > 0)
    return reached & ~torch.eye(adjacency.shape[-1], dtype=torch.bool, device=adjacency.device)
