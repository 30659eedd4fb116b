"""Cascaded velocity controller of a quadcopter: target velocity in, thrust and torque out.

Works on structures of arrays, see `modgnn_rl.envs.flocking.physics.vectors`. The gains are tuned for a Crazyflie 2.X at
48 Hz.
"""

from __future__ import annotations

from torch import Tensor

from modgnn_rl.envs.flocking.physics.quadcopter import CRAZYFLIE, Quadcopter
from modgnn_rl.envs.flocking.physics.vectors import Components, Rotation, Vector, dot, norm

__all__ = ["mix_rotors", "rotor_limits", "rotor_wrench", "velocity_controller"]

Rotors = tuple[Tensor, Tensor, Tensor, Tensor]

INTEGRAL_GAIN = 0.2  # of the proportional gain
INTEGRAL_LIMIT = 2.0  # m
LATERAL_ACCELERATION = 6.0  # m/s^2
VERTICAL_ACCELERATION = (-5.0, 6.0)  # m/s^2
ATTITUDE_GAIN = 150.0  # 1/s^2
RATE_GAIN = 22.0  # 1/s


def velocity_controller(
    target: Components,
    velocity: Components,
    rotation: Rotation,
    body_rate: Components,
    integral: Components,
    dt: float,
    gain: float,
    quadcopter: Quadcopter = CRAZYFLIE,
) -> tuple[Tensor, Vector, Vector]:
    """Compute thrust and torque that steer a quadcopter towards a target velocity.

    With ``e = u - v`` and ``I <- clip(I + e dt)``: acceleration ``a = k_p e + 0.2 k_p I`` (clipped), force
    ``F = m (a + g z)``, thrust ``F . R z``; the desired attitude has its z axis along F and yaw 0; the torque is
    ``J (-150 e_R - 22 w)`` with ``e_R = vee(R_d' R - R' R_d) / 2`` (Lee et al. 2010). The limits of the rotors are not
    applied here, see `rotor_limits`.

    Args:
        target: target velocity u, m/s.
        velocity: velocity v in the world frame, m/s.
        rotation: body-to-world rotation R.
        body_rate: angular velocity w in the body frame, rad/s.
        integral: integral I of the velocity error, m.
        dt: control period, s.
        gain: proportional gain k_p, 1/s.
        quadcopter: constants of the vehicle.

    Returns:
        thrust along the body's z axis, N; torque in the body frame, N m; the new integral, m.
    """
    error = [u - v for u, v in zip(target, velocity, strict=True)]
    new_integral = [(i + e * dt).clamp(-INTEGRAL_LIMIT, INTEGRAL_LIMIT) for i, e in zip(integral, error, strict=True)]
    a_x, a_y, a_z = [gain * e + INTEGRAL_GAIN * gain * i for e, i in zip(error, new_integral, strict=True)]
    f_x = quadcopter.mass * a_x.clamp(-LATERAL_ACCELERATION, LATERAL_ACCELERATION)
    f_y = quadcopter.mass * a_y.clamp(-LATERAL_ACCELERATION, LATERAL_ACCELERATION)
    f_z = quadcopter.mass * (a_z.clamp(*VERTICAL_ACCELERATION) + quadcopter.gravity)
    r_x, r_y, r_z = tuple(zip(*rotation, strict=True))  # the body's axes
    thrust = dot((f_x, f_y, f_z), r_z)

    # Desired axes: z along the force, y = z cross (1, 0, 0) normalised (it has no x), x = y cross z.
    length = 1 / norm((f_x, f_y, f_z))
    z_x, z_y, z_z = length * f_x, length * f_y, length * f_z
    across = 1 / norm((z_y, z_z))
    y_y, y_z = across * z_z, -across * z_y
    x_x, x_y, x_z = y_y * z_z - y_z * z_y, y_z * z_x, -y_y * z_x
    # M = R_d' R has entries desired[a] . R[:, b]; e_R = vee(M - M') / 2.
    d_x, d_z = (x_x, x_y, x_z), (z_x, z_y, z_z)
    attitude_error = (
        0.5 * (dot(d_z, r_y) - (y_y * r_z[1] + y_z * r_z[2])),
        0.5 * (dot(d_x, r_z) - dot(d_z, r_x)),
        0.5 * ((y_y * r_x[1] + y_z * r_x[2]) - dot(d_x, r_y)),
    )
    t_x, t_y, t_z = [
        moment * (-ATTITUDE_GAIN * e - RATE_GAIN * w)
        for moment, e, w in zip(quadcopter.inertia, attitude_error, body_rate, strict=True)
    ]
    i_x, i_y, i_z = new_integral
    return thrust, (t_x, t_y, t_z), (i_x, i_y, i_z)


def rotor_limits(thrust: Tensor, torque: Components, quadcopter: Quadcopter = CRAZYFLIE) -> tuple[Tensor, Vector]:
    """Limit thrust and torque to what four saturating rotors can produce.

    Args:
        thrust: wanted thrust, N.
        torque: wanted torque in the body frame, N m.
        quadcopter: constants of the vehicle.

    Returns:
        the attainable thrust and torque.
    """
    return rotor_wrench(mix_rotors(thrust, torque, quadcopter), quadcopter)


def mix_rotors(thrust: Tensor, torque: Components, quadcopter: Quadcopter = CRAZYFLIE) -> Rotors:
    """Thrusts of the four rotors that produce a wrench, each clipped to [0, thrust_to_weight m g / 4], N.

    Args:
        thrust: wanted thrust, N.
        torque: wanted torque in the body frame, N m.
        quadcopter: constants of the vehicle.
    """
    offset, drag = quadcopter.rotor_offset, quadcopter.torque_coefficient / quadcopter.thrust_coefficient
    t_x, t_y, t_z = torque
    roll, pitch = t_x * (0.25 / offset), t_y * (0.25 / offset)
    yaw, collective = t_z * (0.25 / drag), thrust * 0.25
    most = quadcopter.max_rotor_thrust
    # Rotors at (+,+), (-,+), (-,-), (+,-); the first and third spin so that their drag torque is negative.
    return (
        (collective + roll - pitch - yaw).clamp(0.0, most),
        (collective + roll + pitch + yaw).clamp(0.0, most),
        (collective - roll + pitch - yaw).clamp(0.0, most),
        (collective - roll - pitch + yaw).clamp(0.0, most),
    )


def rotor_wrench(rotors: Components, quadcopter: Quadcopter = CRAZYFLIE) -> tuple[Tensor, Vector]:
    """Thrust, N, and torque in the body frame, N m, of four rotors with given thrusts."""
    offset, drag = quadcopter.rotor_offset, quadcopter.torque_coefficient / quadcopter.thrust_coefficient
    first, second, third, fourth = rotors
    torque = (
        offset * (first + second - third - fourth),
        offset * (second + third - first - fourth),
        drag * (second + fourth - first - third),
    )
    return first + second + third + fourth, torque
