"""PyBullet as the physics engine: the same controllers as in torch, bodies moved by Bullet, one client per flock.

Each agent is a single body on which one wrench acts. Without collisions, trajectories equal those of `TorchPhysics` up
to rounding. PyBullet is called for each agent and substep, so it is slow, and it runs on one core;
`modgnn_rl.envs.parallel.parallel_flocks` spreads flocks over several processes.
"""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch import Tensor

from modgnn_rl.envs.flocking.physics.engine import TorchPhysics, advance
from modgnn_rl.envs.flocking.physics.quadcopter import Dynamics
from modgnn_rl.envs.flocking.physics.rigid_body import Bodies
from modgnn_rl.envs.flocking.physics.vectors import Components, Vector, rotation_matrix, scale, to_body_frame
from modgnn_rl.errors import InputError

__all__ = ["MAX_CLIENTS", "BulletPhysics", "import_pybullet"]

MAX_CLIENTS = 512  # per process; each takes 28 MB, and PyBullet's table holds 1,024
BASE = -1  # PyBullet's index of a body's only link
CENTRE = (0.0, 0.0, 0.0)
FLOOR, AGENT = 1, 2  # collision groups
WITHOUT_FRICTION = {"lateralFriction": 0, "spinningFriction": 0, "rollingFriction": 0, "restitution": 0}


def import_pybullet() -> Any:
    """Import PyBullet without the message that it prints to stderr when it is first imported."""
    if "pybullet" not in sys.modules:
        stderr = os.dup(2)
        try:
            with open(os.devnull, "w") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            import pybullet  # noqa: F401
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
    return sys.modules["pybullet"]


bullet = import_pybullet()


