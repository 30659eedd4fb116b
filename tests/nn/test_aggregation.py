"""Sums over the neighbours: blocks and recomputation against plain autograd over all links at once."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.utils import parametrizations
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.nn import aggregation, graph
from modgnn_rl.nn.aggregation import NodeInputs, aggregate
from modgnn_rl.nn.communication import Adjacency, GraphAttention, Laplacian
from modgnn_rl.nn.graph import EdgeList
from modgnn_rl.nn.topology import Topology
from tests.nn.helpers import WIDTH, assert_all_close, edge_lists, numbers, random_edges, random_inputs, results

seeds = st.integers(0, 999)
few = settings(max_examples=15)


class _OwnNumbers(nn.Module):
    """An f_pre of data, of an embedding of whole numbers, and of further data with two dimensions."""

    def __init__(self) -> None:
        super().__init__()
        self.linear, self.table = nn.Linear(WIDTH + 4, 2), nn.Embedding(5, 2)

    def forward(self, data: Tensor, role: Tensor, arms: Tensor) -> Tensor:
        return self.linear(torch.cat((data, self.table(role.squeeze(-1)), arms.sum(1)), -1)).tanh()


class _Zeros(nn.Module):
    def forward(self, data: Tensor) -> Tensor:
        return torch.zeros_like(data)


def tanh_network(inputs: int = WIDTH, outputs: int = 2) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 4), nn.Tanh(), nn.Linear(4, outputs)).double()


MODULES: dict[str, Callable[[], tuple[nn.Module, nn.Module]]] = {
    "plain": lambda: (nn.Bilinear(WIDTH, WIDTH, WIDTH), tanh_network()),
    "attention": lambda: (GraphAttention(WIDTH, 4, 2), nn.Identity()),
    "keyed": lambda: (
        Laplacian(),
        TensorDictModule(_OwnNumbers(), ["data", ("own", "role"), ("own", "arms")], ["out"]),
    ),
    "without weights": lambda: (Adjacency(), nn.Tanh()),
    "in place": lambda: (Adjacency(), nn.Sequential(nn.ReLU(inplace=True), nn.Tanh(), nn.Linear(WIDTH, 2))),
    "constant": lambda: (Adjacency(), _Zeros()),
}


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.parametrize("kind", graph.AGGREGATIONS)
@settings(max_examples=8)
@given(links=edge_lists, size=st.sampled_from([1, 4, 100]), stored=st.booleans())
def test_blocks_stored_or_not_are_plain_autograd(
    name: str, kind: str, links: EdgeList, size: int, stored: bool
) -> None:
    f_com, f_pre = (module.double() for module in MODULES[name]())
    role, arms = torch.randint(5, (links.num_receivers, 1)), numbers(links.num_receivers, 3, 2).requires_grad_()
    hop = random_inputs(links, role=role, arms=arms)
    expected = results(links, f_com, f_pre, hop, kind, at_once=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph, "BLOCK", {"cpu": size})
        patch.setattr(aggregation, "MAX_STORED_EDGES", 1000 if stored else 0)
        assert_all_close(results(links, f_com, f_pre, hop, kind), expected)


@few
@given(links=edge_lists, size=st.sampled_from([1, 4, 100]))
def test_frozen_weights_and_constant_data_have_no_gradient(links: EdgeList, size: int) -> None:
    f_com, f_pre = nn.Bilinear(WIDTH, WIDTH, WIDTH).double(), tanh_network()
    f_pre[0].requires_grad_(False)  # type: ignore[index]
    hop = random_inputs(links)
    hop.senders.requires_grad_(False)
    expected = results(links, f_com, f_pre, hop, "sum", at_once=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph, "BLOCK", {"cpu": size})
        patch.setattr(aggregation, "MAX_STORED_EDGES", 0)
        assert_all_close(results(links, f_com, f_pre, hop, "sum"), expected)


def test_the_backward_pass_draws_the_same_dropout(small_blocks: Callable[[int], None], monkeypatch) -> None:
    torch.manual_seed(0)
    many = random_edges(12, 9, 0.5)
    f_pre = nn.Sequential(nn.Dropout(0.5), tanh_network(), nn.Dropout(0.5))
    hop = random_inputs(many)
    small_blocks(7)
    torch.manual_seed(1)
    value = aggregate(many, Laplacian(), f_pre, hop)
    torch.rand(11)  # others draw in between
    state = torch.get_rng_state()
    ours = torch.autograd.grad(value.square().sum(), (hop.senders, hop.receivers, *f_pre.parameters()))
    assert torch.equal(torch.get_rng_state(), state)
    monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", 1000)
    torch.manual_seed(1)
    stored = aggregate(many, Laplacian(), f_pre, hop)
    theirs = torch.autograd.grad(stored.square().sum(), (hop.senders, hop.receivers, *f_pre.parameters()))
    assert_all_close([value, *ours], [stored, *theirs])
    assert not torch.allclose(value, aggregate(many, Laplacian(), f_pre, hop))  # drops others now


@pytest.mark.parametrize("inside", [True, False])
def test_autocast_holds_in_the_backward_pass(
    inside: bool, small_blocks: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the same weights are used with and without recomputation under one autocast, which caches casts."""
    torch.manual_seed(0)
    many = random_edges(12, 9, 0.5)
    f_pre = tanh_network().float()
    senders, receivers = torch.randn(12, WIDTH).requires_grad_(), torch.randn(9, WIDTH).requires_grad_()
    wanted = (senders, receivers, *f_pre.parameters())
    small_blocks(7)

    def gradients(stored: tuple[int, ...]) -> tuple[Tensor, ...]:
        total = torch.zeros(())
        with torch.autocast("cpu", torch.bfloat16):
            for limit in stored:
                monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", limit)
                value = aggregate(many, Laplacian(), f_pre, NodeInputs(senders, receivers, {}))
                assert value.dtype == torch.bfloat16
                total = total + value.float().square().sum()
            if inside:
                return torch.autograd.grad(total, wanted)
        return torch.autograd.grad(total, wanted)

    expected = gradients((1000, 1000))
    for stored in ((0, 0), (0, 1000), (1000, 0)):
        for ours, theirs in zip(gradients(stored), expected, strict=True):
            assert ours.dtype == torch.float32
            torch.testing.assert_close(ours, theirs, rtol=2e-2, atol=2e-2 * float(theirs.abs().max()))


