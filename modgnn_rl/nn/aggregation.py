"""From the neighbours' messages to one vector an agent: ``sum_j f_pre(f_com(m_j, m_i))``, where nearly all time goes.

`aggregate` is the one function that the layers call; a fused kernel would replace it. It chooses between

- the *exact rewrites* of `modgnn_rl.nn.fused`, for a plain f_com and an f_pre of linear layers and ReLUs: linear
  layers before the first ReLU act on nodes instead of links, those after the last ReLU on the sum;
- *blocks of links* that stay in the processor's cache, and are computed again in the backward pass instead of being
  stored where there are many; any f_com and f_pre;
- *all at once*, where blocks would not be exact (batch statistics, values of links asked for) or possible
(`DenseGraph`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.func import functional_call
from torch.nn.modules.batchnorm import _NormBase

from modgnn_rl.nn import fused
from modgnn_rl.nn.communication import Communication
from modgnn_rl.nn.graph import EdgeList, Graph
from modgnn_rl.utils.tensors import is_transformed

__all__ = ["Hop", "aggregate", "call", "suited_form"]

STORED_LINKS = 1 << 16  # up to this many links, the backward pass finds all activations stored

NodeFeatures = Mapping[tuple[str, ...], Tensor]


class Hop(NamedTuple):
    """What the agents hold when messages of one hop come in.

    Attributes:
        senders: what each sender held one step earlier [S, D].
        receivers: what each receiver held one step earlier [R, D].
        own: data of the receivers now, by the key that a keyed submodule reads them under [R, ...].
    """

    senders: Tensor
    receivers: Tensor
    own: NodeFeatures


def call(module: nn.Module, data: Tensor, own: NodeFeatures, links: Graph | None = None) -> Tensor:
    """Apply a plain or a keyed submodule to rows of data [E, D]; ``own`` [E, ...] and ``links`` are for keyed ones."""
    if not isinstance(module, TensorDictModuleBase):
        return module(data)
    return _call_keyed(module, {("data",): data, **own}, links)


def _call_keyed(module: TensorDictModuleBase, entries: NodeFeatures, links: Graph | None) -> Tensor:
    rows = TensorDict({}, next(iter(entries.values())).shape[:1])
    for key, value in entries.items():
        rows[key] = value
    if links is not None and links.weight is not None:
        rows["link", "weight"] = links.weight.unsqueeze(-1)
    if links is not None and links.feature is not None:
        rows["link", "feature"] = links.feature
    return module(rows)[module.out_keys[-1]]


def communicate(f_com: nn.Module, sender: Tensor, receiver: Tensor, own: NodeFeatures, links: Graph) -> Tensor:
    """Y of the links [E, D'], with whichever signature f_com has."""
    if isinstance(f_com, Communication):
        return f_com(sender, receiver, links)
    if isinstance(f_com, TensorDictModuleBase):
        return _call_keyed(f_com, {("sender",): sender, ("receiver",): receiver, **own}, links)
    return f_com(sender, receiver)


def aggregate(
    graph: Graph,
    f_com: nn.Module,
    f_pre: nn.Module,
    hop: Hop,
    aggregation: str = "sum",
    record: Callable[[str, Tensor], None] | None = None,
) -> Tensor:
    """Aggregate ``f_pre(f_com(m_j, m_i))`` over the links that each agent receives on.

    Args:
        graph: the links.
        f_com: see `modgnn_rl.nn.communication`.
        f_pre: a plain module, or one with keys of its own.
        hop: what the agents hold.
        aggregation: ``sum``, ``mean`` or ``max``.
        record: is given ``("f_com", y)`` and ``("f_pre", f_pre(y))`` of all links.

    Returns:
        one row a receiver [R, F]; zero where it receives on no link.
    """
    if record is not None or not isinstance(graph, EdgeList) or _has_batch_statistics(f_com, f_pre):
        own = {key: graph.gather_receivers(value) for key, value in hop.own.items()}
        rows = graph.gather_senders(hop.senders), graph.gather_receivers(hop.receivers)
        return graph.aggregate(_values(f_com, f_pre, graph, *rows, own, record), aggregation)
    rewritten = fused.rewrite(graph, f_com, f_pre) if aggregation in ("sum", "mean") else None
    if rewritten is not None:
        total = rewritten(hop.senders, hop.receivers)
        return total / graph.degree().clamp(min=1).unsqueeze(-1) if aggregation == "mean" else total
    tables = (hop.senders, hop.receivers, *hop.own.values())
    values = _OfLinks(f_com, f_pre)
    if torch.is_grad_enabled() and len(graph) > STORED_LINKS and not _learned_links(graph):
        return _Recomputed.apply(values, graph, aggregation, tuple(hop.own), *tables, *values.weights().values())
    return _in_blocks(values, graph, aggregation, tuple(hop.own), tables)


def _values(
    f_com: nn.Module,
    f_pre: nn.Module,
    links: Graph,
    sender: Tensor,
    receiver: Tensor,
    own: NodeFeatures,
    record: Callable[[str, Tensor], None] | None = None,
) -> Tensor:
    """``f_pre(f_com(m_j, m_i))`` of links [E, F]."""
    y = communicate(f_com, sender, receiver, own, links)
    if record is not None:
        record("f_com", y)
    result = call(f_pre, y, own, links)
    if record is not None:
        record("f_pre", result)
    return result


class _OfLinks(nn.Module):
    """`_values` with its two modules, as one module."""

    def __init__(self, f_com: nn.Module, f_pre: nn.Module) -> None:
        super().__init__()
        self.f_com, self.f_pre = f_com, f_pre

    def forward(self, links: Graph, sender: Tensor, receiver: Tensor, own: NodeFeatures) -> Tensor:
        return _values(self.f_com, self.f_pre, links, sender, receiver, own)

    def weights(self) -> dict[str, Tensor]:
        """Parameters and buffers by the place where they are; buffers as they are now: modules change them as they run.

        A module in several places comes once. Parameters that several modules share come with each.
        """
        found: dict[str, Tensor] = {}
        for path, module in self.named_modules():
            found |= {f"{path}.{name}": value for name, value in module.named_parameters(recurse=False)}
            found |= {f"{path}.{name}": value.clone() for name, value in module.named_buffers(recurse=False)}
        return found


def _in_blocks(
    values: _OfLinks, graph: EdgeList, aggregation: str, keys: tuple[tuple[str, ...], ...], tables: Iterable[Tensor]
) -> Tensor:
    """Aggregate block by block; whole neighbourhoods lie in one block."""
    senders, *of_receivers = tables
    results = []
    for receivers, links in graph.blocks():
        block = graph.block(receivers, links)
        receiver, *own = (block.gather_receivers(table[receivers]) for table in of_receivers)
        result = values(block, block.gather_senders(senders), receiver, dict(zip(keys, own, strict=True)))
        results.append(block.aggregate(result, aggregation))
    return results[0] if len(results) == 1 else torch.cat(results)


class _Recomputed(torch.autograd.Function):
    """`_in_blocks` that stores the nodes' tables only, and computes each block again in the backward pass.

    The weights are those of the forward pass, which may have been lent to the modules for it (``functional_call``, the
    losses of TorchRL) and taken back since.
    """

    @staticmethod
    def forward(
        ctx: Any,
        values: _OfLinks,
        graph: EdgeList,
        aggregation: str,
        keys: tuple[tuple[str, ...], ...],
        *tensors: Tensor,
    ) -> Tensor:
        ctx.values, ctx.graph, ctx.aggregation, ctx.keys = values, graph, aggregation, keys
        ctx.names = tuple(values.weights())
        device = tensors[0].device
        ctx.autocast = (device.type, torch.get_autocast_dtype(device.type), torch.is_autocast_enabled(device.type))
        ctx.generators = _generator_states(device)
        ctx.save_for_backward(*tensors)
        return _in_blocks(values, graph, aggregation, keys, tensors[: 2 + len(keys)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Any:
        count = 2 + len(ctx.keys)
        tensors, wanted = ctx.saved_tensors, ctx.needs_input_grad[4:]
        senders, *of_receivers = tensors[:count]
        weights = [
            tensor.detach().clone().requires_grad_(needed)
            for tensor, needed in zip(tensors[count:], wanted[count:], strict=True)
        ]
        gradients = [
            torch.zeros_like(tensor) if needed else None for tensor, needed in zip(tensors, wanted, strict=True)
        ]
        kind, dtype, enabled = ctx.autocast
        with _GeneratorsAt(ctx.generators, senders.device), torch.autocast(kind, dtype, enabled):
            for receivers, links in ctx.graph.blocks():
                block = ctx.graph.block(receivers, links)
                rows = [
                    block.gather_senders(senders),
                    *(block.gather_receivers(table[receivers]) for table in of_receivers),
                ]
                rows = [row.requires_grad_(needed) for row, needed in zip(rows, wanted, strict=False)]
                leaves = [tensor for tensor, needed in zip((*rows, *weights), wanted, strict=True) if needed]
                with torch.enable_grad():
                    sender, receiver, *own = (row.clone() for row in rows)  # which modules may change in place
                    inputs = block, sender, receiver, dict(zip(ctx.keys, own, strict=True))
                    given = dict(zip(ctx.names, weights, strict=True))
                    result = functional_call(ctx.values, given, inputs, tie_weights=False)
                    result = block.aggregate(result, ctx.aggregation)
                if not result.requires_grad:
                    continue
                found = iter(
                    torch.autograd.grad(result, leaves, gradient[receivers].to(result.dtype), allow_unused=True)
                )
                for index, total in enumerate(gradients):
                    part = None if total is None else next(found)
                    if total is None or part is None:
                        continue
                    if index == 0:
                        total.index_add_(0, block.sender, part)
                    elif index < count:
                        total[receivers] += block.scatter_sum(part)
                    else:
                        total += part
        return None, None, None, None, *gradients


class _GeneratorsAt:
    """Draw from torch's global generators as they once stood, then put them back: random modules draw alike."""

    def __init__(self, states: list[Tensor], device: torch.device) -> None:
        self.states, self.device = states, device

    def __enter__(self) -> None:
        self.before = _generator_states(self.device)
        _set_generators(self.states, self.device)

    def __exit__(self, *_: object) -> None:
        _set_generators(self.before, self.device)


def _generator_states(device: torch.device) -> list[Tensor]:
    states = [torch.get_rng_state()]
    if device.type != "cpu":
        states.append(torch.get_device_module(device).get_rng_state(device))
    return states


def _set_generators(states: list[Tensor], device: torch.device) -> None:
    torch.set_rng_state(states[0])
    if len(states) > 1:
        torch.get_device_module(device).set_rng_state(states[1], device)


def _learned_links(graph: EdgeList) -> bool:
    return any(value is not None and value.requires_grad for value in (graph.weight, graph.feature))


def _has_batch_statistics(*modules: nn.Module) -> bool:
    """Whether modules, or parts of them, normalise by statistics of the rows that they are given."""
    return any(isinstance(part, _NormBase) for module in modules for part in module.modules())


def suited_form(form: str, module: nn.Module) -> str:
    """The form of graph to work on: where it is not set, links if batch statistics must see nothing else."""
    return "links" if form == "auto" and _has_batch_statistics(module) and not is_transformed() else form
