"""Graphs: links and pairs against loops over the mask, and one computation from every form that a graph comes in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.errors import InputError
from modgnn_rl.nn import graph, topology
from modgnn_rl.nn.communication import MessagePassing
from modgnn_rl.nn.graph import DenseGraph, EdgeList
from modgnn_rl.nn.topology import Topology
from tests.nn.helpers import numbers

seeds = st.integers(0, 999)
shares = st.sampled_from([0.0, 0.4, 1.0])
few = settings(max_examples=25)


def random_mask(graphs: int, receivers: int, senders: int, share: float, seed: int) -> Tensor:
    torch.manual_seed(seed)
    return torch.rand(graphs, receivers, senders) < share


masks = st.builds(random_mask, st.integers(1, 3), st.integers(1, 4), st.integers(1, 4), shares, seeds)


def links_of(mask: Tensor, **attributes: Tensor) -> EdgeList:
    """The links of a mask [G, R, S], written down one after the other."""
    graphs, receivers, senders = mask.shape
    entries = [(g * senders + j, g * receivers + i) for g, i, j in mask.nonzero().tolist()]
    sender, receiver = torch.tensor(entries, dtype=torch.long).view(-1, 2).unbind(-1)
    chosen = {name: value[mask] for name, value in attributes.items()}
    return EdgeList(sender, receiver, graphs * senders, graphs * receivers, **chosen)


def neighbourhoods(mask: Tensor) -> list[list[int]]:
    """For each receiver, where its links lie among all of them."""
    count, found = 0, []
    for row in mask.flatten(0, 1):
        found.append(list(range(count, count + int(row.sum()))))
        count += int(row.sum())
    return found


def over_neighbours(function: Callable[[Tensor], Tensor], values: Tensor, mask: Tensor) -> Tensor:
    """A function of each receiver's values [n, F], zero where there are none."""
    rows = [function(values[found]) if found else values.new_zeros(values.shape[1:]) for found in neighbourhoods(mask)]
    return torch.stack(rows)


def in_pairs(values: Tensor, mask: Tensor, elsewhere: float = torch.nan) -> Tensor:
    """Values of the links [E, F] among rubbish for all other pairs [G * R * S, F]."""
    everywhere = values.new_full((mask.numel(), *values.shape[1:]), elsewhere)
    return everywhere.index_copy(0, mask.flatten().nonzero().squeeze(-1), values)


# Links and pairs against loops.


@few
@given(mask=masks)
def test_ends_of_the_links(mask: Tensor) -> None:
    links, pairs = links_of(mask), DenseGraph(mask)
    graphs, receivers, senders = mask.shape
    of_senders, of_receivers = numbers(graphs * senders, 2, 3), numbers(graphs * receivers)
    ends = [(of_senders[g * senders + j], of_receivers[g * receivers + i]) for g, i, j in mask.nonzero().tolist()]
    expected = [torch.stack(side) if ends else None for side in zip(*ends, strict=True)] or [None, None]
    linked = mask.flatten()
    for found, side in (
        ((links.gather_senders(of_senders), pairs.gather_senders(of_senders)[linked]), expected[0]),
        ((links.gather_receivers(of_receivers), pairs.gather_receivers(of_receivers)[linked]), expected[1]),
    ):
        for one in found:
            assert len(one) == len(ends)
            assert side is None or torch.equal(one, side)
    assert links.degree().tolist() == pairs.degree().tolist() == mask.sum(-1).flatten().tolist()


LOOPS: dict[str, Callable[[Tensor], Tensor]] = {
    "sum": lambda values: values.sum(0),
    "mean": lambda values: values.sum(0) / len(values),
    "max": lambda values: values.max(0).values,
}


@few
@given(mask=masks, aggregation=st.sampled_from(sorted(LOOPS)))
def test_aggregates_and_their_gradients(mask: Tensor, aggregation: str) -> None:
    values = numbers(int(mask.sum()), 2).requires_grad_()
    weights = numbers(mask.shape[:2].numel(), 2).requires_grad_()
    expected = over_neighbours(LOOPS[aggregation], values, mask)
    (gradient,) = torch.autograd.grad((expected * weights).sum(), values, materialize_grads=True)
    for found in (
        links_of(mask).aggregate(values, aggregation),
        DenseGraph(mask).aggregate(in_pairs(values, mask), aggregation),
    ):
        torch.testing.assert_close(found, expected)
        (ours,) = torch.autograd.grad((found * weights).sum(), values, materialize_grads=True)
        torch.testing.assert_close(ours, gradient)