def test_weights_lent_to_a_module_get_the_gradients(small_blocks: Callable[[int], None]) -> None:
    """As ``functional_call`` and the losses of TorchRL lend them: they are gone when the backward pass runs."""
    torch.manual_seed(0)
    f_com, f_pre = nn.Bilinear(WIDTH, WIDTH, WIDTH).double(), tanh_network()
    both = _Pair(f_com, f_pre)
    many = random_edges(8, 7, 0.5)
    hop = random_inputs(many)
    lent = {name: numbers(*value.shape).requires_grad_() for name, value in both.named_parameters()}
    at_once = torch.func.functional_call(both, lent, (many, hop, lambda name, rows: None))
    expected = torch.autograd.grad(at_once.square().sum(), tuple(lent.values()))
    small_blocks(5)
    value = torch.func.functional_call(both, lent, (many, hop))
    assert_all_close([value, *torch.autograd.grad(value.square().sum(), tuple(lent.values()))], [at_once, *expected])
    weights = TensorDict(lent, []).unflatten_keys(".")
    with weights.to_module(both):
        value = both(many, hop)
    assert_all_close([value, *torch.autograd.grad(value.square().sum(), tuple(lent.values()))], [at_once, *expected])


class _Pair(nn.Module):
    def __init__(self, f_com: nn.Module, f_pre: nn.Module) -> None:
        super().__init__()
        self.f_com, self.f_pre = f_com, f_pre

    def forward(self, links: EdgeList, hop: NodeInputs, record=None) -> Tensor:
        return aggregate(links, self.f_com, self.f_pre, hop, record=record)


