"""Interrupted rollouts continue bit for bit: all physics, leaders, perturbations and sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from safetensors.torch import load, save
from tensordict import TensorDictBase
from torch import Tensor

from modgnn_rl import configs
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.physics.bullet import BulletPhysics, bullet
from modgnn_rl.errors import InputError

EXPERT = Reynolds(action=("agents", "action"))
OUTDOORS = yaml.safe_load((Path(configs.__file__).parent / "env" / "outdoors.yaml").read_text())
del OUTDOORS["defaults"]

WORLDS: dict[str, dict[str, Any]] = {
    "plain": {},
    "float64": {"dtype": torch.float64},
    "rotors": {"motor_lag": 0.05, "drag": 1.0, "ground": -1.5, "linear_damping": 0.1},
    "waypoints": {"leader": "waypoints", "leader_radius": 0.5},
    "circle": {"leader": "circle"},
    "outdoors": OUTDOORS,
    "packet loss": {"num_agents": [3, 6, 4], "graph": "links", "message_loss": 0.3, "wind": 1.0, "range_spread": 0.3},
    "bullet": {"physics": "bullet", "dtype": torch.float64},
    "bullet outdoors": {"physics": "bullet", "motor_lag": 0.05, "ground": -1.5, **OUTDOORS, "dtype": torch.float64},
    "bullet collisions": {"physics": "bullet", "collisions": True, "dtype": torch.float64},
}


def make(seed: int = 0, num_envs: int = 3, **settings: Any) -> FlockingEnv:
    """An environment with short episodes."""
    return FlockingEnv(num_envs, seed=seed, stagger=True, **{"num_agents": 5, "max_steps": 9, **settings})


def rollout(env: FlockingEnv, td: TensorDictBase, steps: int) -> tuple[list[TensorDictBase], TensorDictBase]:
    """The expert's transitions, and the tensordict to continue from."""
    rollout = []
    for _ in range(steps):
        transition, td = env.step_and_maybe_reset(EXPERT(td.clone()))
        rollout.append(transition)
    return rollout, td


def generators(env: FlockingEnv) -> list[Tensor]:
    return [env.generator.get_state(), env.perturbations.generator.get_state()]


def resume(env: FlockingEnv, snapshot: dict[str, Tensor], states: list[Tensor]) -> None:
    env.restore(snapshot)
    env.generator.set_state(states[0])
    env.perturbations.generator.set_state(states[1])


def assert_equal(rollout: list[TensorDictBase], other: list[TensorDictBase]) -> None:
    """Equal bit for bit."""
    for step, (one, two) in enumerate(zip(rollout, other, strict=True)):
        assert set(one.keys(True, True)) == set(two.keys(True, True))
        for key, value in one.items(True, True):
            assert torch.equal(value, two[key]), (step, key)


@pytest.mark.parametrize("name", [*WORLDS, pytest.param("compiled", marks=pytest.mark.slow)])
def test_rollouts_continue_bit_for_bit(name: str) -> None:
    """In an environment with another seed that was never reset, and in one used for other rollouts meanwhile."""
    settings = WORLDS.get(name, {"compile": True, "motor_lag": 0.05})
    env = make(**settings)
    _, td = rollout(env, env.reset(), 11)
    stored, states, carried = save(env.snapshot()), generators(env), td.clone()
    expected, _ = rollout(env, td, 16)
    fresh = make(seed=1, **settings)
    for other in (fresh, env):
        resume(other, load(stored), states)
        assert_equal(rollout(other, carried.clone(), 16)[0], expected)
    # The snapshot was taken within episodes, and all flocks have been reset since.
    assert torch.stack([td["next", "done"] for td in expected]).any(0).all()


