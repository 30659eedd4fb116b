"""Rigid-body motion in semi-implicit steps, in the order of Bullet's computation, on structures of arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from modgnn_rl.envs.flocking.physics.quadcopter import Dynamics
from modgnn_rl.envs.flocking.physics.vectors import (
    Components,
    Quaternion,
    Vector,
    add,
    cross,
    dot,
    norm,
    rotation_matrix,
    scale,
    to_body_frame,
    to_world_frame,
)

__all__ = ["Bodies", "rotor_drag", "step_bodies"]

# Parameters of contacts in Bullet's solver, found by experiment.
CONTACT_MARGIN = 0.02 * 3**0.5  # of the radius: of the half diagonal of the box around the sphere
CONTACT_SLOP = 1e-5  # m
CONTACT_CORRECTION = 0.08  # fraction of a penetration that a step corrects
TINY_ANGLE = 1e-9  # rad


class Bodies(NamedTuple):
    """State of rigid bodies; velocity and spin (angular velocity) are in the world frame.

    Attributes:
        position: m.
        quaternion: from body to world, x, y, z, w.
        velocity: m/s.
        spin: rad/s.
    """

    position: Vector
    quaternion: Quaternion
    velocity: Vector
    spin: Vector


def step_bodies(
    bodies: Bodies,
    thrust: Tensor,
    torque: Components,
    dynamics: Dynamics,
    substeps: int = 1,
    acceleration: Components | None = None,
) -> Bodies:
    """Move rigid bodies under a wrench that is constant in the body frame.

    Each of the substeps is semi-implicit with the gyroscopic term, as Bullet's multi-body::

        w = R' W;  alpha = J^-1 (torque - w x J w) - d_a w (1 + |w|)
        v += dt (R z thrust / m - g z + a - d v (1 + |v|));  W += dt R alpha;  p += dt v;  q <- exp(W dt) q

    with the damping d of velocities and d_a of angular velocities. A floor limits v_z, see `_stay_above`.

    Args:
        bodies: the state.
        thrust: force along the body's z axis, N.
        torque: torque in the body frame, N m.
        dynamics: length of a substep, damping, floor, vehicle.
        substeps: number of substeps.
        acceleration: external acceleration a in the world frame, m/s^2.

    Returns:
        the new state, with normalised quaternions.
    """
    position, quaternion, velocity, spin = bodies
    vehicle, dt = dynamics.vehicle, dynamics.dt
    lift = thrust * (dt / vehicle.mass)
    fall = dt * vehicle.gravity
    twist = _times([dt / moment for moment in vehicle.inertia], torque)
    for _ in range(substeps):
        rotation = rotation_matrix(quaternion)
        rate = to_body_frame(rotation, spin)
        turn = add(twist, _gyration(rate, vehicle.inertia, dt))
        rise = lift * rotation[2][2] - fall
        change = (lift * rotation[0][2], lift * rotation[1][2], rise)
        if acceleration is not None:
            change = add(change, acceleration, dt)
        if dynamics.angular_damping:
            turn = add(turn, _damping(rate, dt * dynamics.angular_damping))
        if dynamics.linear_damping:
            change = add(change, _damping(velocity, dt * dynamics.linear_damping))
        velocity = add(velocity, change)
        spin = add(spin, to_world_frame(rotation, turn))
        if dynamics.ground is not None:
            velocity = _stay_above(position, velocity, dynamics)
        position = add(position, velocity, dt)
        quaternion = _rotate(quaternion, spin, dt)
    x, y, z, w = quaternion
    unit = 1 / norm(quaternion)
    return Bodies(position, (unit * x, unit * y, unit * z, unit * w), velocity, spin)


def rotor_drag(bodies: Bodies, rotors: Components, dynamics: Dynamics) -> Vector:
    """Acceleration by the drag of the rotors (Forster 2015, eq. 4.3), in the world frame, m/s^2.

    The force is ``-c_i v_i sum_r omega_r`` along each body axis i, the rotor speeds being ``omega = sqrt(f / k_f)``.

    Args:
        bodies: the state.
        rotors: thrusts f of the rotors, N.
        dynamics: multiple of the drag, vehicle.
    """
    vehicle = dynamics.vehicle
    first, second, third, fourth = [(thrust / vehicle.thrust_coefficient).sqrt() for thrust in rotors]
    rotation = rotation_matrix(bodies.quaternion)
    drag = _times(vehicle.drag_coefficient, to_body_frame(rotation, bodies.velocity))
    factor = (first + second + third + fourth) * (-dynamics.drag / vehicle.mass)
    return scale(factor, to_world_frame(rotation, drag))


def _times(factors: Sequence[float], vector: Components) -> Vector:
    x, y, z = vector
    return factors[0] * x, factors[1] * y, factors[2] * z


def _gyration(rate: Vector, inertia: tuple[float, float, float], dt: float) -> Vector:
    """Change of the body rates by the gyroscopic term, ``-dt J^-1 (w x J w)``."""
    (w_x, w_y, w_z), (j_x, j_y, j_z) = rate, inertia
    return (
        (dt * (j_y - j_z) / j_x) * w_y * w_z,
        (dt * (j_z - j_x) / j_y) * w_z * w_x,
        (dt * (j_x - j_y) / j_z) * w_x * w_y,
    )


def _damping(velocity: Vector, damping: float) -> Vector:
    """Bullet's damping ``-d v (1 + |v|)``."""
    return scale(-damping * (1 + norm(velocity)), velocity)


def _stay_above(position: Vector, velocity: Vector, dynamics: Dynamics) -> Vector:
    """Velocities after contact of a sphere with a floor, without friction or restitution, as in Bullet's solver.

    A contact exists where the gap before the step is below the margin. There, the vertical velocity is at least the one
    that closes the gap in one step, or that corrects a fraction of the penetration; both are measured from a level
    `CONTACT_SLOP` below the floor.
    """
    assert dynamics.ground is not None
    radius = dynamics.vehicle.arm
    gap = position[2] - radius - dynamics.ground
    depth = gap + CONTACT_SLOP
    least = torch.where(depth > 0, -depth, -CONTACT_CORRECTION * depth) / dynamics.dt
    vertical = torch.where(gap < CONTACT_MARGIN * radius, torch.maximum(velocity[2], least), velocity[2])
    return velocity[0], velocity[1], vertical


def _rotate(quaternion: Quaternion, spin: Vector, dt: float) -> Quaternion:
    """exp(W dt) q: the quaternions after rotation with world-frame angular velocities for dt seconds."""
    half = norm(spin) * (0.5 * dt)
    # sin(x) / x, which is 1 in floating point where x is tiny.
    vector = scale(0.5 * dt * torch.where(half > TINY_ANGLE, half.sin() / half, 1.0), spin)
    scalar = half.cos()
    axis, w = quaternion[:3], quaternion[3]
    x, y, z = (
        torch.addcmul(torch.addcmul(t, scalar, a), w, v)
        for a, v, t in zip(axis, vector, cross(vector, axis), strict=True)
    )
    return x, y, z, scalar * w - dot(vector, axis)
