"""Rigid-body motion in semi-implicit steps, written as Bullet computes it.

Structures of arrays, see `modgnn_rl.envs.vectors`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from modgnn_rl.envs.quadcopter import CRAZYFLIE, Quadcopter
from modgnn_rl.envs.vectors import constant, cross, norm, rotation_matrix, to_body_frame

__all__ = ["Bodies", "step_bodies"]


class Bodies(NamedTuple):
    """State of rigid bodies: position, m [3, ...]; quaternion [4, ...]; velocity, m/s [3, ...]; spin, rad/s [3, ...].

    Velocity and spin (angular velocity) are in the world frame.
    """

    position: Tensor
    quaternion: Tensor
    velocity: Tensor
    spin: Tensor


def step_bodies(
    bodies: Bodies, thrust: Tensor, torque: Tensor, dt: float, substeps: int, quadcopter: Quadcopter = CRAZYFLIE
) -> Bodies:
    """Move rigid bodies under a wrench that is constant in the body frame.

    Each of the substeps is semi-implicit with the gyroscopic term, as Bullet's multi-body without damping::

        w = R' W;  alpha = J^-1 (torque - w x J w)
        v += dt (R z thrust / m - g z);  W += dt R alpha;  p += dt v;  q <- exp(W dt) q

    Args:
        bodies: the state.
        thrust: force along the body's z axis, N [...].
        torque: torque in the body frame, N m [3, ...].
        dt: length of one substep, s.
        substeps: number of substeps.
        quadcopter: constants of the vehicle.

    Returns:
        the new state, its quaternions normalised.
    """
    position, quaternion, velocity, spin = bodies
    inertia = constant(quadcopter.inertia, velocity)
    weight = constant((0.0, 0.0, quadcopter.gravity), velocity)
    acceleration = thrust / quadcopter.mass
    for _ in range(substeps):
        rotation = rotation_matrix(quaternion)
        rate = to_body_frame(rotation, spin)
        alpha = (torque - cross(rate, inertia * rate)) / inertia
        velocity = velocity + dt * (rotation[:, 2] * acceleration - weight)
        spin = spin + dt * (rotation * alpha).sum(1)
        position = position + dt * velocity
        quaternion = _rotate(quaternion, spin, dt)
    return Bodies(position, quaternion / norm(quaternion), velocity, spin)


def _rotate(quaternion: Tensor, spin: Tensor, dt: float) -> Tensor:
    """exp(W dt) q: the quaternions [4, ...] after turning with world-frame angular velocity [3, ...] for dt seconds."""
    half = norm(spin) * (0.5 * dt)
    vector = spin * (0.5 * dt * torch.sinc(half / torch.pi))
    scalar = half.cos()
    axis, w = quaternion[:3], quaternion[3]
    turned = scalar * axis + w * vector + cross(vector, axis)
    return torch.cat((turned, (scalar * w - (vector * axis).sum(0)).unsqueeze(0)))