@few
@given(mask=masks, offset=st.sampled_from([0.0, 1e4, -1e4]), rubbish=st.sampled_from([1e5, -1e5]))
def test_softmax_and_its_gradient(mask: Tensor, offset: float, rubbish: float) -> None:
    """Of logits of any size, next to pairs without a link whose logits are far larger or smaller."""
    logits = (numbers(int(mask.sum()), 2) + offset).requires_grad_()
    weights = numbers(*logits.shape)
    parts = [logits[found].softmax(0) for found in neighbourhoods(mask) if found]
    expected = torch.cat(parts) if parts else logits * 0.0
    (gradient,) = torch.autograd.grad((expected * weights).sum(), logits)
    pairs = DenseGraph(mask)
    everywhere = in_pairs(logits, mask, rubbish)
    of_pairs = pairs.fill_non_edges(pairs.softmax(everywhere))[mask.flatten()]
    for found in (links_of(mask).softmax(logits), of_pairs):
        torch.testing.assert_close(found, expected)
        (ours,) = torch.autograd.grad((found * weights).sum(), logits)
        torch.testing.assert_close(ours, gradient)


@few
@given(mask=masks, seed=seeds, share=shares)
def test_links_between_some(mask: Tensor, seed: int, share: float) -> None:
    torch.manual_seed(seed)
    graphs, receivers, senders = mask.shape
    of_senders, of_receivers = torch.rand(graphs, senders) < share, torch.rand(graphs, receivers) < 0.7
    weight, feature = numbers(*mask.shape), numbers(*mask.shape, 2)
    kept = mask & of_senders.unsqueeze(1) & of_receivers.unsqueeze(2)
    expected = links_of(kept, weight=weight, feature=feature)
    links = links_of(mask, weight=weight, feature=feature).subgraph(of_senders.flatten(), of_receivers.flatten())
    assert torch.equal(links.sender, expected.sender)
    assert torch.equal(links.receiver, expected.receiver)
    pairs = DenseGraph(mask, weight, feature).subgraph(of_senders.flatten(), of_receivers.flatten())
    assert torch.equal(pairs.mask, kept)
    assert (links.num_senders, links.num_receivers) == (pairs.num_senders, pairs.num_receivers)
    for name in ("weight", "feature"):
        value, of_links = getattr(expected, name), getattr(links, name)
        assert torch.equal(of_links, value)
        assert torch.equal(getattr(pairs, name)[kept.flatten()], value)


@pytest.mark.parametrize("size", [1, 3, 1000])
@few
@given(mask=masks)
def test_blocks_hold_whole_neighbourhoods_and_make_the_whole(size: int, mask: Tensor) -> None:
    links = links_of(mask, weight=numbers(*mask.shape))
    values = numbers(len(links), 2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graph, "BLOCK", {"cpu": size})
        blocks = links.blocks()
    assert [index for receivers, _ in blocks for index in range(links.num_receivers)[receivers]] == list(
        range(links.num_receivers)
    )
    totals = []
    for receivers, part in blocks:
        block = links.block(receivers, part)
        assert torch.equal(block.sender, links.sender[part])
        assert torch.equal(block.receiver + receivers.start, links.receiver[part])
        assert block.weight is not None
        assert links.weight is not None
        assert torch.equal(block.weight, links.weight[part])
        assert len(block) <= size + max(links.degree().tolist(), default=0)
        totals.append(block.scatter_sum(values[part]))
    torch.testing.assert_close(torch.cat(totals), links.scatter_sum(values))


# What a user gives.


def layer_of_links() -> ModGNNLayer:
    """Two hops whose messages feel weight and feature of their link."""
    f_com = [MessagePassing(nn.Sequential(nn.Linear(2 * 3 + 1 + 2, 3), nn.Tanh())) for _ in range(2)]
    f_pre = [nn.Sequential(nn.Linear(3, 4), nn.Tanh()) for _ in range(3)]
    return ModGNNLayer(2, f_com=f_com, f_pre=f_pre).double()


def as_edge_list(adjacency: Tensor, filling: int) -> tuple[Tensor, Tensor, Tensor]:
    """An edge list [G, 2, E] of a dense graph in any order, and where in it is which entry i, j of which graph."""
    links = [graph.nonzero() for graph in adjacency]
    length = max(len(entries) for entries in links) + filling
    edges = torch.full((len(links), 2, length), -1)
    filled, entries = torch.zeros(len(links), length, dtype=torch.bool), []
    for number, found in enumerate(links):
        places = torch.randperm(length)[: len(found)].sort().values
        found = found[torch.randperm(len(found))]
        edges[number, 0, places], edges[number, 1, places] = found[:, 1], found[:, 0]
        filled[number, places] = True
        entries.append(torch.cat((torch.full((len(found), 1), number), found), 1))
    return edges, filled, torch.cat(entries)


