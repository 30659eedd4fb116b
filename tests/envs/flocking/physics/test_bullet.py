"""PyBullet against torch physics; laws that both satisfy; collisions, resets, and the lifetime of clients."""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from modgnn_rl.envs.flocking.physics import bullet as module
from modgnn_rl.envs.flocking.physics.bullet import BulletPhysics, bullet
from modgnn_rl.envs.flocking.physics.engine import Physics, TorchPhysics
from modgnn_rl.envs.flocking.physics.quadcopter import CRAZYFLIE, Dynamics, Quadcopter
from modgnn_rl.envs.flocking.physics.vectors import rotation_matrix
from modgnn_rl.errors import InputError

RADIUS, GRAVITY = CRAZYFLIE.arm, CRAZYFLIE.gravity
POWERLESS = Quadcopter(thrust_to_weight=0.0)  # its rotors give nothing, so that bodies fall freely
ENGINES = [TorchPhysics, BulletPhysics]
Engine = type[TorchPhysics]

OPTIONS = {
    "none": {},
    "damping": {"linear_damping": 0.04, "angular_damping": 0.04},
    "drag": {"drag": 1.0},
    "motor lag": {"motor_lag": 0.05},
    "ground": {"ground": 0.0},
    "all": {"linear_damping": 0.3, "angular_damping": 0.5, "drag": 1.0, "motor_lag": 0.05, "ground": -1.0},
}


@pytest.fixture(autouse=True)
def _collect() -> Iterator[None]:
    """Free the clients of other tests' engines."""
    yield
    gc.collect()


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def zeros(*shape: int) -> Tensor:
    return torch.zeros(*shape, dtype=torch.float64)


def random_start(flocks: int, agents: int, *, spin: float, seed: int = 0) -> list[Tensor]:
    """Position, velocity, attitude and spins of at most ``spin`` rad/s; every other agent level and at rest."""
    position, velocity, axis = randn(3, flocks, agents, 3, seed=seed).unbind(0)
    quaternion = randn(flocks, agents, 4, seed=seed + 1)
    rate = spin * torch.rand(flocks, agents, 1, generator=torch.Generator().manual_seed(seed)).double()
    calm = (torch.arange(agents) % 2 == 0).unsqueeze(-1)
    level = torch.tensor([0.0, 0, 0, 1], dtype=torch.float64)
    return [
        3 * position.abs() + 0.1,
        velocity.masked_fill(calm, 0.0),
        torch.where(calm, level, quaternion / quaternion.norm(dim=-1, keepdim=True)),
        (rate * axis / axis.norm(dim=-1, keepdim=True)).masked_fill(calm, 0.0),
    ]


