"""Constants of the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CRAZYFLIE", "Quadcopter"]


@dataclass(frozen=True)
class Quadcopter:
    """Constants of a quadcopter with rotors at the corners (+-rotor_offset, +-rotor_offset), SI units."""

    mass: float = 0.027
    gravity: float = 9.8
    inertia: tuple[float, float, float] = (1.4e-5, 1.4e-5, 2.17e-5)
    rotor_offset: float = 0.0397 / 2**0.5
    thrust_coefficient: float = 3.16e-10
    torque_coefficient: float = 7.94e-12
    thrust_to_weight: float = 2.25

    @property
    def max_rotor_thrust(self) -> float:
        """Largest thrust of one rotor, N."""
        return self.thrust_to_weight * self.mass * self.gravity / 4


CRAZYFLIE = Quadcopter()
