"""Near pairs against a comparison of all pairs, by both algorithms."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl.utils import neighbours
from modgnn_rl.utils.neighbours import near_pairs
from modgnn_rl.utils.tensors import PAIRS_IN_BLOCK, pair_distances

WAYS = ("blocks", "cells")
seeds = st.integers(0, 999)
radii = st.sampled_from([0.05, 0.5, 1.0, 3.5, 100.0])


@pytest.fixture(params=WAYS)
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Find pairs by this algorithm, whatever the size of the flocks, a few at a time."""
    use(monkeypatch, request.param)
    return str(request.param)


def use(monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    monkeypatch.setattr(neighbours, "MANY", 0 if way == "cells" else math.inf)
    monkeypatch.setattr(neighbours, "GAIN", 0)
    monkeypatch.setitem(PAIRS_IN_BLOCK, "cpu", 40)


def assert_all_and_only_the_near_pairs(position: Tensor, radius: float) -> None:
    flock, receiver, sender, distance = near_pairs(position, radius)
    expected = pair_distances(position)
    assert torch.equal(torch.stack((flock, receiver, sender), -1), (expected <= radius).nonzero())
    assert torch.equal(distance, expected[flock, receiver, sender])
    assert flock.dtype == receiver.dtype == sender.dtype == torch.int64
    assert distance.dtype == position.dtype


def scattered(seed: int, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Agents in clumps of very different width, some of them in one place."""
    generator = torch.Generator().manual_seed(seed)
    width = 10 ** (3 * torch.rand(*shape, 1, generator=generator, dtype=dtype) - 2)
    position = width * torch.randn(*shape, 3, generator=generator, dtype=dtype)
    same = torch.rand(*shape, 1, generator=generator) < 0.1
    return torch.where(same, position[:, :1], position)


def both_ways(position: Tensor, radius: float) -> None:
    for way in WAYS:
        with pytest.MonkeyPatch.context() as patch:
            use(patch, way)
            assert_all_and_only_the_near_pairs(position, radius)


@given(seeds, st.integers(0, 3), st.integers(1, 24), radii, st.sampled_from([torch.float32, torch.float64]))
def test_near_pairs_are_those_of_all_pairs_bit_for_bit(
    seed: int, flocks: int, agents: int, radius: float, dtype: torch.dtype
) -> None:
    both_ways(scattered(seed, flocks, agents, dtype=dtype), radius)


@given(st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=1, max_size=20), st.sampled_from([0.1, 0.5, 1.0, 2.0]))
def test_agents_on_the_boundaries_of_cells(places: list[tuple[int, int, int]], radius: float) -> None:
    """On a lattice whose spacing is the radius, many distances are exactly the radius."""
    both_ways(radius * torch.tensor([places], dtype=torch.float32), radius)
    both_ways(torch.tensor([places], dtype=torch.float64) * (radius * neighbours.SLACK), radius)


@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), min_size=1, max_size=8), radii)
def test_arbitrary_positions(places: list[tuple[float, float, float]], radius: float) -> None:
    both_ways(torch.tensor([places, places[::-1]], dtype=torch.float32), radius)


def test_agents_with_nan_positions_are_in_no_pair(way: str) -> None:
    position = torch.zeros(2, 6, 3)
    position[0, 1, 2], position[0, 3], position[1, 4, 0] = math.nan, math.inf, -math.inf
    flock, receiver, sender, distance = near_pairs(position, 1.0)
    assert [int((flock == number).sum()) for number in range(2)] == [4 * 3, 5 * 4]
    for number, nowhere in ((0, (1, 3)), (1, (4,))):
        ends = torch.cat((receiver[flock == number], sender[flock == number]))
        assert not torch.isin(ends, torch.tensor(nowhere)).any()
    assert not distance.any()
    for nothing in (torch.full((2, 3, 3), math.nan), torch.zeros(1, 1, 3), torch.zeros(0, 4, 3), torch.zeros(2, 0, 3)):
        assert [len(part) for part in near_pairs(nothing, 1.0)] == [0] * 4


def test_pairs_do_not_cross_flocks(way: str) -> None:
    """Flocks in the same place, or as far apart as floating point allows, have only their own pairs."""
    alone = scattered(3, 1, 20)
    expected = near_pairs(alone, 2.0)
    far = torch.tensor([0.0, 1e5, -1e7, 1e15]).view(-1, 1, 1)
    flock, receiver, sender, distance = near_pairs(alone.expand(3, -1, -1), 2.0)
    for number in range(3):
        for part, one in zip((receiver, sender, distance), expected[1:], strict=True):
            assert torch.equal(part[flock == number], one)
    assert_all_and_only_the_near_pairs(alone + far, 2.0)


@given(seeds)
def test_permuting_agents_permutes_pairs(seed: int) -> None:
    position, generator = scattered(seed, 2, 30), torch.Generator().manual_seed(seed)
    order = torch.randperm(30, generator=generator)
    flock, receiver, sender, _ = near_pairs(position[:, order], 1.0)
    renumbered = set(zip(flock.tolist(), order[receiver].tolist(), order[sender].tolist(), strict=True))
    assert renumbered == set(zip(*(part.tolist() for part in near_pairs(position, 1.0)[:3]), strict=True))


@pytest.mark.parametrize("radius", [0.4, 2.0, 50.0])
def test_large_flocks(radius: float) -> None:
    """By the default choice of algorithm."""
    generator = torch.Generator().manual_seed(0)
    position = 10 * torch.randn(2, 600, 3, generator=generator)
    assert_all_and_only_the_near_pairs(position, radius)


def test_agents_of_a_wide_flock_are_compared_only_with_those_in_adjacent_cells() -> None:
    """Of the 17 million pairs of 4,096 agents, few are compared."""
    generator = torch.Generator().manual_seed(0)
    position = 40 * torch.rand(1, 4096, 3, generator=generator)
    cells = neighbours._Cells(position, 2.0)
    assert cells.num_candidates < 4096 * 27
    place, distance = cells.near_pairs()
    assert torch.equal(place, (pair_distances(position) <= 2.0).flatten().nonzero().view(-1))
    assert (distance <= 2.0).all()
