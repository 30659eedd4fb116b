"""VMAS scenarios as tasks: equal seeds give equal rollouts, experts act, all trainers take them, errors are clear."""

from __future__ import annotations

import importlib.util
from typing import Any

import pytest
import torch

from modgnn_rl.actions import Discrete
from modgnn_rl.configs.schema import BCConfig, DAggerConfig, EvaluationConfig, MAPPOConfig, TrainConfig
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.experiment.training import train
from modgnn_rl.task import ACTION, EXPERT_ACTION, OBSERVATION, make_task
from modgnn_rl.tracking.loading import load_policy

pytest.importorskip("vmas")

from torchrl.envs.utils import check_env_specs

from modgnn_rl.envs.vmas import Vmas, VmasConfig

SCENARIOS = ["navigation", "flocking", "balance", "wheel", "transport", "discovery"]
SMALL: dict[str, Any] = {"num_envs": 2, "steps_per_round": 3, "rounds": 1}
IMITATION: dict[str, Any] = {"cloning_steps": 3, "cloning_updates": 1, "batch_size": 4, "num_val_envs": 1}


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_scenario_fits_the_task_interface(scenario):
    task = Vmas(VmasConfig(scenario=scenario))
    env = task.training_env(2, 4, seed=0, device="cpu")
    check_env_specs(env)
    state = env.reset()
    assert task.layout.vectors == 2  # the observation begins with position and velocity
    torch.testing.assert_close(state[OBSERVATION][..., :2], task.positions(state))
    assert task.frequency == pytest.approx(10)
    label = task.teacher(state)[EXPERT_ACTION]
    assert label.shape == (2, 4, 2)
    assert label.abs().max() <= 1
    windows = torch.stack([state, state], 1)  # experts also label windows
    torch.testing.assert_close(task.teacher(windows)[EXPERT_ACTION][:, 1], label)


def test_equal_seeds_give_equal_rollouts_whatever_else_runs():
    task = Vmas(VmasConfig(scenario="navigation", max_steps=4))
    before = torch.get_rng_state()

    def observations(disturb):
        env = task.training_env(2, 3, seed=7, device="cpu")
        state, seen = env.reset(), []
        for step in range(8):  # episodes begin again in between
            if disturb:
                task.training_env(1, 2, seed=step, device="cpu").reset()
            _, state = env.step_and_maybe_reset(state.set(ACTION, torch.full((2, 3, 2), 0.1)))
            seen.append(state[OBSERVATION])
        return torch.stack(seen)

    assert torch.equal(observations(disturb=False), observations(disturb=True))
    assert torch.equal(torch.get_rng_state(), before)
    other = task.training_env(2, 3, seed=8, device="cpu").reset()[OBSERVATION]
    assert not torch.equal(other, task.training_env(2, 3, seed=7, device="cpu").reset()[OBSERVATION])


def test_the_expert_solves_navigation():
    task = Vmas(VmasConfig(scenario="navigation"))
    options = {"num_agents": 4, "num_flocks": 8, "steps": 150, "seed": 0}
    results = {name: rollout(policy, task, **options) for name, policy in task.reference_policies().items()}
    assert results["expert"]["success"].all()
    assert results["expert"]["reward"].mean() > 2
    assert not results["zero action"]["success"].any()


def test_success_and_places_are_those_of_the_scenario():
    balance, flocking = (Vmas(VmasConfig(scenario=name)) for name in ("balance", "flocking"))
    assert "success" in balance.metrics
    assert "success" not in flocking.metrics
    env = balance.evaluation_env(16, 4, seed=0, device="cpu", steps=120)
    state = env.rollout(120, break_when_any_done=False)["next"]
    fell = state["terminated"].squeeze(-1)
    assert fell.any()  # random forces drop the package, which ends the episode
    assert not balance.success(state)[fell].all()
    assert balance.targets(state).shape == (16, 120, 2, 2)  # goal and package
    assert Vmas(VmasConfig(scenario="dispersion")).expert() is None


def test_discrete_actions_have_an_expert_where_vmas_has_one_for_them():
    balance, wheel = (Vmas(VmasConfig(scenario=name, discrete=True)) for name in ("balance", "wheel"))
    assert isinstance(balance.actions, Discrete)
    env = balance.training_env(2, 4, seed=0, device="cpu")
    label = balance.teacher(env.reset())[EXPERT_ACTION]
    assert label.shape == (2, 4, balance.actions.width)
    assert (label.sum(-1) == 1).all()
    assert wheel.expert() is None  # VMAS' is for continuous actions
    assert list(wheel.reference_policies()) == ["first action"]


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize(
    "trainer",
    [
        BCConfig(num_envs=2, **IMITATION),
        DAggerConfig(updates_per_round=1, **SMALL, **IMITATION),
        MAPPOConfig(critic_warmup=0, **SMALL),
    ],
    ids=lambda trainer: trainer.name,
)
def test_every_trainer_takes_every_scenario(scenario, trainer, tmp_path):
    env = VmasConfig(scenario=scenario, num_agents=3, max_steps=4, comm_range=0.5)
    config = TrainConfig(env=env, trainer=trainer, evaluation=EvaluationConfig(num_flocks=2), runs=str(tmp_path))
    load_policy(train(config, evaluate=False))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenario": "navigaton"}, r"did you mean 'navigation'\?"),
        ({"scenario": "football"}, "agents of different kinds|has 6 agents|has 3 agents"),
        ({"scenario": "give_way", "num_agents": 4}, r"set env.num_agents=2"),
        ({"scenario": "wheel", "options": {"lines": 2}}, "env.options do not fit scenario 'wheel'"),
        ({"scenario": "simple_adversary", "num_agents": 3}, "agents of different kinds"),
    ],
)
def test_what_does_not_fit_is_said_in_one_sentence(settings, message):
    with pytest.raises(InputError, match=message) as caught:
        _ = make_task(VmasConfig(**settings)).actions
    assert "\n" not in str(caught.value)


def test_without_vmas_it_says_what_to_install(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "vmas" else find(name, *rest))
    with pytest.raises(InputError, match=r"pip install 'modgnn-rl\[vmas\]'"):
        make_task(VmasConfig())
