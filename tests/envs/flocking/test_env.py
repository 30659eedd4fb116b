"""The flocking environment: its TorchRL interface, seeds and resets, and the rules of the task."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from modgnn_rl import configs
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.configs.settings import check
from modgnn_rl.envs import FlockingEnv, TorchPhysics
from modgnn_rl.envs.flocking.expert import LocalReynolds, Reynolds
from modgnn_rl.envs.flocking.leader import NoiseLeader
from modgnn_rl.envs.flocking.rewards import flocking_costs, flocking_reward, reward_weights
from modgnn_rl.errors import InputError
from modgnn_rl.models.factory import make_model
from modgnn_rl.nn.topology import as_matrix
from modgnn_rl.utils.tensors import pair_distances

NAN = math.nan
ACTION = ("agents", "action")


def constant_policy(value: float):
    """A policy whose actions are ``value`` times a fixed pattern of target velocities."""

    def policy(td: TensorDictBase) -> TensorDictBase:
        agents = td["agents", "observation"][..., :3]
        pattern = torch.arange(agents.shape[1]).view(-1, 1) * torch.tensor([0.1, -0.05, 0.02])
        td["agents", "action"] = (value * pattern).to(agents.dtype).expand_as(agents).clone()
        return td

    return policy


def act(env: FlockingEnv, td: TensorDictBase, action: Tensor | float = 0.0) -> TensorDictBase:
    """Take one step; returns the tensordict with the transition."""
    full = torch.zeros(*env.batch_size, env.num_agents, 3, dtype=env.dtype) + action
    td["agents", "action"] = full
    return env.step(td)


def place(env: FlockingEnv, flock: int, position: Any) -> None:
    """Place the agents of one flock at rest at ``position`` [N, 3]."""
    where = torch.as_tensor(position, dtype=env.dtype).unsqueeze(0)
    env.physics.reset(torch.tensor([flock]), where, torch.zeros_like(where))


def line(*x: float) -> list[list[float]]:
    return [[value, 0.0, 0.0] for value in x]


def equal(a: TensorDictBase, b: TensorDictBase) -> bool:
    """Equal bit for bit."""
    return bool((a == b).all()) and set(a.keys(True, True)) == set(b.keys(True, True))


def rows(mask: list[bool]) -> TensorDict:
    return TensorDict({"_reset": torch.tensor(mask).view(-1, 1)}, [len(mask)])


# Interface


@pytest.mark.parametrize(
    ("num_envs", "num_agents", "dtype"),
    [(3, 4, torch.float32), (2, 3, torch.float64), (1, 1, torch.float32), (1, 2, torch.float32), (4, 1, torch.float64)],
)
def test_specs_hold(num_envs: int, num_agents: int, dtype: torch.dtype) -> None:
    env = FlockingEnv(num_envs, num_agents, dtype=dtype, seed=0)
    check_env_specs(env)
    rollout = env.rollout(3)
    assert env.batch_size == (num_envs,)
    assert env.batch_locked
    agents = (num_envs, 3, num_agents)
    expected = {
        ("agents", "observation"): ((*agents, 6), dtype),
        ("agents", "controlled"): (agents, torch.bool),
        ("agents", "action"): ((*agents, 3), dtype),
        "adjacency": ((*agents, num_agents), torch.bool),
        ("next", "agents", "observation"): ((*agents, 6), dtype),
        ("next", "agents", "controlled"): (agents, torch.bool),
        ("next", "agents", "reward"): ((*agents, 1), dtype),
        ("next", "adjacency"): ((*agents, num_agents), torch.bool),
    }
    for name in ("done", "terminated", "truncated"):
        expected[name] = expected["next", name] = ((num_envs, 3, 1), torch.bool)
    found = {key: (tuple(rollout[key].shape), rollout[key].dtype) for key in rollout.keys(True, True)}
    assert found == expected


def test_all_agents_are_one_group() -> None:
    env = FlockingEnv(1, 3)
    assert env.group_map == {"agents": ["agent_0", "agent_1", "agent_2"]}


def test_all_agents_but_the_leader_are_controlled() -> None:
    controlled = FlockingEnv(2, 4).reset()["agents", "controlled"]
    assert controlled.tolist() == [[False, True, True, True]] * 2


def test_observation_is_the_state_of_the_physics() -> None:
    env = FlockingEnv(2, 3, seed=0)
    td = act(env, env.reset(), 0.5)
    for _ in range(20):
        td = act(env, step_mdp(td), 0.5)
    observation = td["next", "agents", "observation"]
    assert torch.equal(observation[..., :3], env.physics.position)
    assert torch.equal(observation[..., 3:], env.physics.velocity)
    assert float(observation[:, 1:, 3].min()) > 0.05


def test_flocks_start_at_rest_and_apart_in_a_ball_that_scales_with_their_size() -> None:
    for size in (1, 4, 32):
        env = FlockingEnv(20, size, seed=0)
        observation = env.reset()["agents", "observation"]
        radius = 4.0 * (size / 32) ** (1 / 3)
        assert not observation[..., 3:].any()
        distance = observation[..., :3].norm(dim=-1)
        assert 0.8 * radius < float(distance.max()) <= radius * (1 + 1e-6)
        if size > 1:
            assert min(float(torch.pdist(flock).min()) for flock in observation[..., :3]) >= 0.3


# Seeds


def test_one_seed_determines_a_rollout_bit_for_bit() -> None:
    state = torch.get_rng_state()
    rollouts = [
        FlockingEnv(3, 4, seed=seed, max_steps=7).rollout(20, constant_policy(1.0), break_when_any_done=False)
        for seed in (5, 5, 6)
    ]
    assert equal(rollouts[0], rollouts[1])
    assert not equal(rollouts[0], rollouts[2])
    env = FlockingEnv(3, 4, max_steps=7)
    env.set_seed(5)
    assert equal(env.rollout(20, constant_policy(1.0), break_when_any_done=False), rollouts[0])
    assert torch.equal(torch.get_rng_state(), state)


def test_without_a_seed_rollouts_differ() -> None:
    first, second = (FlockingEnv(2, 3).reset() for _ in range(2))
    assert not equal(first, second)


def test_initial_positions_and_leader_do_not_depend_on_the_policy() -> None:
    rollouts = [
        FlockingEnv(3, 4, seed=1, max_steps=9).rollout(24, constant_policy(value), break_when_any_done=False)
        for value in (0.0, 1.0, 50.0)
    ]
    start, leader = (rollouts[0]["agents", "observation"][:, step] for step in (0, slice(None)))
    for rollout in rollouts[1:]:
        observation = rollout["agents", "observation"]
        assert torch.equal(observation[:, 0], start)
        assert torch.equal(observation[:, 9], rollouts[0]["agents", "observation"][:, 9])  # a fresh episode
        assert torch.equal(observation[..., 0, :], leader[..., 0, :])
        assert not torch.equal(observation[..., 1, :], leader[..., 1, :])


# Leader


def test_leader_ignores_the_action_even_nan() -> None:
    env, twin = (FlockingEnv(2, 3, seed=0) for _ in range(2))
    td, other = env.reset(), twin.reset()
    for _ in range(5):
        action = torch.zeros(2, 3, 3)
        action[:, 0] = NAN
        td, other = act(env, td, action), act(twin, other, 0.0)
        assert torch.equal(td["next", "agents", "observation"], other["next", "agents", "observation"])
        td, other = step_mdp(td), step_mdp(other)


def test_leader_velocity_is_integrated_gaussian_noise() -> None:
    """After n steps its variance per component is n ls^2 dt; increments and flocks are independent."""
    env = FlockingEnv(2000, 1, seed=0, leader_noise=0.3, leader_max_speed=math.inf, dtype=torch.float64)
    td, path = env.reset(), []
    for _ in range(6):
        td = step_mdp(act(env, td))
        path.append(env.target_velocity[:, 0])
    deviation = 0.3 / 48**0.5
    increments = torch.stack(path).diff(dim=0, prepend=torch.zeros(1, 2000, 3).double()) / deviation
    assert float(increments.std()) == pytest.approx(1, abs=0.02)
    assert abs(float(increments.mean())) < 0.02
    correlation = torch.corrcoef(increments.transpose(0, 1).reshape(2000, 18).T)
    torch.testing.assert_close(correlation, torch.eye(18).double(), rtol=0, atol=0.1)
    assert float(path[-1].std()) == pytest.approx(deviation * 6**0.5, rel=0.05)


def test_leader_speed_is_limited() -> None:
    env = FlockingEnv(50, 1, seed=0, leader_noise=20.0, leader_max_speed=0.8)
    act(env, env.reset())
    speed = env.target_velocity[:, 0].norm(dim=-1)
    torch.testing.assert_close(speed, torch.full((50,), 0.8))


def test_leader_follows_its_target_velocity() -> None:
    env = FlockingEnv(4, 1, seed=0, leader_noise=0.0, velocity_gain=3.0)
    td = env.reset()
    assert isinstance(env.leader, NoiseLeader)
    env.leader.velocity = torch.tensor([0.3, -0.2, 0.1]).expand(4, 3).clone()
    for _ in range(200):
        td = step_mdp(act(env, td))
    torch.testing.assert_close(td["agents", "observation"][:, 0, 3:], env.target_velocity[:, 0], rtol=0, atol=0.03)


# Actions


def test_actions_are_projected_onto_the_ball_of_max_speed() -> None:
    """Compared with a second engine that gets projected actions: unchanged inside the ball, on the sphere outside."""
    env = FlockingEnv(2, 5, seed=0, dtype=torch.float64, max_speed=0.7)
    td = env.reset()
    twin = TorchPhysics(2, 5, dtype=torch.float64)
    twin.reset(torch.arange(2), env.physics.position, env.physics.velocity)
    generator = torch.Generator().manual_seed(0)
    scale = torch.tensor([1.0, 0.1, 0.5, 3.0, 1e6], dtype=torch.float64).view(5, 1)
    for _ in range(10):
        action = scale * torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
        td = step_mdp(act(env, td, action))
        norm = action.norm(dim=-1, keepdim=True)
        target = torch.where(norm > 0.7, action * 0.7 / norm, action)
        target[:, 0] = env.target_velocity[:, 0]
        twin.step(target)
        torch.testing.assert_close(env.physics.position, twin.position, rtol=0, atol=1e-13)


def test_a_float64_environment_accepts_float32_actions() -> None:
    env = FlockingEnv(1, 2, dtype=torch.float64)
    td = env.reset()
    td["agents", "action"] = torch.zeros(1, 2, 3)
    assert env.step(td)["next", "agents", "observation"].dtype == torch.float64


@pytest.mark.parametrize("value", [NAN, math.inf, -math.inf])
def test_nan_and_infinite_actions_are_errors(value: float) -> None:
    env = FlockingEnv(3, 4, seed=0)
    td = step_mdp(act(env, step_mdp(act(env, env.reset()))))
    before = env.physics.position
    action = torch.zeros(3, 4, 3)
    action[1, 3, 2] = value
    with pytest.raises(InputError, match="agent 3 in flock 1 at step 2 is NaN or infinite"):
        act(env, td, action)
    assert torch.equal(env.physics.position, before)


# Who hears whom


def test_adjacency_follows_from_distances() -> None:
    rollout = FlockingEnv(3, 12, seed=0, comm_range=2.0).rollout(10, constant_policy(5.0))
    for side in (rollout, rollout["next"]):
        adjacency, position = side["adjacency"], side["agents", "observation"][..., :3]
        assert 0.1 < float(adjacency.double().mean()) < 0.9
        assert torch.equal(adjacency, adjacency.mT)
        for i in range(12):
            for j in range(12):
                near = (position[..., i, :] - position[..., j, :]).norm(dim=-1) <= 2.0
                assert torch.equal(adjacency[..., i, j], near if i != j else torch.zeros_like(near))


def test_agents_exactly_at_the_range_are_heard() -> None:
    env = FlockingEnv(2, 2, leader_noise=0.0, comm_range=3.5)
    td = env.reset()
    place(env, 0, line(0.0, 3.5))
    place(env, 1, line(0.0, 3.5000005))  # at rest all feel the same force, so the distances stay
    heard = act(env, td)["next", "adjacency"]
    assert heard[:, 0, 1].tolist() == [True, False]


# Rewards and ends


@pytest.mark.parametrize("graph", ["matrix", "links"])
def test_reward_is_that_of_the_next_state(graph: str) -> None:
    env = FlockingEnv(2, 3, leader_noise=0.0, collision_distance=0.2, graph=graph)
    td = env.reset()
    place(env, 0, line(0.0, 1.0, 1.1))
    td = act(env, td, 0.5)
    position, velocity = td["next", "agents", "observation"].split(3, -1)
    costs = flocking_costs(
        position,
        velocity,
        env.target_velocity,
        pair_distances(position).amin(-1),
        crowding_distance=0.4,
        collision_distance=0.2,
    )
    assert costs["collision"][0].tolist() == [0.0, 1.0, 1.0]
    reward = td["next", "agents", "reward"]
    torch.testing.assert_close(reward, flocking_reward(costs, reward_weights(env.config)))
    assert float(reward[0, 1]) < -1.0


def test_episodes_are_truncated_after_max_steps_and_restart() -> None:
    env = FlockingEnv(2, 3, seed=0, max_steps=5)
    rollout = env.rollout(13, constant_policy(1.0), break_when_any_done=False)
    ends = [step in (4, 9) for step in range(13)]
    for name, expected in (("truncated", ends), ("done", ends), ("terminated", [False] * 13)):
        assert rollout["next", name][..., 0].tolist() == [expected] * 2
    now, after = rollout["agents", "observation"], rollout["next", "agents", "observation"]
    for step in range(12):
        assert torch.equal(after[:, step], now[:, step + 1]) is not ends[step]
    # The final observation belongs to the rollout that ends: 5 steps of motion, not a fresh start at rest.
    assert now[:, (0, 5, 10), :, 3:].count_nonzero() == 0
    assert after[:, (4, 9), 1:, 3:].abs().amin() > 1e-4
    assert float((after[:, 4, :, :3] - now[:, 4, :, :3]).abs().max()) < 0.05
    assert len({str(now[0, step].tolist()) for step in (0, 5, 10)}) == 3


def test_a_diverged_flock_is_terminated_and_only_it_restarts() -> None:
    env = FlockingEnv(3, 2, seed=0, max_distance=5.0)
    td = env.reset()
    place(env, 1, line(0.0, 10.1))
    td = act(env, td)
    assert td["next", "terminated"].flatten().tolist() == [False, True, False]
    assert td["next", "done"].flatten().tolist() == [False, True, False]
    assert not td["next", "truncated"].any()
    final = td["next", "agents", "observation"]
    assert float((final[1, 1] - final[1, 0])[0]) == pytest.approx(10.1, abs=1e-3)
    fresh = env.maybe_reset(step_mdp(td))["agents", "observation"]
    assert torch.equal(fresh[[0, 2]], final[[0, 2]])
    assert not fresh[1, :, 3:].any()
    assert float(fresh[1, :, :3].norm(dim=-1).max()) < 2.0
    assert env.step_count.flatten().tolist() == [1, 0, 1]


def test_an_episode_terminates_when_too_many_agents_collide() -> None:
    """Of four agents, two in collision are the allowed fraction of one half; three are more."""
    env = FlockingEnv(4, 4, leader_noise=0.0, collision_distance=0.08, max_colliding=0.5)
    td = env.reset()
    place(env, 0, line(0.0, 0.07, 1.0, 2.0))
    place(env, 1, line(0.0, 0.07, 0.14, 2.0))
    place(env, 2, line(0.0, 0.09, 0.18, 0.27))
    place(env, 3, line(0.0, 0.07, 1.0, 1.07))
    td = act(env, td)
    assert td["next", "terminated"].flatten().tolist() == [False, True, False, True]
    assert (td["next", "agents", "reward"][..., 0] < -0.9).sum(-1).tolist() == [2, 3, 0, 4]


def test_staggered_flocks_end_their_first_episode_at_different_steps() -> None:
    options: dict[str, Any] = {"seed": 0, "max_steps": 10, "stagger": True}
    env = FlockingEnv(64, 2, **options)
    rollout = env.rollout(40, constant_policy(0.0), break_when_any_done=False)
    done = rollout["next", "done"][..., 0]
    first = done.int().argmax(1)
    assert set(first.tolist()) == set(range(10))
    for flock in range(64):
        assert done[flock].nonzero()[:, 0].tolist() == list(range(int(first[flock]), 40, 10))
    again = FlockingEnv(64, 2, **options).rollout(40, constant_policy(0.0), break_when_any_done=False)
    assert equal(rollout, again)
    assert not env.rollout(9, constant_policy(0.0))["next", "done"].any()  # a full reset later is whole


# Resets and aliasing


def snapshot(env: FlockingEnv) -> dict[str, Tensor]:
    physics = env.physics
    assert isinstance(physics, TorchPhysics)
    state = {name: torch.stack(part, -1) for name, part in physics.state.bodies._asdict().items()}
    integral = torch.stack(physics.state.integral, -1)
    return state | {"integral": integral, "leader": env.target_velocity[:, 0].clone(), "steps": env.step_count.clone()}


@pytest.mark.parametrize("mask", [[False, True, False, True], [True] * 4, [False] * 4])
def test_a_partial_reset_changes_only_its_rows(mask: list[bool]) -> None:
    env = FlockingEnv(4, 3, seed=0)
    td = env.reset()
    for _ in range(5):
        td = step_mdp(act(env, td, 0.5))
    before, kept = snapshot(env), [not reset for reset in mask]
    out = env.reset(td.clone().update(rows(mask)))
    after = snapshot(env)
    level = torch.tensor([0.0, 0, 0, 1]).expand(sum(mask), 3, 4)
    for name, value in after.items():
        assert torch.equal(value[kept], before[name][kept]), name
        if name == "quaternion":
            assert torch.equal(value[mask], level)
        elif name != "position":
            assert before[name][mask].any() or not any(mask), name
            assert not value[mask].any(), name
    assert (after["position"][mask] != before["position"][mask]).all()
    assert torch.equal(out["agents", "observation"][..., :3], after["position"])
    assert torch.equal(out["agents", "observation"][kept], td["agents", "observation"][kept])
    assert torch.equal(out["adjacency"][kept], td["adjacency"][kept])
    assert not out["done"].any()


def test_outputs_do_not_alias_the_state() -> None:
    env, twin = (FlockingEnv(1, 2, seed=0) for _ in range(2))
    td, other = env.reset(), twin.reset()
    for _ in range(4):
        td, other = act(env, td, 0.4), act(twin, other, 0.4)
        assert equal(td, other)
        following = step_mdp(td.clone())
        for key in td.keys(True, True):  # spoil the whole transition, the action and the next observation too
            td[key].zero_() if td[key].dtype == torch.bool else td[key].fill_(1e3)
        td, other = following, step_mdp(other)


def test_steps_of_a_rollout_differ() -> None:
    observation = FlockingEnv(2, 3, seed=0).rollout(6, constant_policy(3.0))["agents", "observation"]
    for step in range(1, 6):
        assert (observation[:, step] != observation[:, 0]).any(-1).all()


# Compiled


@pytest.mark.parametrize("how", ["setting", "configuration", "method"])
def test_compile_covers_physics_graph_and_reward(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str] = []

    def record(function: Any) -> Any:
        names.append(function.__name__)
        return function

    for module in ("flocking.env", "flocking.physics.engine"):
        monkeypatch.setattr(f"modgnn_rl.envs.{module}.compiled", record)
    if how == "setting":
        env = FlockingEnv(2, 3, seed=0, compile=True)
    elif how == "configuration":
        env = FlockingEnv(2, 3, seed=0, config=FlockingConfig(compile=True))
    else:
        env = FlockingEnv(2, 3, seed=0).compile()
    assert sorted(names) == ["adjacency_matrix", "advance", "step_outcome"]
    check_env_specs(env)


@pytest.mark.slow  # half a minute of compiling
@pytest.mark.parametrize("settings", [{}, {"wind": 1.0, "drag": 1.0, "motor_lag": 0.05, "range_spread": 0.3}])
def test_compiled_rollouts_equal_eager_ones(settings: dict[str, Any]) -> None:
    rollouts = []
    for is_compiled in (False, True):
        config = FlockingConfig(compile=is_compiled, **settings)
        env = FlockingEnv(3, 5, seed=0, config=config, dtype=torch.float64)
        rollouts.append(env.rollout(60, Reynolds.for_env(config, action=ACTION), break_when_any_done=False))
    for key in (("next", "agents", "observation"), ("next", "agents", "reward")):
        torch.testing.assert_close(rollouts[0][key], rollouts[1][key], rtol=0, atol=1e-9)
    assert torch.equal(rollouts[0]["next", "adjacency"], rollouts[1]["next", "adjacency"])


# EdgeList


@pytest.mark.parametrize("settings", [{}, {"range_spread": 0.4}, {"num_agents": [4, 20]}])
def test_the_edge_list_holds_the_edges_of_the_matrix(settings: dict[str, Any]) -> None:
    dense, listed = (
        FlockingEnv(3, seed=0, graph=graph, **{"num_agents": 20, **settings}) for graph in ("matrix", "links")
    )
    for env in (dense, listed):
        env.rollout(10, constant_policy(1.0))
    matrix = dense.reset()["adjacency"]
    links = listed.reset()["adjacency"]
    for flock in range(3):
        sender, receiver = links[flock][:, links[flock, 0] >= 0]
        assert torch.equal(torch.stack((receiver, sender), -1), matrix[flock].nonzero())


def test_too_many_edges_are_an_error() -> None:
    env = FlockingEnv(2, 20, seed=0, graph="links", max_links=2)
    with pytest.raises(InputError, match=r"flock \d has \d+ edges, but its list holds only 40: raise env.max_links"):
        env.reset()


@pytest.mark.parametrize(
    "policy",
    [make_model("modgnn_mlp", seed=0), LocalReynolds(action=ACTION), LocalReynolds(hops=2, action=ACTION)],
    ids=["policy", "local expert", "local expert, two hops"],
)
def test_policies_act_equally_on_edge_lists_and_matrices(policy: Any) -> None:
    rollouts = []
    for graph in ("matrix", "links"):
        env = TransformedEnv(FlockingEnv(2, 12, seed=0, graph=graph), InitTracker())
        env.append_transform(policy.make_tensordict_primer())
        rollouts.append(env.rollout(5, policy)[ACTION])
    torch.testing.assert_close(rollouts[0], rollouts[1])


@pytest.mark.parametrize("graph", ["matrix", "links"])
def test_no_agent_receives_from_itself_whatever_the_range(graph: str) -> None:
    env = FlockingEnv(2, [3, 5], seed=0, comm_range=math.inf, graph=graph)
    adjacency = as_matrix(env.reset()["adjacency"], 5)
    assert not adjacency.diagonal(0, -2, -1).any()
    assert adjacency.sum((-2, -1)).tolist() == [3 * 2, 5 * 4]


# Given states


def test_episodes_start_at_given_states() -> None:
    env = FlockingEnv(3, 4, seed=0)
    state = torch.randn(3, 4, 6, generator=torch.Generator().manual_seed(0))
    td = env.reset(TensorDict({"agents": {"state": state}}, [3]), set_state=True)
    assert torch.equal(td["agents", "observation"], state)
    ended = env.rollout(5, constant_policy(1.0))[:, -1]["next"]
    again = FlockingEnv(3, 4, seed=9).reset(ended.clone(), set_state=True)  # where another rollout ended
    assert torch.equal(again["agents", "observation"], ended["agents", "observation"])
    assert not torch.equal(env.reset(ended.clone())["agents", "observation"], ended["agents", "observation"])


def test_some_flocks_start_at_given_states() -> None:
    env = FlockingEnv(3, 4, seed=0)
    td = env.reset()
    given = td.clone().update(rows([False, True, False]))
    given["agents", "observation"] = torch.full((3, 4, 6), 2.0) + torch.arange(4).view(4, 1)
    after = env.reset(given.clone(), set_state=True)
    assert torch.equal(after["agents", "observation"][1], given["agents", "observation"][1])
    position = env.physics.position
    assert torch.equal(position[[0, 2]], td["agents", "observation"][[0, 2], :, :3])


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (torch.zeros(2, 3, 6), r"of shape \(2, 4, 6\).*there is shape \(2, 3, 6\)"),
        (None, "there is nothing"),
        (torch.full((2, 4, 6), NAN), "the state of agent 0 in flock 0 is NaN or infinite"),
    ],
)
def test_invalid_states_are_errors(state: Tensor | None, message: str) -> None:
    given = TensorDict({} if state is None else {"agents": {"state": state}}, [2])
    with pytest.raises(InputError, match=message):
        FlockingEnv(2, 4, seed=0).reset(given, set_state=True)


def test_actions_of_another_shape_are_errors() -> None:
    env = FlockingEnv(2, 4, seed=0)
    td = env.reset()
    td["agents", "action"] = torch.zeros(2, 4, 2)
    with pytest.raises(InputError, match=r"shape \(2, 4, 2\); this environment expects \(2, 4, 3\)"):
        env.step(td)


def test_coincident_agents_keep_finite_states() -> None:
    """Nothing divides by their distance: the rule is softened, and they count as in collision."""
    env = FlockingEnv(1, 4, seed=0, max_colliding=1.0)
    td = env.reset(TensorDict({"agents": {"state": torch.zeros(1, 4, 6)}}, [1]), set_state=True)
    for _ in range(10):
        td = step_mdp(env.step(Reynolds(action=ACTION)(td)))
        assert bool(td["agents", "observation"].isfinite().all())


# Flocks of different size


@pytest.mark.parametrize("graph", ["matrix", "links"])
def test_specs_hold_for_flocks_of_different_size(graph: str) -> None:
    env = FlockingEnv(4, [3, 1, 5], seed=0, graph=graph)
    check_env_specs(env)
    td = env.reset()
    assert td["agents", "mask"].sum(-1).tolist() == [3, 1, 5, 3]
    assert td["agents", "controlled"].sum(-1).tolist() == [2, 0, 4, 2]
    assert not td["agents", "observation"][~td["agents", "mask"]].any()


def test_padding_has_no_effect() -> None:
    """Rewards, the end of the episode and the expert's labels are those of the flock without padding."""
    mixed, small = FlockingEnv(2, [3, 6], seed=0, leader_noise=0.0), FlockingEnv(1, 3, seed=0, leader_noise=0.0)
    td, expert = mixed.reset(), Reynolds(action=("agents", "action"))
    state = td["agents", "observation"][:1, :3]
    other = small.reset(TensorDict({"agents": {"state": state}}, [1]), set_state=True)
    for _ in range(20):
        td, other = mixed.step(expert(td)), small.step(expert(other))
        torch.testing.assert_close(td["agents", "action"][:1, :3], other["agents", "action"])
        torch.testing.assert_close(td["next", "agents", "reward"][:1, :3], other["next", "agents", "reward"])
        assert not td["next", "agents", "reward"][0, 3:].any()
        assert torch.equal(td["next", "adjacency"][:1, :3, :3], other["next", "adjacency"])
        assert not td["next", "done"].any()
        td, other = step_mdp(td), step_mdp(other)