def test_a_module_that_changes_as_it_runs_is_run_again_as_it_was(
    small_blocks: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Spectral normalisation takes a step of its power iteration at every call, that is, for every block."""
    torch.manual_seed(0)
    f_pre = nn.Sequential(parametrizations.spectral_norm(nn.Linear(WIDTH, 4)), nn.Tanh()).double()
    many, other = random_edges(8, 7, 0.5), copy.deepcopy(f_pre)
    hop = random_inputs(many)
    small_blocks(5)
    ours = results(many, Laplacian(), f_pre, hop, "sum")
    monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", 1000)
    assert_all_close(ours, results(many, Laplacian(), other, hop, "sum"))
    assert_all_close(list(f_pre.buffers()), list(other.buffers()))


class _Twice(nn.Module):
    """At will an f_com or an f_pre."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(WIDTH, WIDTH)

    def forward(self, data: Tensor, receiver: Tensor | None = None) -> Tensor:
        return self.linear(data if receiver is None else data - receiver).tanh()


@pytest.mark.parametrize("what", ["module", "part", "weight"])
def test_what_f_com_and_f_pre_share_gets_both_gradients(what: str, small_blocks: Callable[[int], None]) -> None:
    torch.manual_seed(0)
    f_com, f_pre = _Twice().double(), _Twice().double()
    if what == "module":
        f_pre = f_com
    elif what == "part":
        f_pre.linear = f_com.linear
    else:
        f_pre.linear.weight = f_com.linear.weight
    many = random_edges(8, 7, 0.5)
    hop = random_inputs(many)
    weights = dict(f_com.named_parameters())
    expected = results(many, f_com, f_pre, hop, "sum", at_once=True)
    small_blocks(5)
    assert_all_close(results(many, f_com, f_pre, hop, "sum"), expected)
    assert all(value is weights[name] for name, value in f_com.named_parameters())


@pytest.mark.parametrize("limit", [0, 1000])
def test_learned_weights_and_features_of_links_get_gradients(
    limit: int, small_blocks: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    bare = random_edges(8, 7, 0.5)
    weight, feature = numbers(len(bare)).requires_grad_(), numbers(len(bare), 2).requires_grad_()
    many = EdgeList(bare.sender, bare.receiver, 8, 7, weight, feature)
    f_com = TensorDictModule(_Concatenated(), ["sender", ("edge", "weight"), ("edge", "feature")], ["y"])
    hop, f_pre = random_inputs(many), tanh_network(WIDTH + 3)
    at_once = aggregate(many, f_com, f_pre, hop, record=lambda name, rows: None)
    small_blocks(5)
    monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", limit)
    value = aggregate(many, f_com, f_pre, hop)
    ours, theirs = (
        torch.autograd.grad(total.square().sum(), (weight, feature, *f_pre.parameters())) for total in (value, at_once)
    )
    assert_all_close([value, *ours], [at_once, *theirs])


class _Concatenated(nn.Module):
    def forward(self, *parts: Tensor) -> Tensor:
        return torch.cat(parts, -1)


@pytest.mark.parametrize("form", ["edges", "dense"])
@pytest.mark.parametrize("kind", graph.AGGREGATIONS)
@few
@given(share=st.sampled_from([0.0, 0.4, 1.0]), seed=seeds)
@torch.no_grad()
def test_a_layer_aggregates_what_it_processes_and_what_it_passes_on(
    form: str, kind: str, share: float, seed: int
) -> None:
    torch.manual_seed(seed)
    f_pre = [tanh_network(WIDTH, WIDTH) for _ in range(3)]
    layer = ModGNNLayer(2, f_pre=f_pre, aggregation=kind).double()
    observation, adjacency = numbers(3, 4, WIDTH), torch.rand(3, 4, 4) < share
    output, sent = layer(observation, Topology(adjacency, 4, form=form))

    def over_neighbours(values: Tensor, t: int, i: int) -> Tensor:
        heard = [values[j] - values[i] for j in range(4) if adjacency[t, i, j]]
        if not heard:
            return torch.zeros(1, WIDTH, dtype=torch.float64)
        return torch.stack(heard)

    def total(rows: Tensor) -> Tensor:
        return {"sum": rows.sum(0), "mean": rows.mean(0), "max": rows.amax(0)}[kind]

    passed = torch.stack([total(over_neighbours(observation[0], 1, i)) for i in range(4)])
    torch.testing.assert_close(sent[1, :, 1], passed)
    for i in range(4):
        expected = f_pre[0](observation[2, i])
        for hop, held in ((1, observation[1]), (2, passed)):
            if adjacency[2, i].any():
                expected = expected + total(f_pre[hop](over_neighbours(held, 2, i)))
        torch.testing.assert_close(output[2, i], expected)


# Batch statistics see what is there, and nothing else.


def statistics() -> nn.BatchNorm1d:
    return nn.BatchNorm1d(WIDTH, momentum=1.0)


@pytest.mark.parametrize("form", ["auto", "edges"])
@few
@given(share=st.sampled_from([0.3, 0.9]), seed=seeds)
def test_batch_statistics_are_those_of_real_links_and_agents(form: str, share: float, seed: int) -> None:
    """Not of padded rows, of pairs without a link, or of hops that an agent does not hold yet."""
    torch.manual_seed(seed)
    hops, flocks, steps, agents = 2, 2, 5, 4
    f_pre, f_mid = ([statistics() for _ in range(hops + 1)] for _ in range(2))
    layer = ModGNNLayer(hops, statistics(), Laplacian(), f_pre, f_mid, statistics()).double()
    observation = 5 + numbers(flocks, steps, agents, WIDTH)
    adjacency = (torch.rand(flocks, steps, agents, agents) < share) | torch.eye(agents).bool()
    exists = torch.ones(flocks, steps, agents, dtype=torch.bool)
    if form == "edges":
        exists[0, :, 2:], observation[0, :, 2:] = False, 1e6
    data = TensorDict({"agents": {"observation": observation}, "adjacency": adjacency}, [flocks, steps])
    if form == "edges":
        data["agents", "mask"] = exists
    rows: dict[nn.Module, int] = {}
    for module in layer.submodules:
        module.register_forward_pre_hook(lambda module, inputs: rows.update({module: len(inputs[0])}))
    with set_recurrent_mode(True):
        ModGNN(layer, form=form)(data)

    linked = adjacency & exists.unsqueeze(-1) & exists.unsqueeze(-2)
    for module in (layer.f_input, f_pre[0], f_mid[0], layer.f_final):
        assert rows[module] == int(exists.sum())
    for hop in (1, 2):
        assert rows[f_pre[hop]] == int(linked[:, hop:].sum())
        assert rows[f_mid[hop]] == int(exists[:, hop:].sum())
    seen = observation[exists]
    torch.testing.assert_close(layer.f_input.running_mean, seen.mean(0))
    deviation = (seen.var(0, correction=0) + 1e-5).sqrt()
    differences = [
        (observation[flock, t - 1, j] - observation[flock, t - 1, i]) / deviation
        for flock, t, i, j in linked.nonzero().tolist()
        if t
    ]
    torch.testing.assert_close(f_pre[1].running_mean, torch.stack(differences).mean(0))


def test_batch_statistics_pass_through_a_flock_without_links() -> None:
    seen = statistics()
    layer = ModGNNLayer(1, f_pre=[None, seen]).double()
    layer(numbers(3, 2, WIDTH), torch.zeros(3, 2, 2, dtype=torch.bool))[0].sum().backward()
    assert seen.running_mean is not None
    assert torch.equal(seen.running_mean, torch.zeros(WIDTH, dtype=torch.float64))