class BulletPhysics(TorchPhysics):
    """Quadcopters in PyBullet; see `modgnn_rl.envs.flocking.physics.engine.Physics`.

    Bullet differs from `TorchPhysics` only where a body turns by more than pi/4 in a substep: it shortens the turn.
    State and controllers are float64 on the CPU, whatever dtype and device are returned.

    Args:
        num_envs: flocks B, each in its own client.
        num_agents: agents N in each.
        dynamics: parameters of controller and motion.
        collisions: whether the agents of a flock collide, as spheres with the radius of the rotor arms, without
            friction or restitution. In Bullet they may penetrate each other by the distance covered in a substep, and
            then separate slowly.
        device: device of the returned state.
        dtype: its floating-point type.

    Raises:
        InputError: the process would hold more than `MAX_CLIENTS` flocks.
        RuntimeError: later, when a client has been closed or has died; the message names the flock.
    """

    def __init__(
        self,
        num_envs: int,
        num_agents: int,
        dynamics: Dynamics | None = None,
        *,
        collisions: bool = False,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(num_envs, num_agents, dynamics, dtype=torch.float64)
        self.collisions = collisions
        self._like = torch.empty((), device=device, dtype=dtype)
        self._advance = partial(advance, move=self._move)
        self._clients: list[int] = []
        self._disconnect = weakref.finalize(self, _disconnect, self._clients)  # runs on garbage collection and at exit
        for flock in range(num_envs):
            client = bullet.connect(bullet.DIRECT) if flock < MAX_CLIENTS else -1
            if not 0 <= client < MAX_CLIENTS:
                self.close()
                raise InputError(
                    f"flock {flock} of {num_envs} would be number {MAX_CLIENTS + 1} in PyBullet in this process; at "
                    f"most {MAX_CLIENTS} fit: close other environments, or spread flocks over several processes with "
                    "modgnn_rl.envs.parallel.parallel_flocks"
                )
            self._clients.append(client)
        self._bodies: list[list[int]] = [[] for _ in range(num_envs)]
        for flock in range(num_envs):
            self._build(flock)

    def reset(
        self,
        rows: Tensor,
        position: Tensor,
        velocity: Tensor,
        quaternion: Tensor | None = None,
        spin: Tensor | None = None,
    ) -> None:
        """Set the state of the flocks ``rows``, see `modgnn_rl.envs.flocking.physics.engine.Physics.reset`."""
        quaternion, spin = (None if part is None else _to_bullet(part) for part in (quaternion, spin))
        super().reset(rows.cpu(), _to_bullet(position), _to_bullet(velocity), quaternion, spin)
        for flock in rows.tolist():
            self._build(flock)

    def step(self, target_velocity: Tensor, push: Tensor | None = None) -> None:
        """Advance one control period, see `modgnn_rl.envs.flocking.physics.engine.Physics.step`."""
        self._settle()
        super().step(_to_bullet(target_velocity), push if push is None else _to_bullet(push))

    def restore(self, snapshot: Mapping[str, Tensor]) -> None:
        """Continue from a snapshot in new simulations, see `modgnn_rl.envs.flocking.physics.engine.Physics.restore`.

        Trajectories continue bit for bit, also on the floor, except those of agents in contact with each other: Bullet
        loses its record of the contacts, so these continue up to rounding (1e-6 m after a second of pushing).
        """
        super().restore(snapshot)
        for flock in range(len(self._clients)):
            self._build(flock)

    def compile(self) -> None:
        """Do nothing: Bullet is compiled code."""

    def close(self) -> None:
        """Disconnect the clients; the engine cannot be used any more."""
        self._disconnect()

    def _emit(self, components: Components) -> Tensor:
        return super()._emit(components).to(self._like)

    @contextmanager
    def _client(self, flock: int) -> Iterator[int]:
        """The client of a flock; an error that names the flock where the client no longer answers."""
        try:
            yield self._clients[flock]
        except (IndexError, bullet.error) as error:
            raise RuntimeError(
                f"PyBullet no longer moves flock {flock} ({error}): its client was closed or has died; create the "
                "environment again"
            ) from error

    def _build(self, flock: int) -> None:
        """Rebuild the world of a flock from its state, without any memory, such as that of contacts."""
        dynamics, vehicle = self.dynamics, self.dynamics.vehicle
        has_shape = self.collisions or dynamics.ground is not None
        state = (torch.stack(part, -1)[flock].tolist() for part in self.state.bodies)
        with self._client(flock) as client:
            bullet.resetSimulation(physicsClientId=client)
            bullet.setTimeStep(dynamics.dt, client)
            bullet.setGravity(0, 0, -vehicle.gravity, client)
            if dynamics.ground is not None:
                plane = bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client)
                floor = bullet.createMultiBody(0, plane, BASE, (0, 0, dynamics.ground), physicsClientId=client)
                bullet.changeDynamics(floor, BASE, **WITHOUT_FRICTION, physicsClientId=client)
                bullet.setCollisionFilterGroupMask(floor, BASE, FLOOR, AGENT, client)
            shape = -1
            if has_shape:
                shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, vehicle.arm, physicsClientId=client)
            self._bodies[flock] = []
            for position, quaternion, velocity, spin in zip(*state, strict=True):
                body = bullet.createMultiBody(vehicle.mass, shape, -1, position, quaternion, physicsClientId=client)
                bullet.changeDynamics(
                    body,
                    BASE,
                    localInertiaDiagonal=vehicle.inertia,
                    linearDamping=dynamics.linear_damping,
                    angularDamping=dynamics.angular_damping,
                    maxJointVelocity=1e9,  # without it, components of velocity and spin end at 100
                    **WITHOUT_FRICTION,
                    physicsClientId=client,
                )
                meets = (FLOOR | AGENT if self.collisions else FLOOR) if has_shape else 0
                bullet.setCollisionFilterGroupMask(body, BASE, AGENT, meets, client)
                bullet.resetBaseVelocity(body, velocity, spin, client)
                self._bodies[flock].append(body)

    def _settle(self) -> None:
        """Set all bodies to the state that was last read.

        Bullet returns attitudes that differ from its own by a rounding error; without this, a trajectory would not
        continue from its emitted state bit for bit.
        """
        state = [torch.stack(part, -1).tolist() for part in self.state.bodies]
        place, move = bullet.resetBasePositionAndOrientation, bullet.resetBaseVelocity
        for flock, bodies in enumerate(self._bodies):
            with self._client(flock) as client:
                for body, position, quaternion, *twist in zip(bodies, *(part[flock] for part in state), strict=True):
                    place(body, position, quaternion, client)
                    move(body, *twist, client)

    def _move(
        self,
        bodies: Bodies,
        thrust: Tensor,
        torque: Vector,
        dynamics: Dynamics,
        substeps: int,
        acceleration: Components | None,
    ) -> Bodies:
        """Bullet's counterpart of `modgnn_rl.envs.flocking.physics.rigid_body.step_bodies`."""
        zero = torch.zeros_like(thrust)
        if acceleration is None:
            return self._step_clients((zero, zero, thrust), torque, substeps)
        outside = scale(dynamics.vehicle.mass, acceleration)
        for _ in range(substeps):
            x, y, z = to_body_frame(rotation_matrix(bodies.quaternion), outside)
            bodies = self._step_clients((x, y, z + thrust), torque, 1)
        return bodies

    def _step_clients(self, force: Vector, torque: Vector, substeps: int) -> Bodies:
        """Step all flocks under a force, N, and a torque, N m, in the body frame, and read their state.

        PyBullet clears a wrench after each substep; its own substeps would hold the wrench in the world frame instead.
        """
        push, turn, step = bullet.applyExternalForce, bullet.applyExternalTorque, bullet.stepSimulation
        pose, twist, frame = bullet.getBasePositionAndOrientation, bullet.getBaseVelocity, bullet.LINK_FRAME
        forces, torques = torch.stack(force, -1), torch.stack(torque, -1)
        state: list[float] = []
        for flock, bodies in enumerate(self._bodies):
            wrenches = list(zip(bodies, forces[flock].tolist(), torques[flock].tolist(), strict=True))
            with self._client(flock) as client:
                for _ in range(substeps):
                    for body, body_force, body_torque in wrenches:
                        push(body, BASE, body_force, CENTRE, frame, client)
                        turn(body, BASE, body_torque, frame, client)
                    step(client)
                for body in bodies:
                    for part in (*pose(body, client), *twist(body, client)):
                        state += part
        components = torch.tensor(state, dtype=torch.float64).view(*forces.shape[:2], 13).movedim(-1, 0).contiguous()
        return Bodies(*(part.unbind(0) for part in components.split((3, 4, 3, 3))))


def _to_bullet(value: Tensor) -> Tensor:
    """A value on the CPU in float64, without gradients."""
    return value.detach().to("cpu", torch.float64)


def _disconnect(clients: list[int]) -> None:
    """Disconnect the clients that still answer, and remove them from the list."""
    while clients:
        client = clients.pop()
        if bullet.isConnected(client):
            bullet.disconnect(client)
