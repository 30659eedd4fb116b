"""Initial positions: distances, sizes, shapes, distribution, determinism and errors."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl.envs.flocking.starts import clusters, grid, start_positions, uniform_ball
from modgnn_rl.errors import InputError
from modgnn_rl.utils.neighbours import near_pairs

KINDS = ("ball", "grid", "clusters")


def start(
    kind: str,
    flocks: int,
    agents: int,
    radius: float | Tensor = 4.0,
    distance: float = 0.3,
    *,
    seed: int = 0,
    exists: Tensor | None = None,
) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return start_positions(kind, flocks, agents, radius, distance, 3, generator=generator, exists=exists)


def gaps(position: Tensor) -> Tensor:
    """Distances of different agents [B, N, N], infinite on the diagonal."""
    distance = torch.cdist(position.double(), position.double())
    distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    return distance


def ball(
    flocks: int,
    agents: int,
    *,
    radius: float | Tensor = 4.0,
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


def test_resampling_moves_only_agents_that_are_too_close() -> None:
    """The first sample is the same with and without a minimum distance; only agents in a close pair move."""
    anywhere, apart = ball(50, 10, distance=0.0), ball(50, 10, distance=0.6)
    fits = (gaps(anywhere) > 0.6).all(-1).all(-1)
    assert 0 < int(fits.sum()) < 50
    assert torch.equal(anywhere[fits], apart[fits])
    moved = (anywhere != apart).any(-1)
    assert moved[~fits].any(-1).all()
    assert float(moved[~fits].double().mean()) < 0.5


def test_positions_depend_on_the_given_generator_alone() -> None:
    state = torch.get_rng_state()
    assert torch.equal(ball(3, 8, distance=1.0, seed=5), ball(3, 8, distance=1.0, seed=5))
    assert not torch.equal(ball(3, 8, distance=1.0, seed=5), ball(3, 8, distance=1.0, seed=6))
    assert torch.equal(state, torch.get_rng_state())


def test_positions_of_known_seeds_do_not_change() -> None:
    """The results in the documentation start from them."""
    known = [
        [-2.3196, 1.1190, 2.5424],
        [-0.4733, -3.6568, -1.3075],
        [-2.0487, 2.6747, -1.9308],
        [0.5742, -0.6113, -2.1914],
    ]
    torch.testing.assert_close(ball(2, 4, distance=3.0, seed=7)[0], torch.tensor(known), rtol=0, atol=1e-4)


def test_each_flock_may_have_its_own_radius() -> None:
    radius = torch.tensor([0.5, 1.0, 4.0])
    together = ball(3, 20, radius=radius)
    for number, one in enumerate(radius.tolist()):
        assert torch.equal(together[number], ball(3, 20, radius=one)[number])


@pytest.mark.parametrize("kind", KINDS)
@given(
    flocks=st.integers(0, 4),
    agents=st.integers(1, 20),
    radius=st.floats(2, 10),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=30)
def test_all_starts_keep_agents_apart_around_the_origin(
    kind: str, flocks: int, agents: int, radius: float, seed: int
) -> None:
    distance = 0.3 * radius * agents ** (-1 / 3)
    position = start(kind, flocks, agents, radius, distance, seed=seed)
    assert position.shape == (flocks, agents, 3)
    assert (gaps(position) >= distance * (1 - 1e-5)).all()
    assert (position.norm(dim=-1) < 2.5 * radius).all()
    assert torch.equal(position, start(kind, flocks, agents, radius, distance, seed=seed))
    if flocks:
        assert not torch.equal(position, start(kind, flocks, agents, radius, distance, seed=seed + 1))


@pytest.mark.parametrize("kind", KINDS)
def test_flocks_of_different_size(kind: str) -> None:
    """Agents that exist are apart, with the density of a flock without padding; the others are anywhere."""
    sizes = torch.tensor([4, 32, 9])
    exists = torch.arange(32) < sizes.unsqueeze(-1)
    position = start(kind, 3, 32, 4.0 * (sizes / 32) ** (1 / 3), exists=exists)
    assert position.isfinite().all()
    for number, size in enumerate(sizes.tolist()):
        own = position[number : number + 1, :size]
        assert (gaps(own) >= 0.3 * (1 - 1e-5)).all()
        assert (own.norm(dim=-1) < 10 * (size / 32) ** (1 / 3)).all()
    small = start(kind, 2, 32, 4.0 * (4 / 32) ** (1 / 3), exists=exists[[0, 0]])
    assert small.shape == (2, 32, 3)
    assert (gaps(small[:, :4]) >= 0.3 * (1 - 1e-5)).all()


@pytest.mark.parametrize("kind", KINDS)
def test_agents_that_do_not_exist_take_no_space(kind: str) -> None:
    """Of forty agents three exist, at any index, in a ball too small for forty."""
    exists = torch.zeros(20, 40, dtype=torch.bool)
    for number in range(20):
        exists[number, torch.randperm(40, generator=torch.Generator().manual_seed(number))[:3]] = True
    position = start(kind, 20, 40, 0.8, 0.4, exists=exists)[exists].view(20, 3, 3)
    assert (gaps(position) >= 0.4 * (1 - 1e-5)).all()
    assert (position.norm(dim=-1) < 2).all()


def test_a_grid_is_a_cube_of_the_volume_of_the_ball() -> None:
    """Each of 27 agents is at its own site, up to an offset of at most a quarter of the spacing."""
    position = grid(5, 27, 3.0, 0.0, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    spacing = (4 / 3 * math.pi * 27) ** (1 / 3) / 3
    site = position / spacing
    for flock in site:
        assert len({tuple(place) for place in flock.round().int().tolist()}) == 27
    assert float((site - site.round()).abs().max()) <= 0.25
    assert int(site.round().abs().max()) == 1
    leaders = {tuple(place) for place in site[:, 0].round().int().tolist()}
    assert len(leaders) > 1  # at random sites


@given(seed=st.integers(0, 2**31), agents=st.integers(6, 40), count=st.integers(1, 6))
@settings(max_examples=30)
def test_clusters_are_balls_that_do_not_overlap(seed: int, agents: int, count: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    radius = 4.0 * count ** (-1 / 3)
    position = clusters(3, agents, 4.0, 0.0, count, generator=generator, dtype=torch.float64)
    for flock in position:
        # Agents are assigned in turn, so that every count-th belongs to the same ball.
        balls = [flock[number::count] for number in range(count)]
        assert max(map(len, balls)) - min(map(len, balls)) <= 1
        for number, one in enumerate(balls):
            assert (gaps(one.unsqueeze(0)).masked_fill(torch.eye(len(one)) > 0, 0) <= 2 * radius + 1e-9).all()
            others = torch.cat([other for place, other in enumerate(balls) if place != number] or [one[:0]])
            apart = torch.cdist(one, others)
            assert (apart >= 0.4 * radius - 1e-9).all()
            if count > 1:
                assert float(apart.min()) <= 2.4 * radius + 2 * radius


def test_thousands_of_agents_start_apart() -> None:
    for kind in KINDS:
        position = start(kind, 1, 4096, 4.0 * 128 ** (1 / 3))
        assert len(near_pairs(position, 0.3 * (1 - 1e-5))[0]) == 0


def test_agents_that_do_not_fit_are_an_error() -> None:
    with pytest.raises(InputError, match=r"30 agents at least 1.0 m apart do not fit into a ball of radius 0.8 m"):
        ball(2, 30, radius=0.8, distance=1.0)


@pytest.mark.parametrize("kind", KINDS)
def test_no_start_hangs_when_agents_do_not_fit(kind: str) -> None:
    with pytest.raises(InputError, match=r"30 agents at least 1.0 m apart do not fit .* raise env.start_radius"):
        start(kind, 2, 30, 0.8, 1.0)
