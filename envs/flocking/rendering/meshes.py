"""Triangle meshes of a flock's parts, as arrays [T, 3, 3]: triangles, corners, coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["ARROW", "QUADCOPTER", "normals", "quaternions_along"]

Array = NDArray[Any]


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Array:
    """A box between two corners."""
    corners = np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return corners[[triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))]]


def _ring(radius: float, height: float, sides: int) -> Array:
    """Corners of a regular polygon around the z axis [sides, 3]."""
    angle = np.arange(sides) * 2 * np.pi / sides
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), np.full(sides, height)), -1)


def _cone(radius: float, bottom: float, top: float, sides: int) -> Array:
    """A cone around the z axis, with its base."""
    ring = _ring(radius, bottom, sides)
    following = np.roll(ring, -1, 0)
    tip, centre = (np.broadcast_to((0.0, 0.0, height), ring.shape) for height in (top, bottom))
    return np.concatenate((np.stack((ring, following, tip), 1), np.stack((following, ring, centre), 1)))


def _tube(radius: float, bottom: float, top: float, sides: int) -> Array:
    """The lateral surface of a cylinder around the z axis."""
    low, high = _ring(radius, bottom, sides), _ring(radius, top, sides)
    low_next, high_next = np.roll(low, -1, 0), np.roll(high, -1, 0)
    return np.concatenate((np.stack((low, low_next, high_next), 1), np.stack((low, high_next, high), 1)))


def _quadcopter() -> Array:
    """Two crossed bars and four rotors; the arms have length 1."""
    half = np.sqrt(0.5)
    diagonal = np.array(((half, -half, 0), (half, half, 0), (0, 0, 1)))
    bars = np.concatenate((_box((-1, -0.1, -0.08), (1, 0.1, 0.08)), _box((-0.1, -1, -0.08), (0.1, 1, 0.08))))
    rotor = np.concatenate((_cone(0.55, 0.14, 0.2, 10), _cone(0.55, 0.14, 0.08, 10)[:, ::-1]))
    rotors = [rotor + np.array((x, y, 0)) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    return np.concatenate((bars, *rotors)) @ diagonal.T


def normals(mesh: Array) -> Array:
    """The normal of its triangle for each corner [T, 3, 3]."""
    normal = np.cross(mesh[:, 1] - mesh[:, 0], mesh[:, 2] - mesh[:, 0])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.repeat((normal / np.maximum(length, 1e-30))[:, None], 3, 1)


def quaternions_along(vectors: Array) -> Array:
    """Quaternions x, y, z, w [K, 4] that rotate the z axis into the direction of vectors [K, 3]."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    length = np.sqrt(x * x + y * y + z * z)
    half_turn = np.stack((-y, x, np.zeros_like(z), length + z), -1)  # its length is twice the cosine of half the angle
    norm = np.linalg.norm(half_turn, axis=-1, keepdims=True)
    down = norm <= 1e-9 * np.maximum(length, 1e-30)[:, None]
    return np.where(down, (1.0, 0.0, 0.0, 0.0), half_turn / np.where(down, 1.0, norm))


QUADCOPTER = _quadcopter()
ARROW = np.concatenate((_tube(1.0, 0.0, 0.75, 8), _cone(2.4, 0.72, 1.0, 8)))  # along the z axis, with length 1
