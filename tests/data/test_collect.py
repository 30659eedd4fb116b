"""Collecting a dataset: it resumes wherever it was stopped, and nothing is half-written or overwritten."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from filelock import FileLock
from tensordict import TensorDict

from modgnn_rl.configs.schema import CollectConfig, FlockingConfig
from modgnn_rl.data import collect as collect_module
from modgnn_rl.data import manifest
from modgnn_rl.data.collect import collect_dataset, describe_dataset, rollout_expert
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.data.manifest import LOCK, MANIFEST, STATE, Manifest
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.utils import folders

WORLD = FlockingConfig(num_agents=4)


def config(path: Path, **others: Any) -> CollectConfig:
    given = {"env": WORLD, "episodes": 5, "steps": 4, "num_envs": 2, "seed": 0, "output": str(path), **others}
    return CollectConfig(**given)


def content(path: Path) -> dict[str, bytes]:
    return {str(file.relative_to(path)): file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return content(collect_dataset(config(tmp_path_factory.mktemp("whole") / "set")))


def test_one_seed_fixes_the_rollouts_and_no_two_are_equal(tmp_path: Path, whole: dict[str, bytes]) -> None:
    assert content(collect_dataset(config(tmp_path / "again"))) == whole
    other = EpisodeDataset.open(collect_dataset(config(tmp_path / "other", seed=1)))
    states = torch.cat(
        [shard["state"] for data in (EpisodeDataset.open(tmp_path / "again"), other) for shard in data.shards]
    )
    assert len({str(rollout.tolist()) for rollout in states}) == 10


class Killed(BaseException):
    """Ends a process where it stands."""


STOPS: list[tuple[Any, str]] = [
    (collect_module, "rollout_expert"),
    (folders, "fsync_file"),
    (os, "replace"),
    (collect_module, "describe_shard"),
    (manifest, "write_atomically"),
    (TensorDict, "memmap"),
]


@pytest.mark.parametrize(("module", "name"), STOPS)
@pytest.mark.parametrize("call", [0, 2])
def test_a_stopped_collection_resumes_to_the_same_bits(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    whole: dict[str, bytes],
    module: Any,
    name: str,
    call: int,
) -> None:
    calls, function = [], getattr(module, name)

    def stopped(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        if len(calls) > call:
            raise Killed
        return function(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(module, name, stopped)
        with pytest.raises(Killed):
            collect_dataset(config(tmp_path / "set"))
    if (tmp_path / "set" / MANIFEST).exists():
        with pytest.raises(InputError, match=r"is incomplete \([012] of 3 shards\); re-run the same"):
            EpisodeDataset.open(tmp_path / "set")
    assert content(collect_dataset(config(tmp_path / "set"))) == whole
    EpisodeDataset.open(tmp_path / "set")


def test_leftovers_of_a_killed_process_go(tmp_path: Path, whole: dict[str, bytes]) -> None:
    path = tmp_path / "set"
    (path / "shard_00001.tmp").mkdir(parents=True)
    (path / ".manifest.json.17.tmp").write_text("{")
    assert content(collect_dataset(config(path))) == whole


def test_ctrl_c_says_how_far_it_got(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = rollout_expert

    def interrupted(task: FlockingTask, env: FlockingEnv, *arguments: Any) -> Any:
        if env.batch_size[0] == 1:
            raise KeyboardInterrupt
        return real(task, env, *arguments)

    monkeypatch.setattr(collect_module, "rollout_expert", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collect_dataset(config(tmp_path / "set"))
    assert "has 2 of 3 shards; re-running the same command resumes there" in capsys.readouterr().err


def test_a_finished_dataset_is_not_touched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    collect_dataset(config(tmp_path / "set"))
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")}
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 10, 0))
    collect_dataset(config(tmp_path / "set"))
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*")} == before


@pytest.mark.parametrize("first", [1, 4])
def test_more_episodes_are_added(
    tmp_path: Path, whole: dict[str, bytes], capsys: pytest.CaptureFixture[str], first: int
) -> None:
    collect_dataset(config(tmp_path / "set", episodes=first))
    assert content(collect_dataset(config(tmp_path / "set"))) == whole
    assert "damaged" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: shutil.rmtree(path / "shard_00000"),
        lambda path: os.truncate(path / "shard_00001" / STATE, 10),
        lambda path: (path / "shard_00002" / STATE).write_bytes(bytes(4 * 4 * 4 * 6)),
        lambda path: (path / "shard_00001" / "other").write_text(""),
    ],
)
def test_damaged_shards_are_collected_again(
    tmp_path: Path, whole: dict[str, bytes], capsys: pytest.CaptureFixture[str], damage: Callable[[Path], None]
) -> None:
    path = collect_dataset(config(tmp_path / "set"))
    damage(path)
    assert content(collect_dataset(config(path))) == whole
    assert "and is collected again" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"seed": 1}, r"other settings: seed=1 \(there 0\); give output"),
        ({"steps": 5, "num_envs": 3}, r"num_envs=3 \(there 2\), steps=5 \(there 4\);"),
        ({"env": FlockingConfig(num_agents=4, wind=0.5)}, r"env.wind=0.5 \(there 0.0\);"),
        ({"episodes": 4}, "is for 5 episodes, more than episodes=4"),
    ],
)
def test_other_settings_are_refused(
    tmp_path: Path, whole: dict[str, bytes], others: dict[str, Any], message: str
) -> None:
    path = collect_dataset(config(tmp_path / "set"))
    with pytest.raises(InputError, match=message):
        collect_dataset(config(path, **others))
    assert content(path) == whole


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("message_loss", 0.1),
        ("delay", 1),
        ("range_spread", 0.1),
        ("position_noise", 0.1),
        ("velocity_noise", 0.1),
        ("dropout_rate", 0.1),
        ("graph", "links"),
        ("num_agents", [4, 5]),
    ],
)
def test_worlds_that_positions_do_not_tell_are_refused(tmp_path: Path, setting: str, value: Any) -> None:
    env_config = dataclasses.replace(WORLD, **{setting: value})
    with pytest.raises(InputError, match=f"env.{setting}="):
        collect_dataset(config(tmp_path / "set", env=env_config))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "env_config",
    [
        {"wind": 2.0},
        {"leader": "waypoints", "start": "clusters"},
        {"physics": "bullet", "collisions": True, "start_distance": 0.0, "start_radius": 0.5},
    ],
)
def test_rollouts_do_not_depend_on_those_before(tmp_path: Path, env_config: dict[str, Any]) -> None:
    if "physics" in env_config:
        pytest.importorskip("pybullet")
    env_config = {"env": dataclasses.replace(WORLD, **env_config), "steps": 10, "episodes": 4}
    one = collect_dataset(config(tmp_path / "one", **env_config))
    other = collect_dataset(config(tmp_path / "other", **env_config))
    shutil.rmtree(other / "shard_00001")
    assert content(collect_dataset(config(other, **env_config))) == content(one)


def test_nothing_ends_a_rollout() -> None:
    env_config = FlockingConfig(num_agents=5, max_steps=3, max_distance=0.1, max_colliding=0.01, collision_distance=9.0)
    states, plain = (
        rollout_expert(task, task.evaluation_env(3, 5, 0, "cpu", steps=12), 12)
        for task in (FlockingTask(env_config), FlockingTask(FlockingConfig(num_agents=5)))
    )
    assert torch.equal(states, plain)
    assert not states[:, 0, :, 3:].any()
    assert states[:, 1:, 1:, 3:].any(-1).all()


# Places


def test_a_full_disk_is_refused_beforehand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 0, 5 * 10**6))
    with pytest.raises(InputError, match=r"dataset takes 23,040 MB and the disk of .* has 5 MB free; free some space"):
        collect_dataset(config(tmp_path / "deep" / "set", episodes=30_000, steps=1000, env=FlockingConfig()))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["file", "file/set"])
def test_a_file_in_the_way_is_one_sentence(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match=r"cannot write into .*give output="):
        collect_dataset(config(tmp_path / name))
    assert (tmp_path / "file").read_text() == "mine"


def test_a_folder_of_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(InputError, match="not a dataset of rollouts"):
        collect_dataset(config(tmp_path))
    assert content(tmp_path) == {"mine": b"mine"}


def test_two_processes_do_not_write_one_dataset(tmp_path: Path) -> None:
    with FileLock(tmp_path / LOCK), pytest.raises(InputError, match="another process is writing"):
        collect_dataset(config(tmp_path))
    collect_dataset(config(tmp_path))


# The command


def test_the_report_ends_with_the_command_that_trains_in_the_same_world(tmp_path: Path) -> None:
    env_config = FlockingConfig(
        num_agents=4, separation_gain=0.7, leader_max_speed=float("inf"), start="grid", ground=-9.0
    )
    text = describe_dataset(collect_dataset(config(tmp_path / "my set", env=env_config)))
    assert "5 rollouts of 4 steps with 4 agents are in" in text
    assert text.endswith(
        f"python -m modgnn_rl.train trainer=bc 'trainer.dataset={tmp_path}/my set' env.num_agents=4 "
        "env.separation_gain=0.7 env.start=grid env.leader_max_speed=inf env.ground=-9.0"
    )


@pytest.mark.slow  # a process of its own
def test_the_command_and_kill(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "modgnn_rl.collect", "episodes=40", "steps=100", "num_envs=2", "env.num_agents=5"]
    stopped = subprocess.Popen([*command, "output=stopped"], cwd=tmp_path, stderr=subprocess.DEVNULL)
    while not list((tmp_path / "stopped").glob("shard_0000[0-9]")):
        assert stopped.poll() is None
    stopped.kill()
    stopped.wait()
    assert not Manifest.read(tmp_path / "stopped").is_complete
    for name in ("stopped", "whole"):
        done = subprocess.run([*command, f"output={name}"], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert "Next: python -m modgnn_rl.train trainer=bc" in done.stdout
    assert content(tmp_path / "stopped") == content(tmp_path / "whole")
