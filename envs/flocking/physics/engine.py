"""Physics engines behind one small interface, `Physics`.

An engine owns the bodies of ``[B, N]`` quadcopters and their velocity controllers. The environment resets some flocks,
steps all of them with target velocities, and reads positions and velocities. It uses nothing else, so an engine can be
added without changing the environment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.physics.controller import Rotors, mix_rotors, rotor_wrench, velocity_controller
from modgnn_rl.envs.flocking.physics.quadcopter import Dynamics
from modgnn_rl.envs.flocking.physics.rigid_body import Bodies, rotor_drag, step_bodies
from modgnn_rl.envs.flocking.physics.vectors import Components, Vector, add, rotation_matrix, to_body_frame
from modgnn_rl.errors import InputError
from modgnn_rl.utils.compile import compiled

__all__ = ["Physics", "SimulationState", "TorchPhysics", "advance", "make_physics"]

Move = Callable[[Bodies, Tensor, Vector, Dynamics, int, Components | None], Bodies]


class Physics(Protocol):
    """Batched quadcopters that follow target velocities; all vectors are in the world frame."""

    @property
    def position(self) -> Tensor:
        """Positions, m [B, N, 3]."""

    @property
    def quaternion(self) -> Tensor:
        """Attitudes from body to world, x, y, z, w [B, N, 4]."""

    @property
    def velocity(self) -> Tensor:
        """Velocities, m/s [B, N, 3]."""

    @property
    def spin(self) -> Tensor:
        """Angular velocities, rad/s [B, N, 3]."""

    def reset(
        self,
        rows: Tensor,
        position: Tensor,
        velocity: Tensor,
        quaternion: Tensor | None = None,
        spin: Tensor | None = None,
    ) -> None:
        """Set the state of the flocks ``rows``, with rotors at hover thrust and controller integrals at zero.

        Args:
            rows: indices of flocks, int64 [R].
            position: m [R, N, 3].
            velocity: m/s [R, N, 3].
            quaternion: x, y, z, w, normalised here [R, N, 4]; default: level.
            spin: rad/s [R, N, 3]; default: zero.
        """

    def step(self, target_velocity: Tensor, push: Tensor | None = None) -> None:
        """Advance one control period.

        Args:
            target_velocity: m/s [B, N, 3].
            push: external acceleration, such as wind, m/s^2, broadcast to [B, N, 3].
        """

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the complete state, by name [B, N, C], in the precision in which the engine computes."""

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Continue from a snapshot, whatever device it is on."""

    def close(self) -> None:
        """Free the engine's resources."""


class SimulationState(NamedTuple):
    """State of quadcopters and their controllers, as structures of arrays: tuples of components [B, N].

    Attributes:
        bodies: position, attitude and motion.
        integral: integrated velocity error of the controller, m.
        rotors: thrusts of the rotors, N; empty where the rotors follow their commands without lag.
    """

    bodies: Bodies
    integral: Vector
    rotors: Rotors | tuple[()]


