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

seeds = st.integers(0, 999)
few = settings(max_examples=15)
WIDTH = 3


def numbers(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64)


def random_links(senders: int, receivers: int, share: float, **attributes: Tensor) -> EdgeList:
    """Links between two different sets of nodes, some of which may have none."""
    receiver, sender = (torch.rand(receivers, senders) < share).nonzero().unbind(-1)
    return EdgeList(sender, receiver, senders, receivers, **attributes)


links = st.builds(
    lambda senders, receivers, share, seed: (torch.manual_seed(seed), random_links(senders, receivers, share))[1],
    senders=st.integers(1, 6),
    receivers=st.integers(0, 6),
    share=st.sampled_from([0.0, 0.3, 1.0]),
    seed=seeds,
)


def held_by(links: EdgeList, **own: Tensor) -> NodeInputs:
    rows = links.num_senders, links.num_receivers
    senders, receivers = (numbers(count, WIDTH).requires_grad_() for count in rows)
    return NodeInputs(senders, receivers, {("own", name): value for name, value in own.items()})


def results(
    links: EdgeList, f_com: nn.Module, f_pre: nn.Module, hop: NodeInputs, kind: str, *, at_once: bool = False
) -> list[Tensor]:
    """The aggregate, and gradients for tables and weights; ``at_once`` by plain autograd over all links."""
    value = aggregate(links, f_com, f_pre, hop, kind, (lambda name, rows: None) if at_once else None)
    tables = [table for table in (hop.senders, hop.receivers, *hop.own.values()) if table.requires_grad]
    wanted = tables + [weight for module in (f_com, f_pre) for weight in module.parameters() if weight.requires_grad]
    scale = torch.linspace(0.5, 1.5, value.numel(), dtype=value.dtype).view_as(value)
    if not value.requires_grad:
        return [value, *map(torch.zeros_like, wanted)]
    return [value, *torch.autograd.grad((value * scale).sum(), wanted, allow_unused=True, materialize_grads=True)]


def equal(ours: list[Tensor], theirs: list[Tensor], tolerance: float = 1e-12) -> None:
    for our, their in zip(ours, theirs, strict=True):
        torch.testing.assert_close(our, their, rtol=tolerance, atol=tolerance)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Blocks of a few links."""

    def set_size(size: int) -> None:
        monkeypatch.setattr(graph, "BLOCK", {"cpu": size})

    return set_size


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
@given(f_pre=networks, links=links, size=st.sampled_from([1, 4, 100]))
def test_rewrites_are_exact(f_com: nn.Module, kind: str, f_pre: nn.Module, links: EdgeList, size: int) -> None:
    hop = held_by(links)
    expected = results(links, f_com, f_pre, hop, kind, at_once=True)
    assert fused.fuse(links, f_com, f_pre) is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph, "BLOCK", {"cpu": size})
        equal(results(links, f_com, f_pre, hop, kind), expected)


@pytest.mark.parametrize("f_com", [Laplacian(), Adjacency()])
def test_gradients_of_a_rewrite_by_finite_differences(f_com: nn.Module, small_blocks: Callable[[int], None]) -> None:
    torch.manual_seed(0)
    many, f_pre = random_links(6, 5, 0.5), relu_network([4, 4, 2], [True] * 3, True, (False, False), False)
    small_blocks(5)
    hop = held_by(many)

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
    many = random_links(6, 5, 0.5)
    assert fused.fuse(many, f_com, f_pre) is None
    hop = held_by(many)
    expected = results(many, f_com, f_pre, hop, "sum", at_once=True)
    small_blocks(5)
    equal(results(many, f_com, f_pre, hop, "sum"), expected)


def test_weighted_links_and_autocast_are_not_rewritten() -> None:
    bare = random_links(6, 5, 0.5)
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
    equal(rewritten, outputs())
