"""``sum_j f_pre(f_com(m_j, m_i))`` in fewer operations, for a graph shift as f_com and an f_pre of linear and ReLU.

With y_ij = m_j - m_i and ``f_pre(y) = W3 relu(W2 relu(W1 y + b1) + b2) + b3`` ::

    sum_j f_pre(y_ij) = W3 [ sum_j relu(W2 relu(P_j - Q_i) + b2) ] + degree_i b3,    P = W1 m + b1,  Q = W1 m

The result is exactly the same, but the first and the last layer are computed for nodes instead of edges; only the
layers between two ReLUs remain for the edges. These run in blocks that stay in the processor's cache, in buffers reused
for every block, and the backward pass recomputes them. The hand-written backward pass takes half the time of
``torch.utils.checkpoint`` (``python benchmarks/modgnn_speed.py rewrites``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from modgnn_rl.nn.communication import Adjacency, Laplacian
from modgnn_rl.nn.graph import EdgeList
from modgnn_rl.utils.internals import has_hooks

__all__ = ["fuse", "is_linear_map"]

FusedSum = Callable[[Tensor, Tensor], Tensor]


def is_linear_map(module: nn.Module) -> bool:
    """Whether a module is an affine map of each row: a linear layer, or one whose class sets ``is_linear_map``."""
    return type(module) in (nn.Linear, nn.Identity) or getattr(type(module), "is_linear_map", False)


def fuse(graph: EdgeList, f_com: nn.Module, f_pre: nn.Module) -> FusedSum | None:
    """The sum over incoming edges as a fused function, where there is one.

    Args:
        graph: the edges.
        f_com: see `modgnn_rl.nn.communication`.
        f_pre: a plain module.

    Returns:
        a function of what senders and receivers hold, [S, D] and [R, D], that returns the sums [R, F]. None for other
        kinds of modules, modules with hooks, weighted edges, and under autocast.
    """
    layers = list(_flatten(f_pre))
    if not _is_supported(graph, f_com, f_pre, layers):
        return None
    relus = [index for index, layer in enumerate(layers) if type(layer) is nn.ReLU]
    is_difference = type(f_com) is Laplacian
    if not relus:
        return lambda senders, receivers: _sum_of_linear(graph, layers, senders, receivers if is_difference else None)
    before, after = layers[: relus[0]], layers[relus[-1] + 1 :]
    between = [layers[a + 1 : b] for a, b in pairwise(relus)]
    if not all(len(part) == 1 and type(part[0]) is nn.Linear for part in between):
        return None

    def fused_sum(senders: Tensor, receivers: Tensor) -> Tensor:
        incoming = _apply(before, senders)
        own = None
        if is_difference:
            # W1 m without its bias, which the senders' W1 m + b1 already contains.
            mine = incoming if receivers is senders else _apply(before, receivers)
            own = mine - _apply(before, receivers.new_zeros(1, receivers.shape[-1]))
        weights = [parameter for (layer,) in between for parameter in (layer.weight, layer.bias)]
        return _map_sum(graph, after, _ReluSum.apply(graph, incoming, own, *weights))

    return fused_sum


def _is_supported(graph: EdgeList, f_com: nn.Module, f_pre: nn.Module, layers: list[nn.Module]) -> bool:
    return (
        type(f_com) in (Laplacian, Adjacency)
        and graph.weight is None
        and not torch.is_autocast_enabled(graph.sender.device.type)
        and all(type(layer) is nn.ReLU or is_linear_map(layer) for layer in layers)
        and not any(has_hooks(module) for module in (f_com, *f_pre.modules()))
    )


def _flatten(module: nn.Module) -> Iterator[nn.Module]:
    """The modules that nested sequences apply one after another."""
    if type(module) is nn.Sequential:
        for part in module:
            yield from _flatten(part)
    else:
        yield module


def _apply(layers: list[nn.Module], data: Tensor) -> Tensor:
    for layer in layers:
        data = layer(data)
    return data


def _sum_of_linear(graph: EdgeList, layers: list[nn.Module], senders: Tensor, receivers: Tensor | None) -> Tensor:
    """The sum over incoming edges of an affine map of a graph shift: sum first, map afterwards."""
    if len(graph) == 0:
        total = senders.new_zeros(graph.num_receivers, senders.shape[-1])
    else:
        total = embedding_bag(graph.sender, senders, graph.offsets(), mode="sum")
    if receivers is not None:
        total = total - graph.degree().unsqueeze(-1) * receivers
    return _map_sum(graph, layers, total)


def _map_sum(graph: EdgeList, layers: list[nn.Module], total: Tensor) -> Tensor:
    """The sum over incoming edges of an affine map ``A x + b``, from the sum of x: ``A total + degree b``."""
    if not layers:
        return total
    bias = _apply(layers, total.new_zeros(1, total.shape[-1]))
    return _apply(layers, total) + (graph.degree() - 1).unsqueeze(-1) * bias


class _ReluSum(torch.autograd.Function):
    """``sum_j relu(... W2 relu(P_j - Q_i) + b2 ...)`` over incoming edges: linear layers between ReLUs.

    Inputs: the graph, P [S, H], Q [R, H] or None, then weight and bias (or None) of each linear layer.
    """

    @staticmethod
    def forward(ctx: Any, graph: EdgeList, incoming: Tensor, own: Tensor | None, *weights: Tensor | None) -> Tensor:
        ctx.graph = graph
        ctx.save_for_backward(incoming, own, *weights)
        network = _EdgeNetwork(graph, incoming, own, weights)
        total = incoming.new_empty(graph.num_receivers, network.widths[-1])
        for receivers, edges in graph.blocks():
            total[receivers] = network.sum_to_receivers(network.forward(edges)[-1], receivers, edges)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Any:
        graph: EdgeList = ctx.graph
        incoming, own, *weights = ctx.saved_tensors
        network = _EdgeNetwork(graph, incoming, own, weights)
        of_weights = [None if weight is None else torch.zeros_like(weight) for weight in weights]
        of_incoming = torch.zeros_like(incoming)
        of_own = None if own is None else torch.empty_like(own)
        gradient = gradient.contiguous()
        for receivers, edges in graph.blocks():
            of_difference = network.backward(network.forward(edges), gradient, edges, of_weights)
            of_incoming.index_add_(0, graph.sender[edges], of_difference)
            if of_own is not None:
                of_own[receivers] = network.sum_to_receivers(of_difference, receivers, edges)
        return None, of_incoming, None if of_own is None else of_own.neg_(), *of_weights


class _EdgeNetwork:
    """The layers between the first and the last ReLU, over blocks of edges, in buffers that all blocks share.

    Args:
        graph: the edges.
        incoming: the senders' part of the first pre-activation, P [S, H].
        own: the receivers' part, Q [R, H], or None.
        weights: weight and bias (or None) of each linear layer.
    """

    def __init__(self, graph: EdgeList, incoming: Tensor, own: Tensor | None, weights: Sequence[Tensor | None]) -> None:
        self.graph, self.incoming, self.own = graph, incoming, own
        self.weights = [weight for weight in weights[::2] if weight is not None]
        self.biases = weights[1::2]
        self.transposed = [weight.t().contiguous() for weight in self.weights]
        self.widths = [incoming.shape[1], *(len(weight) for weight in self.weights)]
        self.block_size = max(edges.stop - edges.start for _, edges in graph.blocks())
        self.range = torch.arange(self.block_size, device=incoming.device)
        self.offsets = graph.offsets()
        self.activations = [incoming.new_empty(self.block_size, width) for width in self.widths]
        self.scratch: dict[tuple[int, int], Tensor] = {}

    def forward(self, edges: slice) -> list[Tensor]:
        """Activations after each ReLU, for a block of edges."""
        count = edges.stop - edges.start
        hidden, *outputs = (buffer[:count] for buffer in self.activations)
        torch.index_select(self.incoming, 0, self.graph.sender[edges], out=hidden)
        if self.own is not None:
            mine = self._scratch(0, self.widths[0], count)
            hidden.sub_(torch.index_select(self.own, 0, self.graph.receiver[edges], out=mine))
        activations = [hidden.relu_()]
        for output, weight, bias in zip(outputs, self.transposed, self.biases, strict=True):
            if bias is None:
                torch.mm(activations[-1], weight, out=output)
            else:
                torch.addmm(bias, activations[-1], weight, out=output)
            activations.append(output.relu_())
        return activations

    def backward(
        self, activations: list[Tensor], gradient: Tensor, edges: slice, of_weights: list[Tensor | None]
    ) -> Tensor:
        """Backpropagate through a block of edges.

        Args:
            activations: what `forward` returned for this block.
            gradient: gradient of the receivers' sums [R, F].
            edges: the block.
            of_weights: gradients of weights and biases, which this block's are added to.

        Returns:
            gradient of the first pre-activation ``P_j - Q_i`` [E, H].
        """
        count, relu_backward = len(activations[0]), torch.ops.aten.threshold_backward.grad_input
        upstream = self._scratch(0, self.widths[-1], count)
        torch.index_select(gradient, 0, self.graph.receiver[edges], out=upstream)
        for layer in range(len(self.weights), 0, -1):
            of_output = self._scratch(1, self.widths[layer], count)
            relu_backward(upstream, activations[layer], 0, grad_input=of_output)
            of_weight, of_bias = of_weights[2 * layer - 2], of_weights[2 * layer - 1]
            if of_weight is not None:
                of_weight.addmm_(of_output.t(), activations[layer - 1])
            if of_bias is not None:
                of_bias += of_output.sum(0)
            upstream = self._scratch(0, self.widths[layer - 1], count)
            torch.mm(of_output, self.weights[layer - 1], out=upstream)
        return relu_backward(upstream, activations[0], 0, grad_input=self._scratch(1, self.widths[0], count))

    def sum_to_receivers(self, values: Tensor, receivers: slice, edges: slice) -> Tensor:
        """Sum the values of a block of edges over each of its receivers."""
        offsets = self.offsets[receivers] - edges.start
        if len(values) == 0:
            return values.new_zeros(len(offsets), values.shape[-1])
        return embedding_bag(self.range[: len(values)], values, offsets, mode="sum")

    def _scratch(self, number: int, width: int, count: int) -> Tensor:
        """One of two buffers of this width, which alternate as input and output."""
        key = (number, width)
        if key not in self.scratch:
            self.scratch[key] = self.incoming.new_empty(self.block_size, width)
        return self.scratch[key][:count]
