"""From the neighbours' messages to one vector per agent: ``sum_j f_pre(f_com(m_j, m_i))``, which takes nearly all time.

`aggregate` is the one function that the layers call. It chooses between

- `modgnn_rl.nn.fused`, for a plain f_com and an f_pre of linear layers and ReLUs: linear layers before the first ReLU
  are applied to nodes instead of edges, those after the last ReLU to the sum;
- blocks of edges whose activations stay in the processor's cache, for any f_com and f_pre. Beyond `MAX_STORED_EDGES`
  the backward pass recomputes the activations (gradient checkpointing);
- all edges at once, where blocks would change the result (batch statistics), edge values are asked for, or the graph is
  a `DenseGraph`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils.checkpoint import checkpoint

from modgnn_rl.nn import fused
from modgnn_rl.nn.communication import Communication
from modgnn_rl.nn.graph import EdgeList, Graph
from modgnn_rl.utils.tensors import is_transformed

__all__ = ["NodeInputs", "aggregate", "call_submodule", "resolve_form"]

MAX_STORED_EDGES = 1 << 16  # the activations of this many edges are stored for the backward pass, others recomputed

NodeFeatures = Mapping[tuple[str, ...], Tensor]
EdgeFunction = Callable[[Graph, Tensor, Tensor, NodeFeatures], Tensor]


class NodeInputs(NamedTuple):
    """What the two ends of edges hold when the messages of one hop arrive.

    Attributes:
        senders: what each sender held one step earlier [S, D].
        receivers: what each receiver held one step earlier [R, D].
        own: the receivers' data now, by the key under which a keyed submodule reads them [R, ...].
    """

    senders: Tensor
    receivers: Tensor
    own: NodeFeatures


def call_submodule(module: nn.Module, data: Tensor, own: NodeFeatures, graph: Graph | None = None) -> Tensor:
    """Apply a plain or a keyed submodule to rows of data.

    Args:
        module: a plain module, or a TensorDictModule with keys of its own.
        data: [E, D].
        own: further rows for a keyed module [E, ...].
        graph: where the rows are edges, the graph whose weights and features a keyed module may read.

    Returns:
        [E, F].
    """
    if not isinstance(module, TensorDictModuleBase):
        return module(data)
    return _call_keyed(module, {("data",): data, **own}, graph)


def _call_keyed(module: TensorDictModuleBase, entries: NodeFeatures, graph: Graph | None) -> Tensor:
    rows = TensorDict({}, next(iter(entries.values())).shape[:1])
    for key, value in entries.items():
        rows[key] = value
    if graph is not None and graph.weight is not None:
        rows["edge", "weight"] = graph.weight.unsqueeze(-1)
    if graph is not None and graph.feature is not None:
        rows["edge", "feature"] = graph.feature
    return module(rows)[module.out_keys[-1]]


def _communicate(f_com: nn.Module, graph: Graph, sender: Tensor, receiver: Tensor, own: NodeFeatures) -> Tensor:
    """Apply f_com, with whichever signature it has, to the two ends of all edges [E, D]."""
    if isinstance(f_com, Communication):
        return f_com(sender, receiver, graph)
    if isinstance(f_com, TensorDictModuleBase):
        return _call_keyed(f_com, {("sender",): sender, ("receiver",): receiver, **own}, graph)
    return f_com(sender, receiver)


def _compute_edges(
    f_com: nn.Module,
    f_pre: nn.Module,
    record: Callable[[str, Tensor], None] | None,
    graph: Graph,
    sender: Tensor,
    receiver: Tensor,
    own: NodeFeatures,
) -> Tensor:
    """``f_pre(f_com(m_j, m_i))`` of edges [E, F], from the data of their ends [E, D]."""
    y = _communicate(f_com, graph, sender, receiver, own)
    if record is not None:
        record("f_com", y)
    result = call_submodule(f_pre, y, own, graph)
    if record is not None:
        record("f_pre", result)
    return result


class _EdgeModule(nn.Module):
    """`_compute_edges` with its two modules, as one module."""

    def __init__(self, f_com: nn.Module, f_pre: nn.Module) -> None:
        super().__init__()
        self.f_com, self.f_pre = f_com, f_pre

    def forward(self, graph: Graph, sender: Tensor, receiver: Tensor, own: NodeFeatures) -> Tensor:
        return _compute_edges(self.f_com, self.f_pre, None, graph, sender, receiver, own)

    def state(self) -> dict[str, Tensor]:
        """The parameters, and copies of the buffers, which modules may change as they run.

        A module in several places is listed once; parameters that several modules share are listed with each.
        """
        state: dict[str, Tensor] = {}
        for path, module in self.named_modules():
            state |= {f"{path}.{name}": value for name, value in module.named_parameters(recurse=False)}
            state |= {f"{path}.{name}": value.clone() for name, value in module.named_buffers(recurse=False)}
        return state


def aggregate(
    graph: Graph,
    f_com: nn.Module,
    f_pre: nn.Module,
    inputs: NodeInputs,
    aggregation: str = "sum",
    record: Callable[[str, Tensor], None] | None = None,
) -> Tensor:
    """Aggregate ``f_pre(f_com(m_j, m_i))`` over the incoming edges of each receiver.

    Args:
        graph: the edges.
        f_com: see `modgnn_rl.nn.communication`.
        f_pre: a plain module, or one with keys of its own.
        inputs: what the nodes hold.
        aggregation: ``sum``, ``mean`` or ``max``.
        record: called with ``("f_com", y)`` and ``("f_pre", f_pre(y))`` of all edges.

    Returns:
        one row per receiver [R, F]; zero for a receiver without edges.
    """
    if record is not None or not isinstance(graph, EdgeList) or _has_batch_statistics(f_com, f_pre):
        return _aggregate_block(graph, functools.partial(_compute_edges, f_com, f_pre, record), inputs, aggregation)
    fused_sum = fused.fuse(graph, f_com, f_pre) if aggregation in ("sum", "mean") else None
    if fused_sum is not None:
        total = fused_sum(inputs.senders, inputs.receivers)
        return total / graph.degree().clamp(min=1).unsqueeze(-1) if aggregation == "mean" else total
    results = list(_aggregate_blocks(graph, _EdgeModule(f_com, f_pre), inputs, aggregation))
    return results[0] if len(results) == 1 else torch.cat(results)


def _aggregate_blocks(graph: EdgeList, compute: _EdgeModule, inputs: NodeInputs, aggregation: str) -> Iterator[Tensor]:
    """Yield the aggregates of one block of receivers after another."""
    for receivers, edges in graph.blocks():
        block = graph.block(receivers, edges)
        own = {key: value[receivers] for key, value in inputs.own.items()}
        block_inputs = NodeInputs(inputs.senders, inputs.receivers[receivers], own)
        is_stored = edges.stop <= MAX_STORED_EDGES or not torch.is_grad_enabled()
        yield (_aggregate_block if is_stored else _checkpointed_block)(block, compute, block_inputs, aggregation)


def _aggregate_block(graph: Graph, compute: EdgeFunction, inputs: NodeInputs, aggregation: str) -> Tensor:
    """Gather the data at the ends of edges, compute the edges, aggregate."""
    own = {key: graph.gather_receivers(value) for key, value in inputs.own.items()}
    sender, receiver = graph.gather_senders(inputs.senders), graph.gather_receivers(inputs.receivers)
    return graph.aggregate(compute(graph, sender, receiver, own), aggregation)


def _checkpointed_block(graph: EdgeList, compute: _EdgeModule, inputs: NodeInputs, aggregation: str) -> Tensor:
    """`_aggregate_block` that stores no activations: the backward pass computes the block again.

    It then uses the weights and buffers as they are now: weights may be lent to the modules for the forward pass only
    (``functional_call``, the losses of TorchRL), and modules may change their buffers.
    """
    state, keys = compute.state(), tuple(inputs.own)

    def recompute(*arguments: object) -> Tensor:
        return functional_call(compute, state, arguments, tie_weights=False)

    functions: Iterator[EdgeFunction] = itertools.chain([compute], itertools.repeat(recompute))

    def run(senders: Tensor, receivers: Tensor, *own: Tensor) -> Tensor:
        block_inputs = NodeInputs(senders, receivers, dict(zip(keys, own, strict=True)))
        return _aggregate_block(graph, next(functions), block_inputs, aggregation)

    return checkpoint(run, inputs.senders, inputs.receivers, *inputs.own.values(), use_reentrant=False)


def _has_batch_statistics(*modules: nn.Module) -> bool:
    """Whether modules, or parts of them, normalise by statistics of the rows that they are given."""
    return any(hasattr(part, "track_running_stats") for module in modules for part in module.modules())


def resolve_form(form: str, module: nn.Module) -> str:
    """The form of graphs for a module: ``auto`` becomes ``edges`` if batch statistics must see existing edges only."""
    return "edges" if form == "auto" and _has_batch_statistics(module) and not is_transformed() else form
