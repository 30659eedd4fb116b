"""Constants of the vehicle, and parameters of its controller and motion."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["CRAZYFLIE", "Dynamics", "Quadcopter"]


@dataclass(frozen=True)
class Quadcopter:
    """Constants of a quadcopter with rotors at the corners (+-rotor_offset, +-rotor_offset), SI units."""

    mass: float = 0.027
    gravity: float = 9.8
    inertia: tuple[float, float, float] = (1.4e-5, 1.4e-5, 2.17e-5)
    arm: float = 0.0397
    thrust_coefficient: float = 3.16e-10
    torque_coefficient: float = 7.94e-12
    thrust_to_weight: float = 2.25
    drag_coefficient: tuple[float, float, float] = (9.18e-7, 9.18e-7, 1.03e-6)

    @property
    def rotor_offset(self) -> float:
        """Distance of the rotors from the body's x and y axes, m."""
        return self.arm / 2**0.5

    @property
    def max_rotor_thrust(self) -> float:
        """Largest thrust of one rotor, N."""
        return self.thrust_to_weight * self.mass * self.gravity / 4

    @property
    def hover_thrust(self) -> float:
        """Thrust of one rotor at hover, N."""
        return self.mass * self.gravity / 4


CRAZYFLIE = Quadcopter()


@dataclass(frozen=True)
class Dynamics:
    """Parameters of controller and motion; see the fields of `FlockingConfig` with the same names.

    Attributes:
        period: control period, s.
        substeps: physics steps in it.
        velocity_gain: proportional gain of the velocity controller, 1/s.
        linear_damping: Bullet's damping d of velocities, ``a = -d v (1 + |v|)``.
        angular_damping: Bullet's damping d of angular velocities.
        drag: multiple of the vehicle's rotor drag; 0: none.
        motor_lag: time constant of the rotors, s; 0: none.
        ground: height of the floor, m; None: no floor.
        vehicle: constants of the vehicle.
    """

    period: float = 1 / 48
    substeps: int = 5
    velocity_gain: float = 1.0
    linear_damping: float = 0.0
    angular_damping: float = 0.0
    drag: float = 0.0
    motor_lag: float = 0.0
    ground: float | None = None
    vehicle: Quadcopter = CRAZYFLIE

    @property
    def dt(self) -> float:
        """Length of a physics step, s."""
        return self.period / self.substeps

    @property
    def lag(self) -> float:
        """Fraction of a difference between a rotor's thrust and its command that remains after a physics step."""
        return math.exp(-self.dt / self.motor_lag) if self.motor_lag else 0.0
