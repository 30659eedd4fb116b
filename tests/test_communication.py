"""Links of a graph, and sums over them."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl import communication
from modgnn_rl.communication import Adjacency, Laplacian, links, sum_over_links


def random_graph(*batch: int, agents: int, share: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(*batch, agents, agents, generator=generator) < share


graphs = st.builds(
    lambda batch, agents, share, seed: random_graph(*batch, agents=agents, share=share, seed=seed),
    batch=st.lists(st.integers(1, 3), max_size=2),
    agents=st.integers(1, 5),
    share=st.sampled_from([0.0, 0.4, 1.0]),
    seed=st.integers(0, 999),
)


@given(adjacency=graphs)
def test_links_are_the_entries_of_the_graph_by_receiver(adjacency: Tensor) -> None:
    agents = adjacency.shape[-1]
    expected = [
        (number * agents + i, number * agents + j)
        for number, graph in enumerate(adjacency.reshape(-1, agents, agents).tolist())
        for i in range(agents)
        for j in range(agents)
        if graph[i][j]
    ]
    found = links(adjacency)
    assert list(zip(found.receiver.tolist(), found.sender.tolist(), strict=True)) == expected


@pytest.mark.parametrize("block", [1, 3, 4096])
@given(adjacency=graphs, seed=st.integers(0, 999))
def test_the_sum_over_links_is_a_matrix_product(block: int, adjacency: Tensor, seed: int) -> None:
    nodes = adjacency.shape[:-1].numel()
    values = torch.randn(nodes, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(communication, "BLOCK", block)
        graph, incoming, minus_own = links(adjacency), Adjacency(), Laplacian()
        heard = sum_over_links(lambda j, i: incoming(values[j], values[i]), graph, nodes)
        difference = sum_over_links(lambda j, i: minus_own(values[j], values[i]), graph, nodes)
    grouped = values.view(*adjacency.shape[:-1], 2)
    degree = adjacency.sum(-1, keepdim=True)
    expected = adjacency.double() @ grouped
    torch.testing.assert_close(heard, expected.view(nodes, 2))
    torch.testing.assert_close(difference, (expected - degree * grouped).view(nodes, 2))


def test_the_sum_over_no_links_is_zero_and_as_wide_as_the_function() -> None:
    graph = links(torch.zeros(2, 3, 3, dtype=torch.bool))
    total = sum_over_links(lambda sender, receiver: torch.ones(len(sender), 7, dtype=torch.float64), graph, 6)
    assert torch.equal(total, torch.zeros(6, 7, dtype=torch.float64))


@given(adjacency=graphs, seed=st.integers(0, 999))
def test_links_between_nodes_are_those_with_both_ends_there(adjacency: Tensor, seed: int) -> None:
    nodes = torch.rand(adjacency.shape[:-1], generator=torch.Generator().manual_seed(seed)) < 0.6
    kept = adjacency & nodes.unsqueeze(-1) & nodes.unsqueeze(-2)
    for ours, theirs in zip(links(adjacency).between(nodes.view(-1)), links(kept), strict=True):
        assert torch.equal(ours, theirs)


def test_all_nodes_leave_the_graph_as_it_is() -> None:
    graph = links(torch.ones(2, 2, dtype=torch.bool))
    assert graph.between(torch.ones(2, dtype=torch.bool)) is graph


def test_gradients_pass_through_every_block() -> None:
    adjacency = random_graph(2, agents=5, share=0.7, seed=0)
    graph = links(adjacency)
    values = torch.randn(10, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(communication, "BLOCK", 4)
        assert torch.autograd.gradcheck(
            lambda x: sum_over_links(lambda j, i: (x[j] - x[i]).tanh() * x[i], graph, 10), values
        )
