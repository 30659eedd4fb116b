"""Smallest enclosing spheres of many point sets at once, exact up to rounding."""

from __future__ import annotations

from itertools import combinations

import torch
from torch import Tensor

from modgnn_rl.errors import InputError

__all__ = ["smallest_enclosing_sphere"]

_PAIRS = tuple(combinations(range(4), 2))
_TRIPLES = tuple(combinations(range(4), 3))
# Subsets of (four support points, new point 4) that contain the new point, padded to four with the new point.
_SUBSETS = tuple((*chosen, *[4] * (4 - len(chosen))) for size in (1, 2, 3) for chosen in combinations(range(4), size))
_TOLERANCE = 1e-13  # on squared distances; the points are scaled so that the radius lies between 1 and sqrt(3)
_MAX_ROUNDS = 100  # at most 14 occurred in tests; prevents endless cycles by rounding errors
_BLOCK = 2048  # point sets processed together, so that the candidates fit the cache


@torch.no_grad()
def smallest_enclosing_sphere(points: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest sphere that encloses each point set.

    Starting from one point, each round adds the point farthest from the centre to the at most four points that support
    the sphere and replaces the sphere by the smallest one around these five, which is the circumsphere of one of the
    14 subsets that contain the new point. This repeats until no point lies outside. All arithmetic is in float64. The
    radius is the computed distance to the farthest point, so the sphere encloses all points despite rounding.

    Args:
        points: ``[*B, N, 3]``, N at least 1; any floating dtype and unit. Duplicate, collinear, planar and co-spherical
            points are allowed.

    Returns:
        Centre ``[*B, 3]`` and radius ``[*B]``, in the dtype and unit of ``points`` and without gradient. A set with a
        coordinate that is NaN or infinite has NaN for both.

    Raises:
        InputError: ``points`` does not end in ``[N, 3]`` with N at least 1.
    """
    if points.dim() < 2 or points.shape[-1] != 3 or points.shape[-2] < 1:
        raise InputError(f"points has shape {list(points.shape)}; expected [*B, N, 3] with N at least 1")
    sets = points.to(torch.float64).reshape(-1, *points.shape[-2:])
    low, high = sets.amin(-2, keepdim=True), sets.amax(-2, keepdim=True)
    middle = low / 2 + high / 2
    scale = (high / 2 - low / 2).amax(-1, keepdim=True)
    unit = (sets - middle) / torch.where(scale > 0, scale, 1.0)
    centre = torch.cat([_centres(block) for block in torch.split(unit, _BLOCK)])[:, None]
    radius = (unit - centre).square().sum(-1).amax(-1).sqrt() * scale[:, 0, 0]
    centre = torch.where(radius.isnan()[:, None], torch.nan, (centre * scale + middle)[:, 0])
    batch = points.shape[:-2]
    return centre.reshape(*batch, 3).to(points.dtype), radius.reshape(batch).to(points.dtype)


def _centres(points: Tensor) -> Tensor:
    """Return the centres ``[S, 3]`` of the smallest spheres around ``points`` ``[S, N, 3]`` of size about 1."""
    centres = points[:, 0].clone()
    rows = torch.arange(len(points), device=points.device)
    support = points[:, :1].expand(-1, 4, -1)
    squared_radius = points.new_zeros(len(points))
    for _ in range(_MAX_ROUNDS):
        squared, farthest = (points - centres[rows, None]).square().sum(-1).max(-1)
        outside = squared > squared_radius + _TOLERANCE
        rows, points, support, farthest = rows[outside], points[outside], support[outside], farthest[outside]
        if not len(rows):
            break
        newest = points.gather(1, farthest[:, None, None].expand(-1, 1, 3))
        support, centres[rows], squared_radius = _grow(support, newest)
    return centres


def _grow(support: Tensor, newest: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Smallest sphere around four support points and a point outside their sphere.

    Args:
        support: ``[S, 4, 3]``, padded by repetition where fewer points support the sphere.
        newest: ``[S, 1, 3]``, known to lie on the surface of the new sphere.

    Returns:
        New support ``[S, 4, 3]``, centre ``[S, 3]`` and squared radius ``[S]``.
    """
    offsets = support - newest
    candidates = _circumcentres(offsets)
    five = torch.cat([offsets, torch.zeros_like(newest)], 1)
    # Comparing the radii with which each centre encloses all five points needs no tolerance; a flat subset or one that
    # does not support the sphere cannot have the smallest.
    reach = (candidates[:, :, None] - five[:, None]).square().sum(-1).amax(-1).nan_to_num(torch.inf)
    squared_radius, best = reach.min(-1)
    kept = torch.tensor(_SUBSETS, device=support.device)[best]
    row = torch.arange(len(best), device=best.device)
    return torch.cat([support, newest], 1)[row[:, None], kept], newest[:, 0] + candidates[row, best], squared_radius


def _circumcentres(offsets: Tensor) -> Tensor:
    """Circumcentres of the origin with 1, 2 and 3 of four points.

    Args:
        offsets: ``[S, 4, 3]``.

    Returns:
        ``[S, 14, 3]``, in the order of ``_SUBSETS``; meaningless (NaN, infinite or far away) where the subset is flat.
    """
    squared = offsets.square().sum(-1, keepdim=True)
    i, j = zip(*_PAIRS, strict=True)
    u, v, uu, vv = offsets[:, i], offsets[:, j], squared[:, i], squared[:, j]
    cross = torch.linalg.cross(u, v)
    triangle = torch.linalg.cross(uu * v - vv * u, cross) / (2 * cross.square().sum(-1, keepdim=True))

    i, j, k = zip(*_TRIPLES, strict=True)
    pair = {chosen: index for index, chosen in enumerate(_PAIRS)}
    jk = cross[:, [pair[b, c] for _, b, c in _TRIPLES]]
    ki = -cross[:, [pair[a, c] for a, _, c in _TRIPLES]]
    ij = cross[:, [pair[a, b] for a, b, _ in _TRIPLES]]
    volume = (offsets[:, i] * jk).sum(-1, keepdim=True)
    tetrahedron = (squared[:, i] * jk + squared[:, j] * ki + squared[:, k] * ij) / (2 * volume)
    return torch.cat([offsets / 2, triangle, tetrahedron], 1)
