"""Rigid bodies against PyBullet as an independent engine, closed forms and conservation laws."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pybullet as pb
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pybullet_utils.bullet_client import BulletClient
from torch import Tensor

from modgnn_rl.envs import TorchPhysics
from modgnn_rl.envs.flocking.physics.quadcopter import CRAZYFLIE, Dynamics, Quadcopter
from modgnn_rl.envs.flocking.physics.rigid_body import Bodies, rotor_drag, step_bodies
from modgnn_rl.envs.flocking.physics.vectors import (
    Components,
    cross,
    norm,
    rotation_matrix,
    to_body_frame,
    to_world_frame,
)

DT = Dynamics().dt
HOVER = CRAZYFLIE.mass * CRAZYFLIE.gravity
LOPSIDED = Quadcopter(inertia=(1.4e-5, 1.8e-5, 2.5e-5))


def stack(components: Components) -> Tensor:
    return torch.stack(tuple(components))


def make_bodies(*parts: Tensor) -> Bodies:
    """Bodies of position, quaternion, velocity and spin [., n]."""
    return Bodies(*(tuple(part) for part in parts))


def random_bodies(count: int, *, spin: float, seed: int = 0) -> Bodies:
    """Bodies at any attitude with spins of at most ``spin`` rad/s."""
    generator = torch.Generator().manual_seed(seed)
    position, velocity, axis = (torch.randn(3, count, generator=generator, dtype=torch.float64) for _ in range(3))
    quaternion = torch.randn(4, count, generator=generator, dtype=torch.float64)
    rate = spin * torch.rand(count, generator=generator, dtype=torch.float64)
    return make_bodies(position, quaternion / norm(quaternion), velocity, rate * axis / norm(axis))


def level_body() -> Bodies:
    """One body at rest at the origin."""
    zero = torch.zeros(3, 1, dtype=torch.float64)
    return make_bodies(zero, torch.tensor([[0.0], [0], [0], [1]], dtype=torch.float64), zero, zero)


def energy(bodies: Bodies, quadcopter: Quadcopter) -> Tensor:
    rate = to_body_frame(rotation_matrix(bodies.quaternion), bodies.spin)
    return 0.5 * stack(moment * part**2 for moment, part in zip(quadcopter.inertia, rate, strict=True)).sum(0)


def angular_momentum(bodies: Bodies, quadcopter: Quadcopter) -> Tensor:
    rotation = rotation_matrix(bodies.quaternion)
    rate = to_body_frame(rotation, bodies.spin)
    return stack(to_world_frame(rotation, [j * w for j, w in zip(quadcopter.inertia, rate, strict=True)]))


def free(bodies: Bodies, time: float, dt: float, quadcopter: Quadcopter = CRAZYFLIE) -> Bodies:
    """Move without thrust or torque."""
    zero = torch.zeros_like(bodies.position[0])
    dynamics = Dynamics(period=dt, substeps=1, vehicle=quadcopter)
    return step_bodies(bodies, zero, (zero, zero, zero), dynamics, round(time / dt))


# Against PyBullet


@pytest.mark.parametrize("quadcopter", [CRAZYFLIE, LOPSIDED])
def test_tumbling_bodies_agree_with_bullet(quadcopter: Quadcopter) -> None:
    """With given wrenches in the world frame; for controlled trajectories see test_bullet."""
    client = BulletClient(pb.DIRECT)
    client.setTimeStep(DT)
    client.setGravity(0, 0, -quadcopter.gravity)
    bodies = random_bodies(12, spin=30)
    numbers = []
    for position, quaternion, velocity, spin in zip(*(stack(part).T.tolist() for part in bodies), strict=True):
        numbers.append(client.createMultiBody(quadcopter.mass, basePosition=position, baseOrientation=quaternion))
        client.changeDynamics(
            numbers[-1], -1, linearDamping=0, angularDamping=0, localInertiaDiagonal=quadcopter.inertia
        )
        client.resetBaseVelocity(numbers[-1], velocity, spin)
    generator = torch.Generator().manual_seed(1)
    dynamics = Dynamics(vehicle=quadcopter)
    for _ in range(96):
        thrust = 2 * HOVER * torch.rand(12, generator=generator, dtype=torch.float64)
        torque = 1e-4 * torch.randn(3, 12, generator=generator, dtype=torch.float64)
        bodies = step_bodies(bodies, thrust, torque, dynamics, dynamics.substeps)
        for _ in range(dynamics.substeps):
            for number, force, moment in zip(numbers, thrust.tolist(), torque.T.numpy(), strict=True):
                position, quaternion = client.getBasePositionAndOrientation(number)
                rotation = np.reshape(pb.getMatrixFromQuaternion(quaternion), (3, 3))
                client.applyExternalForce(number, -1, rotation[:, 2] * force, position, pb.WORLD_FRAME)
                client.applyExternalTorque(number, -1, rotation @ moment, pb.WORLD_FRAME)
            client.stepSimulation()
    poses = [client.getBasePositionAndOrientation(number) for number in numbers]
    twists = [client.getBaseVelocity(number) for number in numbers]
    assert np.abs([spin for _, spin in twists]).max() > 25
    np.testing.assert_allclose(stack(bodies.position).T, [position for position, _ in poses], rtol=0, atol=1e-12)
    np.testing.assert_allclose(stack(bodies.velocity).T, [velocity for velocity, _ in twists], rtol=0, atol=1e-12)
    np.testing.assert_allclose(stack(bodies.spin).T, [spin for _, spin in twists], rtol=0, atol=1e-11)
    ours = stack(stack(row) for row in rotation_matrix(bodies.quaternion)).movedim(-1, 0)
    theirs = [np.reshape(pb.getMatrixFromQuaternion(quaternion), (3, 3)) for _, quaternion in poses]
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


# Closed forms


def test_free_fall_is_the_semi_implicit_parabola() -> None:
    start = random_bodies(5, spin=0)
    steps = 480
    end = free(start, steps * DT, DT)
    gravity = torch.tensor([0.0, 0, CRAZYFLIE.gravity], dtype=torch.float64).view(3, 1)
    velocity = stack(start.velocity) - steps * DT * gravity
    position = stack(start.position) + steps * DT * stack(start.velocity) - DT**2 * gravity * steps * (steps + 1) / 2
    torch.testing.assert_close(stack(end.velocity), velocity, rtol=0, atol=1e-12)
    torch.testing.assert_close(stack(end.position), position, rtol=0, atol=1e-11)
    torch.testing.assert_close(end.quaternion, start.quaternion, rtol=0, atol=1e-14)


def test_free_fall_keeps_the_energy_of_the_scheme() -> None:
    """v^2 / 2 + g z - g dt v_z / 2 is what semi-implicit Euler conserves exactly."""
    start = random_bodies(5, spin=0)

    def conserved(bodies: Bodies) -> Tensor:
        height, speed = bodies.position[2], stack(bodies.velocity)
        return 0.5 * (speed**2).sum(0) + CRAZYFLIE.gravity * (height - 0.5 * DT * speed[2])

    torch.testing.assert_close(conserved(free(start, 2, DT)), conserved(start), rtol=0, atol=1e-11)


def test_hover_is_a_fixed_point() -> None:
    start = level_body()
    end = step_bodies(start, torch.full((1,), HOVER, dtype=torch.float64), start.spin, Dynamics(), 1200)
    for before, after in zip(start, end, strict=True):
        torch.testing.assert_close(after, before, rtol=0, atol=1e-11)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_constant_torque_about_a_principal_axis(axis: int) -> None:
    """W_n = n dt tau / J, angle dt^2 (tau / J) n (n + 1) / 2."""
    torque = torch.zeros(3, 1, dtype=torch.float64)
    torque[axis] = 2e-5
    steps, alpha = 240, 2e-5 / LOPSIDED.inertia[axis]
    end = step_bodies(level_body(), torque[0] * 0, torque, Dynamics(vehicle=LOPSIDED), steps)
    half = DT**2 * alpha * steps * (steps + 1) / 4
    expected = torch.zeros(4, 1, dtype=torch.float64)
    expected[axis], expected[3] = math.sin(half), math.cos(half)
    assert float(end.spin[axis]) == pytest.approx(steps * DT * alpha, rel=1e-12)
    torch.testing.assert_close(stack(end.quaternion), expected, rtol=0, atol=1e-12)


def test_thrust_pushes_along_the_body_axis_only() -> None:
    start = random_bodies(20, spin=0)
    end = step_bodies(start, torch.full((20,), HOVER, dtype=torch.float64), start.spin, Dynamics(), 1)
    push = (stack(end.velocity) - stack(free(start, DT, DT).velocity)) / DT
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
        return float((stack(to_body_frame(rotation_matrix(end.quaternion), end.spin)) - expected).abs().max())

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
        end = free(make_bodies(*(stack(part).to(dtype) for part in start)), substeps * DT, DT)
        assert float(norm(end.quaternion).sub(1).abs().max()) <= tolerance


def test_vector_algebra_equals_torch() -> None:
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(3, 4, 5, generator=generator, dtype=torch.float64) for _ in range(2))
    rows = rotation_matrix(stack(random_bodies(20, spin=0).quaternion).unflatten(1, (4, 5)))
    rotation = stack(stack(row) for row in rows)
    torch.testing.assert_close(stack(cross(a, b)), torch.linalg.cross(a, b, dim=0))
    torch.testing.assert_close(norm(a), torch.linalg.vector_norm(a, dim=0))
    torch.testing.assert_close(stack(to_body_frame(rows, a)), torch.einsum("ij...,i...->j...", rotation, a))
    torch.testing.assert_close(stack(to_world_frame(rows, a)), torch.einsum("ij...,j...->i...", rotation, a))
    unit = torch.einsum("ij...,kj...->ik...", rotation, rotation)
    torch.testing.assert_close(unit, torch.eye(3).double().view(3, 3, 1, 1).expand_as(unit), rtol=0, atol=1e-14)
    torch.testing.assert_close(torch.linalg.det(rotation.movedim((0, 1), (-2, -1))), torch.ones(4, 5).double())


# The engine


def random_targets(*shape: int, seed: int = 0, speed: float = 1.0) -> Tensor:
    return speed * torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_flocks_and_agents_do_not_influence_each_other() -> None:
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


def test_reset_levels_some_flocks_and_leaves_the_others() -> None:
    engine = TorchPhysics(4, 2, dtype=torch.float64)
    for step in range(20):
        engine.step(random_targets(4, 2, seed=step, speed=3))
    before = engine.state
    position, velocity = random_targets(2, 2, seed=100), random_targets(2, 2, seed=101)
    engine.reset(torch.tensor([2, 0]), position, velocity)
    assert torch.equal(engine.position[[2, 0]], position)
    assert torch.equal(engine.velocity[[2, 0]], velocity)
    level = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)
    assert torch.equal(engine.quaternion[[0, 2]], level.expand(2, 2, 4))
    assert not engine.spin[[0, 2]].any()
    assert not stack(engine.state.integral)[:, [0, 2]].any()
    assert stack(before.integral).all()
    for old, new in zip((*before.bodies, before.integral), (*engine.state.bodies, engine.state.integral), strict=True):
        assert torch.equal(stack(old)[:, [1, 3]], stack(new)[:, [1, 3]])


def test_substeps_and_frequency_set_the_time_step() -> None:
    """A fall from rest over one control period shows dt and the number of substeps."""
    engine = TorchPhysics(1, 1, Dynamics(period=0.1, substeps=4), dtype=torch.float64)
    velocity = torch.tensor([[[1.0, 0, 0]]], dtype=torch.float64)
    engine.reset(torch.arange(1), torch.zeros_like(velocity), velocity)
    engine.step(velocity)  # the target is met already: it coasts, level
    torch.testing.assert_close(engine.position, 0.1 * velocity, rtol=0, atol=1e-12)
    engine.step(torch.tensor([[[1.0, 0, 1.0]]], dtype=torch.float64))
    integral = 0.1 * 0.2
    acceleration = 1.0 * (1 + integral)
    assert float(engine.velocity[0, 0, 2]) == pytest.approx(0.1 * acceleration, abs=1e-9)
    assert float(engine.position[0, 0, 2]) == pytest.approx(0.025**2 * acceleration * 4 * 5 / 2, abs=1e-9)


# Options


def test_damping_equals_its_equation() -> None:
    """One step without thrust and torque: v (1 - d (1 + |v|) dt) - g dt; the same in the body frame for the rates."""
    start = random_bodies(6, spin=20)
    dynamics = Dynamics(linear_damping=0.3, angular_damping=0.7)
    zero = torch.zeros(6, dtype=torch.float64)
    end = step_bodies(start, zero, (zero, zero, zero), dynamics, 1)
    bare = step_bodies(start, zero, (zero, zero, zero), Dynamics(), 1)
    for name, damping in (("velocity", 0.3), ("spin", 0.7)):
        before, after, without = (stack(getattr(bodies, name)) for bodies in (start, end, bare))
        expected = without - DT * damping * (1 + before.norm(dim=0)) * before
        torch.testing.assert_close(after, expected, rtol=0, atol=1e-13)


def test_rotor_drag_equals_its_equation() -> None:
    """Four rotors at hover, body velocity v: the force is -c_i v_i 4 omega along the body's axes."""
    bodies = random_bodies(6, spin=0)
    hover = torch.full((6,), CRAZYFLIE.hover_thrust, dtype=torch.float64)
    speed = 4 * math.sqrt(CRAZYFLIE.hover_thrust / CRAZYFLIE.thrust_coefficient)
    rotation = stack(stack(row) for row in rotation_matrix(bodies.quaternion)).movedim(-1, 0)
    coefficients = torch.tensor(CRAZYFLIE.drag_coefficient, dtype=torch.float64)
    expected = (
        -2.0
        * speed
        / CRAZYFLIE.mass
        * rotation
        @ coefficients.diag()
        @ rotation.mT
        @ stack(bodies.velocity).T[..., None]
    )
    drag = rotor_drag(bodies, (hover,) * 4, Dynamics(drag=2.0))
    torch.testing.assert_close(stack(drag).T, expected.squeeze(-1), rtol=1e-12, atol=0)


