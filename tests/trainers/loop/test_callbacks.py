"""Callbacks: when they are called and what they can do; early stopping; custom experts."""

from __future__ import annotations

import json
import math

import pytest
import torch
from tensordict.nn import TensorDictModule

from modgnn_rl import load_policy
from modgnn_rl.configs.schema import (
    EvaluationConfig,
    FlockingConfig,
)
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.trainers.loop.callbacks import Callback, StopOnPlateau

# Number of the rounds in which rollouts come in, and of all rounds.
ROUNDS = {"bc": ([1], [1, 2, 3, 4]), "dagger": ([0, 0, 1, 2, 3], [0, 1, 2, 3]), "mappo": ([1, 2, 3], [1, 2, 3])}


class _Watch(Callback):
    def __init__(self, stop_at=None):
        self.calls, self.stop_at, self.metrics = [], stop_at, []

    def on_start(self, policies):
        self.calls.append(("start", tuple(policies)))
        self.policies = policies

    def on_collect(self, index, rollouts):
        self.calls.append(("rollouts", index))
        assert rollouts["agents", "observation"].shape[0] == 8  # flocks of 4: as many agents as 1 of 32
        assert ("agents", "expert_action") in rollouts.keys(include_nested=True)

    def on_round(self, index, metrics):
        self.calls.append(("round", index))
        self.metrics.append(dict(metrics))
        return index == self.stop_at

    def on_end(self, policies):
        self.calls.append(("end", tuple(policies)))
        self.ended = policies


@pytest.mark.parametrize("name", ROUNDS)
def test_every_callback_method_is_called(tmp_path, name, small_config):
    watch = _Watch()
    run = train(small_config(tmp_path, name), callbacks=[watch], evaluate=False)
    kinds = {kind: [value for called, value in watch.calls if called == kind] for kind, _ in watch.calls}
    assert watch.calls[0] == ("start", ("pair_force",))
    assert watch.calls[-1] == ("end", ("pair_force",))
    assert (kinds["rollouts"], kinds["round"]) == ROUNDS[name]
    # Rollouts are shown before the round that learns from them is over.
    assert watch.calls.index(("rollouts", kinds["rollouts"][-1])) < watch.calls.index(("round", kinds["rollouts"][-1]))
    written = [{key: value for key, value in line.items() if key != "step"} for line in run.read_metrics()]
    for shown, line in zip(watch.metrics, written, strict=True):
        assert {key: value for key, value in shown.items() if math.isfinite(value)} == {
            key: value for key, value in line.items() if math.isfinite(value)
        }
    weights = load_policy(run.path).state_dict()
    assert watch.ended["pair_force"] is watch.policies["pair_force"]
    assert all(torch.equal(value, weights[key]) for key, value in watch.ended["pair_force"].state_dict().items())


@pytest.mark.parametrize("name", ROUNDS)
def test_any_callback_stops_training_and_all_are_called(tmp_path, name, small_config):
    watches = [_Watch(), _Watch(stop_at=2), _Watch()]
    run = train(small_config(tmp_path, name), callbacks=watches, evaluate=False)
    assert run.read_metrics()[-1]["step"] == 2
    assert [watch.calls for watch in watches[1:]] == [watches[0].calls] * 2
    assert ("end", ("pair_force",)) in watches[0].calls
    assert load_checkpoint(run.checkpoints).state["learners"] == ["pair_force"]


@pytest.mark.parametrize("name", ["bc", "dagger"])
def test_changes_of_rollouts_by_a_callback_affect_training(tmp_path, name, small_config):
    class Zero(Callback):
        def on_collect(self, index, rollouts):
            rollouts["agents", "expert_action"].zero_()

    losses = []
    for callbacks in ([], [Zero()]):
        run = train(small_config(tmp_path, name), callbacks=callbacks, evaluate=False)
        losses.append(next(line["4/loss"] for line in run.read_metrics() if "4/loss" in line))
    assert losses[0] != losses[1]


