"""Runs that are killed, on disks that are full, and files that are damaged.

Run with ``pytest -m slow tests/experiment/test_survival.py``.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import resource
import shutil
import signal
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch

from modgnn_rl.configs.schema import FlockingConfig, ModelConfig, TrainConfig
from modgnn_rl.errors import InputError
from modgnn_rl.experiment.training import resume, train
from modgnn_rl.tracking.checkpoint import load_checkpoint, save_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder

IMITATION = {"capacity": 150, "num_val_envs": 2, "checkpoint_minutes": 0}
SETTINGS: dict[str, dict[str, Any]] = {
    "bc": {**IMITATION, "cloning_steps": 24, "cloning_updates": 30},
    "dagger": {
        **IMITATION,
        "cloning_steps": 12,
        "cloning_updates": 6,
        "rounds": 20,
        "steps_per_round": 12,
        "beta_rounds": 3,
    },
    "mappo": {
        "rounds": 20,
        "steps_per_round": 8,
        "critic_warmup": 1,
        "num_minibatches": 2,
        "critic_hidden": 64,
        "checkpoint_minutes": 0,
    },
}
MOMENTS = 20
FILE_CALLS = {"open", "write", "close", "mkdir", "fsync", "replace", "rename", "rmdir", "unlink", "scandir", "lstat"}


@pytest.fixture(scope="module")
def config(small_config):
    """Makes the configuration of a run with a checkpoint after every round."""
    env = FlockingConfig(num_agents=4, max_steps=15)

    def make(runs: Path, trainer: str, **settings: Any) -> TrainConfig:
        return small_config(runs, trainer, **{"env": env, "model": ModelConfig(), **SETTINGS[trainer], **settings})

    return make


def _start(function, *arguments, **options):
    """Call a function in a process of its own, without a word."""

    def work():
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        function(*arguments, **options)

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    return process


def _contents(run: RunFolder):
    found = load_checkpoint(run.checkpoints)
    return found.tensors, run.metrics_file.read_bytes()


def _assert_equal(one, other):
    assert one[1] == other[1]
    for group, named in one[0].items():
        for name, value in named.items():
            torch.testing.assert_close(
                other[0][group][name], value, rtol=0, atol=0, equal_nan=True, msg=f"{group} {name}"
            )


@pytest.mark.slow
@pytest.mark.parametrize("trainer", ["bc", "dagger", "mappo"])
def test_runs_killed_at_random_moments(tmp_path, trainer, config):
    began = time.monotonic()
    straight = train(config(tmp_path / "straight", trainer), evaluate=False)
    duration = time.monotonic() - began
    moments = random.Random(0)
    ended = {"before its folder": 0, "before its first checkpoint": 0, "later": 0}
    for number in range(MOMENTS):
        runs = tmp_path / str(number)
        process = _start(train, config(runs, trainer), evaluate=False)
        time.sleep(moments.uniform(0.0, duration))
        process.kill()
        process.join()
        folder = next(runs.glob("*/config.yaml"), runs).parent
        saved = any((folder / "checkpoints").glob("step_*[0-9]"))
        when = "later" if saved else "before its first checkpoint" if folder.parent == runs else "before its folder"
        ended[when] += 1
        if when == "before its folder":
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # no checkpoint may be damaged
            run = resume(folder, evaluate=False)
        _assert_equal(_contents(straight), _contents(run))
        assert run.state == "finished"
    print(f"{trainer} killed", ", ".join(f"{when} {count} times" for when, count in ended.items()))
    assert ended["later"] > MOMENTS / 4


@pytest.mark.slow
def test_killed_at_every_file_operation_while_a_checkpoint_is_written(tmp_path):
    tensors = {"policy": {"weight": torch.arange(6.0)}, "data": {"rows": torch.zeros(1000, 10)}}

    def save_and_die(folder, alive_for):
        calls = 0

        def die(frame, event, function):
            nonlocal calls
            if event == "c_call" and function.__name__ in FILE_CALLS:
                calls += 1
                if calls > alive_for:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.setprofile(die)
        save_checkpoint(folder, 3, tensors, {}, keep=2)

    alive_for, ended = 0, -signal.SIGKILL
    while ended == -signal.SIGKILL:
        folder = tmp_path / str(alive_for)
        for step in (1, 2):
            save_checkpoint(folder, step, tensors, {"step": step}, keep=2)
        process = _start(save_and_die, folder, alive_for)
        process.join()
        ended = process.exitcode
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert load_checkpoint(folder).step in (2, 3)
        alive_for += 1
    assert ended == 0
    assert alive_for > 20
    print(f"killed at {alive_for - 1} calls")


def test_a_full_disk_does_not_stop_training_and_is_reported(tmp_path, finished, config):
    def train_on_a_small_disk():
        warnings.simplefilter("default")
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # of a file; the checkpoints are larger
        train(config(tmp_path / "runs", "dagger", rounds=6), evaluate=False)

    process = _start(train_on_a_small_disk)
    process.join()
    (folder,) = (tmp_path / "runs").iterdir()
    run = RunFolder.open(folder)
    assert process.exitcode == 1
    assert run.state == "failed"
    assert "File too large" in run.status["reason"]
    assert "free some space" in run.status["reason"]
    assert len(run.read_metrics()) == 7  # it went on to the end
    assert [path.name for path in run.checkpoints.iterdir()] == []
    resume(folder, evaluate=False)
    _assert_equal(_contents(finished), _contents(run))


@pytest.fixture(scope="module")
def finished(tmp_path_factory, config):
    return train(config(tmp_path_factory.mktemp("finished"), "dagger", rounds=6), evaluate=False)


def _damage(path: Path, how: str) -> None:
    content = bytearray(path.read_bytes())
    if how == "cut":
        path.write_bytes(content[: len(content) // 2])
    else:
        content[len(content) // 2] ^= 1
        path.write_bytes(content)


@pytest.mark.parametrize("how", [pytest.param("cut", marks=pytest.mark.slow), "one bit flipped"])
def test_a_damaged_checkpoint_is_skipped(tmp_path, finished, how):
    straight = _contents(finished)
    newest = max(finished.checkpoints.iterdir())
    for file in sorted(newest.iterdir()):
        folder = tmp_path / file.name
        shutil.copytree(finished.path, folder)
        _damage(folder / "checkpoints" / newest.name / file.name, how)
        with pytest.warns(RuntimeWarning, match="CHECKPOINT SKIPPED"):
            assert load_checkpoint(folder / "checkpoints").step == 6
    with pytest.warns(RuntimeWarning, match="CHECKPOINT SKIPPED"):
        run = resume(folder, evaluate=False)
    _assert_equal(straight, _contents(run))
    for file in run.checkpoints.glob("*/policy.safetensors"):
        _damage(file, how)
    with pytest.warns(RuntimeWarning), pytest.raises(InputError, match="restore it from a copy or train again"):
        resume(folder, evaluate=False)


def test_a_folder_in_use_is_refused(finished):
    with finished.lock():
        assert finished.is_locked
        process = multiprocessing.get_context("fork").Process(target=_refused, args=(finished.path,))
        process.start()
        process.join()
    assert process.exitcode == 0
    assert not finished.is_locked


def _refused(folder):
    with pytest.raises(InputError, match="in use by a training run"):
        resume(folder, evaluate=False)


def test_a_killed_run_shows_as_killed(tmp_path, finished):
    folder = tmp_path / "run"
    shutil.copytree(finished.path, folder)
    status = json.loads((folder / "status.json").read_text())
    (folder / "status.json").write_text(json.dumps({**status, "state": "training"}))
    run = RunFolder.open(folder)
    assert run.state == "killed"
    with run.lock():
        assert run.state == "training"