def test_agents_in_contact_continue_up_to_rounding_in_bullet() -> None:
    """Agents pushed together: a snapshot does not hold Bullet's record of contacts.

    So a rollout that continues from it is not the old one to the last bit, but the same in whichever engine.
    """
    engine, one, other = (BulletPhysics(1, 6, collisions=True, dtype=torch.float64) for _ in range(3))
    generator = torch.Generator().manual_seed(0)
    position = 0.1 * torch.randn(1, 6, 3, generator=generator)
    for begun in (engine, other):
        begun.reset(torch.arange(1), position, torch.zeros_like(position))
        for _ in range(96):
            begun.step(-3.0 * begun.position)
        assert bullet.getContactPoints(physicsClientId=begun._clients[0])
    for restored in (one, other):
        restored.restore(engine.snapshot())
    for _ in range(24):
        target = -3.0 * engine.position
        for stepped in (engine, one, other):
            stepped.step(target)
        assert torch.equal(one.position, other.position)
        torch.testing.assert_close(one.position, engine.position, rtol=0, atol=1e-4)
    assert not torch.equal(one.position, engine.position)


def test_a_snapshot_is_a_copy() -> None:
    """Rollouts do not change a snapshot, nor the other way round, before and after it is restored."""
    env, twin = (make(seed=2, **OUTDOORS) for _ in range(2))
    _, td = rollout(env, env.reset(), 5)
    snapshot, states = env.snapshot(), generators(env)
    kept = {name: value.clone() for name, value in snapshot.items()}
    resume(twin, snapshot, states)
    expected, _ = rollout(env, td, 5)
    assert all(torch.equal(value, kept[name]) for name, value in snapshot.items())
    for value in snapshot.values():
        value.fill_(1)
    assert_equal(rollout(twin, td, 5)[0], expected)


def test_names_of_tensors() -> None:
    names = set(make(motor_lag=0.05, range_spread=0.1).snapshot())
    bodies = {"position", "quaternion", "velocity", "spin", "integral", "rotors"}
    assert names == {
        "sizes",
        "step_count",
        "target_velocity",
        *(f"physics.{name}" for name in bodies),
        "leader.velocity",
        *(f"perturbations.{name}" for name in ("active", "send_range", "gust", "delayed")),
    }


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"num_envs": 2},
            r"its leader\.velocity is float32 \[2, 3\], that of this environment is float32 \[3, 3\]",
        ),
        ({"num_agents": 4}, r"perturbations\.active is bool \[3, 4\]"),
        ({"delay": 2}, r"perturbations\.delayed is float32 \[2, 3, 5, 6\]"),
        ({"num_agents": [2, 5]}, r"its sizes is \[2, 5, 2\], that of this environment is \[5, 5, 5\]"),
        ({"leader": "circle"}, r"its leader\.heading is float32 \[3, 1\], that of this environment is absent"),
        ({"motor_lag": 0.05}, r"physics\.rotors is float32 \[3, 5, 4\], that of this environment is absent"),
        ({"dtype": torch.float64}, r"is float64"),
        ({"physics": "bullet"}, r"its physics\.integral is float64"),
    ],
)
def test_snapshots_of_other_settings_are_errors(settings: dict[str, Any], message: str) -> None:
    env = make()
    env.reset()
    before = env.snapshot()
    expected = f"of other flocks, agents or settings: .*{message}.*create the environment with"
    with pytest.raises(InputError, match=expected):
        env.restore(make(seed=1, **settings).snapshot())
    after = env.snapshot()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("name", ["plain", "outdoors", "packet loss", "bullet"])
def test_snapshots_restore_on_another_device(name: str) -> None:
    env = make(device="cuda", **WORLDS[name])
    _, td = rollout(env, env.reset(), 11)
    snapshot = {key: value.cpu() for key, value in env.snapshot().items()}
    states, carried = generators(env), td.clone()
    expected, _ = rollout(env, td, 16)
    other = make(seed=1, device="cuda", **WORLDS[name])
    resume(other, snapshot, states)
    assert_equal(rollout(other, carried, 16)[0], expected)
    on_cpu = make(seed=1, **WORLDS[name])
    on_cpu.restore(env.snapshot())
    assert torch.equal(on_cpu.physics.position, env.physics.position.cpu())
