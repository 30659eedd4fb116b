"""A dataset of rollouts: it returns the rollouts that were stored, and nothing else."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import get_primers_from_module, set_recurrent_mode

from modgnn_rl import make_model
from modgnn_rl.configs.schema import CollectConfig, FlockingConfig
from modgnn_rl.data.collect import collect_dataset
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.data.manifest import LOCK, MANIFEST, STATE
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.errors import InputError
from modgnn_rl.utils.seeds import derive_seed

WORLD = FlockingConfig(num_agents=6, comm_range=2.0, separation_gain=0.7, leader_max_speed=float("inf"))
EPISODES, STEPS, AT_ONCE = 5, 9, 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "set"
    return collect_dataset(
        CollectConfig(env=WORLD, episodes=EPISODES, steps=STEPS, num_envs=AT_ONCE, seed=3, output=str(path))
    )


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folder, tmp_path / "copy"))


def rollouts(policy: Any = None) -> TensorDict:
    """The same rollouts from TorchRL, with the actions of a policy that does not act; [E, T]."""
    shards = []
    for name, flocks in (("shard_00000", 2), ("shard_00001", 2), ("shard_00002", 1)):
        env = FlockingEnv(flocks, config=WORLD, seed=derive_seed(3, name))
        primers = [] if policy is None else [get_primers_from_module(policy, warn=False)]
        env = TransformedEnv(env, Compose(InitTracker(), *primers))
        expert, step, steps = Reynolds.for_env(WORLD), env.reset(), []
        for _ in range(STEPS):
            with set_recurrent_mode(False), torch.no_grad():
                step = expert(step) if policy is None else expert(policy(step))
            if policy is not None:
                step["looks_on"] = step["agents", "action"]
            step["agents", "action"] = step["agents", "expert_action"]
            steps.append(step.clone())
            step = env.step_mdp(env.step(step))
        shards.append(torch.stack([step.exclude("next") for step in steps], 1))
    return torch.cat(shards)


def test_what_is_stored_is_what_the_expert_flew(folder: Path) -> None:
    dataset, collected = EpisodeDataset.open(folder), rollouts()
    assert (dataset.episodes, dataset.steps, dataset.num_agents, len(dataset)) == (5, 9, 6, 45)
    assert dataset.env_config == FlockingConfig(**{**vars(WORLD), "max_steps": STEPS})
    stored = torch.cat([shard["state"] for shard in dataset.shards])
    assert torch.equal(stored, collected["agents", "observation"])


@pytest.mark.parametrize("length", [1, 2, 4])
def test_windows_are_the_environments_data_and_its_experts(folder: Path, length: int) -> None:
    dataset, collected = EpisodeDataset.open(folder), rollouts()
    windows = dataset.windows(torch.arange(len(dataset)), length)
    assert windows.batch_size == (len(dataset), length)
    for index in range(len(dataset)):
        episode, last = divmod(index, STEPS)
        steps = torch.arange(last + 1 - length, last + 1).clamp(min=0)
        assert torch.equal(windows["is_init"][index, :, 0], steps == 0)
        expected = collected[episode, steps]
        for key in (("agents", "observation"), ("agents", "controlled"), "adjacency"):
            assert torch.equal(windows[key][index], expected[key])
        torch.testing.assert_close(windows["agents", "expert_action"][index], expected["agents", "expert_action"])


@pytest.mark.parametrize(("name", "layers"), [("pair_force", 1), ("modgnn_mlp", 1), ("gcn", 2)])
def test_a_policy_does_at_the_end_of_a_window_what_it_does_in_a_rollout(folder: Path, name: str, layers: int) -> None:
    policy = make_model(name, hops=2, layers=layers, seed=0)
    collected, dataset = rollouts(policy), EpisodeDataset.open(folder)
    windows = dataset.windows(torch.arange(len(dataset)), policy.window)
    with set_recurrent_mode(True), torch.no_grad():
        action = policy(windows)["agents", "action"][:, -1]
    torch.testing.assert_close(action, collected["looks_on"].flatten(0, 1), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("index", [[-1], [45], [0, 44, 45]])
def test_states_that_do_not_exist_are_refused(folder: Path, index: list[int]) -> None:
    with pytest.raises(InputError, match="indices are 0 to 44"):
        EpisodeDataset.open(folder).windows(torch.tensor(index), 1)


def test_a_shard_is_a_memory_mapped_tensordict(folder: Path) -> None:
    for number, shard in enumerate(EpisodeDataset.open(folder).shards):
        loaded = TensorDict.load_memmap(folder / f"shard_{number:05d}")
        assert loaded.batch_size == shard.batch_size
        assert torch.equal(loaded["state"], shard["state"])


def test_changes_do_not_reach_the_files(folder: Path) -> None:
    EpisodeDataset.open(folder).shards[0]["state"].zero_()
    assert EpisodeDataset.open(folder).shards[0]["state"].any()


# Batches


def test_a_buffer_serves_the_windows_of_its_episodes_alone(folder: Path) -> None:
    dataset = EpisodeDataset.open(folder)
    buffer = dataset.buffer(2, 400, episodes=range(2, 4), generator=torch.Generator().manual_seed(0))
    batch = buffer.sample()
    assert batch.batch_size == (400, 2)
    served = {tuple(state.flatten().tolist()) for state in batch["agents", "observation"][:, -1]}
    states = dataset.states(torch.arange(2 * STEPS, 4 * STEPS), 1)
    assert served == {tuple(state.flatten().tolist()) for state in states}


def test_equal_generators_draw_equal_batches(folder: Path) -> None:
    dataset = EpisodeDataset.open(folder)
    batches = [
        dataset.buffer(1, 8, generator=torch.Generator().manual_seed(seed)).sample()["agents", "observation"]
        for seed in (0, 0, 1)
    ]
    assert torch.equal(batches[0], batches[1])
    assert not torch.equal(batches[0], batches[2])


@pytest.mark.parametrize("episodes", [range(3, 6), range(0), range(-1, 2), range(0, 4, 2)])
def test_episodes_that_do_not_exist_are_refused(folder: Path, episodes: range) -> None:
    with pytest.raises(InputError, match="is not a range of the 5 episodes"):
        EpisodeDataset.open(folder).buffer(1, 8, episodes=episodes)


# Damage


@settings(max_examples=60)
@given(data=st.data())
def test_no_bit_can_change(folder: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = Path(shutil.copytree(folder, tmp_path_factory.mktemp("bits") / "set"))
    file = data.draw(st.sampled_from(sorted(file for file in path.rglob("*") if file.is_file() and file.name != LOCK)))
    content = bytearray(file.read_bytes())
    bit = data.draw(st.integers(0, 8 * len(content) - 1))
    content[bit // 8] ^= 1 << bit % 8
    file.write_bytes(content)
    name = file.parent.name if file.parent != path else MANIFEST
    with pytest.raises(InputError, match=name):
        EpisodeDataset.open(path)


class Malicious:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def _plant(name: str) -> Callable[[Path], None]:
    def plant(path: Path) -> None:
        (path / name).write_bytes(pickle.dumps(Malicious(path.parent / "executed")))

    return plant


def _edit(**changes: Any) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        content = json.loads((path / MANIFEST).read_text())
        (path / MANIFEST).write_text(json.dumps({**content, **changes}))

    return edit


@pytest.mark.parametrize("verify", [True, False])
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: shutil.rmtree(path / "shard_00001"), "shard_00001 is damaged .it is missing.*run the same"),
        (lambda path: (path / "shard_00002" / STATE).unlink(), "shard_00002.*state.memmap is missing"),
        (lambda path: os.truncate(path / "shard_00000" / STATE, 400), "shard_00000.*has 400 bytes instead of 2592"),
        (lambda path: (path / MANIFEST).unlink(), "not a dataset of rollouts.*modgnn_rl.collect creates one"),
        (lambda path: (path / MANIFEST).write_text("[" * 100_000), "manifest.json is damaged"),
        (lambda path: (path / MANIFEST).write_text("null"), "manifest.json is damaged"),
        (lambda path: (path / MANIFEST).write_bytes(b"\xff\xfe"), "manifest.json is damaged"),
        (_edit(schema_version=1), "has schema version 1, this program reads 3"),
        (_edit(steps=1), "manifest.json is damaged .*changed since it was written"),
        (_plant("other.pickle"), "other.pickle does not belong to the dataset"),
        (_plant("shard_00003"), "shard_00003 does not belong to the dataset"),
        (_plant("shard_00001/other.pickle"), "shard_00001 is damaged .other.pickle does not belong there"),
        (_plant("shard_00001/meta.json"), "shard_00001 is damaged .meta.json has"),
    ],
)
def test_damage_is_named(copy: Path, verify: bool, spoil: Callable[[Path], None], message: str) -> None:
    spoil(copy)
    with pytest.raises(InputError, match=message):
        EpisodeDataset.open(copy, verify=verify)
    assert not (copy.parent / "executed").exists()


def test_without_verification_sizes_alone_are_compared(copy: Path) -> None:
    file = copy / "shard_00000" / STATE
    file.write_bytes(bytes(file.stat().st_size))
    assert not EpisodeDataset.open(copy, verify=False).shards[0]["state"].any()
    with pytest.raises(InputError, match=r"shard_00000.*has changed since it was written"):
        EpisodeDataset.open(copy)


# Worlds


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("num_agents", 7),
        ("num_agents", [6, 7]),
        ("comm_range", 3.5),
        ("separation_gain", 0.8),
        ("max_speed", 1.0),
        ("leader_noise", 0.0),
        ("message_loss", 0.1),
        ("wind", 1.0),
        ("graph", "links"),
    ],
)
def test_another_world_is_refused_with_the_difference(folder: Path, setting: str, value: Any) -> None:
    env_config = FlockingConfig(**{**vars(WORLD), setting: value})
    with pytest.raises(InputError) as error:
        EpisodeDataset.open(folder).check_env_config(env_config)
    there = getattr(WORLD, setting)
    assert f"have another env config: env.{setting}={value} (there {there});" in str(error.value)


def test_what_has_no_effect_may_differ(folder: Path) -> None:
    env_config = FlockingConfig(
        **{**vars(WORLD), "num_agents": [6], "max_steps": 7, "max_distance": 5.0, "compile": True}
    )
    EpisodeDataset.open(folder).check_env_config(env_config)