def test_an_error_in_a_callback_ends_the_run(tmp_path, small_config):
    class Fail(_Watch):
        def on_round(self, index, metrics):
            raise RuntimeError("mine")

    watch = Fail()
    with pytest.raises(RuntimeError, match="mine"):
        train(small_config(tmp_path, "dagger"), callbacks=[watch], evaluate=False)
    assert "end" not in {kind for kind, _ in watch.calls}


def _steps_until_stop(values, **settings):
    plateau = StopOnPlateau(**{"rounds": 2, "gain": 0.1, **settings})
    for index, value in enumerate(values, start=1):
        metrics = value if isinstance(value, dict) else {"error": value}
        if plateau.on_round(index, metrics):
            return index
    return None


def test_a_plateau_is_a_decrease_of_the_mean_below_the_gain():
    falling = [0.8**k for k in range(20)]
    assert _steps_until_stop(falling) is None
    assert _steps_until_stop([1.0] * 20) == 4  # two rounds, and two before them
    assert _steps_until_stop([1.0, 1.0, 0.89, 0.89, 0.89, 0.89]) == 5  # 0.89 / 0.945 is not a tenth less
    assert _steps_until_stop([1.0, 1.0, 0.91, 0.91]) == 4
    assert _steps_until_stop([1.0] * 20, gain=0.0) is None  # not above what was
    assert _steps_until_stop([1.0, 1.0, 1.0, 1.1], gain=0.0) == 4
    assert _steps_until_stop([1.0] * 20, rounds=5) == 10


def test_rounds_without_the_metric_and_early_rounds_do_not_count():
    assert _steps_until_stop([math.nan, 1.0, {}, 1.0, math.nan, 1.0, 1.0]) == 7
    assert _steps_until_stop([1.0] * 20, after=6) == 10


def test_the_plateau_of_another_metric():
    metrics = [{"error": 0.7**k, "8/error": 1.0} for k in range(20)]
    assert _steps_until_stop(metrics) is None
    assert _steps_until_stop(metrics, name="8/error") == 4


@pytest.mark.parametrize("name", ["dagger", "mappo"])
def test_the_error_of_a_round_is_the_mean_over_sizes(tmp_path, name, small_config):
    config = small_config(tmp_path, name, env=FlockingConfig(num_agents=[3, 4]))
    run = train(config, evaluate=False)
    for line in run.read_metrics():
        if line["step"] > 0:
            assert line["error"] == pytest.approx((line["3/error"] + line["4/error"]) / 2, nan_ok=True)
    assert math.isfinite(run.read_metrics()[-1]["error"])


@pytest.mark.parametrize("name", ["bc", "dagger"])
def test_a_custom_expert_is_imitated_and_evaluated_against(tmp_path, name, small_config):
    """It stands still; the trained policy does too, and its errors are against it."""
    still = TensorDictModule(
        lambda observation: 0.0 * observation[..., :3],
        in_keys=[("agents", "observation")],
        out_keys=[("agents", "expert_action")],
    )
    shared = {"batch_size": 64, "ema_decay": 0.5, "learning_rates": [1e-2, 1e-2, 1e-2]}
    settings = {
        "bc": {"cloning_steps": 20, "cloning_updates": 40},
        "dagger": {
            "cloning_steps": 10,
            "cloning_updates": 20,
            "steps_per_round": 5,
            "updates_per_round": 20,
            "num_val_envs": 8,
            "beta": 0.0,
            "hold_steps": 5,
        },
    }[name]
    evaluation = EvaluationConfig(num_flocks=2, steps=4)
    run = train(small_config(tmp_path, name, **shared, **settings, evaluation=evaluation), expert=still)
    rows = json.loads((run.path / "evaluation.json").read_text())["4"]["rows"]
    assert rows["expert"]["error"]["mean"] == rows["zero action"]["error"]["mean"] == 0
    errors = [line["4/error"] for line in run.read_metrics() if "4/error" in line]
    assert errors[-1] < 0.01  # far from Reynolds, whose mean square action is above 0.2
