"""Vector algebra on structures of arrays.

A vector is a tuple of its components, one tensor each; a quaternion is x, y, z, w. Every operation is pointwise over
flocks and agents: fast on a CPU, and one loop when compiled. Functions also accept a tensor whose first dimension holds
the components.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

__all__ = [
    "Components",
    "Quaternion",
    "Rotation",
    "Vector",
    "add",
    "cross",
    "dot",
    "norm",
    "rotation_matrix",
    "scale",
    "to_body_frame",
    "to_world_frame",
]

Components = Iterable[Tensor]
Vector = tuple[Tensor, Tensor, Tensor]
Quaternion = tuple[Tensor, Tensor, Tensor, Tensor]
Rotation = tuple[Vector, Vector, Vector]  # rows of a matrix from body to world


def dot(a: Components, b: Components) -> Tensor:
    """Scalar product."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return torch.addcmul(torch.addcmul(a_x * b_x, a_y, b_y), a_z, b_z)


def norm(vector: Components) -> Tensor:
    """Euclidean norm, of any number of components."""
    first, *others = vector
    square = first * first
    for component in others:
        square = torch.addcmul(square, component, component)
    return square.sqrt()


def cross(a: Components, b: Components) -> Vector:
    """Cross product."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return a_y * b_z - a_z * b_y, a_z * b_x - a_x * b_z, a_x * b_y - a_y * b_x


def add(a: Components, b: Components, factor: float = 1.0) -> Vector:
    """Sum ``a + factor b``."""
    (a_x, a_y, a_z), (b_x, b_y, b_z) = a, b
    return torch.add(a_x, b_x, alpha=factor), torch.add(a_y, b_y, alpha=factor), torch.add(a_z, b_z, alpha=factor)


def scale(factor: Tensor | float, vector: Components) -> Vector:
    """A number times a vector."""
    x, y, z = vector
    return factor * x, factor * y, factor * z


def rotation_matrix(quaternion: Components) -> Rotation:
    """Rows of the body-to-world rotation matrix of unit quaternions."""
    x, y, z, w = quaternion
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    return (1 - (yy + zz), xy - wz, xz + wy), (xy + wz, 1 - (xx + zz), yz - wx), (xz - wy, yz + wx, 1 - (xx + yy))


def to_world_frame(rotation: Rotation, vector: Components) -> Vector:
    """R x: body-frame vectors in the world frame."""
    vector = tuple(vector)
    return dot(rotation[0], vector), dot(rotation[1], vector), dot(rotation[2], vector)


def to_body_frame(rotation: Rotation, vector: Components) -> Vector:
    """R' x: world-frame vectors in the body frame."""
    return to_world_frame(tuple(zip(*rotation, strict=True)), vector)  # type: ignore[arg-type]
