"""The coverage task: its expert is Lloyd's algorithm, its symmetries hold, and all trainers take it."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from modgnn_rl.configs.schema import BCConfig, DAggerConfig, EvaluationConfig, MAPPOConfig, TrainConfig
from modgnn_rl.envs.coverage import Coverage, CoverageConfig, voronoi
from modgnn_rl.evaluation.rollout import rollout
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.loading import load_policy, load_task

SMALL: dict[str, Any] = {"num_envs": 2, "steps_per_round": 4, "rounds": 2}
IMITATION: dict[str, Any] = {"cloning_steps": 8, "cloning_updates": 2, "batch_size": 8, "num_val_envs": 1}


def test_cells_are_the_points_nearest_to_each_robot():
    position = torch.tensor([[[-0.5, 0.0], [0.5, 0.0]]])
    centroid, cost = voronoi(position, side=2.0)
    torch.testing.assert_close(centroid, position)  # each has half of the square
    assert cost.item() == pytest.approx(1 / 12 + 1 / 3, rel=0.01)  # of a rectangle of 1 m by 2 m
    both, _ = voronoi(torch.tensor([[[0.1, 0.2], [0.1, 0.2]]]), side=2.0)
    torch.testing.assert_close(both[0], torch.tensor([[0.0, 0.0], [0.1, 0.2]]), atol=1e-6, rtol=0)  # an empty cell


@pytest.mark.parametrize("num_agents", [1, 5])
def test_lloyd_covers_the_square(num_agents):
    task = Coverage(CoverageConfig())
    options = {"num_agents": num_agents, "num_flocks": 8, "steps": 100, "seed": 0}
    policies = task.reference_policies()
    expert, idle = (rollout(policies[name], task, **options) for name in ("expert", "zero action"))
    assert expert["success"].all()
    assert expert["error"].max() == 0
    assert (expert["coverage_cost"] < idle["coverage_cost"]).all()
    assert (expert["reward"] > idle["reward"]).all()


def test_a_mirror_changes_nothing():
    task = Coverage(CoverageConfig())
    check_env_specs(task.training_env(2, 5, seed=0, device="cpu"))
    state = torch.randn(3, 5, 4)
    mirror = torch.tensor([-1.0, 1.0])
    torch.testing.assert_close(task.lloyd(state * mirror.repeat(2)), task.lloyd(state) * mirror)


def test_a_restored_environment_continues_bit_for_bit():
    task = Coverage(CoverageConfig(max_steps=5))
    env, other = (task.training_env(3, 4, seed=seed, device="cpu") for seed in (0, 1))
    action = torch.rand(12, 3, 4, 2) - 0.5
    state = env.reset()
    other.reset()
    seen = []
    for step in range(12):  # episodes end in between
        if step == 4:
            other.restore(env.snapshot())
            for name, generator in other.generators.items():
                generator.set_state(env.generators[name].get_state())
            again = state.clone()
        _, state = env.step_and_maybe_reset(state.set(("agents", "action"), action[step]))
        seen.append(state["agents", "observation"])
        if step >= 4:
            _, again = other.step_and_maybe_reset(again.set(("agents", "action"), action[step]))
            assert torch.equal(again["agents", "observation"], seen[-1])


@pytest.mark.parametrize(
    "trainer",
    [
        BCConfig(num_envs=2, **IMITATION),
        DAggerConfig(updates_per_round=2, **SMALL, **IMITATION),
        MAPPOConfig(critic_warmup=1, **SMALL),
    ],
    ids=lambda trainer: trainer.name,
)
def test_every_trainer_takes_it(trainer, tmp_path):
    env = CoverageConfig(num_agents=[3, 4], max_steps=10)
    config = TrainConfig(env=env, trainer=trainer, evaluation=EvaluationConfig(num_flocks=2), runs=str(tmp_path))
    run = train(config)
    assert load_task(run).config == env
    load_policy(run)
    rows = json.loads((run.path / "evaluation.json").read_text())["4"]["rows"]
    assert {"expert", "zero action"} < set(rows)
    assert {"error", "coverage_cost", "reward", "success"} <= set(rows["expert"])
