"""Cascaded velocity controller of a quadcopter: target velocity in, thrust and torque out.

Structures of arrays, see `modgnn_rl.envs.vectors`. The gains are tuned for a Crazyflie 2.X at 48 Hz.
"""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.envs.quadcopter import CRAZYFLIE, Quadcopter
from modgnn_rl.envs.vectors import constant, norm

__all__ = ["rotor_limits", "velocity_controller"]


INTEGRAL_GAIN = 0.2  # of the proportional gain
INTEGRAL_LIMIT = 2.0  # m
LATERAL_ACCELERATION = 6.0  # m/s^2
VERTICAL_ACCELERATION = (-5.0, 6.0)  # m/s^2
ATTITUDE_GAIN = 150.0  # 1/s^2
RATE_GAIN = 22.0  # 1/s


def velocity_controller(
    target: Tensor,
    velocity: Tensor,
    rotation: Tensor,
    body_rate: Tensor,
    integral: Tensor,
    dt: float,
    gain: float,
    quadcopter: Quadcopter = CRAZYFLIE,
) -> tuple[Tensor, Tensor, Tensor]:
    """Thrust and torque that steer a quadcopter towards a target velocity.

    With ``e = u - v`` and ``I <- clip(I + e dt)``: acceleration ``a = k_p e + 0.2 k_p I`` (clipped), force
    ``F = m (a + g z)``, thrust ``F . R z``; the desired attitude has its z axis along F and yaw 0; the torque is
    ``J (-150 e_R - 22 w)`` with ``e_R = vee(R_d' R - R' R_d) / 2`` (Lee et al. 2010); rotors saturate.

    Args:
        target: target velocity u, m/s [3, ...].
        velocity: velocity v in the world frame, m/s [3, ...].
        rotation: body-to-world rotation R [3, 3, ...].
        body_rate: angular velocity w in the body frame, rad/s [3, ...].
        integral: integral I of the velocity error, m [3, ...].
        dt: control period, s.
        gain: proportional gain k_p, 1/s.
        quadcopter: constants of the vehicle.

    Returns:
        thrust along the body's z axis, N [...]; torque in the body frame, N m [3, ...]; the new integral, m [3, ...].
    """
    error = target - velocity
    integral = (integral + error * dt).clamp(-INTEGRAL_LIMIT, INTEGRAL_LIMIT)
    acceleration = gain * error + INTEGRAL_GAIN * gain * integral
    lateral = acceleration[:2].clamp(-LATERAL_ACCELERATION, LATERAL_ACCELERATION)
    vertical = acceleration[2:].clamp(*VERTICAL_ACCELERATION) + quadcopter.gravity
    force = quadcopter.mass * torch.cat((lateral, vertical))
    thrust = (force * rotation[:, 2]).sum(0)

    # Desired axes: z along the force, y = z cross (1, 0, 0) normalised, x = y cross z.
    z_x, z_y, z_z = (force / norm(force)).unbind(0)
    lateral_norm = (z_y * z_y + z_z * z_z).sqrt()
    y_y, y_z = z_z / lateral_norm, -z_y / lateral_norm
    zero = torch.zeros_like(z_x)
    desired = torch.stack(
        (
            torch.stack((y_y * z_z - y_z * z_y, y_z * z_x, -y_y * z_x)),  # x_d
            torch.stack((zero, y_y, y_z)),  # y_d
            torch.stack((z_x, z_y, z_z)),  # z_d
        )
    )
    # M = R_d' R has entries desired[a] . rotation[:, b]; e_R = vee(M - M') / 2.
    r_x, r_y, r_z = rotation.unbind(1)
    d_x, d_y, d_z = desired.unbind(0)
    attitude_error = 0.5 * torch.stack(
        (
            (d_z * r_y).sum(0) - (d_y * r_z).sum(0),
            (d_x * r_z).sum(0) - (d_z * r_x).sum(0),
            (d_y * r_x).sum(0) - (d_x * r_y).sum(0),
        )
    )
    torque = constant(quadcopter.inertia, force) * (-ATTITUDE_GAIN * attitude_error - RATE_GAIN * body_rate)
    return *rotor_limits(thrust, torque, quadcopter), integral


def rotor_limits(thrust: Tensor, torque: Tensor, quadcopter: Quadcopter = CRAZYFLIE) -> tuple[Tensor, Tensor]:
    """Thrust and torque that four saturating rotors can really give.

    The wrench is mixed into four rotor thrusts, each clipped to [0, thrust_to_weight m g / 4], and mixed back.

    Args:
        thrust: wanted thrust, N [...].
        torque: wanted torque in the body frame, N m [3, ...].
        quadcopter: constants of the vehicle.

    Returns:
        the attainable thrust [...] and torque [3, ...].
    """
    offset, drag = quadcopter.rotor_offset, quadcopter.torque_coefficient / quadcopter.thrust_coefficient
    roll, pitch = torque[0] / (4 * offset), torque[1] / (4 * offset)
    yaw, collective = torque[2] / (4 * drag), thrust / 4
    # Rotors at (+,+), (-,+), (-,-), (+,-); the first and third spin so that their drag torque is negative.
    rotors = torch.stack(
        (
            collective + roll - pitch - yaw,
            collective + roll + pitch + yaw,
            collective - roll + pitch - yaw,
            collective - roll - pitch + yaw,
        )
    ).clamp(0.0, quadcopter.max_rotor_thrust)
    first, second, third, fourth = rotors.unbind(0)
    limited = torch.stack(
        (
            offset * (first + second - third - fourth),
            offset * (second + third - first - fourth),
            drag * (second + fourth - first - third),
        )
    )
    return rotors.sum(0), limited