def outputs_and_gradients(layer: ModGNNLayer, observation: Tensor, topology: Topology, *inputs: Tensor) -> list[Tensor]:
    """What comes out, and gradients for the observation, what else is given, and all weights."""
    output, sent = layer(observation, topology)
    scales = torch.linspace(0.5, 1.5, output.numel(), dtype=output.dtype).view_as(output)
    wanted = (observation, *inputs, *layer.parameters())
    gradients = torch.autograd.grad((output * scales).sum() + sent.nan_to_num().square().sum(), wanted)
    return [output, sent, *gradients]


@settings(max_examples=15)
@given(
    agents=st.integers(1, 4),
    share=shares,
    seed=seeds,
    filling=st.integers(0, 3),
    form=st.sampled_from(topology.FORMS),
    masked=st.booleans(),
    some=st.booleans(),
    rubbish=st.sampled_from([7.0, torch.nan, torch.inf]),
)
def test_every_form_of_a_graph_gives_the_same(
    agents: int, share: float, seed: int, filling: int, form: str, masked: bool, some: bool, rubbish: float
) -> None:
    """Dense or listed, as links or pairs, with any rubbish as weight and feature of what is no link."""
    torch.manual_seed(seed)
    layer, steps = layer_of_links(), 4
    adjacency = torch.rand(steps, agents, agents) < share
    edges, filled, entries = as_edge_list(adjacency, filling)
    observation = numbers(steps, agents, 3).requires_grad_()
    weight, feature = numbers(len(entries)).requires_grad_(), numbers(len(entries), 2).requires_grad_()
    exists = torch.rand(steps, agents) < 0.7 if masked else None
    wanted = torch.rand(steps, agents) < 0.5 if some else None

    def dense(values: Tensor) -> Tensor:
        everywhere = values.new_full((*adjacency.shape, *values.shape[1:]), rubbish)
        return everywhere.index_put(entries.unbind(-1), values)

    def listed(values: Tensor) -> Tensor:
        everywhere = values.new_full((*filled.shape, *values.shape[1:]), rubbish)
        return everywhere.index_put(filled.nonzero().unbind(-1), values)

    given_as: list[tuple[Tensor, Callable[[Tensor], Tensor]]] = [
        (adjacency, dense),
        (adjacency.int(), dense),
        (adjacency.to(torch.uint8), dense),
        (edges, listed),
    ]
    results = []
    for links, spread in given_as:
        of_links: dict[str, Any] = {"weight": spread(weight), "feature": spread(feature)}
        topology = Topology(links, agents, receivers=wanted, mask=exists, form=form, **of_links)
        results.append(outputs_and_gradients(layer, observation, topology, weight, feature))
    reference = Topology(adjacency, agents, receivers=wanted, mask=exists, weight=dense(weight), feature=dense(feature))
    expected = outputs_and_gradients(layer, observation, reference, weight, feature)
    for result in results:
        torch.testing.assert_close(result, expected, equal_nan=True)
    assert all(gradient.isfinite().all() for gradient in expected[2:])


@few
@given(share=shares, seed=seeds, form=st.sampled_from(topology.FORMS))
def test_a_floating_point_adjacency_holds_the_weights(share: float, seed: int, form: str) -> None:
    torch.manual_seed(seed)
    mask = torch.rand(3, 4, 4) < share
    weight = torch.where(mask, numbers(3, 4, 4), 0.0).requires_grad_()
    observation = numbers(3, 4, 2).requires_grad_()
    layer = ModGNNLayer(2, f_mid=[nn.Linear(2, 2) for _ in range(3)]).double()
    found = outputs_and_gradients(layer, observation, Topology(weight, 4, form=form), weight)
    separate = Topology(mask, 4, weight=weight, form="edges")
    torch.testing.assert_close(found, outputs_and_gradients(layer, observation, separate, weight), equal_nan=True)
    ones = outputs_and_gradients(layer, observation, Topology(mask.double(), 4, form=form))
    torch.testing.assert_close(ones, outputs_and_gradients(layer, observation, Topology(mask, 4)), equal_nan=True)


