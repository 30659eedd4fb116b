"""MAPPO as a whole run: its start, its results, what it refuses; and that it learns."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys

import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from modgnn_rl import load_policy
from modgnn_rl.configs.schema import BCConfig, DAggerConfig, FlockingConfig, MAPPOConfig, ModelConfig
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.trainers.loop.setup import initial_policy, resolve_model
from modgnn_rl.trainers.mappo import kl_coef_of_round
from modgnn_rl.trainers.ppo.actor import GaussianActor

ENV = FlockingConfig(num_agents=4, max_steps=15)


@pytest.fixture(scope="module")
def mappo_config(small_config):
    """Makes configurations of small runs of MAPPO with windows of a few steps."""
    small = {"steps_per_round": 8, "critic_warmup": 1, "epochs": 2, "num_minibatches": 2, "window": 3}
    return lambda runs, **settings: small_config(
        runs, "mappo", **{**small, "env": ENV, "model": ModelConfig(), **settings}
    )


@pytest.fixture(scope="module")
def cloned(tmp_path_factory, small_config):
    """The run folder of a policy that was cloned a little."""
    small = {"cloning_steps": 20, "cloning_updates": 20, "num_val_envs": 1, "ema_decay": 0.5}
    model = ModelConfig(name="modgnn_mlp", hops=2, hidden=8)
    return train(small_config(tmp_path_factory.mktemp("runs"), "bc", env=ENV, model=model, **small), evaluate=False)


def _scores(policy):
    rollouts = rollout(policy, FlockingTask(ENV), num_agents=4, num_flocks=3, steps=12, seed=5)
    return torch.cat((rollouts["error"], rollouts["reward"], rollouts["cohesion"]))


def test_training_starts_from_exactly_the_policy_of_init_from(cloned, tmp_path, mappo_config):
    config = resolve_model(mappo_config(tmp_path, init_from=str(cloned.path)), FlockingTask(ENV))
    policy, expected = initial_policy(config, FlockingTask(config.env)), _scores(load_policy(cloned.path))
    assert config.model == ModelConfig(name="modgnn_mlp", hops=2, hidden=8)
    assert torch.equal(_scores(policy), expected)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(_scores(GaussianActor(policy)), expected)
    model = ModelConfig(name="modgnn_mlp", hops=2, hidden=8)
    fresh = resolve_model(mappo_config(tmp_path, model=model), FlockingTask(ENV))
    assert not torch.equal(_scores(initial_policy(fresh, FlockingTask(fresh.env))), expected)


def test_critic_warmup_leaves_the_policy_unchanged(cloned, tmp_path, mappo_config):
    run = train(mappo_config(tmp_path, init_from=str(cloned.path), rounds=2, critic_warmup=2), evaluate=False)
    assert run.config["model"]["name"] == "modgnn_mlp"
    assert torch.equal(_scores(load_policy(run.path)), _scores(load_policy(cloned.path)))


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(ModelConfig(name="pair_force", hidden=8), marks=pytest.mark.slow),
        ModelConfig(name="mpnn", hidden=8, layers=2),
    ],
)
def test_the_seed_determines_a_run_and_global_generators_are_left_alone(tmp_path, model, mappo_config):
    runs = []
    for number, seed in enumerate((1, 1, 2)):
        torch.manual_seed(number)
        before = torch.get_rng_state()
        runs.append(train(mappo_config(tmp_path, model=model, seed=seed, name=f"run{number}"), evaluate=False))
        assert torch.equal(torch.get_rng_state(), before)
    metrics = [run.metrics_file.read_bytes() for run in runs]
    assert metrics[0] == metrics[1] != metrics[2]


def test_a_checkpoint_holds_the_whole_state_of_a_run(tmp_path, mappo_config):
    run = train(mappo_config(tmp_path, env=FlockingConfig(num_agents=[3, 5], max_steps=15)), evaluate=False)
    checkpoint = load_checkpoint(run.checkpoints)
    of_learner = {"policy", "actor", "critic", "value_norm", "reference_policy", "optimizer", "generators"}
    of_flocks = {f"rollouts-{size}.{part}" for size in (3, 5) for part in ("env", "carried")}
    assert set(checkpoint.tensors) == of_learner | of_flocks
    names = {f"rollouts-{size}.{name}" for size in (3, 5) for name in ("env", "faults", "noise")}
    assert set(checkpoint.tensors["generators"]) == {"receivers", "order", *names}
    assert checkpoint.step == 3
    assert checkpoint.state["updates"] == 3 * 2 * 4  # rounds, sizes, updates
    assert checkpoint.state["averaged"] == 2 * 2 * 4  # but for the critic's first round
    assert checkpoint.state["config"] == run.config
    weights = load_policy(run.path).state_dict()
    assert all(torch.equal(value, weights[name]) for name, value in checkpoint.tensors["policy"].items())


def test_each_size_has_its_own_metrics(cloned, tmp_path, mappo_config):
    env, pull = FlockingConfig(num_agents=[3, 5], max_steps=15), {"kl_coef": 0.2, "kl_rounds": 4}
    metrics = train(mappo_config(tmp_path, env=env, init_from=str(cloned.path), **pull), evaluate=False).read_metrics()
    assert [line["step"] for line in metrics] == [1, 2, 3]
    common = ("reward", "cost/leader", "cost/effort", "error", "cohesion", "loss_critic", "kl_approx", "entropy")
    assert all({f"{size}/{name}" for size in (3, 5) for name in common} <= set(line) for line in metrics)
    assert [("3/loss_kl" in line) for line in metrics] == [False, True, True]
    assert [line["kl_coef"] for line in metrics] == pytest.approx([0.2, 0.2, 0.15])
    assert metrics[0]["noise"] == pytest.approx(0.3)


@pytest.mark.parametrize(
    "env",
    [
        FlockingConfig(num_agents=4, graph="links"),
        FlockingConfig(num_agents=4, dropout_rate=2.0, dropout_time=0.2),
        FlockingConfig(num_agents=4, position_noise=0.1, delay=2),
        FlockingConfig(num_agents=2),
    ],
)
@pytest.mark.parametrize(
    "model", [ModelConfig(name="pair_force", hidden=8), ModelConfig(name="mpnn", hidden=8, layers=2)]
)
def test_it_trains_in_every_environment(tmp_path, env, model, mappo_config):
    for line in train(mappo_config(tmp_path, env=env, model=model), evaluate=False).read_metrics():
        assert all(value == value for name, value in line.items() if "separation" not in name), line


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"init_from": "."}, "is not a run folder"),
        ({"init_from": "nowhere"}, "is not a run folder"),
        ({"model": ModelConfig(name="gcn")}, r"name='gcn'.* is not that of init_from=.*name='modgnn_mlp', hops=2"),
        ({"trainer": BCConfig(seeds=2)}, "several policies cannot all start from that of init_from"),
        ({"trainer": BCConfig(models=["gcn"])}, "trainer.models and trainer.hops name new policies"),
        ({"trainer": BCConfig(hops=[1])}, "trainer.models and trainer.hops name new policies"),
        ({"trainer": DAggerConfig(gate="ensemble")}, "several policies cannot all start from that of init_from"),
    ],
)
def test_an_impossible_start_is_refused_before_anything_is_created(
    cloned, tmp_path, monkeypatch, change, message, mappo_config
):
    monkeypatch.chdir(tmp_path)
    config = mappo_config(tmp_path / "runs", init_from=str(cloned.path))
    for name, value in change.items():
        setattr(config, name, value)
    with pytest.raises(InputError, match=message):
        train(config)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("trainer", "message"),
    [
        (MAPPOConfig(steps_per_round=11, window=10), "steps_per_round=11 is too short .* at least 12"),
        (DAggerConfig(steps_per_round=2), "steps_per_round=2 is too short .* at least 3"),
        (BCConfig(cloning_steps=2), "cloning_steps=2 is too short .* at least 3"),
        (BCConfig(cloning_steps=11, dart=True), "cloning_steps=11 is too short .* at least 12"),
    ],
)
def test_rollouts_shorter_than_a_window_are_refused_before_anything_is_created(
    tmp_path, trainer, message, mappo_config
):
    """Learned messages of two layers are recomputed from the two steps before."""
    config = mappo_config(tmp_path / "runs", model=ModelConfig(name="mpnn", layers=2))
    config.trainer = trainer
    with pytest.raises(InputError, match=message):
        train(config)
    assert not list(tmp_path.iterdir())


def test_the_weight_of_the_kl_penalty_decays_linearly_after_the_warm_up():
    settings = MAPPOConfig(critic_warmup=2, kl_coef=0.2, kl_rounds=4)
    weights = [kl_coef_of_round(settings, index) for index in range(1, 10)]
    assert weights == pytest.approx([0.2, 0.2, 0.2, 0.15, 0.1, 0.05, 0, 0, 0])
    constant = dataclasses.replace(settings, kl_rounds=0)
    assert [kl_coef_of_round(constant, index) for index in (1, 2, 1000)] == [0.2] * 3


def test_a_fresh_policy_has_no_kl_penalty(tmp_path, mappo_config):
    metrics = train(mappo_config(tmp_path, kl_coef=100.0), evaluate=False).read_metrics()
    assert [line["kl_coef"] for line in metrics] == [0.0] * 3
    assert not any("4/loss_kl" in line for line in metrics)


def test_callbacks_can_stop_training(tmp_path, mappo_config):
    class Stop(Callback):
        def on_round(self, index, metrics):
            return index == 2

    run = train(mappo_config(tmp_path), callbacks=[Stop()], evaluate=False)
    assert [line["step"] for line in run.read_metrics()] == [1, 2]


@pytest.mark.slow
def test_the_command_continues_from_a_pretrained_policy(cloned, tmp_path):
    """As a user runs it: from the run folder of a cloned policy, with the trainer's own YAML."""
    small = ["num_envs=1", "rounds=1", "steps_per_round=4", "epochs=1", "num_minibatches=1", "critic_hidden=8"]
    command = [sys.executable, "-m", "modgnn_rl.train", "trainer=mappo", f"init_from={cloned.path}"]
    command += [f"trainer.{setting}" for setting in small]
    command += ["env.num_agents=3", "evaluation.num_flocks=2", "evaluation.steps=4"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    assert "mappo-modgnn_mlp" in folder.name
    assert RunFolder.open(folder).config["model"]["hops"] == 2
    assert "modgnn_mlp" in json.loads((folder / "evaluation.json").read_text())["3"]["rows"]


def test_the_reward_rises_from_scratch(tmp_path, mappo_config):
    """Where only effort costs, the best action is the velocity that one has."""
    others = {f"{name}_cost": 0.0 for name in ("leader", "cohesion", "crowding", "collision", "alignment")}
    env = FlockingConfig(num_agents=3, max_steps=100, effort_cost=1.0, **others)
    rates = {"learning_rate": 1e-2, "critic_learning_rate": 1e-2, "gamma": 0.9}
    settings = {"rounds": 8, "steps_per_round": 16, "epochs": 4, "num_minibatches": 4}
    run = train(mappo_config(tmp_path, env=env, model=ModelConfig(name="gcn"), **rates, **settings), evaluate=False)
    rewards = [line["3/reward"] for line in run.read_metrics()]
    assert sum(rewards[-3:]) > 0.8 * sum(rewards[:3])
