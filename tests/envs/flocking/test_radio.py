"""Edge lists of the communication graph."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from modgnn_rl.envs.flocking.radio import padded_edge_list
from modgnn_rl.errors import InputError


@given(st.integers(0, 999), st.integers(1, 4), st.integers(1, 8))
def test_lists_hold_exactly_the_edges_of_each_flock(seed: int, flocks: int, agents: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    adjacency = torch.rand(flocks, agents, agents, generator=generator) < 0.4
    flock, receiver, sender = adjacency.nonzero().unbind(-1)
    edges = padded_edge_list(flock, receiver, sender, flocks, agents**2 + 2)
    assert edges.shape == (flocks, 2, agents**2 + 2)
    assert edges.dtype == torch.int64
    for number in range(flocks):
        count = int(adjacency[number].sum())
        assert torch.equal(edges[number, :, :count].flip(0).t(), adjacency[number].nonzero())
        assert (edges[number, :, count:] == -1).all()


def test_too_many_edges_are_an_error() -> None:
    flock = torch.tensor([0, 1, 1, 1])
    ends = torch.tensor([0, 0, 1, 2])
    assert (padded_edge_list(flock, ends, ends.flip(0), 2, 3) >= 0).sum() == 8
    with pytest.raises(InputError, match=r"flock 1 has 3 edges, .* holds only 2: raise env.max_links"):
        padded_edge_list(flock, ends, ends.flip(0), 2, 2)