def test_few_agents_most_of_which_are_linked_are_worked_on_in_pairs() -> None:
    most, some = torch.ones(2, 4, 4, dtype=torch.bool), torch.eye(4, dtype=torch.bool).expand(2, -1, -1)
    everyone = torch.ones(2, 4, dtype=torch.bool)
    assert Topology(most, 4).is_dense
    assert not Topology(some, 4).is_dense
    assert not Topology(most, 4, mask=everyone).is_dense
    assert not Topology(most, 4, receivers=everyone).is_dense
    assert not Topology(torch.ones(1, 65, 65, dtype=torch.bool), 65).is_dense
    assert not Topology(most, 4, form="edges").is_dense
    assert Topology(some, 4, form="dense").is_dense


@pytest.mark.parametrize("form", topology.FORMS)
@pytest.mark.parametrize(
    ("adjacency", "of_links", "sentence"),
    [
        (torch.ones(2, 3, 4, dtype=torch.bool), {}, r"adjacency of 4 agents must be \[..., 4, 4\], not \(2, 3, 4\)"),
        (torch.ones(4, dtype=torch.bool), {}, r"must be \[..., 4, 4\], not \(4,\)"),
        (torch.ones(2, 4, 4, dtype=torch.int64), {}, r"edge list \[..., 2, E\].*has shape \(2, 4, 4\); .* as bool"),
        (torch.ones(2, dtype=torch.int64), {}, r"edge list \[..., 2, E\].*has shape \(2,\)"),
        (torch.tensor([[[0, 4], [1, 1]]]), {}, r"of 4 agents contains numbers from 0 to 4; expected agents 0 to 3"),
        (torch.tensor([[[0, 3], [1, 4]]]), {}, r"of 4 agents contains numbers from 0 to 4; expected agents 0 to 3"),
        (torch.tensor([[[0, -2], [1, -2]]]), {}, r"numbers from -2 to 1; .* or -1 for both ends"),
        (torch.tensor([[[0, -1], [1, 3]]]), {}, r"numbers from -1 to 3; .* or -1 for both ends"),
        (torch.ones(2, 4, 4, dtype=torch.bool), {"weight": torch.ones(2, 4)}, "8 edge weights for 32 entries"),
        (torch.tensor([[[0, 1], [1, 3]]]), {"feature": torch.ones(1, 3, 5)}, "3 edge features for 2 entries"),
    ],
)
def test_what_is_no_graph_is_refused(form: str, adjacency: Tensor, of_links: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        Topology(adjacency, 4, **of_links, form=form).all_edges()


def test_an_unknown_form_is_refused() -> None:
    with pytest.raises(InputError, match="form='sparse' is not one of auto, edges, dense"):
        ModGNN(ModGNNLayer(1), form="sparse")


@pytest.mark.parametrize("form", topology.FORMS)
def test_no_links_no_agents_and_no_flocks(form: str) -> None:
    layer = layer_of_links()
    for shape, dense, listed in (
        ((2, 3), (2, 3, 3), (2, 2, 0)),
        ((2, 0), (2, 0, 0), (2, 2, 0)),
        ((0, 1, 3), (0, 1, 3, 3), (0, 1, 2, 4)),
    ):
        for adjacency in (torch.zeros(dense, dtype=torch.bool), torch.full(listed, -1)):
            places = adjacency.shape if adjacency.dtype == torch.bool else adjacency[..., 0, :].shape
            topology = Topology(adjacency, shape[-1], weight=numbers(*places), feature=numbers(*places, 2), form=form)
            output, sent = layer(numbers(*shape, 3), topology)
            assert output.shape == (*shape, 4)
            assert sent.shape == (*shape, 2, 3)


@pytest.mark.parametrize("form", topology.FORMS)
def test_a_graph_for_other_data_is_refused(form: str) -> None:
    adjacency, layer = torch.ones(3, 3, dtype=torch.bool), ModGNNLayer(1)
    with pytest.raises(InputError, match=r"1 graphs for observations \[4, 3\] .*; each step of each flock needs one"):
        layer(numbers(4, 3, 2), Topology(adjacency, 3, form=form))


def test_the_form_says_what_kind_of_graph_an_f_com_sees() -> None:
    adjacency = torch.ones(1, 2, 2, dtype=torch.bool)
    for form, kind in (("edges", EdgeList), ("dense", DenseGraph)):
        everyone = Topology(adjacency, 2, form=form).all_edges()
        assert isinstance(everyone, kind)
        assert everyone.weight is None
        assert everyone.feature is None
