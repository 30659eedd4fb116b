"""From the neighbours' messages to one vector an agent: ``sum_j f_pre(f_com(m_j, m_i))``, where nearly all time goes.

`aggregate` is the one function that the layers call; a fused kernel would replace it. It chooses between

- the *exact rewrites* of `modgnn_rl.relu_links`, for a plain f_com and an f_pre of linear layers and ReLUs: linear
  layers before the first ReLU act on nodes instead of links, those after the last ReLU on the sum;
- *blocks of links* that stay in the processor's cache, and are computed again in the backward pass instead of being
  stored where there are many; any f_com and f_pre;
- *all at once*, where blocks would not be exact (batch statistics, values of links asked for) or possible (`Pairs`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.modules.batchnorm import _NormBase

from modgnn_rl import relu_links
from modgnn_rl.communication import Communication
from modgnn_rl.graph import Graph, Links, Pairs

__all__ = ["Hop", "aggregate", "call"]

STORED_LINKS = 1 << 16  # up to this many links, the backward pass finds all activations stored

Tables = Mapping[tuple[str, ...], Tensor]


class Hop(NamedTuple):
    """What the agents hold when messages of one hop come in.

    Attributes:
        senders: what each sender held one step earlier [S, D].
        receivers: what each receiver held one step earlier [R, D].
        own: data of the receivers now, by the key that a keyed submodule reads them under [R, ...].
    """

    senders: Tensor
    receivers: Tensor
    own: Tables


def call(module: nn.Module, data: Tensor, own: Tables, links: Graph | None = None) -> Tensor:
    """Apply a plain or a keyed submodule to rows of data [E, D]; ``own`` [E, ...] and ``links`` are for keyed ones."""
    if not isinstance(module, TensorDictModuleBase):
        return module(data)
    return _call_keyed(module, {("data",): data, **own}, links)


def _call_keyed(module: TensorDictModuleBase, entries: Tables, links: Graph | None) -> Tensor:
    rows = TensorDict({}, next(iter(entries.values())).shape[:1])
    for key, value in entries.items():
        rows[key] = value
    if links is not None and links.weight is not None:
        rows["link", "weight"] = links.weight.unsqueeze(-1)
    if links is not None and links.feature is not None:
        rows["link", "feature"] = links.feature
    return module(rows)[module.out_keys[0]]


def communicate(f_com: nn.Module, sender: Tensor, receiver: Tensor, own: Tables, links: Graph) -> Tensor:
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
        f_com: see `modgnn_rl.communication`.
        f_pre: a plain module, or one with keys of its own.
        hop: what the agents hold.
        aggregation: ``sum``, ``mean`` or ``max``.
        record: is given ``("f_com", y)`` and ``("f_pre", f_pre(y))`` of all links.

    Returns:
        one row a receiver [R, F]; zero where it receives on no link.
    """

    def values(links: Graph, sender: Tensor, receiver: Tensor, own: Tables) -> Tensor:
        y = communicate(f_com, sender, receiver, own, links)
        if isinstance(links, Pairs):
            y = links.only_linked(y)
        result = call(f_pre, y, own, links)
        if record is not None:
            record("f_com", y)
            record("f_pre", result)
        return result

    if record is not None or not isinstance(graph, Links) or _has_batch_statistics(f_com, f_pre):
        own = {key: graph.at_receivers(value) for key, value in hop.own.items()}
        rows = graph.at_senders(hop.senders), graph.at_receivers(hop.receivers)
        return graph.aggregate(values(graph, *rows, own), aggregation)
    rewritten = relu_links.rewrite(graph, f_com, f_pre) if aggregation in ("sum", "mean") else None
    if rewritten is not None:
        total = rewritten(hop.senders, hop.receivers)
        return total / graph.degree().clamp(min=1).unsqueeze(-1) if aggregation == "mean" else total
    parameters = [tensor for module in (f_com, f_pre) for tensor in _learned(module)]
    tables = (hop.senders, hop.receivers, *hop.own.values())
    if torch.is_grad_enabled() and len(graph) > STORED_LINKS and not _learned_links(graph):
        return _Recomputed.apply(values, graph, aggregation, tuple(hop.own), *tables, *parameters)
    return _in_blocks(values, graph, aggregation, tuple(hop.own), tables)


Values = Callable[[Graph, Tensor, Tensor, Tables], Tensor]


def _in_blocks(
    values: Values, graph: Links, aggregation: str, keys: tuple[tuple[str, ...], ...], tables: Iterable[Tensor]
) -> Tensor:
    """Aggregate block by block; whole neighbourhoods lie in one block."""
    senders, *of_receivers = tables
    results = []
    for receivers, links in graph.blocks():
        block = graph.block(receivers, links)
        receiver, *own = (block.at_receivers(table[receivers]) for table in of_receivers)
        result = values(block, block.at_senders(senders), receiver, dict(zip(keys, own, strict=True)))
        results.append(block.aggregate(result, aggregation))
    return results[0] if len(results) == 1 else torch.cat(results)


class _Recomputed(torch.autograd.Function):
    """`_in_blocks` that stores the nodes' tables only, and computes each block again in the backward pass."""

    @staticmethod
    def forward(
        ctx: Any,
        values: Values,
        graph: Links,
        aggregation: str,
        keys: tuple[tuple[str, ...], ...],
        *tensors: Tensor,
    ) -> Tensor:
        ctx.values, ctx.graph, ctx.aggregation, ctx.keys = values, graph, aggregation, keys
        device = tensors[0].device
        ctx.autocast = (device.type, torch.get_autocast_dtype(device.type), torch.is_autocast_enabled(device.type))
        ctx.generators = _generator_states(device)
        ctx.save_for_backward(*tensors)
        return _in_blocks(values, graph, aggregation, keys, tensors[: 2 + len(keys)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Any:
        count = 2 + len(ctx.keys)
        senders, *of_receivers = ctx.saved_tensors[:count]
        parameters = ctx.saved_tensors[count:]
        wanted = ctx.needs_input_grad[4:]
        gradients = [
            torch.zeros_like(t) if needed else None for t, needed in zip(ctx.saved_tensors, wanted, strict=True)
        ]
        kind, dtype, enabled = ctx.autocast
        with _GeneratorsAt(ctx.generators, senders.device), torch.autocast(kind, dtype, enabled):
            for receivers, links in ctx.graph.blocks():
                block = ctx.graph.block(receivers, links)
                rows = [block.at_senders(senders), *(block.at_receivers(table[receivers]) for table in of_receivers)]
                rows = [row.requires_grad_(needed) for row, needed in zip(rows, wanted, strict=False)]
                leaves = [tensor for tensor, needed in zip((*rows, *parameters), wanted, strict=True) if needed]
                with torch.enable_grad():
                    result = ctx.values(block, *rows[:2], dict(zip(ctx.keys, rows[2:], strict=True)))
                    result = block.aggregate(result, ctx.aggregation)
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
                        total[receivers] += block.total(part)
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


def _learned(module: nn.Module) -> list[Tensor]:
    return [tensor for tensor in (*module.parameters(), *module.buffers()) if tensor.requires_grad]


def _learned_links(graph: Links) -> bool:
    return any(value is not None and value.requires_grad for value in (graph.weight, graph.feature))


def _has_batch_statistics(*modules: nn.Module) -> bool:
    return any(isinstance(part, _NormBase) for module in modules for part in module.modules())
