"""Physics engines: what moves quadcopters, behind one small interface.

An engine owns the bodies of ``[B, N]`` quadcopters and their velocity controllers. The environment resets some rows,
steps all of them with target velocities, and reads positions and velocities; it knows nothing else, so that another
engine can be added here without touching it.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from modgnn_rl.envs.controller import velocity_controller
from modgnn_rl.envs.rigid_body import Bodies, step_bodies
from modgnn_rl.envs.vectors import rotation_matrix, to_body_frame

__all__ = ["Physics", "TorchPhysics"]


class Physics(Protocol):
    """Batched quadcopters that follow target velocities."""

    @property
    def position(self) -> Tensor:
        """Positions in the world frame, m [B, N, 3]."""

    @property
    def velocity(self) -> Tensor:
        """Velocities in the world frame, m/s [B, N, 3]."""

    def reset(self, rows: Tensor, position: Tensor, velocity: Tensor) -> None:
        """Put the flocks ``rows`` (indices [R]) level at positions [R, N, 3], m, with velocities [R, N, 3], m/s."""

    def step(self, target_velocity: Tensor) -> None:
        """Fly one control period towards target velocities [B, N, 3], m/s."""


class TorchPhysics:
    """Rigid-body quadcopters in torch, all flocks and agents at once, on any device and in float32 or float64.

    Args:
        num_envs: flocks B.
        num_agents: agents N in each.
        control_frequency: control steps a second, Hz.
        substeps: physics steps in a control step.
        velocity_gain: proportional gain of the velocity controller, 1/s.
        device: where the state lives.
        dtype: floating-point type of the state.
    """

    def __init__(
        self,
        num_envs: int,
        num_agents: int,
        *,
        control_frequency: float = 48.0,
        substeps: int = 5,
        velocity_gain: float = 1.0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.period = 1.0 / control_frequency
        self.substeps = substeps
        self.velocity_gain = velocity_gain
        zeros = torch.zeros(3, num_envs, num_agents, device=device, dtype=dtype)
        level = torch.zeros(4, num_envs, num_agents, device=device, dtype=dtype)
        level[3] = 1.0
        self.bodies = Bodies(zeros, level, zeros, zeros)
        self.integral = zeros

    @property
    def position(self) -> Tensor:
        """Positions in the world frame, m [B, N, 3]."""
        return self.bodies.position.movedim(0, -1).contiguous()

    @property
    def velocity(self) -> Tensor:
        """Velocities in the world frame, m/s [B, N, 3]."""
        return self.bodies.velocity.movedim(0, -1).contiguous()

    def reset(self, rows: Tensor, position: Tensor, velocity: Tensor) -> None:
        """Put the flocks ``rows`` (indices [R]) level at positions [R, N, 3], m, with velocities [R, N, 3], m/s."""
        level = position.new_tensor((0.0, 0.0, 0.0, 1.0)).view(4, 1, 1)
        zero = torch.zeros((), dtype=position.dtype, device=position.device)
        fresh = Bodies(position.movedim(-1, 0), level, velocity.movedim(-1, 0), zero)
        self.bodies = Bodies(*(_replace(old, rows, new) for old, new in zip(self.bodies, fresh, strict=True)))
        self.integral = _replace(self.integral, rows, zero)

    def step(self, target_velocity: Tensor) -> None:
        """Fly one control period towards target velocities [B, N, 3], m/s."""
        self.bodies, self.integral = fly(
            self.bodies, self.integral, target_velocity.movedim(-1, 0), self.period, self.substeps, self.velocity_gain
        )


def fly(
    bodies: Bodies, integral: Tensor, target: Tensor, period: float, substeps: int, gain: float
) -> tuple[Bodies, Tensor]:
    """One control period: the controller once, then the rigid bodies in substeps, as a pure function.

    Args:
        bodies: state of the quadcopters, components first (see `Bodies`).
        integral: integrated velocity error, m [3, ...].
        target: target velocity, m/s [3, ...].
        period: control period, s.
        substeps: physics steps in it.
        gain: proportional gain of the velocity controller, 1/s.

    Returns:
        the new bodies and the new integral.
    """
    rotation = rotation_matrix(bodies.quaternion)
    rate = to_body_frame(rotation, bodies.spin)
    thrust, torque, integral = velocity_controller(target, bodies.velocity, rotation, rate, integral, period, gain)
    return step_bodies(bodies, thrust, torque, period / substeps, substeps), integral


def _replace(old: Tensor, rows: Tensor, new: Tensor) -> Tensor:
    """A copy of ``old`` [C, B, N] with the flocks ``rows`` replaced."""
    out = old.clone()
    out[:, rows] = new
    return out
