"""Communication between neighbours: the choices of f_com, and the sum over the links of a graph.

An f_com is any module ``f_com(sender, receiver) -> y`` of the two agents' aggregates ``[E, D]``, one row a link.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor, nn

__all__ = ["Adjacency", "Laplacian", "Links", "links", "sum_over_links"]

BLOCK = 4096  # links worked on at once: their activations stay in the processor's cache


class Laplacian(nn.Module):
    """Incoming minus own, ``m_j - m_i``: the graph shift operator A - D. Translations of all agents drop out."""

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        """Return ``sender - receiver`` [E, D]."""
        return sender - receiver


class Adjacency(nn.Module):
    """Incoming alone, ``m_j``: the graph shift operator A."""

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        """Return ``sender`` [E, D]."""
        return sender


class Links(NamedTuple):
    """A graph as its links, ordered by receiver: node numbers of senders and receivers [E]."""

    sender: Tensor
    receiver: Tensor

    def between(self, nodes: Tensor) -> Links:
        """The links both of whose ends are among ``nodes``, a boolean [R]."""
        if nodes.all():
            return self
        keep = nodes[self.sender] & nodes[self.receiver]
        return Links(self.sender[keep], self.receiver[keep])


def links(adjacency: Tensor) -> Links:
    """The links of graphs [..., N, N], whose nodes are numbered through: node i of graph g is g N + i."""
    size = adjacency.shape[-1]
    graph, receiver, sender = adjacency.reshape(-1, size, size).nonzero().unbind(-1)
    return Links(graph * size + sender, graph * size + receiver)


def sum_over_links(function: Callable[[Tensor, Tensor], Tensor], graph: Links, nodes: int) -> Tensor:
    """Sum a function of links over the neighbours of each node.

    Args:
        function: maps node numbers of senders and receivers [E] to values [E, F].
        graph: the links.
        nodes: number of nodes R.

    Returns:
        for each node, the sum over the links that it receives on [R, F].
    """
    total: Tensor | None = None
    blocks = zip(graph.sender.split(BLOCK), graph.receiver.split(BLOCK), strict=True)
    for sender, receiver in blocks:
        value = function(sender, receiver)
        if total is None:
            total = value.new_zeros(nodes, value.shape[-1])
        total = total.index_add(0, receiver, value)
    assert total is not None  # split gives one empty block for an empty graph
    return total
