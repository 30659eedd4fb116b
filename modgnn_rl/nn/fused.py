"""Exact rewrites of ``sum_j f_pre(f_com(m_j, m_i))``: f_com a plain graph shift, f_pre linear layers and ReLUs.

With y = m_j - m_i and ``f_pre(y) = W3 relu(W2 relu(W1 y + b1) + b2) + b3`` ::

    sum_j f_pre(y_ij) = W3 [ sum_j relu(W2 relu(P_j - Q_i) + b2) ] + degree_i b3,    P = W1 m + b1,  Q = W1 m

so that the first and the last layer cost nodes, not links, and only the layers between two ReLUs are left for the
links. These run in blocks that stay in the processor's cache, in buffers used again for every block, and are computed
again in the backward pass instead of being stored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag

from modgnn_rl.nn.communication import Adjacency, Laplacian
from modgnn_rl.nn.graph import EdgeList

__all__ = ["is_linear_map", "rewrite"]

Rewritten = Callable[[Tensor, Tensor], Tensor]


def is_linear_map(module: nn.Module) -> bool:
    """Whether a module is an affine map of each row: a linear layer, or one that says so with ``is_linear_map``."""
    return type(module) in (nn.Linear, nn.Identity) or getattr(type(module), "is_linear_map", False)


def rewrite(graph: EdgeList, f_com: nn.Module, f_pre: nn.Module) -> Rewritten | None:
    """A function of the senders' and the receivers' tables [S, D], [R, D] that returns the sum, or None.

    None is returned where the modules are of another kind, carry hooks, or weigh links.
    """
    if (
        type(f_com) not in (Laplacian, Adjacency)
        or graph.weight is not None
        or torch.is_autocast_enabled(graph.sender.device.type)
    ):
        return None
    modules = list(_parts(f_pre))
    kinds = [type(module) is nn.ReLU or is_linear_map(module) for module in modules]
    if not all(kinds) or any(_is_hooked(module) for module in (f_com, *f_pre.modules())):
        return None
    nonlinear = [index for index, module in enumerate(modules) if type(module) is nn.ReLU]
    is_difference = type(f_com) is Laplacian
    if not nonlinear:
        return lambda senders, receivers: _sum_of_linear(graph, modules, senders, receivers if is_difference else None)
    before, after = modules[: nonlinear[0]], modules[nonlinear[-1] + 1 :]
    between = [modules[a + 1 : b] for a, b in pairwise(nonlinear)]
    if not all(len(layers) == 1 and type(layers[0]) is nn.Linear for layers in between):
        return None

    def run(senders: Tensor, receivers: Tensor) -> Tensor:
        incoming = _apply(before, senders)
        own = None
        if is_difference:
            # W1 m without its bias, which W1 m of the senders has already.
            mine = incoming if receivers is senders else _apply(before, receivers)
            own = mine - _apply(before, receivers.new_zeros(1, receivers.shape[-1]))
        weights = [parameter for (layer,) in between for parameter in (layer.weight, layer.bias)]
        total = _ReluOverLinks.apply(graph, incoming, own, *weights)
        return _after_the_sum(graph, after, total)

    return run


def _sum_of_linear(graph: EdgeList, modules: list[nn.Module], senders: Tensor, receivers: Tensor | None) -> Tensor:
    """The sum over neighbours of an affine map of a graph shift: sum first, map afterwards."""
    if len(graph) == 0:
        total = senders.new_zeros(graph.num_receivers, senders.shape[-1])
    else:
        total = embedding_bag(graph.sender, senders, graph.first(), mode="sum")
    if receivers is not None:
        total = total - graph.degree().unsqueeze(-1) * receivers
    return _after_the_sum(graph, modules, total)


def _after_the_sum(graph: EdgeList, modules: list[nn.Module], total: Tensor) -> Tensor:
    """The sum over links of an affine map, from the sum over links of what goes into it."""
    if not modules:
        return total
    constant = _apply(modules, total.new_zeros(1, total.shape[-1]))
    return _apply(modules, total) + (graph.degree() - 1).unsqueeze(-1) * constant


def _parts(module: nn.Module) -> Iterator[nn.Module]:
    """The modules that a nested sequence applies one after the other."""
    if type(module) is nn.Sequential:
        for part in module:
            yield from _parts(part)
    else:
        yield module


def _apply(modules: list[nn.Module], data: Tensor) -> Tensor:
    for module in modules:
        data = module(data)
    return data


def _is_hooked(module: nn.Module) -> bool:
    hooks = (module._forward_hooks, module._forward_pre_hooks, module._backward_hooks, module._backward_pre_hooks)
    return any(hooks)


class _ReluOverLinks(torch.autograd.Function):
    """``sum_j relu(... W2 relu(P_j - Q_i) + b2 ...)``: ReLUs and linear layers, a ReLU at both ends.

    Inputs: the graph, P [S, H], Q [R, H] or None, then weight and bias (or None) of each linear layer.
    """

    @staticmethod
    def forward(ctx: Any, graph: EdgeList, incoming: Tensor, own: Tensor | None, *weights: Tensor | None) -> Tensor:
        ctx.graph = graph
        ctx.save_for_backward(incoming, own, *weights)
        layers = _Layers(graph, incoming, own, weights)
        total = incoming.new_empty(graph.num_receivers, layers.widths[-1])
        first = graph.first()
        for receivers, links in graph.blocks():
            activations = layers.forward(receivers, links)
            total[receivers] = layers.sum_to_receivers(activations[-1], first[receivers] - links.start)
        return total

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Any:
        graph: EdgeList = ctx.graph
        incoming, own, *weights = ctx.saved_tensors
        layers = _Layers(graph, incoming, own, weights)
        gradients = [None if weight is None else torch.zeros_like(weight) for weight in weights]
        to_senders = torch.zeros_like(incoming)
        to_receivers = None if own is None else torch.empty_like(own)
        first, gradient = graph.first(), gradient.contiguous()
        for receivers, links in graph.blocks():
            activations = layers.forward(receivers, links)
            flowing = layers.backward(activations, gradient, links, gradients)
            to_senders.index_add_(0, graph.sender[links], flowing)
            if to_receivers is not None:
                to_receivers[receivers] = layers.sum_to_receivers(flowing, first[receivers] - links.start)
        return None, to_senders, None if to_receivers is None else to_receivers.neg_(), *gradients


class _Layers:
    """The layers over blocks of links, in buffers that all blocks share."""

    def __init__(self, graph: EdgeList, incoming: Tensor, own: Tensor | None, weights: Any) -> None:
        self.graph, self.incoming, self.own = graph, incoming, own
        self.weights, self.biases = weights[::2], weights[1::2]
        self.transposed = [weight.t().contiguous() for weight in self.weights]
        self.widths = [incoming.shape[1], *(len(weight) for weight in self.weights)]
        self.longest = max(links.stop - links.start for _, links in graph.blocks())
        self.order = torch.arange(self.longest, device=incoming.device)
        self.buffers = [incoming.new_empty(self.longest, width) for width in self.widths]
        self.scratch: dict[tuple[int, int], Tensor] = {}

    def forward(self, receivers: slice, links: slice) -> list[Tensor]:
        """Activations after each ReLU, for a block of links."""
        count = links.stop - links.start
        hidden, *others = (buffer[:count] for buffer in self.buffers)
        torch.index_select(self.incoming, 0, self.graph.sender[links], out=hidden)
        if self.own is not None:
            mine = self._buffer(0, self.widths[0], count)
            hidden.sub_(torch.index_select(self.own, 0, self.graph.receiver[links], out=mine))
        activations = [hidden.relu_()]
        for output, weight, bias in zip(others, self.transposed, self.biases, strict=True):
            if bias is None:
                torch.mm(activations[-1], weight, out=output)
            else:
                torch.addmm(bias, activations[-1], weight, out=output)
            activations.append(output.relu_())
        return activations

    def backward(
        self, activations: list[Tensor], gradient: Tensor, links: slice, gradients: list[Tensor | None]
    ) -> Tensor:
        """Gradient of the block's first pre-activation; adds to the gradients of weights and biases."""
        count, pass_relu = len(activations[0]), torch.ops.aten.threshold_backward.grad_input
        flowing = self._buffer(0, self.widths[-1], count)
        torch.index_select(gradient, 0, self.graph.receiver[links], out=flowing)
        for index in range(len(self.weights), 0, -1):
            gate = self._buffer(1, self.widths[index], count)
            pass_relu(flowing, activations[index], 0, grad_input=gate)
            of_weight, of_bias = gradients[2 * index - 2], gradients[2 * index - 1]
            if of_weight is not None:
                of_weight.addmm_(gate.t(), activations[index - 1])
            if of_bias is not None:
                of_bias += gate.sum(0)
            flowing = torch.mm(gate, self.weights[index - 1], out=self._buffer(0, self.widths[index - 1], count))
        return pass_relu(flowing, activations[0], 0, grad_input=self._buffer(1, self.widths[0], count))

    def sum_to_receivers(self, values: Tensor, first: Tensor) -> Tensor:
        """Sum a block's values over the links of each receiver, given where each one's links begin."""
        if len(values) == 0:
            return values.new_zeros(len(first), values.shape[-1])
        return embedding_bag(self.order[: len(values)], values, first, mode="sum")

    def _buffer(self, number: int, width: int, count: int) -> Tensor:
        key = (number, width)
        if key not in self.scratch:
            self.scratch[key] = self.incoming.new_empty(self.longest, width)
        return self.scratch[key][:count]
