"""Rigid bodies against PyBullet as an independent engine, against closed forms and against conservation laws."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pybullet as pb
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pybullet_utils.bullet_client import BulletClient
from torch import Tensor

from modgnn_rl.envs import TorchPhysics
from modgnn_rl.envs.controller import velocity_controller
from modgnn_rl.envs.quadcopter import CRAZYFLIE, Quadcopter
from modgnn_rl.envs.rigid_body import Bodies, step_bodies
from modgnn_rl.envs.vectors import cross, norm, rotation_matrix, to_body_frame

PERIOD, SUBSTEPS = 1 / 48, 5
DT = PERIOD / SUBSTEPS
HOVER = CRAZYFLIE.mass * CRAZYFLIE.gravity
LOPSIDED = Quadcopter(inertia=(1.4e-5, 1.8e-5, 2.5e-5))


class State(NamedTuple):
    """Position, rotation matrix, velocity and spin of n bodies, [n, ...], in the world frame."""

    position: np.ndarray
    rotation: np.ndarray
    velocity: np.ndarray
    spin: np.ndarray


class Bullet:
    """Bodies in PyBullet, one body each, moved by a wrench that is constant in the body frame.

    Bullet differs from the equations where a body turns by more than pi/4 in a substep (188 rad/s at 240 Hz; it then
    clamps the turn) and where a component of velocity or spin passes 100 (clamped too); the flights here stay below.
    """

    def __init__(self, start: Bodies, quadcopter: Quadcopter = CRAZYFLIE) -> None:
        self.client = BulletClient(pb.DIRECT)
        self.client.setTimeStep(DT)
        self.client.setGravity(0, 0, -quadcopter.gravity)
        self.bodies = []
        position, quaternion, velocity, spin = (part.T.tolist() for part in start)
        for index in range(len(position)):
            body = self.client.createMultiBody(
                baseMass=quadcopter.mass, basePosition=position[index], baseOrientation=quaternion[index]
            )
            self.client.changeDynamics(
                body, -1, linearDamping=0, angularDamping=0, localInertiaDiagonal=quadcopter.inertia
            )
            self.client.resetBaseVelocity(body, velocity[index], spin[index])
            self.bodies.append(body)

    def state(self) -> State:
        """Where the bodies are now."""
        poses = [self.client.getBasePositionAndOrientation(body) for body in self.bodies]
        twists = [self.client.getBaseVelocity(body) for body in self.bodies]
        rotation = [np.reshape(pb.getMatrixFromQuaternion(quaternion), (3, 3)) for _, quaternion in poses]
        return State(
            np.array([position for position, _ in poses]),
            np.array(rotation),
            np.array([velocity for velocity, _ in twists]),
            np.array([spin for _, spin in twists]),
        )

    def step(self, thrust: Tensor, torque: Tensor, substeps: int) -> State:
        """Thrust [n], torque [3, n] in the body frame."""
        wrenches = list(zip(self.bodies, thrust.tolist(), torque.T.numpy(), strict=True))
        for _ in range(substeps):
            for body, force, moment in wrenches:
                position, quaternion = self.client.getBasePositionAndOrientation(body)
                rotation = np.reshape(pb.getMatrixFromQuaternion(quaternion), (3, 3))
                self.client.applyExternalForce(body, -1, rotation[:, 2] * force, position, pb.WORLD_FRAME)
                self.client.applyExternalTorque(body, -1, rotation @ moment, pb.WORLD_FRAME)
            self.client.stepSimulation()
        state = self.state()
        assert np.abs(state.velocity).max() < 99
        assert np.abs(state.spin).max() < 99
        return state


def random_bodies(count: int, *, spin: float, seed: int = 0) -> Bodies:
    """Bodies [., n] at any attitude with spins of at most ``spin`` rad/s."""
    generator = torch.Generator().manual_seed(seed)
    position, velocity, axis = (torch.randn(3, count, generator=generator, dtype=torch.float64) for _ in range(3))
    quaternion = torch.randn(4, count, generator=generator, dtype=torch.float64)
    rate = spin * torch.rand(count, generator=generator, dtype=torch.float64)
    return Bodies(position, quaternion / norm(quaternion), velocity, rate * axis / norm(axis))


def errors(bodies: Bodies, state: State) -> tuple[float, float, float, float]:
    """Largest differences in position (m), rotation, velocity (m/s), spin (rad/s)."""
    ours = State(
        bodies.position.T.numpy(),
        rotation_matrix(bodies.quaternion).movedim(-1, 0).numpy(),
        bodies.velocity.T.numpy(),
        bodies.spin.T.numpy(),
    )
    return tuple(float(np.abs(a - b).max()) for a, b in zip(ours, state, strict=True))  # type: ignore[return-value]


def energy(bodies: Bodies, quadcopter: Quadcopter) -> Tensor:
    rate = to_body_frame(rotation_matrix(bodies.quaternion), bodies.spin)
    return 0.5 * sum(moment * component**2 for moment, component in zip(quadcopter.inertia, rate, strict=True))


def angular_momentum(bodies: Bodies, quadcopter: Quadcopter) -> Tensor:
    rotation = rotation_matrix(bodies.quaternion)
    inertia = torch.tensor(quadcopter.inertia, dtype=bodies.spin.dtype).view(3, 1)
    return (rotation * (inertia * to_body_frame(rotation, bodies.spin))).sum(1)


def free(bodies: Bodies, time: float, dt: float, quadcopter: Quadcopter = CRAZYFLIE) -> Bodies:
    """Move without thrust and torque."""
    nothing = torch.zeros_like(bodies.position)
    return step_bodies(bodies, nothing[0], nothing, dt, round(time / dt), quadcopter)


# Against PyBullet


@pytest.mark.parametrize("quadcopter", [CRAZYFLIE, LOPSIDED])
def test_tumbling_bodies_agree_with_bullet(quadcopter: Quadcopter) -> None:
    start = random_bodies(12, spin=30)
    generator = torch.Generator().manual_seed(1)
    bodies, bullet = start, Bullet(start, quadcopter)
    for _ in range(96):
        thrust = 2 * HOVER * torch.rand(12, generator=generator, dtype=torch.float64)
        torque = 1e-4 * torch.randn(3, 12, generator=generator, dtype=torch.float64)
        bodies = step_bodies(bodies, thrust, torque, DT, SUBSTEPS, quadcopter)
        state = bullet.step(thrust, torque, SUBSTEPS)
    assert np.abs(state.spin).max() > 25
    position, rotation, velocity, spin = errors(bodies, state)
    assert position < 1e-12
    assert rotation < 1e-12
    assert velocity < 1e-12
    assert spin < 1e-11


def test_flights_agree_with_bullet() -> None:
    """Closed loop for 20 s: four flights from rest, four tumbling at first, targets that saturate rotors."""
    count = 8
    start = random_bodies(count, spin=20)
    calm = torch.arange(count) < count // 2
    level = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).view(4, 1)
    start = Bodies(
        start.position,
        torch.where(calm, level, start.quaternion),
        start.velocity.masked_fill(calm, 0),
        start.spin.masked_fill(calm, 0),
    )
    engines = {dtype: TorchPhysics(1, count, dtype=dtype) for dtype in (torch.float64, torch.float32)}
    for dtype, engine in engines.items():
        engine.bodies = Bodies(*(part.to(dtype).unsqueeze(1) for part in start))
    bullet, integral = Bullet(start), torch.zeros(3, count, dtype=torch.float64)
    state = bullet.state()
    generator = torch.Generator().manual_seed(2)
    worst = {torch.float64: 0.0, torch.float32: 0.0}
    speed = torch.where(torch.arange(count) % 2 == 0, 0.5, 5.0)
    for step in range(960):
        if step % 48 == 0:
            target = speed * torch.randn(3, count, generator=generator).double()
        rotation = torch.from_numpy(state.rotation).movedim(0, -1)
        velocity, spin = (torch.from_numpy(part).T for part in (state.velocity, state.spin))
        rate = to_body_frame(rotation, spin)
        thrust, torque, integral = velocity_controller(target, velocity, rotation, rate, integral, PERIOD, 1.0)
        state = bullet.step(thrust, torque, SUBSTEPS)
        for dtype, engine in engines.items():
            engine.step(target.T.unsqueeze(0).to(dtype))
            worst[dtype] = max(worst[dtype], float(np.abs(engine.position[0].numpy() - state.position).max()))
    assert worst[torch.float64] < 1e-12
    assert worst[torch.float32] < 1e-3
    assert float(norm(engines[torch.float32].bodies.quaternion).sub(1).abs().max()) < 1e-6


# Closed forms


def test_free_fall_is_the_semi_implicit_parabola() -> None:
    start = random_bodies(5, spin=0)
    steps = 480
    end = free(start, steps * DT, DT)
    gravity = torch.tensor([0.0, 0, CRAZYFLIE.gravity], dtype=torch.float64).view(3, 1)
    velocity = start.velocity - steps * DT * gravity
    position = start.position + steps * DT * start.velocity - DT**2 * gravity * steps * (steps + 1) / 2
    torch.testing.assert_close(end.velocity, velocity, rtol=0, atol=1e-12)
    torch.testing.assert_close(end.position, position, rtol=0, atol=1e-11)
    torch.testing.assert_close(end.quaternion, start.quaternion, rtol=0, atol=1e-14)


def test_free_fall_keeps_the_energy_of_the_scheme() -> None:
    """v^2 / 2 + g z - g dt v_z / 2 is what semi-implicit Euler conserves exactly."""
    start = random_bodies(5, spin=0)

    def conserved(bodies: Bodies) -> Tensor:
        height, speed = bodies.position[2], bodies.velocity
        return 0.5 * (speed**2).sum(0) + CRAZYFLIE.gravity * (height - 0.5 * DT * speed[2])

    torch.testing.assert_close(conserved(free(start, 2, DT)), conserved(start), rtol=0, atol=1e-11)


def test_hover_stays() -> None:
    start = Bodies(*(torch.zeros(size, 1, dtype=torch.float64) for size in (3, 4, 3, 3)))
    start.quaternion[3] = 1
    hover = torch.full((1,), HOVER, dtype=torch.float64)
    end = step_bodies(start, hover, torch.zeros(3, 1, dtype=torch.float64), DT, 1200)
    for before, after in zip(start, end, strict=True):
        torch.testing.assert_close(after, before, rtol=0, atol=1e-11)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_constant_torque_about_a_principal_axis(axis: int) -> None:
    """W_n = n dt tau / J, angle dt^2 (tau / J) n (n + 1) / 2."""
    start = Bodies(*(torch.zeros(size, 1, dtype=torch.float64) for size in (3, 4, 3, 3)))
    start.quaternion[3] = 1
    torque = torch.zeros(3, 1, dtype=torch.float64)
    torque[axis] = 2e-5
    steps, alpha = 240, 2e-5 / LOPSIDED.inertia[axis]
    end = step_bodies(start, torch.zeros(1, dtype=torch.float64), torque, DT, steps, LOPSIDED)
    half = DT**2 * alpha * steps * (steps + 1) / 4
    expected = torch.zeros(4, 1, dtype=torch.float64)
    expected[axis], expected[3] = math.sin(half), math.cos(half)
    assert float(end.spin[axis]) == pytest.approx(steps * DT * alpha, rel=1e-12)
    torch.testing.assert_close(end.quaternion, expected, rtol=0, atol=1e-12)


def test_thrust_pushes_along_the_body_axis_only() -> None:
    start = random_bodies(20, spin=0)
    end = step_bodies(start, torch.full((20,), HOVER, dtype=torch.float64), torch.zeros_like(start.spin), DT, 1)
    push = (end.velocity - free(start, DT, DT).velocity) / DT
    x, y, z, w = start.quaternion
    # The image of the z axis, from the double reflection q z q*.
    image = torch.stack((2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z))
    torch.testing.assert_close(push, image * CRAZYFLIE.gravity, rtol=0, atol=1e-11)


def test_torque_free_symmetric_top_precesses() -> None:
    """In the body frame w_z stays and w_x, w_y turn at (J_z - J_x) / J_x w_z; first order in dt."""
    moment, _, axial = CRAZYFLIE.inertia
    start = random_bodies(6, spin=8, seed=3)
    before = to_body_frame(rotation_matrix(start.quaternion), start.spin)
    angle = (axial - moment) / moment * before[2] * 1.0
    expected = torch.stack(
        (
            before[0] * angle.cos() - before[1] * angle.sin(),
            before[0] * angle.sin() + before[1] * angle.cos(),
            before[2],
        )
    )

    def error(dt: float) -> float:
        end = free(start, 1.0, dt)
        return float((to_body_frame(rotation_matrix(end.quaternion), end.spin) - expected).abs().max())

    assert error(1e-3) < 0.01
    assert error(1e-3) / error(5e-4) == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize("law", [energy, angular_momentum])
@pytest.mark.parametrize("quadcopter", [CRAZYFLIE, LOPSIDED])
def test_torque_free_motion_conserves(law: Callable[[Bodies, Quadcopter], Tensor], quadcopter: Quadcopter) -> None:
    """Rotational energy, and angular momentum in the world frame, up to an error of first order in dt."""
    start = random_bodies(6, spin=8, seed=3)
    before = law(start, quadcopter)

    def error(dt: float) -> float:
        after = law(free(start, 0.5, dt, quadcopter), quadcopter)
        return float((after - before).abs().max() / before.abs().max())

    assert error(1e-3) < 0.003
    assert error(1e-3) / error(5e-4) == pytest.approx(2, rel=0.2)


@given(seed=st.integers(0, 2**31), spin=st.floats(0, 150), substeps=st.integers(1, 10))
@settings(max_examples=20)
def test_quaternions_stay_unit(seed: int, spin: float, substeps: int) -> None:
    start = random_bodies(4, spin=spin, seed=seed)
    for dtype, tolerance in ((torch.float64, 1e-15), (torch.float32, 3e-7)):
        end = free(Bodies(*(part.to(dtype) for part in start)), substeps * DT, DT)
        assert float(norm(end.quaternion).sub(1).abs().max()) <= tolerance


def test_vector_algebra_equals_torch() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(3, 4, 5, generator=generator, dtype=torch.float64) for _ in range(2))
    rotation = rotation_matrix(random_bodies(20, spin=0).quaternion.unflatten(1, (4, 5)))
    torch.testing.assert_close(cross(a, b), torch.linalg.cross(a, b, dim=0))
    torch.testing.assert_close(norm(a), torch.linalg.vector_norm(a, dim=0))
    torch.testing.assert_close(to_body_frame(rotation, a), torch.einsum("ij...,i...->j...", rotation, a))
    unit = torch.einsum("ij...,kj...->ik...", rotation, rotation)
    torch.testing.assert_close(unit, torch.eye(3).double().view(3, 3, 1, 1).expand_as(unit), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(rotation.movedim((0, 1), (-2, -1))), torch.ones(4, 5).double())


# The engine


def random_targets(*shape: int, seed: int = 0, speed: float = 1.0) -> Tensor:
    return speed * torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_flocks_and_agents_do_not_feel_each_other() -> None:
    together, alone = TorchPhysics(3, 4, dtype=torch.float64), TorchPhysics(1, 1, dtype=torch.float64)
    position = random_targets(3, 4)
    together.reset(torch.arange(3), position, torch.zeros_like(position))
    alone.reset(torch.arange(1), position[1:2, 2:3], torch.zeros(1, 1, 3, dtype=torch.float64))
    for step in range(200):
        target = random_targets(3, 4, seed=step // 20, speed=3)
        together.step(target)
        alone.step(target[1:2, 2:3])
    torch.testing.assert_close(together.position[1, 2], alone.position[0, 0], rtol=0, atol=1e-12)
    torch.testing.assert_close(together.velocity[1, 2], alone.velocity[0, 0], rtol=0, atol=1e-12)


def test_reset_puts_flocks_level_and_leaves_the_others() -> None:
    engine = TorchPhysics(4, 2, dtype=torch.float64)
    for step in range(20):
        engine.step(random_targets(4, 2, seed=step, speed=3))
    before, integral = engine.bodies, engine.integral
    position, velocity = random_targets(2, 2, seed=100), random_targets(2, 2, seed=101)
    engine.reset(torch.tensor([2, 0]), position, velocity)
    assert torch.equal(engine.position[[2, 0]], position)
    assert torch.equal(engine.velocity[[2, 0]], velocity)
    level = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64).view(4, 1, 1)
    assert torch.equal(engine.bodies.quaternion[:, [0, 2]], level.expand(4, 2, 2))
    assert not engine.bodies.spin[:, [0, 2]].any()
    assert not engine.integral[:, [0, 2]].any()
    assert torch.equal(engine.integral[:, [1, 3]], integral[:, [1, 3]])
    assert integral.all()
    for old, new in zip(before, engine.bodies, strict=True):
        assert torch.equal(old[:, [1, 3]], new[:, [1, 3]])


def test_substeps_and_frequency_set_the_time_step() -> None:
    """With thrust and gravity cut to one control period, a fall from rest shows dt and the number of substeps."""
    engine = TorchPhysics(1, 1, control_frequency=10.0, substeps=4, dtype=torch.float64)
    velocity = torch.tensor([[[1.0, 0, 0]]], dtype=torch.float64)
    engine.reset(torch.arange(1), torch.zeros_like(velocity), velocity)
    engine.step(velocity)  # the target is met already: it coasts, level
    torch.testing.assert_close(engine.position, 0.1 * velocity, rtol=0, atol=1e-12)
    engine.step(torch.tensor([[[1.0, 0, 1.0]]], dtype=torch.float64))
    integral = 0.1 * 0.2
    acceleration = 1.0 * (1 + integral)
    assert float(engine.velocity[0, 0, 2]) == pytest.approx(0.1 * acceleration, abs=1e-9)
    assert float(engine.position[0, 0, 2]) == pytest.approx(0.025**2 * acceleration * 4 * 5 / 2, abs=1e-9)
