"""States and actions that are no numbers any more: named, and either the end or the loss of one flock's rollout."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from tensordict import TensorDictBase
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.nonfinite import nonfinite_agents
from modgnn_rl.errors import InputError, NotFinite
from modgnn_rl.utils.tensors import pair_distances

NAN, INF = math.nan, math.inf
FLOCK, AGENT, STEP = 1, 2, 3  # what goes wrong where and when
EXPERT = Reynolds(action=("agents", "action"))
Saboteur = Callable[[FlockingEnv, Tensor], None]


def spoiled_state(value: float, name: str = "velocity") -> Saboteur:
    """One number of the state that the next step reaches."""

    def sabotage(env: FlockingEnv, action: Tensor) -> None:
        step = env.physics.step

        def spoiled(target_velocity: Tensor, push: Tensor | None = None) -> None:
            step(target_velocity, push)
            state = env.physics.snapshot()
            state[name][FLOCK, AGENT, 0] = value
            env.physics.restore(state)
            env.physics.step = step  # type: ignore[method-assign]

        env.physics.step = spoiled  # type: ignore[method-assign]

    return sabotage


def spoiled_action(value: float) -> Saboteur:
    """One number of the next action."""

    def sabotage(env: FlockingEnv, action: Tensor) -> None:
        action[FLOCK, AGENT, 1] = value

    return sabotage


SABOTEURS = {
    "state NaN": spoiled_state(NAN),
    "state infinite": spoiled_state(-INF, "position"),
    "state huge": spoiled_state(1e30, "position"),
    "action NaN": spoiled_action(NAN),
    "action infinite": spoiled_action(INF),
}


def rollout(env: FlockingEnv, steps: int, sabotage: Saboteur | None = None) -> list[TensorDictBase]:
    """The expert's transitions, one of them spoiled."""
    td, rollout = env.reset(), []
    for step in range(steps):
        td = EXPERT(td)
        if sabotage is not None and step == STEP:
            sabotage(env, td["agents", "action"])
        transition, td = env.step_and_maybe_reset(td)
        rollout.append(transition)
    return rollout


def is_finite(td: TensorDictBase) -> bool:
    return all(bool(value.isfinite().all()) for value in td.values(True, True))


@pytest.mark.parametrize("name", SABOTEURS)
def test_flights_stop_with_one_sentence(name: str) -> None:
    kind = name.split()[0]
    wrong = "too large to compute with" if "huge" in name else "NaN or infinite"
    message = rf"the {kind} of agent 2 in flock 1 at step 3 is {wrong} \(\[.*env\.on_nonfinite=restart"
    with pytest.raises(NotFinite, match=message):
        rollout(FlockingEnv(3, 4, seed=0), 5, SABOTEURS[name])
    assert issubclass(NotFinite, InputError)  # so that commands report it in one line


@pytest.mark.parametrize("name", SABOTEURS)
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"physics": "bullet", "collisions": True},
        {"num_agents": [3, 5, 4], "graph": "links", "motor_lag": 0.05},
        {"delay": 2, "wind": 0.5, "message_loss": 0.3, "dropout_rate": 0.1},
    ],
    ids=["plain", "bullet", "sizes and links", "faults"],
)
def test_only_the_lost_flock_begins_anew(settings: dict[str, Any], name: str) -> None:
    """Against a twin that is not disturbed: all flocks before and in that step, the others for ever."""
    settings = {"num_agents": 4, "leader_noise": 0.0, "on_nonfinite": "restart", **settings}
    env, twin = (FlockingEnv(3, seed=0, **settings) for _ in range(2))
    others = [flock for flock in range(3) if flock != FLOCK]
    with pytest.warns(RuntimeWarning, match=r"of agent 2 in flock 1 at step 3 is .*that flock restarts") as record:
        found = rollout(env, 8, SABOTEURS[name])
    expected = rollout(twin, 8)
    assert len(record) == 1
    assert all(torch.equal(found[STEP][key][FLOCK], expected[STEP][key][FLOCK]) for key in ("done", "adjacency"))

    lost, key = found[STEP][FLOCK], env.config.state_key
    assert is_finite(found[STEP]["next"])
    assert torch.equal(lost["next"][key], lost[key])
    assert [bool(lost["next", flag]) for flag in ("terminated", "truncated", "done")] == [True, False, True]
    fresh = found[STEP + 1][FLOCK]
    assert not fresh[key][:, 3:].any()
    assert not torch.equal(fresh[key], lost[key])
    assert env.step_count.flatten().tolist() == [8, 4, 8]

    # A reset draws for all flocks anew what is random in a step, so with faults only that step can be compared.
    for step in range(STEP + 1 if "delay" in settings else 8):
        theirs = expected[step][others].exclude(("agents", "action"))
        for entry, value in theirs.items(True, True):
            assert torch.equal(found[step][others][entry], value), (step, entry)


@pytest.mark.parametrize("settings", [{"linear_damping": 1e6}, {"linear_damping": 1e9}, {"leader_noise": INF}], ids=str)
def test_flights_that_cannot_be_integrated_survive(settings: dict[str, float]) -> None:
    """Damping far beyond what the length of a step allows, so that speeds are squared again and again; a mad leader."""
    env = FlockingEnv(3, 4, config=FlockingConfig(on_nonfinite="restart", **settings), seed=0)  # type: ignore[arg-type]
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        steps = rollout(env, 12)
    assert len(record) == 12
    assert all(is_finite(transition) for transition in steps)
    with pytest.raises(NotFinite, match=r"lower gains and dampings or raise env\.physics_substeps"):
        rollout(FlockingEnv(3, 4, config=FlockingConfig(**settings), seed=0), 12)  # type: ignore[arg-type]


def test_several_lost_flocks_are_one_line() -> None:
    env = FlockingEnv(3, 4, seed=0, on_nonfinite="restart")
    td = EXPERT(env.reset())
    td["agents", "action"][:, 1:] = NAN
    with pytest.warns(RuntimeWarning, match=r"agent 1 in flock 0 at step 0 .*, as in 2 other flocks; ") as record:
        transition, _ = env.step_and_maybe_reset(td)
    assert len(record) == 1
    assert transition["next", "terminated"].all()


def test_agents_that_are_not_flown_lose_nothing() -> None:
    env = FlockingEnv(2, [2, 4], seed=0)
    td = EXPERT(env.reset())
    td["agents", "action"][~td["agents", "controlled"]] = NAN
    assert is_finite(env.step(td)["next"])


@example(1e19, torch.float32, 0)
@given(st.floats(width=32), st.sampled_from([torch.float32, torch.float64]), st.integers(0, 5))
def test_what_is_usable_has_finite_distances(value: float, dtype: torch.dtype, component: int) -> None:
    state = torch.zeros(2, 3, 6, dtype=dtype)
    state[1, 2, component], state[1, 1, component] = value, -value
    bad = nonfinite_agents(state)
    if bad is None:
        assert pair_distances(state[1]).square().isfinite()[~torch.eye(3, dtype=torch.bool)].all()
    else:
        assert not abs(value) < 1e18
        assert bad.tolist() == [[False] * 3, [False, True, True]]
