"""The adapters for Gymnasium and PettingZoo: the libraries' checkers, and agreement with the environment."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import VectorEnv
from pettingzoo.test import parallel_api_test
from tensordict import TensorDict
from torchrl.envs import GymEnv

from modgnn_rl import make_model
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.adapters.pettingzoo_env import parallel_env
from modgnn_rl.errors import InputError

NAME = "modgnn_rl/Flocking-v0"


def make(num_agents: int = 4, **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(NAME, num_agents=num_agents, **options)


def make_vec(num_envs: int, num_agents: int = 4, **options: Any) -> VectorEnv[Any, Any, Any]:
    return gymnasium.make_vec(NAME, num_envs, vectorization_mode="vector_entry_point", num_agents=num_agents, **options)


def actions(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(*shape, 3)).astype(np.float32)


@pytest.mark.parametrize(
    "settings",
    [{}, {"physics": "bullet"}, {"dropout_rate": 0.5, "position_noise": 0.1}, {"graph": "links"}, {"num_agents": 1}],
)
def test_gymnasium_check_env_passes(settings: dict[str, Any]) -> None:
    env = make(**{"num_agents": 4, "width": 40, "height": 30, "render_mode": "rgb_array", **settings})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Deprecation warnings of TorchRL and PyTorch are not the adapter's.
        warnings.filterwarnings("ignore", category=DeprecationWarning)
        check_env(env.unwrapped)
    env.close()


def test_the_adapter_equals_the_environment() -> None:
    env, behind = make(), FlockingEnv(1, 4)
    observation, info = env.reset(seed=3)
    behind.set_seed(3)
    td = behind.reset()
    for step in range(10):
        assert np.array_equal(observation["observation"], td["agents", "observation"][0])
        assert np.array_equal(observation["adjacency"], td["adjacency"][0].to(torch.int8))
        assert observation["controlled"].tolist() == [0, 1, 1, 1]
        assert np.array_equal(info["state"], observation["observation"])
        action = actions(4, seed=step)
        observation, reward, terminated, truncated, info = env.step(action)
        td["agents", "action"] = torch.from_numpy(action).unsqueeze(0)
        td = behind.step(td)["next"]
        rewards = td["agents", "reward"][0, :, 0]
        assert reward == pytest.approx(float(rewards[1:].mean()), rel=1e-6)
        assert np.array_equal(info["agent_rewards"], rewards)
        assert (terminated, truncated) == (False, False)
    assert np.array_equal(info["target_velocity"], behind.target_velocity[0])


def test_seeds_determine_rollouts_and_outputs_are_copies() -> None:
    rollouts = []
    for seed in (1, 1, 2):
        env = make()
        first, _ = env.reset(seed=seed)
        kept = first["observation"].copy()
        rollouts.append([env.step(actions(4, seed=step))[0]["observation"] for step in range(5)])
        assert np.array_equal(first["observation"], kept)
    assert np.array_equal(rollouts[0], rollouts[1])
    assert not np.array_equal(rollouts[0], rollouts[2])


def test_episodes_end() -> None:
    env = make(max_steps=3)
    env.reset(seed=0)
    assert [env.step(actions(4))[3] for _ in range(3)] == [False, False, True]


def test_episodes_start_at_given_states() -> None:
    state = np.arange(24.0).reshape(4, 6)
    observation, _ = make().reset(options={"state": state})
    assert np.array_equal(observation["observation"], state)
    with pytest.raises(InputError, match=r"shape \(3, 6\); positions and velocities have \(4, 6\)"):
        make().reset(options={"state": state[:3]})
    with pytest.raises(InputError, match="no option 'sate'; did you mean 'state'"):
        make().reset(options={"sate": state})


def test_invalid_settings_actions_and_modes_are_errors() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'comm_rage'; did you mean 'comm_range'"):
        make(comm_rage=3.0)
    with pytest.raises(InputError, match="comm_range=-1"):
        make(comm_range=-1.0)
    env = make()
    env.reset(seed=0)
    with pytest.raises(InputError, match="NaN or infinite"):
        env.step(np.full((4, 3), np.nan, np.float32))
    with pytest.raises(InputError, match="render_mode"):
        env.unwrapped.render()


# Many flocks


def test_one_flock_in_a_batch_is_the_single_flock() -> None:
    single, batch = make(max_steps=5), make_vec(1, max_steps=5)
    seen, _ = single.reset(seed=1)
    seen_in_batch, _ = batch.reset(seed=1)
    for step in range(12):
        assert np.array_equal(seen["observation"], seen_in_batch["observation"][0])
        action = actions(4, seed=step)
        seen, reward, terminated, truncated, _ = single.step(action)
        seen_in_batch, rewards, terminations, truncations, info = batch.step(action[None])
        assert (reward, terminated, truncated) == (rewards[0], terminations[0], truncations[0])
        if truncated:
            assert np.array_equal(info["final_obs"]["observation"][0], seen["observation"])
            assert info["_final_obs"].tolist() == [True]
            seen, _ = single.reset()
        else:
            assert "final_obs" not in info


def test_observations_lie_in_their_spaces() -> None:
    batch = make_vec(3, dropout_rate=1.0, physics="torch")
    observation, _ = batch.reset(seed=[1, 2, 3])  # type: ignore[arg-type]
    for _ in range(3):
        assert batch.observation_space.contains(observation)
        observation, rewards, *_ = batch.step(batch.action_space.sample())
        assert rewards.shape == (3,)
    batch.close()


def test_gymnasium_vectorizes_single_flocks() -> None:
    batch = gymnasium.make_vec(NAME, 2, vectorization_mode="sync", num_agents=3)
    observation, _ = batch.reset(seed=0)
    assert observation["observation"].shape == (2, 3, 6)
    batch.close()


# Other libraries


def test_torchrl_wraps_it() -> None:
    rollout = GymEnv(NAME, num_agents=4).rollout(3)
    assert rollout["observation"].shape == (3, 4, 6)
    assert rollout["next", "reward"].shape == (3, 1)


def test_pettingzoo_parallel_api_test_passes() -> None:
    parallel_api_test(parallel_env(num_agents=4, max_steps=10), num_cycles=30)


def test_followers_observe_their_neighbours_in_the_graph() -> None:
    env = parallel_env(num_agents=5, comm_range=1.5)
    observations, _ = env.reset(seed=0)
    assert list(observations) == env.agents == ["agent_1", "agent_2", "agent_3", "agent_4"]
    behind = FlockingEnv(1, 5, comm_range=1.5)
    behind.set_seed(0)
    td = behind.reset()
    for index, name in enumerate(env.agents, 1):
        heard = td["adjacency"][0, index]
        assert observations[name]["heard"].tolist() == heard.int().tolist()
        everyone = td["agents", "observation"][0]
        assert np.array_equal(observations[name]["neighbours"], torch.where(heard.unsqueeze(-1), everyone, 0.0))
        assert np.array_equal(observations[name]["observation"], everyone[index])


def test_a_follower_follows_its_own_action() -> None:
    env = parallel_env(num_agents=3)
    env.reset(seed=0)
    env.step({"agent_2": np.array([0.5, 0.0, 0.0])})
    target = env.flocks.env.target_velocity[0]
    assert target[1:].tolist() == [[0, 0, 0], [0.5, 0, 0]]


@pytest.mark.parametrize(
    ("arguments", "message"), [({"num_agents": 1}, "leaves no agent to control"), ({"graph": "links"}, "matrix")]
)
def test_flocks_without_followers_and_edge_lists_are_errors(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parallel_env(**arguments)


def test_a_policy_of_all_agents_acts_on_what_pettingzoo_infos_hold() -> None:
    env, policy = parallel_env(5), make_model("gcn", seed=0)
    _, infos = env.reset(seed=0)
    for _ in range(2):
        observation, adjacency = (torch.from_numpy(infos["agent_1"][key]) for key in ("observations", "adjacency"))
        near = torch.cdist(observation[:, :3], observation[:, :3]) <= 3.5
        assert torch.equal(adjacency.bool(), near.fill_diagonal_(False))
        data = TensorDict({"agents": {"observation": observation}, "adjacency": adjacency.bool()}, [])
        data["is_init"] = torch.ones(1, dtype=torch.bool)
        action = policy(data)["agents", "action"].detach().numpy()
        _, _, _, _, infos = env.step({name: action[index] for index, name in enumerate(env.possible_agents, 1)})
    env.close()
