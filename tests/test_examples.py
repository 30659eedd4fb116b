"""The examples run in short form, and do what they say."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from modgnn_rl import TASKS, make_task
from modgnn_rl.configs.schema import DAggerConfig, EvaluationConfig, TrainConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.experiment.training import train

EXAMPLES = Path(__file__).parent.parent / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_own_f_pre_learns_what_each_role_does():
    errors, ignorant = example("own_f_pre").main(num_envs=8, num_agents=8, steps=32, rounds=3, updates=30)
    assert errors[-1] < 0.2 * errors[0]
    assert ignorant > 2 * errors[-1]


def test_own_f_com_finds_the_gains_of_the_expert_when_it_hears_everybody():
    results = example("own_f_com").main(comm_ranges=(2.0, 100.0), num_envs=4, num_agents=8, steps=48)
    (near_cohesion, *_), near_error = results[2.0]
    (cohesion, separation, alignment), error = results[100.0]
    assert cohesion == pytest.approx(0.06, rel=0.05)
    assert separation == pytest.approx(0.8, rel=0.05)
    assert 0.0 < alignment < 0.1
    assert error < 1e-3
    assert near_error > 0.05
    assert near_cohesion > 0.1  # few pull for all


@pytest.mark.slow
def test_modgnn_learns_on_vmas():
    pytest.importorskip("vmas")
    module = example("modgnn_on_vmas")
    returns = module.main(num_envs=16, num_agents=3, steps=60, iterations=5)
    assert len(returns) == 5
    assert sum(returns[-2:]) / 2 > 0.3  # without communication it is about 0.1


def test_the_loss_of_the_vmas_example_sees_the_messages_of_the_rollout():
    pytest.importorskip("vmas")
    module = example("modgnn_on_vmas")
    torch.manual_seed(0)
    env = module.make_env(num_envs=4, num_agents=3, steps=6, seed=0)
    check_env_specs(env)
    assert not env.reset()["adjacency"].diagonal(dim1=-2, dim2=-1).any()
    actor = module.make_actor(env, hops=2)
    critic: TensorDictModule = module.make_critic(num_agents=3)
    loss_module = module.make_loss(actor, critic)
    size = {"frames_per_batch": 4 * 10, "total_frames": 4 * 30}
    for number, rollouts in enumerate(Collector(env, actor, **size, auto_register_policy_transforms=True)):
        begins = rollouts["is_init"].squeeze(-1)
        assert begins.any(1).all()
        assert (rollouts["messages"].flatten(2).nan_to_num().abs().sum(-1) > 0)[~begins].all()
        if number:
            assert not begins[:, 0].all()  # batches go on where the last one stopped
        with torch.no_grad():
            loss_module.value_estimator(rollouts)
            losses = loss_module(rollouts)
        # The policy has not changed, so what it does in a window is what it did step by step.
        assert losses["kl_approx"].abs().max() < 1e-5
        assert losses["clip_fraction"] == 0
    rollouts["messages"].zero_()
    with torch.no_grad():
        assert loss_module(rollouts)["kl_approx"].abs().max() > 1e-4  # the messages before the window count


def test_own_task_hides_what_the_expert_knows_and_trains_by_its_name(monkeypatch, tmp_path):
    pytest.importorskip("vmas")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    name = "own_task:BlindNavigation"
    env = TASKS[name].option("settings")(name=name, num_agents=3, max_steps=30)
    task = make_task(env)
    results = rollout(task.reference_policies()["expert"], task, num_agents=3, num_flocks=4, steps=120, seed=0)
    assert results["success"].all()
    small = {"num_envs": 8, "steps_per_round": 20, "rounds": 2, "updates_per_round": 40, "batch_size": 32}
    trainer = DAggerConfig(cloning_steps=20, cloning_updates=80, num_val_envs=2, ema_decay=0.9, **small)
    run = train(TrainConfig(env=env, trainer=trainer, evaluation=EvaluationConfig(num_flocks=4), runs=str(tmp_path)))
    rows = json.loads((run.path / "evaluation.json").read_text())["3"]["rows"]
    assert rows["modgnn_mlp"]["error"]["mean"] < 0.7 * rows["zero action"]["error"]["mean"]


@pytest.mark.parametrize(("schedule", "gate"), [("linear", "near"), ("exponential", "disagreement")])
def test_own_dagger_learns_with_each_gate_and_schedule(schedule, gate):
    small = {"num_envs": 4, "num_agents": 8, "steps": 20, "rounds": 2, "updates": 25, "test_steps": 20}
    errors = example("own_dagger").main(schedule, gate, **small)
    assert len(errors) == 2
    assert errors[-1] < 0.8 * errors[0]


@pytest.mark.slow
def test_own_mappo_earns_more_of_its_own_reward(monkeypatch):
    module = example("own_mappo")
    monkeypatch.setattr(module, "WEIGHTS", {"effort": 1.0})  # what is felt at once is learned at once
    rewards = module.main(num_envs=16, num_agents=4, steps=20, rounds=5)
    assert rewards[-1] > rewards[0] + 0.01


def test_own_reward_counts_what_it_says():
    module = example("own_mappo")
    env = TransformedEnv(FlockingEnv(2, 5, seed=0), module.OwnReward())
    check_env_specs(env)
    step = env.rollout(2)[:, -1]
    position, velocity = step["next", "agents", "observation"].split(3, -1)
    nearest = (torch.cdist(position, position) + 1e9 * torch.eye(5)).amin(-1)
    spread, drift = (vectors - vectors.mean(1, keepdim=True) for vectors in (position, velocity))
    costs = {
        "spacing": (nearest - 1).abs(),
        "cohesion": spread.norm(dim=-1),
        "collision": (nearest < 0.08).float(),
        "alignment": drift.norm(dim=-1),
        "effort": (step["agents", "action"] - velocity).norm(dim=-1),
    }
    expected = -sum(module.WEIGHTS[name] * cost for name, cost in costs.items())
    torch.testing.assert_close(step["next", "agents", "reward"].squeeze(-1), expected, atol=1e-4, rtol=1e-4)


def test_own_callback_stops_early_and_learns_from_an_expert_that_keeps_more_distance(tmp_path, capsys):
    small = {"batch_size": 16, "cloning_steps": 20, "cloning_updates": 5, "steps_per_round": 20, "updates_per_round": 2}
    figures = example("own_callback").main(error=1.0, runs=tmp_path, steps=20, beta_rounds=1, **small)
    assert figures["8"]["rows"]["expert"]["error"]["mean"] == 0
    printed = capsys.readouterr().out
    assert "round 2: error" in printed
    assert "round 3: error" not in printed  # the first round in which the policy acts alone is the second
