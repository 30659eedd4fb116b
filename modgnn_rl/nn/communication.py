"""Communication between neighbours: the choices of f_com.

An f_com computes what an agent makes of one incoming message, ``y_ij = f_com(m_j, m_i)``, from the aggregates that
sender and receiver held one step earlier. It may be

- any module ``f_com(sender, receiver) -> y`` of two tensors [E, D], one row a link;
- a `Communication`, which also sees the links: their weights and features, and the whole neighbourhood;
- a TensorDictModule that reads ``"sender"``, ``"receiver"``, the receiver's own data now under ``"own"``, and the
  links' ``("link", "weight")`` [E, 1] and ``("link", "feature")`` [E, F]; its last out-key is y.
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
    """An f_com that sees the links beside the two ends.

    ``links`` gives ``links.weight`` [E] and ``links.feature`` [E, F] (None where there are none), and what needs a
    whole neighbourhood: ``links.softmax(logits)`` over the links that a receiver receives on, ``links.degree()`` their
    number [R], ``links.scatter_sum(values)`` their sum [R, F], and ``links.gather_receivers(table)``, which brings a
    value of each receiver [R, F] to its links [E, F].
    """

    @abc.abstractmethod
    def forward(self, sender: Tensor, receiver: Tensor, links: Graph) -> Tensor:
        """Return y of the links [E, D'] from what their senders and receivers hold [E, D]."""


class GraphShift(Communication):
    """An f_com without parameters that is linear: one application of a graph shift operator S, ``m <- S m``.

    Weights of the links, where there are any, are the entries of S.
    """


class Adjacency(GraphShift):
    """Incoming alone, ``w_ij m_j``: the graph shift operator A."""

    def forward(self, sender: Tensor, receiver: Tensor, links: Graph | None = None) -> Tensor:
        """Return ``w sender`` [E, D]."""
        return _weigh(sender, links)


class Laplacian(GraphShift):
    """Incoming minus own, ``w_ij (m_j - m_i)``: the operator A - D. Translations of all agents drop out."""

    def forward(self, sender: Tensor, receiver: Tensor, links: Graph | None = None) -> Tensor:
        """Return ``w (sender - receiver)`` [E, D]."""
        return _weigh(sender - receiver, links)


class NormalizedAdjacency(GraphShift):
    """Incoming as a mean over the neighbours, ``w_ij m_j / sum_j w_ij``: the random-walk operator D^-1 A.

    The symmetric normalisation ``D^-1/2 A D^-1/2`` is not offered: it needs the number of the sender's neighbours now,
    which no message of one step ago can tell.
    """

    def forward(self, sender: Tensor, receiver: Tensor, links: Graph) -> Tensor:
        """Return ``w sender / sum of w`` [E, D]."""
        if links.weight is None:
            return sender / links.gather_receivers(links.degree()).unsqueeze(-1).clamp(min=1)
        whole = links.gather_receivers(links.scatter_sum(links.weight.unsqueeze(-1)))
        return links.weight.unsqueeze(-1) * sender / torch.where(whole == 0, 1.0, whole)


class GraphAttention(Communication):
    r"""Attention normalised over the neighbours, several heads side by side (GATv2, Brody, Alon and Yahav 2022).

    For each head, with ``z = m_j`` (or ``m_j - m_i`` if ``relative``)::

        e_ij = a . LeakyReLU(W_s z + W_r m_i),   alpha_ij = softmax over j in N_i of e_ij,   y_ij = alpha_ij W_s z

    so that the sum over the neighbours is the attention's output. If ``relative``, the receiver's own ``m_i`` is left
    out, and y does not feel a translation of all agents.

    Args:
        in_features: width of the messages D.
        out_features: width of y, a multiple of ``heads``.
        heads: number of heads.
        relative: attend to differences.

    Raises:
        InputError: ``out_features`` is no multiple of ``heads``.
    """

    def __init__(self, in_features: int, out_features: int, heads: int = 1, *, relative: bool = False) -> None:
        super().__init__()
        if out_features % heads:
            raise InputError(f"out_features={out_features} is no multiple of heads={heads}; each head has its share")
        self.heads, self.relative = heads, relative
        self.of_sender = nn.Linear(in_features, out_features, bias=False)
        self.of_receiver = None if relative else nn.Linear(in_features, out_features)
        self.score = nn.Parameter(torch.empty(heads, out_features // heads))
        nn.init.xavier_uniform_(self.score)

    def forward(self, sender: Tensor, receiver: Tensor, links: Graph) -> Tensor:
        """Return the attended data of the links [E, out_features]."""
        value = self.of_sender(sender - receiver if self.relative else sender)
        key = value if self.of_receiver is None else value + self.of_receiver(receiver)
        scores = (nn.functional.leaky_relu(key.unflatten(-1, (self.heads, -1)), 0.2) * self.score).sum(-1)
        return (links.softmax(scores).unsqueeze(-1) * value.unflatten(-1, (self.heads, -1))).flatten(-2)


class MessagePassing(Communication):
    """A learned network of sender and receiver (Gilmer et al. 2017), ``y_ij = network([m_j, m_i, w_ij, f_ij])``.

    Weights and features of the links are appended where there are any.

    Args:
        network: maps [E, 2 D (+ 1) (+ F)] to [E, D'].
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, sender: Tensor, receiver: Tensor, links: Graph) -> Tensor:
        """Return the network's output for each link [E, D']."""
        parts = [sender, receiver]
        if links.weight is not None:
            parts.append(links.weight.unsqueeze(-1))
        if links.feature is not None:
            parts.append(links.feature)
        return self.network(torch.cat(parts, -1))


class CoordinateFrame(Communication):
    """The sender's data in the receiver's frame of coordinates: moved to its place, turned by its heading.

    Points become relative to the receiver's position; points and vectors are then turned about the last axis (z, or the
    plane's) by minus the heading of the receiver. All other columns stay as they are.

    Args:
        positions: first columns of the points in the message, each with ``dimensions`` columns: the agent's position,
            and others (a goal, a landmark), if any.
        vectors: first columns of the vectors (velocities, directions), likewise.
        heading: column that holds the heading, rad; default: frames are not turned. The sender's heading becomes the
            difference of the headings, between -pi and pi.
        dimensions: 2 or 3.
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

    def forward(self, sender: Tensor, receiver: Tensor, links: Graph | None = None) -> Tensor:
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


def _weigh(value: Tensor, links: Graph | None) -> Tensor:
    return value if links is None or links.weight is None else links.weight.unsqueeze(-1) * value
