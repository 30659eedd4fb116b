"""The velocity controller against its equations in matrix form, its symmetries, and the limits of rotors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from modgnn_rl.envs import TorchPhysics
from modgnn_rl.envs.flocking.physics.controller import rotor_limits, velocity_controller
from modgnn_rl.envs.flocking.physics.quadcopter import CRAZYFLIE
from modgnn_rl.envs.flocking.physics.vectors import rotation_matrix

GRAVITY, MASS = CRAZYFLIE.gravity, CRAZYFLIE.mass
INERTIA = np.diag(CRAZYFLIE.inertia)
MAX_ROTOR = 2.25 * MASS * GRAVITY / 4
# Rotors at 45 degrees on arms of 39.7 mm; neighbours spin in opposite senses.
ROTORS = 0.0397 * np.array([(np.cos(angle), np.sin(angle)) for angle in np.deg2rad([45, 135, 225, 315])])
DRAG = 7.94e-12 / 3.16e-10
# (thrust, torque) = ALLOCATION @ rotor thrusts; torque = r x F plus the drag torque of the rotor.
ALLOCATION = np.stack([np.ones(4), ROTORS[:, 1], -ROTORS[:, 0], DRAG * np.array([-1, 1, -1, 1])])


def saturate(wrench: np.ndarray) -> np.ndarray:
    """The wrench [4, ...] of clipped rotors."""
    return ALLOCATION @ np.clip(np.linalg.solve(ALLOCATION, wrench), 0, MAX_ROTOR)


def one_controller(u, v, rotation, rate, integral, dt, gain):
    """The equations of the controller for one vehicle: wrench (4,) and integral (3,)."""
    error = u - v
    integral = np.clip(integral + error * dt, -2, 2)
    a = np.clip(gain * error + 0.2 * gain * integral, [-6, -6, -5], [6, 6, 6])
    force = MASS * (a + np.array([0, 0, GRAVITY]))
    z = force / np.linalg.norm(force)
    y = np.cross(z, [1, 0, 0])
    y /= np.linalg.norm(y)
    desired = np.column_stack([np.cross(y, z), y, z])
    skew = 0.5 * (desired.T @ rotation - rotation.T @ desired)
    attitude_error = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    torque = INERTIA @ (-150 * attitude_error - 22 * rate)
    return saturate(np.array([force @ rotation[:, 2], *torque])), integral


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@given(
    seed=st.integers(0, 2**31),
    speed=st.sampled_from([0.1, 1.0, 30.0]),
    rate=st.sampled_from([0.0, 0.1, 5.0]),
    gain=st.floats(0.1, 5),
)
@settings(max_examples=40)
def test_controller_equals_its_equations(seed: int, speed: float, rate: float, gain: float) -> None:
    target, velocity, rates, integral = random(4, 3, 5, seed=seed).unbind(0)
    target, rates = speed * target, rate * rates
    quaternion = random(4, 5, seed=seed + 1)
    rotation = rotation_matrix(quaternion / quaternion.norm(dim=0))
    wanted_thrust, wanted_torque, new_integral = velocity_controller(
        target, velocity, rotation, rates, integral, 0.1, gain
    )
    thrust, torque = rotor_limits(wanted_thrust, wanted_torque)
    matrix = torch.stack([torch.stack(row) for row in rotation])
    for i in range(5):
        u, v, r, w, old = (x[..., i].numpy() for x in (target, velocity, matrix, rates, integral))
        wrench, expected = one_controller(u, v, r, w, old, dt=0.1, gain=gain)
        np.testing.assert_allclose([thrust[i], *(part[i] for part in torque)], wrench, rtol=0, atol=1e-13)
        np.testing.assert_allclose([part[i] for part in new_integral], expected, rtol=0, atol=1e-15)


def test_hover_is_a_fixed_point() -> None:
    zero = torch.zeros(3, 1, dtype=torch.float64)
    level = rotation_matrix(torch.tensor([[0.0], [0], [0], [1]], dtype=torch.float64))
    thrust, torque, integral = velocity_controller(zero, zero, level, zero, zero, 1 / 48, 1.0)
    assert float(thrust) == pytest.approx(MASS * GRAVITY, rel=1e-12)
    assert float(torch.stack(torque).abs().max()) < 1e-18
    assert not torch.stack(integral).any()


def test_constant_target_velocity_is_reached() -> None:
    """The slow pole of the loop decays with 0.28 / s; the vertical one is linear: s^2 + s + 0.2 = 0."""
    engine = TorchPhysics(1, 20, dtype=torch.float64)
    target = 0.8 * random(1, 20, 3)
    for _ in range(48 * 30):
        engine.step(target)
    assert float((engine.velocity - target).abs().max()) < 1e-3
    assert float(engine.spin.abs().max()) < 1e-3


def test_trajectories_commute_with_mirrors() -> None:
    """A desired yaw of 0 fixes the x axis, so mirrored targets give mirrored trajectories, and so do half turns."""
    signs = torch.tensor([[1.0, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]], dtype=torch.float64).unsqueeze(1)
    engine = TorchPhysics(4, 6, dtype=torch.float64)
    for step in range(240):
        engine.step(signs * 3 * random(1, 6, 3, seed=step // 24))
    for value in (engine.position, engine.velocity):
        torch.testing.assert_close(signs * value, value[:1].expand(4, 6, 3), rtol=0, atol=1e-12)


def test_quarter_turns_hold_along_the_axes_and_nearly_elsewhere() -> None:
    """Yaw 0 singles out x, so a quarter turn is a symmetry only for motion that needs no yaw."""
    engine = TorchPhysics(2, 4, dtype=torch.float64)
    target = torch.tensor([[1.0, 0, 0], [0, 1, 0.5], [-2, 0, 0], [0.6, 0.4, 0]], dtype=torch.float64)
    for _ in range(240):
        engine.step(torch.stack((target, turn(target))))
    position, turned = engine.position
    difference = (turned - turn(position)).norm(dim=-1)
    assert float(difference[:3].max()) < 1e-12
    assert 1e-9 < float(difference[3]) < 1e-3


def turn(vector: Tensor) -> Tensor:
    """A quarter turn about z."""
    x, y, z = vector.unbind(-1)
    return torch.stack((-y, x, z), -1)


# Rotors

rotor_thrusts = st.lists(st.floats(0, MAX_ROTOR), min_size=4, max_size=4)
wrenches = st.tuples(st.floats(-1, 2), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02), st.floats(-0.005, 0.005))


def limit(wrench: np.ndarray) -> np.ndarray:
    thrust, torque = rotor_limits(torch.tensor(wrench[0]), torch.tensor(wrench[1:]))
    return np.array([thrust, *torque])


@given(rotor_thrusts)
def test_attainable_wrenches_are_unchanged(rotors: list[float]) -> None:
    wrench = ALLOCATION @ rotors
    np.testing.assert_allclose(limit(wrench), wrench, rtol=0, atol=1e-15)


@given(wrenches)
def test_limits_are_those_of_single_rotors(wrench: tuple[float, ...]) -> None:
    limited = limit(np.array(wrench))
    np.testing.assert_allclose(limited, saturate(np.array(wrench)), rtol=0, atol=1e-14)
    rotors = np.linalg.solve(ALLOCATION, limited)
    assert rotors.min() > -1e-14
    assert rotors.max() < MAX_ROTOR + 1e-14
    np.testing.assert_allclose(limit(limited), limited, rtol=0, atol=1e-14)


@given(wrenches)
def test_limits_have_the_symmetry_of_the_frame(wrench: tuple[float, ...]) -> None:
    """A quarter turn swaps the rotors' directions of rotation, as a mirror does; a half turn does not."""
    thrust, roll, pitch, yaw = wrench
    limited, *torque = limit(np.array(wrench))
    a, b, c = torque
    for other, expected in (
        ((thrust, -roll, -pitch, yaw), (limited, -a, -b, c)),
        ((thrust, -roll, pitch, -yaw), (limited, -a, b, -c)),
        ((thrust, -pitch, roll, -yaw), (limited, -b, a, -c)),
    ):
        np.testing.assert_allclose(limit(np.array(other)), expected, rtol=0, atol=1e-15)


def test_thrust_lies_between_zero_and_the_thrust_to_weight_ratio() -> None:
    assert limit(np.array([-1.0, 0, 0, 0])).tolist() == [0, 0, 0, 0]
    np.testing.assert_allclose(limit(np.array([99.0, 0, 0, 0])), [2.25 * MASS * GRAVITY, 0, 0, 0], atol=1e-15)
