"""Vector algebra on structures of arrays.

The component comes first: vectors are ``[3, ...]``, quaternions ``[4, ...]`` in the order x, y, z, w, rotation
matrices ``[3, 3, ...]`` (row, column). So every operation is pointwise over flocks and agents, which is what makes
the physics fast on a CPU.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["constant", "cross", "norm", "rotation_matrix", "to_body_frame"]


def constant(values: tuple[float, ...], like: Tensor) -> Tensor:
    """A constant vector [C, 1, ...] that broadcasts against vectors [C, ...] of the device and type of ``like``."""
    return like.new_tensor(values).view(len(values), *[1] * (like.ndim - 1))


def norm(vector: Tensor) -> Tensor:
    """Euclidean norm [...] over the first dimension of [C, ...]; much faster there than torch.linalg.vector_norm."""
    return (vector * vector).sum(0).sqrt()


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of vectors [3, ...] along the first dimension."""
    a_x, a_y, a_z = a.unbind(0)
    b_x, b_y, b_z = b.unbind(0)
    return torch.stack((a_y * b_z - a_z * b_y, a_z * b_x - a_x * b_z, a_x * b_y - a_y * b_x))


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Body-to-world rotation matrix [3, 3, ...] of unit quaternions x, y, z, w [4, ...]."""
    x, y, z, w = quaternion.unbind(0)
    x2, y2, z2 = x + x, y + y, z + z
    xx, yy, zz = x * x2, y * y2, z * z2
    xy, xz, yz = x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    rows = (1 - (yy + zz), xy - wz, xz + wy, xy + wz, 1 - (xx + zz), yz - wx, xz - wy, yz + wx, 1 - (xx + yy))
    return torch.stack(rows).unflatten(0, (3, 3))


def to_body_frame(rotation: Tensor, vector: Tensor) -> Tensor:
    """R' x: world-frame vectors [3, ...] in the body frame, for rotations [3, 3, ...]."""
    return (rotation * vector.unsqueeze(1)).sum(0)
