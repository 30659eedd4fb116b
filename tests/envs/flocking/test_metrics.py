"""Metrics against their definitions written as loops, closed forms and invariances."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl.envs.flocking import metrics
from modgnn_rl.errors import InputError
from modgnn_rl.utils import tensors

NAN, INF = math.nan, math.inf


def random_flocks(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def all_distances(position: Tensor) -> dict[str, Tensor]:
    return {
        "leader_distance": metrics.leader_distance(position),
        "cohesion": metrics.cohesion(position),
        "separation": metrics.separation(position),
        "min_distance": metrics.min_distance(position),
    }


def test_closed_form_line() -> None:
    """Agents at 0, 1, 3 and 8 m on a line; agent 0 leads."""
    position = torch.tensor([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [8, 0, 0]])
    assert float(metrics.leader_distance(position)) == pytest.approx(4.0)
    assert float(metrics.leader_distance(position, 2)) == pytest.approx(0.0)
    assert float(metrics.leader_distance(position, 3)) == pytest.approx(8 - 4 / 3)
    assert float(metrics.cohesion(position)) == pytest.approx(8.0)
    assert metrics.separation(position).tolist() == [1.0, 1.0, 2.0, 5.0]
    assert float(metrics.min_distance(position)) == 1.0
    assert [int(metrics.collision_rate(position, d)) for d in (1.0, 1.5, 2.5, 3.0, 3.5, 100.0)] == [0, 1, 2, 2, 3, 6]
    assert [bool(metrics.is_diverged(position, d)) for d in (4.9, 5.0)] == [True, False]
    assert [bool(metrics.leader_lost(position, r)) for r in (0.9, 1.0)] == [True, False]
    assert [bool(metrics.leader_lost(position, r, leader=3)) for r in (4.9, 5.0)] == [True, False]


@pytest.mark.parametrize("budget", [1, 40, 700, 10**6])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pairs_match_loops_whatever_the_blocks(
    monkeypatch: pytest.MonkeyPatch, budget: int, dtype: torch.dtype
) -> None:
    monkeypatch.setitem(tensors.PAIRS_IN_BLOCK, "cpu", budget)
    position = random_flocks(2, 3, 9).to(dtype)
    separation, count = metrics.separation(position), metrics.collision_rate(position, 1.0)
    assert separation.dtype == dtype
    assert separation.shape == (2, 3, 9)
    assert count.shape == (2, 3)
    for b in range(2):
        for t in range(3):
            points = position[b, t].tolist()
            gaps = [[math.dist(p, q) if p is not q else INF for q in points] for p in points]
            assert separation[b, t].tolist() == pytest.approx([min(row) for row in gaps], rel=1e-5)
            assert int(count[b, t]) == sum(gaps[i][j] < 1.0 for i in range(9) for j in range(i))
    assert torch.equal(metrics.min_distance(position), separation.amin(-1))


def test_close_pairs_far_from_the_origin_keep_their_distance() -> None:
    position = torch.tensor([[4096.0, 4096.0, 0], [4096.0, 4096.0, 0.01], [0, 0, 0]])
    assert float(metrics.min_distance(position)) == pytest.approx(0.01, rel=1e-6)


def test_identical_agents() -> None:
    position = torch.ones(4, 3)
    assert metrics.separation(position).tolist() == [0.0] * 4
    assert int(metrics.collision_rate(position, 0.1)) == 6
    assert int(metrics.collision_rate(position, 0.0)) == 0


@settings(max_examples=25, deadline=None)
@given(
    st.integers(2, 12),
    st.integers(0, 2**31),
    st.floats(0.01, 100),
    st.tuples(*[st.floats(-50, 50)] * 3),
)
def test_distances_follow_similarity_transforms(n: int, seed: int, scale: float, shift: tuple[float, ...]) -> None:
    position = random_flocks(3, n, seed=seed)
    rotation = torch.linalg.qr(random_flocks(3, seed=seed + 1)).Q
    moved = scale * position @ rotation + torch.tensor(shift, dtype=torch.float64)
    expected = all_distances(position)
    for name, value in all_distances(moved).items():
        assert torch.allclose(value, scale * expected[name], rtol=1e-9, atol=1e-11), name
    assert (metrics.collision_rate(moved, scale) == metrics.collision_rate(position, 1.0)).all()
    assert (metrics.is_diverged(moved, 2 * scale) == metrics.is_diverged(position, 2.0)).all()
    assert (metrics.leader_lost(moved, scale) == metrics.leader_lost(position, 1.0)).all()


def test_numbering_of_the_followers_does_not_matter() -> None:
    position = random_flocks(6, 10)
    order = torch.cat(
        [torch.zeros(1, dtype=torch.long), 1 + torch.randperm(9, generator=torch.Generator().manual_seed(2))]
    )
    shuffled = position[:, order]
    expected = all_distances(position)
    expected["separation"] = expected["separation"][:, order]
    for name, value in all_distances(shuffled).items():
        assert torch.allclose(value, expected[name], rtol=1e-12), name
    leader = int(torch.argsort(torch.randperm(10, generator=torch.Generator().manual_seed(3)))[0])
    swapped = position.roll(leader, dims=1)
    assert torch.allclose(metrics.leader_distance(swapped, leader), expected["leader_distance"])
    assert torch.equal(metrics.leader_lost(swapped, 1.0, leader), metrics.leader_lost(position, 1.0))


def test_bounds_between_metrics() -> None:
    position = random_flocks(50, 7)
    widest = torch.cdist(position, position).amax((-1, -2))
    cohesion = metrics.cohesion(position)
    assert (cohesion >= widest - 1e-12).all()
    assert (cohesion <= widest * (3 / 2) ** 0.5 + 1e-12).all()  # Jung's theorem in three dimensions


def test_one_agent() -> None:
    position = torch.tensor([[[1.0, 2.0, 3.0]]])
    assert metrics.leader_distance(position).tolist() == [0.0]
    assert metrics.cohesion(position).tolist() == [0.0]
    assert metrics.separation(position).isnan().tolist() == [[True]]
    assert metrics.min_distance(position).isnan().tolist() == [True]
    assert metrics.collision_rate(position, 1.0).tolist() == [0]
    assert metrics.is_diverged(position, 1.0).tolist() == [False]
    assert metrics.leader_lost(position, 1.0).tolist() == [False]


def test_two_agents() -> None:
    position = torch.tensor([[0.0, 0, 0], [0, 3, 4]])
    assert float(metrics.leader_distance(position)) == 5.0
    assert float(metrics.cohesion(position)) == pytest.approx(5.0)
    assert metrics.separation(position).tolist() == [5.0, 5.0]
    assert int(metrics.collision_rate(position, 5.5)) == 1


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_flocks_with_nan_or_infinite_coordinates_have_diverged(bad: float) -> None:
    position = torch.zeros(2, 4, 3)
    position[1, 2, 1] = bad
    assert metrics.is_diverged(position, 10.0).tolist() == [False, True]
    assert metrics.is_diverged(position, INF).tolist() == [False, True]
    assert metrics.cohesion(position).isnan().tolist() == [False, True]
    assert metrics.collision_rate(position, 1.0).tolist() == [6, 3]
    assert metrics.leader_lost(position, 1.0).tolist() == [False, False]
    assert metrics.leader_lost(position, 1.0, leader=2).tolist() == [False, True]


def test_agents_that_do_not_exist_make_no_flock_diverge() -> None:
    position = torch.zeros(3, 5, 3)
    position[:, :3] = torch.tensor([[0.0, 0, 0], [3, 0, 0], [6, 0, 0]])
    position[0, 3:], position[1, 3:], position[2, 3:] = NAN, INF, 1e4
    exists = torch.arange(5).expand(3, 5) < 3
    for distance in (2.9, 3.0, 3.1):
        expected = metrics.is_diverged(position[:, :3], distance)
        assert torch.equal(metrics.is_diverged(position, distance, exists), expected)
    assert metrics.is_diverged(position, 3.1).all()
    position[1, 2, 0] = NAN
    assert metrics.is_diverged(position, 3.1, exists).tolist() == [False, True, False]


def test_nan_agent_shows_in_the_separation_of_its_flock_only() -> None:
    position = random_flocks(2, 4)
    position[1, 2, 1] = NAN
    assert metrics.separation(position).isnan().tolist() == [[False] * 4, [True] * 4]


@pytest.mark.parametrize("function", [metrics.leader_distance, lambda p, leader: metrics.leader_lost(p, 1.0, leader)])
@pytest.mark.parametrize("leader", [-1, 4])
def test_unknown_leader_is_refused(function: Callable[..., object], leader: int) -> None:
    with pytest.raises(InputError, match="not an agent"):
        function(torch.zeros(4, 3), leader)


def test_empty_batch() -> None:
    position = torch.zeros(0, 4, 3)
    assert metrics.separation(position).shape == (0, 4)
    assert metrics.collision_rate(position, 1.0).shape == (0,)
    assert metrics.cohesion(position).shape == (0,)
