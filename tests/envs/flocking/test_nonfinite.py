"""NaN, infinite and overflowing states and actions: a clear error, or a restart of that flock alone."""

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
FLOCK, AGENT, STEP = 1, 2, 3  # where and when a value becomes invalid
EXPERT = Reynolds(action=("agents", "action"))
Saboteur = Callable[[FlockingEnv, Tensor], None]


def sabotaged_state(value: float, name: str = "velocity") -> Saboteur:
    """Change one number of the state that the next step reaches."""

    def sabotage(env: FlockingEnv, action: Tensor) -> None:
        step = env.physics.step

        def sabotaged(target_velocity: Tensor, push: Tensor | None = None) -> None:
            step(target_velocity, push)
            state = env.physics.snapshot()
            state[name][FLOCK, AGENT, 0] = value
            env.physics.restore(state)
            env.physics.step = step  # type: ignore[method-assign]

        env.physics.step = sabotaged  # type: ignore[method-assign]

    return sabotage


def sabotaged_action(value: float) -> Saboteur:
    """Change one number of the next action."""

    def sabotage(env: FlockingEnv, action: Tensor) -> None:
        action[FLOCK, AGENT, 1] = value

    return sabotage


SABOTEURS = {
    "state NaN": sabotaged_state(NAN),
    "state infinite": sabotaged_state(-INF, "position"),
    "state huge": sabotaged_state(1e30, "position"),
    "action NaN": sabotaged_action(NAN),
    "action infinite": sabotaged_action(INF),
}


def rollout(env: FlockingEnv, steps: int, sabotage: Saboteur | None = None) -> list[TensorDictBase]:
    """The expert's transitions, one of them sabotaged."""
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
def test_an_invalid_value_stops_the_rollout_with_one_sentence(name: str) -> None:
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
    ids=["plain", "bullet", "sizes and edge lists", "perturbations"],
)
def test_only_the_flock_with_the_invalid_value_restarts(settings: dict[str, Any], name: str) -> None:
    """Compared with an undisturbed twin: all flocks up to that step, the other flocks always."""
    settings = {"num_agents": 4, "leader_noise": 0.0, "on_nonfinite": "restart", **settings}
    env, twin = (FlockingEnv(3, seed=0, **settings) for _ in range(2))
    others = [flock for flock in range(3) if flock != FLOCK]
    with pytest.warns(RuntimeWarning, match=r"of agent 2 in flock 1 at step 3 is .*that flock restarts") as record:
        found = rollout(env, 8, SABOTEURS[name])
    expected = rollout(twin, 8)
    assert len(record) == 1
    assert all(torch.equal(found[STEP][key][FLOCK], expected[STEP][key][FLOCK]) for key in ("done", "adjacency"))

    failed, key = found[STEP][FLOCK], env.config.state_key
    assert is_finite(found[STEP]["next"])
    assert torch.equal(failed["next"][key], failed[key])
    assert [bool(failed["next", flag]) for flag in ("terminated", "truncated", "done")] == [True, False, True]
    fresh = found[STEP + 1][FLOCK]
    assert not fresh[key][:, 3:].any()
    assert not torch.equal(fresh[key], failed[key])
    assert env.step_count.flatten().tolist() == [8, 4, 8]

    # A reset samples perturbations for all flocks, so with perturbations only that step can be compared.
    for step in range(STEP + 1 if "delay" in settings else 8):
        theirs = expected[step][others].exclude(("agents", "action"))
        for entry, value in theirs.items(True, True):
            assert torch.equal(found[step][others][entry], value), (step, entry)


@pytest.mark.parametrize("settings", [{"linear_damping": 1e6}, {"linear_damping": 1e9}, {"leader_noise": INF}], ids=str)
def test_rollouts_with_unstable_dynamics_continue(settings: dict[str, float]) -> None:
    """Damping too strong for the step size, so that speeds are squared again and again; an infinitely noisy leader."""
    env = FlockingEnv(3, 4, config=FlockingConfig(on_nonfinite="restart", **settings), seed=0)  # type: ignore[arg-type]
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        steps = rollout(env, 12)
    assert len(record) == 12
    assert all(is_finite(transition) for transition in steps)
    with pytest.raises(NotFinite, match=r"lower gains and dampings or raise env\.physics_substeps"):
        rollout(FlockingEnv(3, 4, config=FlockingConfig(**settings), seed=0), 12)  # type: ignore[arg-type]


def test_several_flocks_give_one_warning() -> None:
    env = FlockingEnv(3, 4, seed=0, on_nonfinite="restart")
    td = EXPERT(env.reset())
    td["agents", "action"][:, 1:] = NAN
    with pytest.warns(RuntimeWarning, match=r"agent 1 in flock 0 at step 0 .*, as in 2 other flocks; ") as record:
        transition, _ = env.step_and_maybe_reset(td)
    assert len(record) == 1
    assert transition["next", "terminated"].all()


def test_actions_of_uncontrolled_agents_are_not_checked() -> None:
    env = FlockingEnv(2, [2, 4], seed=0)
    td = EXPERT(env.reset())
    td["agents", "action"][~td["agents", "controlled"]] = NAN
    assert is_finite(env.step(td)["next"])


@example(1e19, torch.float32, 0)
@given(st.floats(width=32), st.sampled_from([torch.float32, torch.float64]), st.integers(0, 5))
def test_accepted_values_have_finite_squared_distances(value: float, dtype: torch.dtype, component: int) -> None:
    state = torch.zeros(2, 3, 6, dtype=dtype)
    state[1, 2, component], state[1, 1, component] = value, -value
    bad = nonfinite_agents(state)
    if bad is None:
        assert pair_distances(state[1]).square().isfinite()[~torch.eye(3, dtype=torch.bool)].all()
    else:
        assert not abs(value) < 1e18
        assert bad.tolist() == [[False] * 3, [False, True, True]]