class TorchPhysics:
    """Rigid-body quadcopters in torch, all flocks and agents at once, on any device and in float32 or float64.

    Args:
        num_envs: flocks B.
        num_agents: agents N in each.
        dynamics: parameters of controller and motion.
        device: device of the state.
        dtype: floating-point type of the state.
    """

    def __init__(
        self,
        num_envs: int,
        num_agents: int,
        dynamics: Dynamics | None = None,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.dynamics = dynamics or Dynamics()
        self._advance = advance
        zero = torch.zeros(num_envs, num_agents, device=device, dtype=dtype)
        nothing = (zero, zero, zero)
        hover = torch.full_like(zero, self.dynamics.vehicle.hover_thrust)
        rotors = (hover, hover, hover, hover) if self.dynamics.motor_lag else ()
        self.state = SimulationState(
            Bodies(nothing, (*nothing, torch.ones_like(zero)), nothing, nothing), nothing, rotors
        )

    @property
    def position(self) -> Tensor:
        """Positions, m [B, N, 3]."""
        return self._emit(self.state.bodies.position)

    @property
    def quaternion(self) -> Tensor:
        """Attitudes from body to world, x, y, z, w [B, N, 4]."""
        return self._emit(self.state.bodies.quaternion)

    @property
    def velocity(self) -> Tensor:
        """Velocities, m/s [B, N, 3]."""
        return self._emit(self.state.bodies.velocity)

    @property
    def spin(self) -> Tensor:
        """Angular velocities, rad/s [B, N, 3]."""
        return self._emit(self.state.bodies.spin)

    def reset(
        self,
        rows: Tensor,
        position: Tensor,
        velocity: Tensor,
        quaternion: Tensor | None = None,
        spin: Tensor | None = None,
    ) -> None:
        """Set the state of the flocks ``rows``, see `Physics.reset`."""
        nothing = torch.zeros_like(position)
        level = torch.cat((nothing, torch.ones_like(position[..., :1])), -1)
        hover = torch.full_like(level, self.dynamics.vehicle.hover_thrust)
        bodies, integral, rotors = self.state
        attitude = level if quaternion is None else quaternion / quaternion.norm(dim=-1, keepdim=True)
        fresh = (position, attitude, velocity, nothing if spin is None else spin)
        self.state = SimulationState(
            Bodies(*(_replace(old, rows, new) for old, new in zip(bodies, fresh, strict=True))),
            _replace(integral, rows, nothing),
            _replace(rotors, rows, hover) if rotors else (),
        )

    def step(self, target_velocity: Tensor, push: Tensor | None = None) -> None:
        """Advance one control period, see `Physics.step`."""
        air = None if push is None else push.unbind(-1)
        self.state = self._advance(self.state, target_velocity.unbind(-1), air, self.dynamics)

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of the state, see `Physics.snapshot`."""
        bodies, integral, rotors = self.state
        parts = {**bodies._asdict(), "integral": integral, **({"rotors": rotors} if rotors else {})}
        return {name: torch.stack(tuple(part), -1) for name, part in parts.items()}

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Continue from a snapshot, see `Physics.restore`."""
        device = self.state.integral[0].device
        # Components are contiguous, as after a step: the same arithmetic, bit for bit, and no recompilation.
        parts: dict[str, Any] = {
            name: tuple(part.to(device).clone(memory_format=torch.contiguous_format) for part in value.unbind(-1))
            for name, value in snapshot.items()
        }
        bodies = Bodies(*(parts[name] for name in Bodies._fields))
        self.state = SimulationState(bodies, parts["integral"], parts.get("rotors", ()))

    def compile(self) -> None:
        """Compile a control period into one function."""
        self._advance = compiled(advance)

    def close(self) -> None:
        """Do nothing: there is nothing to free."""

    def _emit(self, components: Components) -> Tensor:
        """A part of the state as a tensor [B, N, C]."""
        return torch.stack(tuple(components), -1)


def advance(
    state: SimulationState, target: Components, push: Components | None, dynamics: Dynamics, move: Move = step_bodies
) -> SimulationState:
    """Advance one control period: the controller once, then the rigid bodies in substeps. A pure function.

    Args:
        state: the current state.
        target: target velocity, m/s.
        push: external acceleration, m/s^2.
        dynamics: parameters of controller and motion.
        move: integrates rigid bodies; same arguments as `modgnn_rl.envs.flocking.physics.rigid_body.step_bodies`.

    Returns:
        the new state.
    """
    bodies, integral, rotors = state
    rotation = rotation_matrix(bodies.quaternion)
    rate = to_body_frame(rotation, bodies.spin)
    thrust, torque, integral = velocity_controller(
        target, bodies.velocity, rotation, rate, integral, dynamics.period, dynamics.velocity_gain, dynamics.vehicle
    )
    commands = mix_rotors(thrust, torque, dynamics.vehicle)
    if not rotors and not dynamics.drag:
        wrench = rotor_wrench(commands, dynamics.vehicle)
        return SimulationState(move(bodies, *wrench, dynamics, dynamics.substeps, push), integral, ())
    for _ in range(dynamics.substeps):
        thrusts = _follow(rotors, commands, dynamics.lag) if rotors else commands
        rotors = thrusts if rotors else ()
        pushed = push
        if dynamics.drag:
            pushed = rotor_drag(bodies, thrusts, dynamics)
            pushed = pushed if push is None else add(pushed, push)
        bodies = move(bodies, *rotor_wrench(thrusts, dynamics.vehicle), dynamics, 1, pushed)
    return SimulationState(bodies, integral, rotors)


def _follow(rotors: Rotors, commands: Rotors, lag: float) -> Rotors:
    """Thrusts of the rotors after a physics step; the fraction ``lag`` of the difference from the commands remains."""
    first, second, third, fourth = (c + lag * (f - c) for f, c in zip(rotors, commands, strict=True))
    return first, second, third, fourth


def _replace(old: Components, rows: Tensor, new: Tensor) -> Any:
    """Components [B, N], with those of the flocks ``rows`` replaced by ``new`` [R, N, C]."""
    return tuple(part.index_copy(0, rows, value) for part, value in zip(old, new.unbind(-1), strict=True))


def make_physics(
    config: FlockingConfig, num_envs: int, num_agents: int, device: torch.device, dtype: torch.dtype
) -> Physics:
    """Build the engine that ``config.physics`` names for B flocks of N agents.

    Raises:
        InputError: the engine does not support a setting.
    """
    dynamics = Dynamics(
        period=1 / config.control_frequency,
        substeps=config.physics_substeps,
        velocity_gain=config.velocity_gain,
        linear_damping=config.linear_damping,
        angular_damping=config.angular_damping,
        drag=config.drag,
        motor_lag=config.motor_lag,
        ground=config.ground,
    )
    if config.physics == "bullet":
        from modgnn_rl.envs.flocking.physics.bullet import BulletPhysics  # here, because it imports pybullet

        return BulletPhysics(num_envs, num_agents, dynamics, collisions=config.collisions, device=device, dtype=dtype)
    if config.collisions:
        raise InputError("env.collisions=true needs env.physics=bullet; the torch physics lets agents pass each other")
    return TorchPhysics(num_envs, num_agents, dynamics, device=device, dtype=dtype)
