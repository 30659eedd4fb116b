"""The shared tensor functions against loops, and their laws."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl.utils import tensors
from modgnn_rl.utils.tensors import clip_to_ball, pair_blocks, pair_differences, pair_distances, squared_norm


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


vectors = st.lists(st.floats(-1e9, 1e9), min_size=3, max_size=3).map(lambda v: torch.tensor(v, dtype=torch.float64))


@given(vectors, st.floats(0.1, 10))
def test_clipping_projects_onto_the_ball(vector: Tensor, radius: float) -> None:
    clipped, norm = clip_to_ball(vector, radius), float(vector.norm())
    if norm <= radius * (1 - 1e-12):
        assert torch.equal(clipped, vector)
    else:
        assert float(clipped.norm()) == pytest.approx(radius, rel=1e-12)
        torch.testing.assert_close(clipped, vector * (radius / norm), rtol=1e-12, atol=0)
    torch.testing.assert_close(clip_to_ball(clipped, radius), clipped, rtol=1e-12, atol=0)


def test_an_infinite_ball_clips_nothing() -> None:
    vector = 1e6 * random(4, 3)
    assert torch.equal(clip_to_ball(vector, math.inf), vector)


def test_clipping_has_a_gradient_everywhere() -> None:
    vector = torch.stack((torch.zeros(3), torch.full((3,), 0.1), torch.full((3,), 5.0))).double().requires_grad_()
    clip_to_ball(vector, 1.0).sum().backward()
    assert vector.grad is not None
    assert torch.equal(vector.grad[:2], torch.ones(2, 3).double())
    torch.testing.assert_close(vector.grad[2], torch.zeros(3).double())  # along the vector nothing changes
    assert torch.autograd.gradcheck(lambda v: clip_to_ball(v, 1.0), random(6, 3).requires_grad_())


def test_differences_point_from_row_to_column() -> None:
    x = random(2, 5, 3)
    differences = pair_differences(x)
    assert len(differences) == 3
    for component, difference in enumerate(differences):
        assert difference.shape == (2, 5, 5)
        for i in range(5):
            for j in range(5):
                assert torch.equal(difference[:, i, j], x[:, j, component] - x[:, i, component])


def test_differences_to_some_receivers_are_rows_of_those_to_all() -> None:
    x = random(2, 5, 3)
    for some, everyone in zip(pair_differences(x, slice(1, 4)), pair_differences(x), strict=True):
        assert torch.equal(some, everyone[:, 1:4])


@given(st.integers(0, 5), st.integers(0, 9), st.integers(1, 120))
def test_blocks_hold_every_receiver_once_in_order_and_no_more_pairs_than_fit(
    flocks: int, agents: int, budget: int
) -> None:
    numbers = torch.arange(flocks * agents).view(flocks, agents, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(tensors.PAIRS_IN_BLOCK, "cpu", budget)
        blocks = [numbers[some, receivers] for some, receivers in pair_blocks(numbers)]
    assert torch.equal(torch.cat([block.flatten() for block in blocks]), numbers.flatten())
    assert all(block.numel() * agents <= max(budget, agents) for block in blocks)


def test_squared_norm_sums_the_squares() -> None:
    components = list(random(4, 3, 2))
    before = [component.clone() for component in components]
    torch.testing.assert_close(squared_norm(components), sum(component**2 for component in components))
    torch.testing.assert_close(squared_norm(components[:1]), components[0] ** 2)
    assert all(map(torch.equal, components, before))


def test_distances_equal_brute_force_and_are_infinite_to_oneself() -> None:
    position = random(2, 3, 6, 3)
    distance = pair_distances(position)
    assert distance.shape == (2, 3, 6, 6)
    assert torch.equal(distance, distance.mT)
    for i in range(6):
        for j in range(6):
            expected = (
                torch.full((2, 3), math.inf).double()
                if i == j
                else (position[:, :, i] - position[:, :, j]).norm(dim=-1)
            )
            torch.testing.assert_close(distance[:, :, i, j], expected)


def test_close_pairs_far_from_the_origin_keep_their_distance() -> None:
    """In float32, 1 km away, coordinates are 0.06 mm apart; a distance from |x|^2 - 2 x y + |y|^2 would lose it all."""
    position = torch.tensor([[1000.0, 1000, 1000], [1000.25, 1000, 1000]])
    assert float(pair_distances(position)[0, 1]) == 0.25


def test_distances_carry_a_gradient_past_the_diagonal() -> None:
    position = random(4, 3).requires_grad_()
    distance = pair_distances(position)
    distance[~torch.eye(4, dtype=torch.bool)].sum().backward()
    assert position.grad is not None
    assert position.grad.isfinite().all()


@pytest.mark.parametrize("shape", [(1, 3), (2, 1, 3), (0, 4, 3)])
def test_small_and_empty_flocks(shape: tuple[int, ...]) -> None:
    distance = pair_distances(random(*shape))
    assert distance.shape == (*shape[:-1], shape[-2])
    assert (distance == math.inf)[..., 0, 0].all()
