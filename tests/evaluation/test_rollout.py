"""Evaluation rollouts and their table."""

from __future__ import annotations

import json

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential

from modgnn_rl import make_model
from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs import TorchPhysics
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.evaluation.rollout import evaluate, rollout
from modgnn_rl.evaluation.table import evaluation_markdown, read_tables, summarise_rollouts
from modgnn_rl.registry import METRICS

TASK = FlockingTask(FlockingConfig())
ROLLOUT = {"num_agents": 6, "num_flocks": 4, "steps": 40, "seed": 3}


@pytest.fixture(scope="module")
def rollouts():
    return evaluate({"gcn": make_model("gcn", seed=0)}, TASK, **ROLLOUT)


def test_reference_policies_have_the_errors_they_must_have(rollouts):
    assert rollouts["expert"]["error"].max() == 0
    assert (rollouts["zero action"]["error"] > rollouts["local expert (2 hops)"]["error"]).all()
    # The expert is clipped to the ball of 0.92 m/s and mostly on its surface: doing nothing scores |u|^2 / 3.
    assert 0.2 < float(rollouts["zero action"]["error"].mean()) <= 0.92**2 / 3


def test_equal_seeds_give_equal_rollouts(rollouts):
    again = rollout(make_model("gcn", seed=0), TASK, **ROLLOUT)
    assert torch.equal(again["error"], rollouts["gcn"]["error"])
    assert torch.equal(again["min_distance"], rollouts["gcn"]["min_distance"])


def test_all_policies_have_the_same_starts_and_leaders():
    """The first observations are equal, and so is the leader at every step, which ignores the others."""
    seen = {}

    class Spy(TensorDictSequential):
        def forward(self, tensordict):
            seen.setdefault(self, []).append(tensordict["agents", "observation"].clone())
            return super().forward(tensordict)

    for policy in TASK.reference_policies().values():
        rollout(Spy(policy), TASK, **ROLLOUT)
    first, *others = seen.values()
    assert len(others) == 3
    for other in others:
        assert torch.equal(first[0], other[0])
        for mine, theirs in zip(first, other, strict=True):
            assert torch.equal(mine[:, 0], theirs[:, 0])


def test_a_policy_acts_the_same_in_both_physics():
    policy = make_model("pair_force", seed=0)
    in_torch, in_bullet = (
        rollout(policy, FlockingTask(FlockingConfig(physics=name)), **ROLLOUT) for name in ("torch", "bullet")
    )
    for name in ("error", "leader_distance", "cohesion", "separation", "min_distance", "reward"):
        torch.testing.assert_close(in_bullet[name], in_torch[name], rtol=1e-3, atol=1e-4)
    assert torch.equal(in_bullet["leader_lost"], in_torch["leader_lost"])


def test_rollouts_close_their_physics(monkeypatch):
    """Each flock in PyBullet holds a client until its environment is closed."""
    closed = []
    monkeypatch.setattr(TorchPhysics, "close", lambda physics: closed.append(physics))
    rollout(make_model("gcn", seed=0), TASK, **ROLLOUT)
    assert len(closed) == 1


def test_metrics_are_of_the_true_state_with_noisy_sensors():
    quiet, noisy = (
        rollout(Reynolds(action=("agents", "action"), observation=key), FlockingTask(config), **ROLLOUT)
        for key, config in (
            (("agents", "observation"), FlockingConfig()),
            (("agents", "state"), FlockingConfig(position_noise=0.5)),
        )
    )
    assert torch.equal(quiet["separation"], noisy["separation"])
    assert noisy["error"].max() == 0


def test_quarters_average_to_the_error(rollouts):
    for metrics in rollouts.values():
        torch.testing.assert_close(metrics.error_by_quarter.mean(-1).double(), metrics["error"], rtol=1e-4, atol=1e-6)


def test_a_diverging_flock_is_rolled_out_to_the_end_and_counted():
    away = TensorDictModule(
        lambda observation: 10 * observation[..., :3], [("agents", "observation")], [("agents", "action")]
    )
    metrics = rollout(
        away, FlockingTask(FlockingConfig(max_distance=5.0)), num_agents=6, num_flocks=3, steps=400, seed=0
    )
    assert metrics["diverged"].all()
    assert metrics["leader_lost"].all()


@pytest.mark.parametrize("agents", [1, 2])
def test_the_smallest_flocks_have_a_table_too(agents):
    rollouts = evaluate({}, TASK, num_agents=agents, num_flocks=3, steps=8, seed=0)
    assert "| expert" in evaluation_markdown(_tables(rollouts, agents), "few")


def test_table_gives_mean_median_spread_and_paired_difference(rollouts):
    table = summarise_rollouts(rollouts, TASK, seed=0)
    row = table["gcn"]
    errors = rollouts["gcn"]["error"]
    assert row["error"]["mean"] == pytest.approx(float(errors.mean()))
    assert row["error"]["median"] == pytest.approx(float(errors.quantile(0.5)))
    assert row["error"]["low"] <= row["error"]["mean"] <= row["error"]["high"]
    difference = errors - rollouts["local expert (1 hop)"]["error"]
    assert row["error_minus_local"]["mean"] == pytest.approx(float(difference.mean()))
    assert "error_minus_local" not in table["local expert (1 hop)"]


def test_a_new_metric_appears_in_rollouts_and_tables(monkeypatch):
    monkeypatch.setattr(METRICS, "_added", dict(METRICS._added))
    METRICS.register(
        "height", title="height", unit="m", better="higher", about="mean height", over_time="mean", cell="{mean:.1f}"
    )(lambda position: position[..., 2])
    rollouts = evaluate({}, FlockingTask(FlockingConfig()), num_agents=3, num_flocks=2, steps=4, seed=0)
    assert rollouts["expert"]["height"].shape == (2,)
    table = _tables(rollouts, 3)
    assert table["3"]["rows"]["expert"]["height"]["mean"] == float(rollouts["expert"]["height"].mean())
    text = evaluation_markdown(table, "title")
    assert "| height |" in text
    assert "Height [m]: mean height." in text


def test_markdown_contains_every_policy(rollouts):
    text = evaluation_markdown(_tables(rollouts, 6), "title")
    assert all(text.count(f"| {name} ") == 2 for name in rollouts)
    assert "## 6 agents, 4 episodes of 40 steps" in text


def test_tables_are_read_back(rollouts, tmp_path):
    file = tmp_path / "evaluation.json"
    assert read_tables(file) == {}
    file.write_text(json.dumps(_tables(rollouts, 6)))
    assert read_tables(file)["6"]["rows"]["gcn"] == summarise_rollouts(rollouts, TASK, seed=0)["gcn"]


@pytest.mark.parametrize("text", ["", "[]", "{}]", '{"six": {"rows": {}}}', '{"6": 1}', '{"6": {}}'])
def test_a_damaged_table_is_refused(text, tmp_path):
    file = tmp_path / "evaluation.json"
    file.write_text(text)
    with pytest.raises(InputError, match="not as an evaluation wrote it"):
        read_tables(file)


def _tables(rollouts, agents):
    return {
        str(agents): {
            "num_flocks": 4,
            "steps": 40,
            "task": "flocking",
            "rows": summarise_rollouts(rollouts, FlockingTask(FlockingConfig()), seed=0),
        }
    }
