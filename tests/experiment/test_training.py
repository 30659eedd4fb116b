"""The main job as a user runs it, in small."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import pytest
import torch
import yaml
from tensordict import TensorDict

from modgnn_rl import load_policy
from modgnn_rl.cli.command import run_command
from modgnn_rl.configs.schema import (
    DAggerConfig,
    EnvOverrides,
    EvaluateConfig,
    EvaluationConfig,
    FlockingConfig,
    ModelConfig,
    TrainConfig,
)
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.errors import InputError
from modgnn_rl.experiment.evaluate import evaluate_run
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.train import main
from modgnn_rl.trainers.loop import dashboard_callback
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.utils.device import prepare_torch

SMALL_EVALUATION = EvaluationConfig(num_flocks=3, steps=12)


@pytest.fixture(scope="module")
def config(small_config):
    """Makes the configuration of a small run with a small evaluation."""
    small = {"num_envs": 2, "capacity": 400, "cloning_steps": 10, "cloning_updates": 4, "steps_per_round": 5}
    small |= {"env": FlockingConfig(num_agents=5), "model": ModelConfig(), "evaluation": SMALL_EVALUATION}
    return lambda runs, **settings: small_config(runs, "dagger", **{**small, **settings})


@pytest.fixture(scope="module")
def run(tmp_path_factory, config) -> RunFolder:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dashboard_callback, "STEPS", 8)  # of the reference rollouts
        return train(config(tmp_path_factory.mktemp("runs"), logger="csv"))


def test_a_run_folder_holds_configuration_metrics_checkpoint_and_table(run):
    config = yaml.safe_load((run.path / "config.yaml").read_text())
    assert config["trainer"]["rounds"] == 3
    assert config["env"]["comm_range"] == 3.5
    metrics = run.read_metrics()
    assert [line["step"] for line in metrics] == [0, 1, 2, 3]
    for name in ("error", "loss", "leader_distance", "cohesion", "separation", "min_distance"):
        assert f"5/{name}" in metrics[-1]
    assert list(run.checkpoints.iterdir())
    table = json.loads((run.path / "evaluation.json").read_text())["5"]["rows"]
    rows = ["moment_force", "expert", "local expert (2 hops)", "local expert (1 hop)", "zero action"]
    assert list(table) == rows
    assert all(row in (run.path / "evaluation.md").read_text() for row in rows)


def test_a_checkpoint_holds_the_whole_state_of_a_run(run):
    checkpoint = load_checkpoint(run.checkpoints)
    of_flocks = {
        f"{name}.{part}" for name in ("rollouts-5", "validation-5") for part in ("env", "carried", "mixture", "data")
    }
    assert set(checkpoint.tensors) == {"policy", "trained", "optimizer", "generators", *of_flocks}
    generators = ("env", "faults", "noise", "places", "mixture", "disturbance", "batches")
    assert set(checkpoint.tensors["generators"]) == {
        "learner",
        "validation",
        *(f"{name}.{role}" for name in ("rollouts-5", "validation-5") for role in generators),
    }
    assert checkpoint.state["config"] == run.config
    assert checkpoint.state["updates"] == checkpoint.state["averaged"] == 10
    assert checkpoint.step == 4  # rounds, the cloning included


@pytest.mark.parametrize("agents", [1, 2, 9])
def test_the_policy_loads_and_acts_at_any_size(run, agents):
    policy = load_policy(run.path)
    agents_data = TensorDict({"observation": torch.randn(4, agents, 6)}, [4])
    step = TensorDict({"agents": agents_data, "adjacency": torch.zeros(4, agents, agents, dtype=torch.bool)}, [4])
    step["is_init"] = torch.ones(4, 1, dtype=torch.bool)
    assert policy(step)["agents", "action"].shape == (4, agents, 3)


def test_evaluation_repeats_that_at_the_end_of_training(run):
    before = (run.path / "evaluation.json").read_text()
    settings = EvaluationConfig(num_flocks=3, steps=12)
    evaluate_run(EvaluateConfig(run=str(run.path), evaluation=settings, threads=1))
    assert (run.path / "evaluation.json").read_text() == before


def test_evaluation_at_other_sizes(run):
    settings = EvaluationConfig(num_flocks=2, steps=4, num_agents=[3, 7])
    evaluate_run(EvaluateConfig(run=str(run.path), evaluation=settings, threads=1))
    tables = json.loads((run.path / "evaluation.json").read_text())
    assert {size: table["num_flocks"] for size, table in tables.items()} == {"3": 2, "5": 3, "7": 2}


def test_evaluation_in_another_environment_has_its_own_files(run):
    before = (run.path / "evaluation.json").read_text()
    changes = EnvOverrides(message_loss=0.5, physics="bullet")
    config = EvaluateConfig(
        run=str(run.path), evaluation=EvaluationConfig(num_flocks=2, steps=4), threads=1, env=changes
    )
    file = evaluate_run(config)
    assert file.name == "evaluation-message_loss=0.5,physics=bullet.json"
    assert "with message_loss=0.5,physics=bullet" in file.with_suffix(".md").read_text()
    assert json.loads(file.read_text())["5"]["num_flocks"] == 2
    assert (run.path / "evaluation.json").read_text() == before
    with pytest.raises(InputError, match=r"env\.max_links"):
        evaluate_run(dataclasses.replace(config, env=EnvOverrides(max_links="many")))


def test_the_seed_determines_a_run(tmp_path, config):
    metrics = []
    for seed in (1, 1, 2):
        run = train(config(tmp_path, seed=seed, name=f"seed{seed}"))
        metrics.append((run.metrics_file.read_bytes(), (run.path / "evaluation.json").read_bytes()))
    assert metrics[0] == metrics[1]
    assert metrics[0] != metrics[2]


def test_behaviour_cloning_of_several_sizes(tmp_path, small_config):
    env, model = FlockingConfig(num_agents=[3, 6]), ModelConfig(name="modgnn_mlp", hops=2, hidden=8)
    run = train(small_config(tmp_path, "bc", env=env, model=model, cloning_updates=40, evaluation=SMALL_EVALUATION))
    assert {"3/validation_loss", "6/validation_loss"} <= set(run.read_metrics()[-1])
    assert list(json.loads((run.path / "evaluation.json").read_text())) == ["3", "6"]


@pytest.mark.slow  # about three minutes
def test_dagger_beats_the_local_expert(tmp_path):
    run = train(TrainConfig(trainer=DAggerConfig(), runs=str(tmp_path), threads=1))
    table = json.loads((run.path / "evaluation.json").read_text())["32"]["rows"]
    assert table["moment_force"]["error"]["mean"] < 0.09
    assert table["moment_force"]["error_minus_local"]["high"] < 0


def test_a_missing_device_is_reported():
    with pytest.raises(InputError, match="device=cuda:99 cannot be used"):
        prepare_torch("cuda:99", 1)


def test_a_policy_of_another_model_is_refused(run, tmp_path):
    copy = tmp_path / "copy"
    copy.mkdir()
    text = (run.path / "config.yaml").read_text().replace("name: moment_force", "name: gcn")
    (copy / "config.yaml").write_text(text)
    (copy / "checkpoints").symlink_to(run.checkpoints)
    with pytest.raises(InputError, match="does not fit the model 'gcn'"):
        load_policy(copy)


def _command(module, *arguments, folder):
    command = [sys.executable, "-m", f"modgnn_rl.{module}", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["trainer=dager"], "did you mean 'dagger'"),
        (["env.comm_rnge=3"], "did you mean 'env.comm_range'"),
        (["env.comm_range=-1"], "env.comm_range=-1.0 is out of range"),
        (["trainer.rounds=many"], "trainer.rounds"),
        (["trainer=bc", "trainer.rounds=3"], "trainer.rounds"),
        (["env.num_agents=[8,0]"], "env.num_agents=0 is out of range"),
        (["env.num_agents=null"], "env.num_agents=None is not a whole number"),
        (["trainer.learning_rates=[1e-3]"], "trainer.learning_rates"),
    ],
)
def test_an_invalid_setting_is_one_line_and_leaves_nothing(tmp_path, arguments, words):
    done = _command("train", *arguments, folder=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["env.num_agents=[4,4]"], "must list each number once"),
        (["env.start_distance=9"], "do not fit into a ball"),
        (["model.hops=0"], "has nothing to learn"),
        (["device=tpu9"], "device=tpu9"),
        (["trainer.updates_per_round=1", "env.num_agents=[4,5]"], "too few for 2 flock sizes"),
    ],
)
def test_an_invalid_setting_that_training_finds_is_one_line_and_leaves_nothing(
    tmp_path, monkeypatch, capsys, arguments, words
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    monkeypatch.setattr(sys, "argv", ["train", *arguments])
    with pytest.raises(SystemExit) as stopped:
        run_command(main, TrainConfig, "train")
    error = capsys.readouterr().err
    assert stopped.value.code == 2
    assert words in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "argument", "words"),
    [
        ("train", "runs=file/runs", "cannot write into"),
        ("train", "resume=nowhere", "is not a run folder"),
        ("train", "init_from=.", "is not a run folder"),
        ("evaluate", "run=nowhere", "is not a run folder"),
        ("export", "run=nowhere", "is not a run folder"),
    ],
)
def test_an_unusable_folder_is_reported_before_torch_is_imported(tmp_path, command, argument, words):
    (tmp_path / "file").touch()
    program = f"""