# Settings


@pytest.mark.parametrize(
    ("arguments", "settings", "message"),
    [
        ((0,), {}, "num_envs=0"),
        ((2.0,), {}, "num_envs=2.0"),
        ((2, 0), {}, "num_agents=0"),
        ((2, [8, 0]), {}, "num_agents=0"),
        ((2, 2.5), {}, r"num_agents=2\.5"),
        ((2, []), {}, r"num_agents=\[\]"),
        ((2, 3), {"collisions": True}, "env.collisions=true needs env.physics=bullet"),
        ((2, 3), {"comm_range": 0.0}, "env.comm_range=0.0 is out of range: it must be greater than 0"),
        ((2, 3), {"comm_range": NAN}, "env.comm_range is not a number"),
        ((2, 3), {"max_steps": 0}, "env.max_steps=0"),
        ((2, 3), {"max_speed": -1.0}, "env.max_speed=-1.0"),
        ((2, 3), {"max_colliding": 1.5}, "env.max_colliding=1.5.*at most 1"),
        ((2, 3), {"physics": "torhc"}, "env.physics=torhc is not one of torch.*did you mean 'torch'"),
        ((2, 3), {"config": FlockingConfig(), "comm_range": 2.0}, "either config or settings.*comm_range"),
    ],
)
def test_bad_settings_are_errors(arguments: tuple[Any, ...], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        FlockingEnv(*arguments, **settings)


def test_flocks_that_do_not_fit_are_errors() -> None:
    with pytest.raises(InputError, match=r"lower env\.start_distance or raise env\.start_radius"):
        FlockingEnv(1, 64, start_radius=1.0, start_distance=2.0).reset()


def test_settings_and_config_create_equal_environments() -> None:
    one = FlockingEnv(2, seed=0, config=FlockingConfig(num_agents=5, leader_noise=1.0))
    two = FlockingEnv(2, 5, seed=0, leader_noise=1.0)
    assert one.num_agents == 5
    assert equal(one.rollout(5, constant_policy(1.0)), two.rollout(5, constant_policy(1.0)))


def test_the_environment_cannot_be_moved() -> None:
    env = FlockingEnv(1, 2)
    assert env.to("cpu") is env
    with pytest.raises(InputError, match="create it with device='meta'"):
        env.to("meta")
    with pytest.raises(InputError, match=r"create it with dtype=torch.float64"):
        env.to(torch.float64)


def test_a_device_without_index_is_the_current_one(monkeypatch: pytest.MonkeyPatch) -> None:
    env = FlockingEnv(1, 2)
    monkeypatch.setattr(FlockingEnv, "device", torch.device("cuda:0"))  # what TorchRL makes of "cuda"
    assert env.to("cuda") is env
    assert env.to("cuda:0") is env
    with pytest.raises(InputError, match="is on cuda:0"):
        env.to("cuda:1")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_specs_hold_on_a_gpu() -> None:
    env = FlockingEnv(3, 4, device="cuda", seed=0)
    check_env_specs(env.to("cuda"))
    assert env.rollout(3).device == env.device


def test_presets() -> None:
    """``env=paper`` differs from the default in the separation and the leader."""
    preset = yaml.safe_load((Path(configs.__file__).parent / "env" / "paper.yaml").read_text())
    assert preset.pop("defaults") == ["flocking", "_self_"]
    paper, default = FlockingConfig(**preset), FlockingConfig()
    check(paper, "env")
    names = ("cohesion_gain", "separation_gain", "alignment_gain", "max_speed", "start_radius", "leader_noise")
    cap = "leader_max_speed"
    assert [getattr(default, name) for name in (*names, cap)] == [0.06, 0.8, 0.02, 0.92, 4.0, 0.10, 0.8]
    assert [getattr(paper, name) for name in (*names, cap)] == [0.06, 0.7, 0.02, 0.92, 4.0, 0.15, math.inf]
    assert (default.num_agents, default.comm_range, default.max_steps, default.velocity_gain) == (32, 3.5, 1000, 1.0)
    assert (default.control_frequency, default.physics_substeps) == (48.0, 5)


@pytest.mark.parametrize(("given", "sizes"), [(8, [8]), ([8, 16], [8, 16])])
def test_sizes_are_a_list(given: Any, sizes: list[int]) -> None:
    assert FlockingConfig(num_agents=given).sizes == sizes


def test_an_unknown_setting_is_an_error_with_a_suggestion() -> None:
    with pytest.raises(InputError, match="no setting comm_rnge; did you mean 'comm_range'"):
        FlockingEnv(1, 2, comm_rnge=3.0)
