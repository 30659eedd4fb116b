"""The data of a layer's forward pass by node, and functions of such rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from modgnn_rl.nn.aggregation import NodeFeatures, call_submodule
from modgnn_rl.nn.graph import Graph
from modgnn_rl.nn.recorder import Recorder
from modgnn_rl.nn.topology import Topology
from modgnn_rl.utils.tensors import flatnonzero, mask_rows

__all__ = ["Window", "call_where", "mask_invalid", "select"]


class Window(NamedTuple):
    """The data of one forward pass by node: all agents of all steps of all flocks are numbered consecutively.

    Attributes:
        shape: [*B, T, N].
        topology: the graphs.
        valid: nodes that exist and observe finite data, bool [R].
        own: data of the nodes, by the key under which keyed submodules read them [R, ...].
        target_own: the same of the targets only, see `Topology`.
        recorder: collects intermediate results.
    """

    shape: torch.Size
    topology: Topology
    valid: Tensor
    own: NodeFeatures
    target_own: NodeFeatures
    recorder: Recorder | None

    @property
    def inputs(self) -> Tensor:
        """The layer's input [R, F]."""
        return self.own["input",]

    def of_targets(self, table: Tensor) -> Tensor:
        """The targets' rows of a table [R, ...]."""
        return select(table, self.topology.target_index)

    def record(self, name: str, hop: int | None, value: Tensor) -> None:
        """Record a result of nodes if it is requested."""
        if self.recorder is not None and self.recorder.wants(name, hop):
            self.recorder.record_nodes(name, hop, value)

    def edge_recorder(self, hop: int, graph: Graph) -> Callable[[str, Tensor], None] | None:
        """A function that records results of edges, or None if none are requested."""
        recorder = self.recorder
        if recorder is None or not any(recorder.wants(name, hop) for name in ("f_com", "f_pre")):
            return None

        def record(name: str, value: Tensor) -> None:
            if recorder.wants(name, hop):
                recorder.record_edges(name, hop, value, graph)

        return record


def call_where(mask: Tensor | None, window: Window, module: nn.Module, data: Tensor, own: NodeFeatures) -> Tensor:
    """Apply a submodule to some rows, bool [R], or all; the others get zeros and do not enter batch statistics."""
    if mask is None:
        return call_submodule(module, data, own)
    if window.topology.is_dense or mask.all():
        return mask_rows(call_submodule(module, data, own), mask)
    index = flatnonzero(mask)
    result = call_submodule(module, select(data, index), {key: select(value, index) for key, value in own.items()})
    return result.new_zeros(len(data), *result.shape[1:]).index_copy(0, index, result)


def select(table: Tensor, index: Tensor | None) -> Tensor:
    """The rows of the given numbers, or all."""
    return table if index is None else table.index_select(0, index)


def mask_invalid(
    observation: Tensor, own: NodeFeatures, exists: Tensor | None = None
) -> tuple[Tensor, dict[tuple[str, ...], Tensor], Tensor]:
    """Replace the data of invalid agents, whose data contain NaN or infinity or who do not exist, by zeros.

    Args:
        observation: [R, F].
        own: further data [R, ...].
        exists: which agents exist, bool [R]; default: all.

    Returns:
        observation and further data, with zeros for invalid agents, and which agents are valid, bool [R].
    """
    valid = observation.isfinite().all(-1)
    if exists is not None:
        valid = valid & exists
    for value in own.values():
        valid = valid & value.isfinite().flatten(1).all(-1)
    return mask_rows(observation, valid), {key: mask_rows(value, valid) for key, value in own.items()}, valid