def compare(options: dict[str, Any], *, seconds: int, wind: float = 0.0, seed: int = 1) -> dict[torch.dtype, float]:
    """Largest distance of agents in torch from those in PyBullet, m, while targets change every second.

    It depends on the start by what tumbling makes of a rounding error: from seed 0, two rollouts in torch that start
    one rounding error apart are 1e-12 m apart after 20 s, as are PyBullet's and torch's.
    """
    flocks, agents = 2, 4
    dynamics = Dynamics(**options)
    theirs = BulletPhysics(flocks, agents, dynamics, dtype=torch.float64)
    ours = {dtype: TorchPhysics(flocks, agents, dynamics, dtype=dtype) for dtype in (torch.float64, torch.float32)}
    start = random_start(flocks, agents, spin=20, seed=seed)
    for engine, dtype in ((theirs, torch.float64), *((engine, dtype) for dtype, engine in ours.items())):
        engine.reset(torch.arange(flocks), *(part.to(dtype) for part in start))
    speed = torch.tensor([0.5, 0.5, 5.0, 5.0]).view(4, 1)  # the last two saturate the rotors
    sink = torch.tensor([0.0, 0.0, 0.6 if dynamics.ground is not None else 0.0])
    worst = dict.fromkeys(ours, 0.0)
    for step in range(48 * seconds):
        target = (speed * randn(flocks, agents, 3, seed=1000 * seed + step // 48) - sink).float()
        push = wind * randn(flocks, 1, 3, seed=step // 12).float() if wind else None
        theirs.step(target, push)
        for dtype, engine in ours.items():
            engine.step(target.to(dtype), None if push is None else push.to(dtype))
            worst[dtype] = max(worst[dtype], float((engine.position - theirs.position).abs().max()))
    for name in ("velocity", "spin"):
        difference = getattr(ours[torch.float64], name) - getattr(theirs, name)
        assert float(difference.abs().max()) < 1e-11
    matrices = [
        torch.stack([torch.stack(row) for row in rotation_matrix(engine.quaternion.unbind(-1))])
        for engine in (ours[torch.float64], theirs)
    ]
    torch.testing.assert_close(*matrices, rtol=0, atol=1e-11)
    if dynamics.ground is not None:
        assert float((theirs.position[..., 2] - dynamics.ground).min()) < RADIUS  # somebody has landed
    return worst


# The same rollouts


@pytest.mark.parametrize("name", ["none", "ground", "all"])
def test_trajectories_agree_with_torch(name: str) -> None:
    worst = compare(OPTIONS[name], seconds=3, wind=0.5 if name == "all" else 0.0)
    assert worst[torch.float64] < 1e-12
    assert worst[torch.float32] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
@pytest.mark.parametrize("name", OPTIONS)
def test_long_trajectories_agree_with_torch(name: str, seed: int) -> None:
    worst = compare(OPTIONS[name], seconds=20, wind=0.5 if name == "all" else 0.0, seed=seed)
    assert worst[torch.float64] < 1e-12
    assert worst[torch.float32] < 1e-3


def test_state_has_the_requested_type_and_the_given_initial_value() -> None:
    start = random_start(2, 3, spin=5)
    for dtype in (torch.float32, torch.float64):
        engine = BulletPhysics(2, 3, dtype=dtype)
        engine.reset(torch.arange(2), *(part.to(dtype) for part in start))
        state = (engine.position, engine.velocity, engine.quaternion, engine.spin)
        for part, expected in zip(state, start, strict=True):
            assert part.dtype == dtype
            assert part.is_contiguous()
            torch.testing.assert_close(part, expected.to(dtype), rtol=0, atol=torch.finfo(dtype).eps)


# Laws, for both engines


@pytest.mark.parametrize("engine_type", ENGINES)
def test_free_fall(engine_type: Engine) -> None:
    """The parabola of the semi-implicit scheme, also beyond 100 m/s, Bullet's default limit."""
    engine = engine_type(1, 1, Dynamics(vehicle=POWERLESS), dtype=torch.float64)
    start, steps = random_start(1, 1, spin=0), 12 * 240
    engine.reset(torch.arange(1), *start)
    for _ in range(12 * 48):
        engine.step(zeros(1, 1, 3))
    dt, gravity = Dynamics().dt, torch.tensor([0, 0, GRAVITY], dtype=torch.float64)
    torch.testing.assert_close(engine.velocity, start[1] - steps * dt * gravity, rtol=0, atol=1e-10)
    fallen = steps * dt * start[1] - dt**2 * gravity * steps * (steps + 1) / 2
    torch.testing.assert_close(engine.position, start[0] + fallen, rtol=0, atol=1e-9)


@pytest.mark.parametrize("engine_type", ENGINES)
def test_hover_stays(engine_type: Engine) -> None:
    engine = engine_type(1, 2, dtype=torch.float64)
    start = random_start(1, 1, spin=0)[0].expand(1, 2, 3)
    engine.reset(torch.arange(1), start, zeros(1, 2, 3))
    for _ in range(480):
        engine.step(zeros(1, 2, 3))
    torch.testing.assert_close(engine.position, start, rtol=0, atol=1e-11)
    assert float(engine.spin.abs().max()) < 1e-11


@pytest.mark.parametrize("engine_type", ENGINES)
def test_tumbling_keeps_energy_and_angular_momentum(engine_type: Engine) -> None:
    """Without a wrench, up to an error of first order in the time step."""
    start = random_start(1, 6, spin=8)

    def laws(engine: Physics) -> tuple[Tensor, Tensor]:
        rotation = torch.stack([torch.stack(row, -1) for row in rotation_matrix(engine.quaternion.unbind(-1))], -2)
        rate = (rotation.mT @ engine.spin.unsqueeze(-1)).squeeze(-1)
        momentum = torch.tensor(CRAZYFLIE.inertia, dtype=torch.float64) * rate
        return (momentum * rate).sum(-1), (rotation @ momentum.unsqueeze(-1)).squeeze(-1)

    def error(substeps: int) -> list[float]:
        engine = engine_type(1, 6, Dynamics(substeps=substeps, vehicle=POWERLESS), dtype=torch.float64)
        engine.reset(torch.arange(1), *start)
        before = laws(engine)
        for _ in range(24):
            engine.step(zeros(1, 6, 3))
        return [float((a - b).abs().max() / b.abs().max()) for a, b in zip(laws(engine), before, strict=True)]

    for coarse, fine in zip(error(20), error(40), strict=True):
        assert 1e-7 < coarse < 0.003
        assert coarse / fine == pytest.approx(2, rel=0.2)


@pytest.mark.parametrize("engine_type", ENGINES)
def test_floor_holds_without_friction(engine_type: Engine) -> None:
    """Agents that fall on it keep their horizontal speed and do not turn; they sink in by less than a substep."""
    engine = engine_type(1, 2, Dynamics(ground=-2.0, vehicle=POWERLESS), dtype=torch.float64)
    position = torch.tensor([[[0.0, 0, -1], [5, 0, -1.9]]], dtype=torch.float64)
    velocity = torch.tensor([[[1.0, -2, 0], [0, 0, -3]]], dtype=torch.float64)
    engine.reset(torch.arange(1), position, velocity)
    for _ in range(96):
        engine.step(zeros(1, 2, 3))
        assert float(engine.position[..., 2].min()) > RADIUS - 2 - 4.5 * Dynamics().dt
    assert float(engine.position[..., 2].max()) < RADIUS - 2 + 1e-6
    torch.testing.assert_close(engine.velocity[..., :2], velocity[..., :2], rtol=0, atol=1e-9)
    assert float(engine.velocity[..., 2].abs().max()) < 1e-9
    assert float(engine.spin.abs().max()) < 1e-9


# Collisions


def meet(collisions: bool, offset: float = 0.0) -> BulletPhysics:
    """Two unpowered agents that collide along x at 1 m/s each, half a second later."""
    engine = BulletPhysics(1, 2, Dynamics(vehicle=POWERLESS), collisions=collisions, dtype=torch.float64)
    position = torch.tensor([[[-0.25, 0, 0], [0.25, offset, 0]]], dtype=torch.float64)
    engine.reset(torch.arange(1), position, torch.tensor([[[1.0, 0, 0], [-1, 0, 0]]], dtype=torch.float64))
    for _ in range(24):
        engine.step(zeros(1, 2, 3))
        if collisions:
            distance = float((engine.position[0, 0] - engine.position[0, 1]).norm())
            assert distance > 2 * RADIUS - 2 * Dynamics().dt  # a contact is seen a substep late at most
    return engine


@pytest.mark.parametrize("offset", [0.0, 0.03])
def test_agents_that_collide_keep_their_momentum(offset: float) -> None:
    """They do not pass each other, and along the line between them only a slow separation velocity remains."""
    engine = meet(collisions=True, offset=offset)
    total = engine.velocity.sum(1)
    torch.testing.assert_close(total, torch.tensor([[0, 0, -GRAVITY]], dtype=torch.float64), rtol=0, atol=1e-9)
    assert float(engine.velocity[..., :2].square().sum()) < 2 - 1e-3
    assert float(engine.spin.abs().max()) < 1e-9
    if not offset:
        assert 0 <= float(engine.velocity[0, 1, 0]) < 0.1


def test_agents_pass_each_other_without_collisions() -> None:
    engine = meet(collisions=False)
    assert float(engine.position[0, 0, 0]) == pytest.approx(0.25, abs=1e-12)


def test_coincident_agents_are_pushed_apart() -> None:
    engine = BulletPhysics(1, 3, collisions=True)
    engine.reset(torch.arange(1), torch.zeros(1, 3, 3), torch.zeros(1, 3, 3))
    for _ in range(96):
        engine.step(torch.zeros(1, 3, 3))
    assert engine.position.isfinite().all()
    assert float(torch.pdist(engine.position[0]).min()) > RADIUS


# Memory


def crowd(engine: BulletPhysics, flock: int, seed: int) -> None:
    """Place a flock with its agents in contact."""
    position = 0.1 * randn(1, 4, 3, seed=seed)
    engine.reset(torch.tensor([flock]), position, zeros(1, 4, 3))


def fly_on(engine: BulletPhysics, steps: int, seed: int) -> Tensor:
    for step in range(steps):
        engine.step(randn(1, 4, 3, seed=seed + step // 12).expand(len(engine.position), 4, 3))
    return torch.cat((engine.position, engine.velocity, engine.quaternion, engine.spin), -1)


def test_resets_leave_no_trace() -> None:
    """Bit for bit, with contacts: reset flocks behave as in a new engine, and the others as without the reset."""
    dynamics = Dynamics(ground=-0.2)
    engines = [BulletPhysics(2, 4, dynamics, collisions=True, dtype=torch.float64) for _ in range(2)]
    for engine in engines:
        for flock in range(2):
            crowd(engine, flock, seed=flock)
    undisturbed, engine = engines
    fly_on(engine, 30, seed=0)
    crowd(engine, 1, seed=5)
    after = fly_on(engine, 48, seed=7)
    fly_on(undisturbed, 30, seed=0)
    assert torch.equal(fly_on(undisturbed, 48, seed=7)[0], after[0])
    fresh = BulletPhysics(1, 4, dynamics, collisions=True, dtype=torch.float64)
    crowd(fresh, 0, seed=5)
    assert torch.equal(fly_on(fresh, 48, seed=7)[0], after[1])


# Clients


def test_a_dead_client_is_an_error_that_names_its_flock() -> None:
    engine = BulletPhysics(3, 2)
    bullet.disconnect(engine._clients[1])
    with pytest.raises(RuntimeError, match="flock 1"):
        engine.step(torch.zeros(3, 2, 3))
    with pytest.raises(RuntimeError, match="flock 1"):
        engine.reset(torch.tensor([1]), torch.zeros(1, 2, 3), torch.zeros(1, 2, 3))


def test_a_closed_engine_is_an_error() -> None:
    engine = BulletPhysics(2, 2)
    engine.close()
    engine.close()
    with pytest.raises(RuntimeError, match=r"flock 0 .*closed"):
        engine.step(torch.zeros(2, 2, 3))


def test_engines_free_their_clients() -> None:
    kept = BulletPhysics(1, 1)
    for _ in range(3):
        engine = BulletPhysics(2, 1)
        clients = list(engine._clients)
        assert all(map(bullet.isConnected, clients))
        del engine
        gc.collect()
        assert not any(map(bullet.isConnected, clients))
    assert bullet.isConnected(kept._clients[0])


def test_too_many_flocks_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    gc.collect()  # what other tests left
    first = BulletPhysics(2, 1)
    monkeypatch.setattr(module, "MAX_CLIENTS", most := max(first._clients) + 2)
    with pytest.raises(InputError, match=rf"flock 1 of 2 .* at most {most}"):
        BulletPhysics(2, 1)
    last = BulletPhysics(1, 1)  # what was taken has been given back
    assert bullet.isConnected(last._clients[0])
    first.close()


def test_importing_pybullet_prints_nothing() -> None:
    script = "from modgnn_rl.envs.flocking.physics.bullet import BulletPhysics; BulletPhysics(1, 2)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
