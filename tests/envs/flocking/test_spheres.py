"""Smallest enclosing spheres against closed forms, brute force over all supports and the optimality condition."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl.envs.flocking.spheres import smallest_enclosing_sphere
from modgnn_rl.errors import InputError

GOLDEN = (1 + 5**0.5) / 2
CUBE = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
ICOSAHEDRON = [point for a in (-1, 1) for b in (-GOLDEN, GOLDEN) for point in ([0, a, b], [a, b, 0], [b, 0, a])]
SQUARE = [[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]
CLOSED_FORMS = {
    "one point": ([[3, -4, 5]], [3, -4, 5], 0.0),
    "two points": ([[0, 0, 0], [2, 4, 4]], [1, 2, 2], 3.0),
    "identical": ([[1, 2, 3]] * 6, [1, 2, 3], 0.0),
    "collinear": ([[1, 1, 1], [2, 2, 2], [5, 5, 5], [3, 3, 3]], [3, 3, 3], 2 * 3**0.5),
    "obtuse triangle": ([[-2, 0, 0], [2, 0, 0], [0, 1, 0]], [0, 0, 0], 2.0),
    "right triangle": ([[0, 0, 0], [6, 0, 0], [0, 8, 0]], [3, 4, 0], 5.0),
    "equilateral triangle": ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], [1 / 3] * 3, (2 / 3) ** 0.5),
    "square": (SQUARE, [0, 0, 0], 2**0.5),
    "flat pyramid": ([*SQUARE, [0, 0, 0.5]], [0, 0, 0], 2**0.5),
    "tall pyramid": ([*SQUARE, [0, 0, 2]], [0, 0, 0.5], 1.5),
    "tetrahedron": ([CUBE[0], CUBE[3], CUBE[5], CUBE[6]], [0, 0, 0], 3**0.5),
    "cube": (CUBE, [0, 0, 0], 3**0.5),
    "icosahedron": (ICOSAHEDRON, [0, 0, 0], (1 + GOLDEN**2) ** 0.5),
}


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_points(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, 3, generator=generator(seed), dtype=torch.float64)


def brute_force(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Best of the circumcentres (least squares, in the affine hull) of all subsets of at most four points."""
    best, radius = points[0], np.inf
    for size in range(1, min(4, len(points)) + 1):
        for subset in combinations(points, size):
            edges = np.array(subset[1:]).reshape(-1, 3) - subset[0]
            centre = subset[0] + np.linalg.lstsq(2 * edges, (edges**2).sum(1), rcond=1e-12)[0]
            reach = np.linalg.norm(points - centre, axis=1).max()
            if reach < radius:
                best, radius = centre, reach
    return best, float(radius)


def assert_optimal(points: Tensor, tolerance: float = 1e-12) -> None:
    """A centre c is optimal if and only if max_i |p_i - c - d|^2 >= r^2 + |d|^2 for every displacement d."""
    centre, radius = smallest_enclosing_sphere(points)
    assert torch.allclose((points - centre[:, None]).norm(dim=-1).amax(-1), radius, rtol=1e-15, atol=0)
    direction = torch.nn.functional.normalize(random_points(200, seed=1), dim=-1)
    for length in (1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0):
        moved = centre[:, None, None] + length * direction[:, None]
        reach = (points[:, None] - moved).square().sum(-1).amax(-1)
        assert (reach >= radius.square()[:, None] + length**2 - tolerance).all()


@pytest.mark.parametrize("name", CLOSED_FORMS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_closed_forms(name: str, dtype: torch.dtype) -> None:
    points, expected_centre, expected_radius = CLOSED_FORMS[name]
    centre, radius = smallest_enclosing_sphere(torch.tensor(points, dtype=dtype))
    atol = 1e-13 if dtype == torch.float64 else 1e-6
    assert centre.dtype == radius.dtype == dtype
    assert centre.shape == (3,)
    assert radius.shape == ()
    assert torch.allclose(centre, torch.tensor(expected_centre, dtype=dtype), rtol=0, atol=atol)
    assert float(radius) == pytest.approx(expected_radius, rel=0, abs=atol)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1, max_size=7))