import atexit, runpy, sys
atexit.register(lambda: print("torch" in sys.modules))
sys.argv = ["{command}", "{argument}"]
runpy.run_module("modgnn_rl.{command}", run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (2, "False\n")
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("model", ["moment_force", "mpnn"])
def test_training_under_perturbations_learns_from_the_true_state(tmp_path, model, config):
    env_config = FlockingConfig(
        num_agents=[4, 6],
        message_loss=0.3,
        delay=1,
        position_noise=0.05,
        velocity_noise=0.05,
        dropout_rate=1.0,
        dropout_time=0.2,
        wind=0.5,
    )
    seen = []

    class DashboardCallback(Callback):
        def on_collect(self, index, rollouts):
            seen.append(rollouts.select(("agents", "state"), ("agents", "mask"), ("agents", "expert_action")).clone())

    run = train(config(tmp_path, env=env_config, model=ModelConfig(name=model)), callbacks=[DashboardCallback()])
    for rollouts in seen:
        agents = rollouts["agents"]
        label = Reynolds.for_env(env_config)(rollouts.exclude(("agents", "expert_action")))["agents", "expert_action"]
        there = agents["mask"]
        torch.testing.assert_close(agents["expert_action"][there], label[there])
    assert {there.shape[-1] for there in (rollouts["agents", "mask"] for rollouts in seen)} == {4, 6}
    assert not all(bool(rollouts["agents", "mask"].all()) for rollouts in seen)  # somebody dropped out
    assert all(parameter.isfinite().all() for parameter in load_policy(run.path).parameters())