def test_rotors_lag_exponentially() -> None:
    """A climb from hover: after k substeps the thrust is F + (m g - F) exp(-k dt / tau)."""
    dynamics = Dynamics(motor_lag=0.03)
    engine = TorchPhysics(1, 1, dynamics, dtype=torch.float64)
    target = torch.tensor([[[0.0, 0, 1.0]]], dtype=torch.float64)
    engine.step(target)
    wanted = 1 + 0.2 * dynamics.period  # acceleration, m/s^2: k_p (e + 0.2 I)
    shares = [1 - math.exp(-k * dynamics.dt / 0.03) for k in range(1, dynamics.substeps + 1)]
    assert float(engine.velocity[0, 0, 2]) == pytest.approx(dynamics.dt * wanted * sum(shares), rel=1e-12)


@pytest.mark.parametrize("changes", [{"motor_lag": 1e-9}, {"drag": 1e-12}, {"ground": -1e3}])
def test_neutral_options_change_nothing(changes: dict[str, Any]) -> None:
    plain, other = (TorchPhysics(1, 5, dynamics, dtype=torch.float64) for dynamics in (Dynamics(), Dynamics(**changes)))
    for step in range(96):
        for engine in (plain, other):
            engine.step(random_targets(1, 5, seed=step // 24, speed=3))
    torch.testing.assert_close(plain.position, other.position, rtol=0, atol=1e-9)


def test_push_is_an_acceleration() -> None:
    """A push along z that balances gravity keeps an unpowered body in place."""
    engine = TorchPhysics(2, 3, Dynamics(vehicle=Quadcopter(thrust_to_weight=0.0)), dtype=torch.float64)
    push = torch.tensor([0.5, 0, CRAZYFLIE.gravity], dtype=torch.float64)
    for _ in range(48):
        engine.step(torch.zeros(2, 3, 3, dtype=torch.float64), push.expand(2, 1, 3))
    expected = torch.tensor([0.5, 0, 0], dtype=torch.float64).expand(2, 3, 3)
    torch.testing.assert_close(engine.velocity, expected, rtol=0, atol=1e-12)
