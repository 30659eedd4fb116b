"""Every f_com against its formula, written with dense matrices or loops, and the symmetries it promises."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from modgnn_rl import ModGNNLayer
from modgnn_rl.errors import InputError
from modgnn_rl.nn.communication import (
    Adjacency,
    Communication,
    CoordinateFrame,
    GraphAttention,
    Laplacian,
    MessagePassing,
    NormalizedAdjacency,
)
from modgnn_rl.nn.graph import DenseGraph, Graph
from modgnn_rl.nn.topology import Topology
from tests.nn.helpers import numbers

seeds = st.integers(0, 999)
shares = st.sampled_from([0.0, 0.4, 1.0])
forms = st.sampled_from(["edges", "dense"])
few = settings(max_examples=15)
STEPS, AGENTS = 5, 4


def random_mask(*shape: int, agents: int = AGENTS, share: float = 0.5) -> Tensor:
    return (torch.rand(*shape, agents, agents) < share) & ~torch.eye(agents, dtype=torch.bool)


def on_links(f_com: Communication, held: Tensor, mask: Tensor, form: str, **of_links: Tensor | None) -> Tensor:
    """Y of all pairs [G, N, N, D'], zero where there is no link, from what the agents hold [G, N, D]."""
    topology = Topology(mask, AGENTS, **of_links, form=form)
    everyone, table = topology.all_edges(), held.flatten(0, 1)
    y = f_com(everyone.gather_senders(table), everyone.gather_receivers(table), everyone)
    return topology.to_input_layout(y, everyone)


def every_link(mask: Tensor) -> list[list[int]]:
    return mask.nonzero().tolist()


# Linear ones: graph shift operators.


def shift(f_com: nn.Module, weight: Tensor) -> Tensor:
    """The operator S of weights [..., N, N]."""
    if isinstance(f_com, Adjacency):
        return weight
    rows = weight.sum(-1)
    if isinstance(f_com, NormalizedAdjacency):
        return weight / torch.where(rows == 0, 1.0, rows).unsqueeze(-1)
    return weight - torch.diag_embed(rows)


@pytest.mark.parametrize("f_com", [Adjacency(), Laplacian(), NormalizedAdjacency()])
@pytest.mark.parametrize("weighted", [False, True])
@few
@given(hops=st.integers(0, 3), agents=st.integers(1, 5), share=shares, seed=seeds, form=forms)
def test_a_gcn_is_its_closed_form(
    f_com: nn.Module, weighted: bool, hops: int, agents: int, share: float, seed: int, form: str
) -> None:
    """``x(t) = sum_k S(t) S(t-1) ... S(t-k+1) X(t-k) A_k`` with S changing from step to step."""
    torch.manual_seed(seed)
    mask, observation = random_mask(STEPS, agents=agents, share=share), numbers(STEPS, agents, 3)
    weight = torch.where(mask, 0.5 + torch.rand(mask.shape) if weighted else 1.0, 0.0).double().requires_grad_()
    f_mid = [nn.Linear(3, 2, bias=False) for _ in range(hops + 1)]
    layer = ModGNNLayer(hops, f_com=f_com, f_mid=f_mid).double()
    output, _ = layer(observation, Topology(weight if weighted else mask, agents, form=form))
    operator, expected = shift(f_com, weight), []
    for t in range(hops, STEPS):
        product, total = torch.eye(agents, dtype=torch.float64), torch.zeros(agents, 2, dtype=torch.float64)
        for k in range(hops + 1):
            total = total + product @ observation[t - k] @ f_mid[k].weight.T
            product = product @ operator[t - k]
        expected.append(total)
    torch.testing.assert_close(output[hops:], torch.stack(expected))
    wanted = (weight, *layer.parameters())
    ours, theirs = (
        torch.autograd.grad(value.square().sum(), wanted, allow_unused=True, materialize_grads=True)
        for value in (output[hops:], torch.stack(expected))
    )
    torch.testing.assert_close(ours[1:], theirs[1:])
    if weighted:  # a weight of zero is no link, and has no gradient
        torch.testing.assert_close(ours[0], torch.where(mask, theirs[0], 0.0))


# Attention.


def attention(f_com: GraphAttention, mine: Tensor, theirs: Tensor) -> tuple[Tensor, Tensor]:
    """One receiver's y [n, H D] of what its n neighbours hold, and the weights of its heads [n, H]."""
    difference = theirs - mine if f_com.relative else theirs
    heads, scores = [], []
    for head, rows in enumerate(f_com.of_sender.weight.chunk(f_com.heads)):
        value = difference @ rows.T
        key = value
        if f_com.of_receiver is not None:
            weight, bias = (
                part.chunk(f_com.heads)[head] for part in (f_com.of_receiver.weight, f_com.of_receiver.bias)
            )
            key = value + mine @ weight.T + bias
        score = nn.functional.leaky_relu(key, 0.2) @ f_com.score[head]
        scores.append(score.softmax(0))
        heads.append(scores[-1].unsqueeze(-1) * value)
    return torch.cat(heads, -1), torch.stack(scores, -1)


@pytest.mark.parametrize("relative", [False, True])
@few
@given(heads=st.integers(1, 3), share=shares, seed=seeds, form=forms, scale=st.sampled_from([1.0, 300.0]))
def test_attention_is_a_softmax_over_the_neighbours(
    relative: bool, heads: int, share: float, seed: int, form: str, scale: float
) -> None:
    torch.manual_seed(seed)
    f_com = GraphAttention(3, 2 * heads, heads, relative=relative).double()
    mask, held = random_mask(2, share=share), (scale * numbers(2, AGENTS, 3)).requires_grad_()
    y = on_links(f_com, held, mask, form)
    expected = torch.zeros(*mask.shape, 2 * heads, dtype=torch.float64)
    for g in range(2):
        for i in range(AGENTS):
            neighbours = mask[g, i].nonzero().squeeze(-1)
            if len(neighbours):
                rows, weights = attention(f_com, held[g, i], held[g, neighbours])
                torch.testing.assert_close(weights.sum(0), torch.ones(heads, dtype=torch.float64))
                expected = expected.index_put((torch.tensor(g), torch.tensor(i), neighbours), rows)
    torch.testing.assert_close(y, expected)
    wanted = (held, *f_com.parameters())
    ours, theirs = (
        torch.autograd.grad((value.sin().sum()), wanted, materialize_grads=True, allow_unused=True)
        for value in (y, expected + 0 * held.sum())
    )
    torch.testing.assert_close(ours, theirs)


@few
@given(seed=seeds, form=forms)
@torch.no_grad()
def test_attention_to_differences_does_not_feel_a_translation(seed: int, form: str) -> None:
    torch.manual_seed(seed)
    mask, held, far = random_mask(2, share=0.8), numbers(2, AGENTS, 3), torch.tensor([100.0, -20, 3])
    for relative in (True, False):
        f_com = GraphAttention(3, 4, 2, relative=relative).double()
        here, there = (on_links(f_com, data, mask, form) for data in (held, held + far))
        assert torch.allclose(here, there, rtol=0, atol=1e-11) == (relative or not mask.any())


def test_heads_share_the_width() -> None:
    with pytest.raises(InputError, match="out_features=5 is not a multiple of heads=2"):
        GraphAttention(3, 5, 2)


# Message passing.


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("features", [0, 2])
@few
@given(share=shares, seed=seeds, form=forms)
def test_message_passing_reads_both_ends_and_the_link(
    weighted: bool, features: int, share: float, seed: int, form: str
) -> None:
    torch.manual_seed(seed)
    mask, held = random_mask(2, share=share), numbers(2, AGENTS, 3)
    weight = numbers(2, AGENTS, AGENTS) if weighted else None
    feature = numbers(2, AGENTS, AGENTS, features) if features else None
    network = nn.Sequential(nn.Linear(6 + weighted + features, 4), nn.Tanh()).double()
    y = on_links(MessagePassing(network), held, mask, form, weight=weight, feature=feature)
    expected = torch.zeros(*mask.shape, 4, dtype=torch.float64)
    for g, i, j in every_link(mask):
        parts = [held[g, j], held[g, i]]
        parts += [] if weight is None else [weight[g, i, j].view(1)]
        parts += [] if feature is None else [feature[g, i, j]]
        expected[g, i, j] = network(torch.cat(parts))
    torch.testing.assert_close(y, expected)


# Frames of coordinates.


def turned(vector: Tensor, angle: Tensor) -> Tensor:
    """Vectors [..., 2 or 3] turned about z by angles [...], rad."""
    cosine, sine = angle.cos(), angle.sin()
    matrix = torch.stack((torch.stack((cosine, -sine), -1), torch.stack((sine, cosine), -1)), -2)
    return torch.cat(((matrix @ vector[..., :2, None]).squeeze(-1), vector[..., 2:]), -1)


def robots(dimensions: int) -> dict[str, Tensor]:
    """Position, battery, velocity, heading and goal of two flocks, each [2, N, *]."""
    return {
        "position": 10 * numbers(2, AGENTS, dimensions),
        "battery": numbers(2, AGENTS, 1),
        "velocity": numbers(2, AGENTS, dimensions),
        "heading": 6.28 * torch.rand(2, AGENTS, 1, dtype=torch.float64),
        "goal": 10 * numbers(2, AGENTS, dimensions),
    }


def frame(dimensions: int) -> CoordinateFrame:
    goal = 2 * dimensions + 2
    return CoordinateFrame((0, goal), (dimensions + 1,), heading=2 * dimensions + 1, dimensions=dimensions)


@pytest.mark.parametrize("dimensions", [2, 3])
@few
@given(seed=seeds, form=forms)
@torch.no_grad()
def test_a_frame_of_coordinates_is_the_receivers(dimensions: int, seed: int, form: str) -> None:
    torch.manual_seed(seed)
    mask, data = random_mask(2), robots(dimensions)
    y = on_links(frame(dimensions), torch.cat(list(data.values()), -1), mask, form)
    for g, i, j in every_link(mask):
        mine, theirs = ({name: value[g, agent] for name, value in data.items()} for agent in (i, j))
        back = -mine["heading"].squeeze(-1)
        position, battery, velocity, heading, goal = y[g, i, j].split([value.shape[-1] for value in data.values()])
        torch.testing.assert_close(position, turned(theirs["position"] - mine["position"], back))
        torch.testing.assert_close(goal, turned(theirs["goal"] - mine["position"], back))
        torch.testing.assert_close(velocity, turned(theirs["velocity"], back))
        torch.testing.assert_close(battery, theirs["battery"])
        assert heading.abs() <= torch.pi
        difference = theirs["heading"] - mine["heading"]
        torch.testing.assert_close(
            torch.cat((heading.cos(), heading.sin())), torch.cat((difference.cos(), difference.sin()))
        )


@pytest.mark.parametrize("dimensions", [2, 3])
@few
@given(seed=seeds, form=forms)
@torch.no_grad()
def test_frames_do_not_feel_where_the_world_lies(dimensions: int, seed: int, form: str) -> None:
    """Moving and turning all agents together changes nothing that anybody hears."""
    torch.manual_seed(seed)
    mask, data = random_mask(2), robots(dimensions)
    angle, offset = 6.28 * torch.rand(1, dtype=torch.float64), 50 * numbers(dimensions)
    moved = dict(data)
    for name in ("position", "goal"):
        moved[name] = turned(data[name], angle) + offset
    moved["velocity"], moved["heading"] = turned(data["velocity"], angle), data["heading"] + angle
    before, after = (on_links(frame(dimensions), torch.cat(list(d.values()), -1), mask, form) for d in (data, moved))
    heading = 2 * dimensions + 1  # defined up to whole turns
    apart = (after - before)[..., heading]
    torch.testing.assert_close(apart.cos(), torch.ones_like(apart))
    others = [column for column in range(before.shape[-1]) if column != heading]
    torch.testing.assert_close(after[..., others], before[..., others])
    # A frame that is not turned feels a turn, but no translation.
    fixed = CoordinateFrame((0, 2 * dimensions + 2), (dimensions + 1,), dimensions=dimensions)
    shifted = {**data, "position": data["position"] + offset, "goal": data["goal"] + offset}
    before, after = (on_links(fixed, torch.cat(list(d.values()), -1), mask, form) for d in (data, shifted))
    torch.testing.assert_close(after, before)


def test_frames_are_of_two_or_three_dimensions() -> None:
    with pytest.raises(InputError, match="dimensions=4 is not 2 or 3"):
        CoordinateFrame(dimensions=4)


# A user's own, and what holds for all.


class _Nearer(Communication):
    """A user's f_com, with everything that links offer: louder the nearer, relative to the neighbours' mean."""

    def forward(self, sender: Tensor, receiver: Tensor, links: Graph) -> Tensor:
        loudness = links.softmax(-(sender - receiver).norm(dim=-1, keepdim=True))
        mean = links.scatter_sum(sender) / links.degree().clamp(min=1).unsqueeze(-1)
        return loudness * (sender - links.gather_receivers(mean))


@few
@given(share=shares, seed=seeds, form=forms)
def test_a_users_own_f_com(share: float, seed: int, form: str) -> None:
    torch.manual_seed(seed)
    mask, held = random_mask(2, share=share), numbers(2, AGENTS, 3).requires_grad_()
    y = on_links(_Nearer(), held, mask, form)
    distance = (held.unsqueeze(1) - held.unsqueeze(2)).square().sum(-1)
    distance = torch.where(mask, distance, 1.0).sqrt()  # of an agent to itself it has no gradient
    loudness = torch.where(mask, (-distance).exp(), 0.0)
    loudness = loudness / loudness.sum(-1, keepdim=True).clamp(min=1e-9)
    mean = mask.double() @ held / mask.sum(-1, keepdim=True).clamp(min=1)
    expected = loudness.unsqueeze(-1) * (held.unsqueeze(1) - mean.unsqueeze(2))
    torch.testing.assert_close(y, expected)
    (ours,), (theirs,) = (torch.autograd.grad(value.sin().sum(), held) for value in (y, expected))
    torch.testing.assert_close(ours, theirs)


class _Direction(nn.Module):
    """An f_com that has no gradient between an agent and itself, where it would divide zero by zero."""

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        offset = sender - receiver
        return offset / offset.square().sum(-1, keepdim=True).sqrt()


@few
@given(share=shares, seed=seeds)
def test_what_is_no_link_spoils_no_gradient(share: float, seed: int) -> None:
    """Also where all pairs are computed, and whatever f_com and f_pre would make of an agent and itself."""
    torch.manual_seed(seed)
    mask, results = random_mask(3, share=share), []
    f_pre = [None, nn.Sequential(_Logarithm(), nn.Linear(3, 3))]
    layer = ModGNNLayer(1, nn.Linear(3, 3), _Direction(), f_pre).double()
    observation = numbers(3, AGENTS, 3).requires_grad_()
    for form in ("edges", "dense"):
        output, _ = layer(observation, Topology(mask, AGENTS, form=form))
        results.append([output, *torch.autograd.grad(output.square().sum(), (observation, *layer.parameters()))])
        assert all(value.isfinite().all() for value in results[-1])
    torch.testing.assert_close(*results)


class _Logarithm(nn.Module):
    def forward(self, data: Tensor) -> Tensor:
        return data.square().log()


MAKERS: dict[str, Callable[[], nn.Module]] = {
    "adjacency": Adjacency,
    "laplacian": Laplacian,
    "normalised": NormalizedAdjacency,
    "attention": lambda: GraphAttention(3, 3, 3),
    "relative attention": lambda: GraphAttention(3, 3, relative=True),
    "message passing": lambda: MessagePassing(nn.Sequential(nn.Linear(9, 5), nn.Tanh(), nn.Linear(5, 3))),
    "frame": lambda: CoordinateFrame(heading=2, dimensions=2),
    "bilinear": lambda: nn.Bilinear(3, 3, 3),
    "a user's": _Nearer,
}


@pytest.mark.parametrize("aggregation", ["sum", "mean", "max"])
@pytest.mark.parametrize("name", MAKERS)
@settings(max_examples=5)
@given(order=st.permutations(range(AGENTS)), share=shares, seed=seeds, form=forms)
@torch.no_grad()
def test_renumbering_the_agents_renumbers_what_they_compute(
    name: str, aggregation: str, order: list[int], share: float, seed: int, form: str
) -> None:
    torch.manual_seed(seed)
    f_pre = [nn.Sequential(nn.Linear(3, 3), nn.Tanh()) for _ in range(3)]
    layer = ModGNNLayer(2, f_com=MAKERS[name](), f_pre=f_pre, aggregation=aggregation).double()
    mask, observation = random_mask(STEPS, share=share), numbers(STEPS, AGENTS, 3)
    weight, feature = 0.5 + torch.rand(mask.shape).double(), numbers(*mask.shape, 2)
    links = [(mask, weight, feature), tuple(value[:, order][:, :, order] for value in (mask, weight, feature))]
    (output, sent), permuted = (
        layer(data, Topology(graph, AGENTS, weight=weights, feature=features, form=form))
        for data, (graph, weights, features) in zip((observation, observation[:, order]), links, strict=True)
    )
    torch.testing.assert_close(permuted[0], output[:, order])
    torch.testing.assert_close(permuted[1], sent[:, order], equal_nan=True)


@pytest.mark.parametrize("name", MAKERS)
@few
@given(share=shares, seed=seeds)
def test_links_and_pairs_are_one(name: str, share: float, seed: int) -> None:
    torch.manual_seed(seed)
    layer = ModGNNLayer(2, f_com=MAKERS[name](), f_pre=nn.Sequential(nn.Linear(3, 4), nn.Tanh())).double()
    mask, observation = random_mask(STEPS, share=share), numbers(STEPS, AGENTS, 3).requires_grad_()
    weight, feature = torch.rand(mask.shape).double().requires_grad_(), numbers(*mask.shape, 2).requires_grad_()
    results = []
    for form in ("edges", "dense"):
        output, sent = layer(observation, Topology(mask, AGENTS, weight=weight, feature=feature, form=form))
        wanted = (observation, weight, feature, *layer.parameters())
        total = output.square().sum() + sent.nan_to_num().square().sum()
        results.append([output, sent, *torch.autograd.grad(total, wanted, materialize_grads=True, allow_unused=True)])
    torch.testing.assert_close(*results, equal_nan=True)


def test_pairs_without_gradients_need_no_stand_ins() -> None:
    """The data of unlinked pairs are replaced for the sake of gradients only."""
    table, pairs = numbers(3, 2), DenseGraph(torch.eye(3, dtype=torch.bool).unsqueeze(0))
    with torch.no_grad():
        assert torch.equal(pairs.gather_senders(table), table.repeat(3, 1))
    assert torch.equal(pairs.gather_senders(table)[1], table[0])
