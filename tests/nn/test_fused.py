"""Rewrites of f_com and f_pre that are linear layers and ReLUs, against plain autograd over all links."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.nn.utils import parametrizations

from modgnn_rl import ModGNNLayer
from modgnn_rl.nn import fused, graph
from modgnn_rl.nn.aggregation import NodeInputs, aggregate
from modgnn_rl.nn.communication import Adjacency, Laplacian
from modgnn_rl.nn.graph import EdgeList
from modgnn_rl.nn.topology import Topology
from tests.nn.helpers import WIDTH, assert_all_close, edge_lists, numbers, random_edges, random_inputs, results

seeds = st.integers(0, 999)
few = settings(max_examples=15)


class _Scale(nn.Module):
    """A module that says itself that it is linear."""

    is_linear_map = True

    def forward(self, data: Tensor) -> Tensor:
        return data * torch.tensor([0.5, -2.0, 0.0])


def relu_network(
    widths: list[int], biases: list[bool], scaled: bool, ends: tuple[bool, bool], nested: bool
) -> nn.Module:
    """Linear layers with ReLUs between them, and perhaps at the ends."""
    parts: list[nn.Module] = [_Scale()] if scaled else []
    parts += [nn.ReLU()] if ends[0] else []
    layers = [nn.Linear(a, b, bias) for (a, b), bias in zip(pairwise((WIDTH, *widths)), biases, strict=False)]
    for layer in layers:
        parts += [nn.Sequential(layer, nn.ReLU(inplace=True))] if nested else [layer, nn.ReLU()]
    if nested:
        parts[-1] = parts[-1] if ends[1] else layers[-1]
    elif not ends[1]:
        del parts[-1]
    return nn.Sequential(*parts).double()


networks = st.builds(
    relu_network,
    widths=st.lists(st.integers(1, 5), min_size=1, max_size=4),
    biases=st.lists(st.booleans(), min_size=4, max_size=4),
    scaled=st.booleans(),
    ends=st.tuples(st.booleans(), st.booleans()),
    nested=st.booleans(),
)


@pytest.mark.parametrize("f_com", [Laplacian(), Adjacency()])
@pytest.mark.parametrize("kind", ["sum", "mean"])
@settings(max_examples=60)
@given(f_pre=networks, links=edge_lists, size=st.sampled_from([1, 4, 100]))
def test_rewrites_are_exact(f_com: nn.Module, kind: str, f_pre: nn.Module, links: EdgeList, size: int) -> None:
    hop = random_inputs(links)
    expected = results(links, f_com, f_pre, hop, kind, at_once=True)
    assert fused.fuse(links, f_com, f_pre) is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph, "BLOCK", {"cpu": size})
        assert_all_close(results(links, f_com, f_pre, hop, kind), expected)


@pytest.mark.parametrize("f_com", [Laplacian(), Adjacency()])
def test_gradients_of_a_rewrite_by_finite_differences(f_com: nn.Module, small_blocks: Callable[[int], None]) -> None:
    torch.manual_seed(0)
    many, f_pre = random_edges(6, 5, 0.5), relu_network([4, 4, 2], [True] * 3, True, (False, False), False)
    small_blocks(5)
    hop = random_inputs(many)

    def value(senders: Tensor, receivers: Tensor, *weights: Tensor) -> Tensor:
        return aggregate(many, f_com, f_pre, NodeInputs(senders, receivers, {}))

    assert fused.fuse(many, f_com, f_pre) is not None
    inputs = (hop.senders, hop.receivers, *f_pre.parameters())
    assert torch.autograd.gradcheck(value, inputs, check_undefined_grad=False)


class _Linear(nn.Linear):
    def forward(self, data: Tensor) -> Tensor:
        return super().forward(data).sin()


class _MinusOwn(Laplacian):
    def forward(self, sender: Tensor, receiver: Tensor, links: object = None) -> Tensor:
        return (sender - receiver).sin()


def _hooked(register: str) -> nn.Module:
    network = nn.Sequential(nn.Linear(WIDTH, 4), nn.ReLU(), nn.Linear(4, 2), nn.ReLU(), nn.Linear(2, 2))
    getattr(network[2], register)(lambda module, *values: None)
    return network


OTHERS: dict[str, Callable[[], tuple[nn.Module, nn.Module]]] = {
    "a forward hook": lambda: (Laplacian(), _hooked("register_forward_hook")),
    "a forward pre-hook": lambda: (Laplacian(), _hooked("register_forward_pre_hook")),
    "a backward hook": lambda: (Laplacian(), _hooked("register_full_backward_hook")),
    "a backward pre-hook": lambda: (Laplacian(), _hooked("register_full_backward_pre_hook")),
    "a parametrization": lambda: (
        Laplacian(),
        nn.Sequential(nn.Linear(WIDTH, 4), nn.ReLU(), parametrizations.weight_norm(nn.Linear(4, 4)), nn.ReLU()),
    ),
    "a subclass of Linear": lambda: (Laplacian(), nn.Sequential(_Linear(WIDTH, 4), nn.ReLU(), nn.Linear(4, 2))),
    "a subclass of Laplacian": lambda: (_MinusOwn(), nn.Sequential(nn.Linear(WIDTH, 4), nn.ReLU())),
    "another activation": lambda: (Laplacian(), nn.Sequential(nn.Linear(WIDTH, 4), nn.ELU(), nn.Linear(4, 2))),
    "a layer that is no linear map": lambda: (Adjacency(), nn.Sequential(nn.ReLU(), nn.Tanh(), nn.ReLU())),
    "two layers between ReLUs": lambda: (
        Adjacency(),
        nn.Sequential(nn.ReLU(), nn.Linear(WIDTH, 4), nn.Linear(4, 4), nn.ReLU()),
    ),
}


@pytest.mark.parametrize("name", OTHERS)
def test_other_modules_are_not_rewritten(name: str, small_blocks: Callable[[int], None]) -> None:
    torch.manual_seed(0)
    f_com, f_pre = (module.double() for module in OTHERS[name]())
    many = random_edges(6, 5, 0.5)
    assert fused.fuse(many, f_com, f_pre) is None
    hop = random_inputs(many)
    expected = results(many, f_com, f_pre, hop, "sum", at_once=True)
    small_blocks(5)
    assert_all_close(results(many, f_com, f_pre, hop, "sum"), expected)


def test_weighted_links_and_autocast_are_not_rewritten() -> None:
    bare = random_edges(6, 5, 0.5)
    f_pre = nn.Sequential(nn.Linear(WIDTH, 4), nn.ReLU(), nn.Linear(4, 2))
    weighted = EdgeList(bare.sender, bare.receiver, 6, 5, torch.ones(len(bare)))
    assert fused.fuse(bare, Laplacian(), f_pre) is not None
    assert fused.fuse(weighted, Laplacian(), f_pre) is None
    with torch.autocast("cpu", torch.bfloat16):
        assert fused.fuse(bare, Laplacian(), f_pre) is None


def test_a_rewritten_policy_acts_and_learns_as_one_with_a_hook() -> None:
    torch.manual_seed(0)
    f_pre = [relu_network([4, 4, 2], [True] * 3, hop == 1, (False, False), False) for hop in range(3)]
    layer = ModGNNLayer(2, f_pre=f_pre).double()
    observation = numbers(5, 6, WIDTH).requires_grad_()
    adjacency, wanted = torch.rand(5, 6, 6) < 0.4, torch.rand(5, 6) < 0.6

    def outputs() -> list[Tensor]:
        value = layer(observation, Topology(adjacency, 6, receivers=wanted))[0]
        return [value, *torch.autograd.grad(value.square().sum(), (observation, *layer.parameters()))]

    rewritten = outputs()
    for hop in f_pre:
        hop.register_forward_hook(lambda module, inputs, output: None)
    assert_all_close(rewritten, outputs())
