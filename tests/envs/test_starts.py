"""Starting positions: distances, radius, distribution, determinism and refusals."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl.envs.starts import uniform_ball
from modgnn_rl.errors import InputError


def ball(
    flocks: int,
    agents: int,
    *,
    radius: float = 4.0,
    distance: float = 0.0,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return uniform_ball(flocks, agents, radius, distance, generator=generator, dtype=dtype)


@given(
    flocks=st.integers(0, 5),
    agents=st.integers(1, 12),
    radius=st.floats(0.5, 10),
    crowding=st.floats(0, 0.5),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=50)
def test_agents_lie_in_the_ball_and_apart(
    flocks: int, agents: int, radius: float, crowding: float, dtype: torch.dtype, seed: int
) -> None:
    distance = crowding * radius
    position = ball(flocks, agents, radius=radius, distance=distance, seed=seed, dtype=dtype)
    assert position.shape == (flocks, agents, 3)
    assert position.dtype == dtype
    assert (position.norm(dim=-1) <= radius * (1 + 1e-6)).all()
    for flock in position.double():
        assert (torch.pdist(flock) >= distance * (1 - 1e-6)).all()


def test_positions_are_uniform_in_the_ball() -> None:
    """(|p| / R)^3 is uniform, the direction isotropic; three standard errors of 20,000 samples allow 2 %."""
    position = ball(20_000, 1, radius=2.0, dtype=torch.float64)[:, 0]
    share, _ = (position.norm(dim=-1) / 2).pow(3).sort()
    even = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000
    assert float((share - even).abs().max()) < 0.015  # Kolmogorov-Smirnov; 1.95 / sqrt(n) has level 0.1 %
    direction = position / position.norm(dim=-1, keepdim=True)
    for axis in range(3):
        # Archimedes: each coordinate of a uniform direction is uniform in [-1, 1].
        height, _ = ((direction[:, axis] + 1) / 2).sort()
        assert float((height - even).abs().max()) < 0.015
    covariance = direction.T @ direction / len(direction)
    torch.testing.assert_close(covariance, torch.eye(3).double() / 3, rtol=0, atol=0.02)


def test_redrawing_keeps_the_sets_that_fit_already() -> None:
    """The first draw is the same with and without a smallest distance; only agents in a close pair move."""
    anywhere, apart = ball(50, 10, distance=0.0), ball(50, 10, distance=0.6)
    distances = torch.cdist(anywhere.double(), anywhere.double())
    distances.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    fits = (distances > 0.6).all(-1).all(-1)
    assert 0 < int(fits.sum()) < 50
    assert torch.equal(anywhere[fits], apart[fits])
    moved = (anywhere != apart).any(-1)
    assert moved[~fits].any(-1).all()
    assert float(moved[~fits].double().mean()) < 0.5


def test_the_generator_fixes_the_positions_and_nothing_else_is_drawn_from() -> None:
    state = torch.get_rng_state()
    assert torch.equal(ball(3, 8, distance=1.0, seed=5), ball(3, 8, distance=1.0, seed=5))
    assert not torch.equal(ball(3, 8, distance=1.0, seed=5), ball(3, 8, distance=1.0, seed=6))
    assert torch.equal(state, torch.get_rng_state())


def test_agents_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"30 agents at least 1.0 m apart do not fit into a ball of radius 0.8 m"):
        ball(2, 30, radius=0.8, distance=1.0)
