"""Intermediate results of a policy's layers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import torch
from torch import Tensor

from modgnn_rl.nn.graph import Graph
from modgnn_rl.nn.topology import Topology
from modgnn_rl.utils.tensors import mask_rows

__all__ = ["Recorder", "RequestRecorder"]


class Recorder(Protocol):
    """Collects intermediate results."""

    def wants(self, name: str, hop: int | None = None) -> bool:
        """Whether the result of this name is requested."""

    def record_nodes(self, name: str, hop: int | None, value: Tensor) -> None:
        """Record a result of all agents, or of the targets [R, F]."""

    def record_edges(self, name: str, hop: int, value: Tensor, graph: Graph) -> None:
        """Record a result of all edges of a graph [E, F]."""


class RequestRecorder:
    """Collects the requested intermediate results, in the shape of the data.

    Args:
        agents: leading shape of the data [*B, N].
        requested: the keys that are requested.
    """

    topology: Topology

    def __init__(self, agents: torch.Size, requested: Iterable[tuple[str, ...]]) -> None:
        self.agents, self.requested = agents, set(requested)
        self.results: dict[tuple[str, ...], Tensor] = {}
        self.layer = ""

    def begin_layer(self, number: int, topology: Topology) -> None:
        """Set the layer whose results follow, and the graphs it works on."""
        self.layer, self.topology = str(number), topology

    def wants(self, name: str, hop: int | None = None) -> bool:
        """Whether the result of this name is requested."""
        return self._key(name, hop) in self.requested

    def record_nodes(self, name: str, hop: int | None, value: Tensor) -> None:
        """Record a result of all agents, or of the targets [R, F]."""
        index, targets = self.topology.target_index, self.topology.targets
        if name not in ("f_input", "messages") and targets is not None:  # these two are computed for all agents
            if index is None or len(value) == self.topology.num_nodes:
                value = mask_rows(value, targets)
            else:
                value = value.new_zeros(self.topology.num_nodes, value.shape[-1]).index_copy(0, index, value)
        # A copy, because the next module may work in place.
        self.results[self._key(name, hop)] = value.reshape(*self.agents, value.shape[-1]).clone()

    def record_edges(self, name: str, hop: int, value: Tensor, graph: Graph) -> None:
        """Record a result of all edges of a graph [E, F]."""
        values = self.topology.to_input_layout(value, graph)
        self.results[self._key(name, hop)] = values.reshape(*self.agents[:-1], *values.shape[1:])

    def _key(self, name: str, hop: int | None) -> tuple[str, ...]:
        path = ("layers", self.layer, name)
        return path if hop is None else (*path, str(hop))