def test_integer_grids_match_brute_force(grid: list[tuple[int, int, int]]) -> None:
    points = np.array(grid, dtype=np.float64)
    centre, radius = smallest_enclosing_sphere(torch.from_numpy(points))
    expected_centre, expected_radius = brute_force(points)
    assert float(radius) == pytest.approx(expected_radius, rel=0, abs=1e-12)
    np.testing.assert_allclose(centre, expected_centre, rtol=0, atol=1e-6)  # up to sqrt(rounding)


@pytest.mark.parametrize("num_points", [2, 3, 4, 5, 9])
def test_random_points_match_brute_force(num_points: int) -> None:
    points = random_points(12, num_points)
    centre, radius = smallest_enclosing_sphere(points)
    for row in range(len(points)):
        expected_centre, expected_radius = brute_force(points[row].numpy())
        assert float(radius[row]) == pytest.approx(expected_radius, rel=1e-12)
        np.testing.assert_allclose(centre[row], expected_centre, rtol=0, atol=1e-10)


@pytest.mark.parametrize("shape", ["gauss", "flat", "thin", "sphere", "hemisphere", "circle", "grid"])
@pytest.mark.parametrize("noise", [0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-4])
def test_many_points_are_optimal(shape: str, noise: float) -> None:
    points = random_points(20, 100, seed=3)
    match shape:
        case "flat":
            points[..., 2] = 0
        case "thin":
            points[..., 1:] *= 1e-6
        case "sphere":
            points = torch.nn.functional.normalize(points, dim=-1)
        case "hemisphere":
            points[..., 2].abs_()
            points = torch.nn.functional.normalize(points, dim=-1)
        case "circle":
            points[..., 2] = 0
            points = torch.nn.functional.normalize(points, dim=-1)
        case "grid":
            points = points.round()
    assert_optimal(points + noise * random_points(20, 100, seed=4), tolerance=2e-12)


def test_invariance() -> None:
    points = random_points(50, 20)
    rotation = torch.linalg.qr(random_points(3)).Q
    shift = torch.tensor([5.0, -7.0, 9.0], dtype=torch.float64)
    centre, radius = smallest_enclosing_sphere(points)
    order = torch.randperm(20, generator=generator())
    moved_centre, moved_radius = smallest_enclosing_sphere(3 * points[:, order] @ rotation + shift)
    assert torch.allclose(moved_radius, 3 * radius, rtol=1e-13)
    assert torch.allclose(moved_centre, 3 * centre @ rotation + shift, rtol=0, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-300, 1e-12, 1e12, 1e300])
def test_extreme_scales(scale: float) -> None:
    centre, radius = smallest_enclosing_sphere(torch.tensor(CUBE, dtype=torch.float64) * scale)
    assert float(radius) == pytest.approx(3**0.5 * scale, rel=1e-13)
    assert torch.allclose(centre / scale, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-13)


def test_rows_do_not_mix_and_bad_rows_are_nan() -> None:
    points = random_points(4, 5, 8)
    points[0, 1, 2, 0] = torch.nan
    points[2, 3, 0, 2] = torch.inf
    centre, radius = smallest_enclosing_sphere(points)
    assert centre.shape == (4, 5, 3)
    assert radius.shape == (4, 5)
    bad = torch.zeros(4, 5, dtype=torch.bool)
    bad[0, 1] = bad[2, 3] = True
    assert torch.equal(radius.isnan(), bad)
    assert torch.equal(centre.isnan(), bad[..., None].expand(4, 5, 3))
    for row in bad.logical_not().nonzero():
        alone_centre, alone_radius = smallest_enclosing_sphere(points[tuple(row)])
        assert torch.allclose(centre[tuple(row)], alone_centre, rtol=0, atol=1e-13)
        assert torch.allclose(radius[tuple(row)], alone_radius, rtol=1e-13)


def test_empty_batch() -> None:
    centre, radius = smallest_enclosing_sphere(torch.zeros(0, 5, 3))
    assert centre.shape == (0, 3)
    assert radius.shape == (0,)


@pytest.mark.parametrize("shape", [(3,), (4, 2), (2, 0, 3)])
def test_wrong_shapes_are_errors(shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="expected"):
        smallest_enclosing_sphere(torch.zeros(shape))
