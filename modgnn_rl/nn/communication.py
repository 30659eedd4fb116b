"""Communication between neighbours: implementations of f_com.

An f_com computes what an agent makes of one incoming message, ``y_ij = f_com(m_j, m_i)``, from the aggregates that
sender and receiver held one step earlier. It may be

- any module ``f_com(sender, receiver) -> y`` of two tensors [E, D], one row per edge;
- a `Communication`, which also sees the graph: edge weights and features, and the whole neighbourhood;
- a TensorDictModule that reads ``"sender"``, ``"receiver"``, the receiver's own current data under ``"own"``, and the
  edges' ``("edge", "weight")`` [E, 1] and ``("edge", "feature")`` [E, F]; its last out-key is y.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from modgnn_rl.errors import InputError
from modgnn_rl.nn.graph import Graph

__all__ = [
    "Adjacency",
    "Communication",
    "CoordinateFrame",
    "GraphAttention",
    "GraphShift",
    "Laplacian",
    "MessagePassing",
    "NormalizedAdjacency",
]


class Communication(nn.Module, abc.ABC):
    """An f_com that sees the graph beside the two ends of each edge.

    ``graph`` provides ``graph.weight`` [E] and ``graph.feature`` [E, F] (None if there are none), and functions of
    whole neighbourhoods: ``graph.softmax(logits)`` over each receiver's incoming edges, ``graph.degree()``, their
    number [R], ``graph.scatter_sum(values)``, their sum [R, F], and ``graph.gather_receivers(table)``, which gives each
    edge its receiver's row of a table: [R, F] -> [E, F]. See `modgnn_rl.nn.graph.Graph`.
    """

    @abc.abstractmethod
    def forward(self, sender: Tensor, receiver: Tensor, graph: Graph) -> Tensor:
        """Return y of the edges [E, D'] from what their senders and receivers hold [E, D]."""


class GraphShift(Communication):
    """A linear f_com without parameters: one application of a graph shift operator S, ``m <- S m``.

    Edge weights, if there are any, are the entries of S.
    """


class Adjacency(GraphShift):
    """The incoming message alone, ``w_ij m_j``: the graph shift operator A."""

    def forward(self, sender: Tensor, receiver: Tensor, graph: Graph | None = None) -> Tensor:
        """Return ``w sender`` [E, D]."""
        return _weigh(sender, graph)


class Laplacian(GraphShift):
    """Incoming minus own, ``w_ij (m_j - m_i)``: the operator A - D. It is invariant to translations of all agents."""

    def forward(self, sender: Tensor, receiver: Tensor, graph: Graph | None = None) -> Tensor:
        """Return ``w (sender - receiver)`` [E, D]."""
        return _weigh(sender - receiver, graph)


class NormalizedAdjacency(GraphShift):
    """The mean over neighbours, ``w_ij m_j / sum_j w_ij``: the random-walk operator D^-1 A.

    The symmetric normalisation ``D^-1/2 A D^-1/2`` is not available: it needs the sender's current number of
    neighbours, which a message that is one step old cannot contain.
    """

    def forward(self, sender: Tensor, receiver: Tensor, graph: Graph) -> Tensor:
        """Return ``w sender / sum of w`` [E, D]."""
        if graph.weight is None:
            return sender / graph.gather_receivers(graph.degree()).unsqueeze(-1).clamp(min=1)
        whole = graph.gather_receivers(graph.scatter_sum(graph.weight.unsqueeze(-1)))
        return graph.weight.unsqueeze(-1) * sender / torch.where(whole == 0, 1.0, whole)


class GraphAttention(Communication):
    r"""Attention normalised over the neighbours, several heads side by side (GATv2, Brody, Alon and Yahav 2022).

    For each head, with ``z = m_j`` (or ``m_j - m_i`` if ``relative``)::

        e_ij = a . LeakyReLU(W_s z + W_r m_i),   alpha_ij = softmax over j in N_i of e_ij,   y_ij = alpha_ij W_s z

    so that the sum over the neighbours is the output of the attention. If ``relative``, the receiver's own ``m_i`` is
    left out, and y is invariant to translations of all agents.

    Args:
        in_features: width of the messages D.
        out_features: width of y, a multiple of ``heads``.
        heads: number of heads.
        relative: attend to differences.

    Raises:
        InputError: ``out_features`` is not a multiple of ``heads``.
    """

    def __init__(self, in_features: int, out_features: int, heads: int = 1, *, relative: bool = False) -> None:
        super().__init__()
        if out_features % heads:
            raise InputError(f"out_features={out_features} is not a multiple of heads={heads}")
        self.heads, self.relative = heads, relative
        self.of_sender = nn.Linear(in_features, out_features, bias=False)
        self.of_receiver = None if relative else nn.Linear(in_features, out_features)
        self.score = nn.Parameter(torch.empty(heads, out_features // heads))
        nn.init.xavier_uniform_(self.score)

    def forward(self, sender: Tensor, receiver: Tensor, graph: Graph) -> Tensor:
        """Return attention times value of the edges [E, out_features]."""
        value = self.of_sender(sender - receiver if self.relative else sender)
        key = value if self.of_receiver is None else value + self.of_receiver(receiver)
        scores = (nn.functional.leaky_relu(key.unflatten(-1, (self.heads, -1)), 0.2) * self.score).sum(-1)
        return (graph.softmax(scores).unsqueeze(-1) * value.unflatten(-1, (self.heads, -1))).flatten(-2)


class MessagePassing(Communication):
    """A learned network of sender and receiver (Gilmer et al. 2017), ``y_ij = network([m_j, m_i, w_ij, f_ij])``.

    Edge weights and features are appended if there are any.

    Args:
        network: maps [E, 2 D (+ 1) (+ F)] to [E, D'].
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, sender: Tensor, receiver: Tensor, graph: Graph) -> Tensor:
        """Return the network's output for each edge [E, D']."""
        parts = [sender, receiver]
        if graph.weight is not None:
            parts.append(graph.weight.unsqueeze(-1))
        if graph.feature is not None:
            parts.append(graph.feature)
        return self.network(torch.cat(parts, -1))


class CoordinateFrame(Communication):
    """The sender's data in the receiver's coordinate frame.

    Points become relative to the receiver's position. Points and vectors are then rotated about the last axis (z, or
    the normal of the plane) by minus the receiver's heading. All other columns stay as they are.

    Args:
        positions: first columns of the points in the message, each with ``dimensions`` columns: the agent's position,
            then others (a goal, a landmark), if any.
        vectors: first columns of the vectors (velocities, directions).
        heading: column of the heading, rad; default: frames are not rotated. The sender's heading becomes the
            difference of the headings, between -pi and pi.
        dimensions: 2 or 3.

    Raises:
        InputError: ``dimensions`` is neither 2 nor 3.
    """

    def __init__(
        self,
        positions: Sequence[int] = (0,),
        vectors: Sequence[int] = (),
        *,
        heading: int | None = None,
        dimensions: int = 3,
    ) -> None:
        super().__init__()
        if dimensions not in (2, 3):
            raise InputError(f"dimensions={dimensions} is not 2 or 3")
        self.positions, self.vectors = tuple(positions), tuple(vectors)
        self.heading, self.dimensions = heading, dimensions

    def forward(self, sender: Tensor, receiver: Tensor, graph: Graph | None = None) -> Tensor:
        """Return the senders' data in the receivers' frames [E, D]."""
        columns = list(sender.unbind(-1))
        for first in self.positions:
            for axis in range(self.dimensions):
                columns[first + axis] = columns[first + axis] - receiver[..., self.positions[0] + axis]
        if self.heading is not None:
            cosine, sine = receiver[..., self.heading].cos(), receiver[..., self.heading].sin()
            for first in (*self.positions, *self.vectors):
                x, y = columns[first], columns[first + 1]
                columns[first], columns[first + 1] = cosine * x + sine * y, cosine * y - sine * x
            turn = columns[self.heading] - receiver[..., self.heading]
            columns[self.heading] = torch.atan2(turn.sin(), turn.cos())
        return torch.stack(columns, -1)


def _weigh(value: Tensor, graph: Graph | None) -> Tensor:
    return value if graph is None or graph.weight is None else graph.weight.unsqueeze(-1) * value
