"""A run that was stopped or killed, and is resumed, ends like an uninterrupted one."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest
import torch

from modgnn_rl import load_policy
from modgnn_rl.configs.schema import (
    CollectorConfig,
    FlockingConfig,
    ModelConfig,
)
from modgnn_rl.errors import InputError
from modgnn_rl.experiment.training import resume, train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.loop.callbacks import Callback
from modgnn_rl.utils.signals import Stopped

IMITATION: dict[str, Any] = {"num_envs": 2, "capacity": 150, "num_val_envs": 2, "checkpoint_minutes": 0}
BC: dict[str, Any] = {**IMITATION, "cloning_steps": 24, "cloning_updates": 6}
DAGGER: dict[str, Any] = {
    **IMITATION,
    "cloning_steps": 12,
    "cloning_updates": 6,
    "rounds": 4,
    "steps_per_round": 12,
    "updates_per_round": 4,
}
MAPPO: dict[str, Any] = {
    "num_envs": 2,
    "rounds": 5,
    "steps_per_round": 14,
    "critic_warmup": 1,
    "num_minibatches": 2,
    "checkpoint_minutes": 0,
}
# Trainer and settings.
RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "bc": ("bc", BC),
    "bc of several policies with DART": ("bc", {**BC, "dart": True, "models": ["gcn", "modgnn_mlp"], "seeds": 2}),
    "dagger": ("dagger", {**DAGGER, "beta_rounds": 3}),
    "dagger with a reservoir, stored messages, a plateau": (
        "dagger",
        {
            **DAGGER,
            "capacity": 40,
            "replacement": "reservoir",
            "plateau_rounds": 1,
            "model": ModelConfig(name="pair_force", hidden=8),
        },
    ),
    "dagger with an ensemble": ("dagger", {**DAGGER, "gate": "ensemble", "ensemble": 2, "gate_threshold": 0.1}),
    "dagger of two sizes with perturbations": (
        "dagger",
        {
            **DAGGER,
            "env": FlockingConfig(
                num_agents=[3, 5],
                max_steps=15,
                delay=2,
                position_noise=0.01,
                message_loss=0.1,
                dropout_rate=0.3,
                wind=0.2,
                range_spread=0.2,
                motor_lag=0.02,
                leader="waypoints",
            ),
        },
    ),
    "mappo": ("mappo", MAPPO),
    "mappo with learned messages": (
        "mappo",
        {**MAPPO, "window": 3, "model": ModelConfig(name="modgnn_mlp", layers=2, hidden=8)},
    ),
}


class Signal(Callback):
    """Sends a signal to this process in one round."""

    def __init__(self, at, number=signal.SIGTERM):
        self.at, self.number = at, number

    def on_collect(self, index, rollouts):
        """Send the signal."""
        if index == self.at:
            self.at = None
            os.kill(os.getpid(), self.number)


@pytest.fixture
def config(small_config):
    """Makes the configuration of a run with a checkpoint after every round."""
    env = FlockingConfig(num_agents=4, max_steps=15)
    return lambda runs, trainer, settings: small_config(
        runs, trainer, **{"env": env, "model": ModelConfig(), **settings}
    )


@pytest.fixture
def stopped_run(config):
    """Makes a run that was stopped by a signal in one of its rounds."""

    def make(runs, trainer, settings, at=2, number=signal.SIGTERM):
        with pytest.raises(Stopped) as stopped:
            train(config(runs, trainer, settings), callbacks=[Signal(at, number)], evaluate=False)
        assert stopped.value.code == 128 + number
        (folder,) = runs.iterdir()
        return RunFolder.open(folder)

    return make


def _all_of(run):
    """All that a run ended with."""
    found = load_checkpoint(run.checkpoints)
    times = {"seconds", "config"}
    return found.tensors, {k: v for k, v in found.state.items() if k not in times}, run.metrics_file.read_bytes()


def _assert_equal(one, other):
    for tensors in (one[0], other[0]):
        assert {name.rpartition(".")[2] for name in tensors} & {"policy", "data"}
    assert {group: set(named) for group, named in one[0].items()} == {g: set(named) for g, named in other[0].items()}
    for group, named in one[0].items():
        for name, value in named.items():
            torch.testing.assert_close(
                value, other[0][group][name], rtol=0, atol=0, equal_nan=True, msg=f"{group} {name}"
            )
    assert one[1:] == other[1:]


QUICK = {"dagger with a reservoir, stored messages, a plateau", "mappo"}


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in RUNS]
)
def test_a_stopped_and_resumed_run_ends_like_an_uninterrupted_one(tmp_path, name, config, stopped_run):
    straight = train(config(tmp_path / "straight", *RUNS[name]), evaluate=False)
    run = stopped_run(tmp_path / "stopped", *RUNS[name], at=1 if name.startswith("bc") else 2)
    assert run.state == "stopped"
    resume(run.path, evaluate=False)
    assert run.state == "finished"
    _assert_equal(_all_of(straight), _all_of(run))


@pytest.mark.parametrize("how", ["another number of agents", "no data in checkpoints"])
def test_environments_or_data_that_start_afresh(tmp_path, capsys, how, stopped_run):
    kept = how == "another number of agents"
    run = stopped_run(tmp_path, "dagger", {**DAGGER, "checkpoint_data": kept})
    before = load_policy(run.path).state_dict()
    resume(run.path, {"env.num_agents": [3, 5]} if kept else {}, evaluate=False)
    assert ("start afresh because of env.num_agents=[3, 5]" in capsys.readouterr().out) == kept
    assert [line["step"] for line in run.read_metrics()] == [0, 1, 2, 3, 4]
    assert any(not torch.equal(value, before[name]) for name, value in load_policy(run.path).state_dict().items())


def test_a_setting_that_cannot_change_is_named_and_nothing_is_touched(tmp_path, stopped_run):
    run = stopped_run(tmp_path, "dagger", DAGGER)
    before = {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"cannot change model\.hidden from 32 to 64"):
        resume(run.path, {"model.hidden": 64})
    assert {path: path.read_bytes() for path in run.path.rglob("*") if path.is_file()} == before


def test_the_best_policy_is_kept_beside_the_last(tmp_path, config):
    better = {"bc": "validation_loss", "dagger": "error"}
    for name, metric in better.items():
        run = train(config(tmp_path / name, *RUNS[name]), evaluate=False)
        records = [record[metric] for record in run.read_metrics() if record[metric] == record[metric]]
        found = load_checkpoint(run.best)
        assert set(found.tensors) == {"policy"}
        blocks = [run.read_metrics()[start : start + 5] for start in range(0, len(run.read_metrics()), 5)]
        means = [[record[metric] for record in block if record[metric] == record[metric]] for block in blocks]
        assert found.state["score"] == pytest.approx(min(sum(mean) / len(mean) for mean in means if mean))
        assert records
        load_policy(run.path, which="best")


def test_a_run_that_fails_keeps_the_earlier_policies(tmp_path, config):
    run = train(config(tmp_path, *RUNS["bc of several policies with DART"]), evaluate=False)
    before = {path: path.read_bytes() for path in run.path.glob("*/checkpoints/*/*")}
    assert len(before) >= 4 * 3  # of four policies

    class Break(Callback):
        def on_start(self, policies):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        resume(run.path, {"trainer.cloning_updates": 8}, callbacks=[Break()], evaluate=False)
    assert run.state == "failed"
    assert {path: path.read_bytes() for path in run.path.glob("*/checkpoints/*/*")} == before
    resume(run.path, evaluate=False)
    assert run.state == "finished"
    assert "reason" not in run.status


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["process", "ray"])
@pytest.mark.parametrize("name", ["dagger of two sizes with perturbations", "dagger with an ensemble", "mappo"])
def test_a_stopped_and_resumed_run_with_workers_ends_like_an_uninterrupted_one(
    tmp_path, name, kind, config, stopped_run
):
    if kind == "ray":
        pytest.importorskip("ray")
    trainer, settings = RUNS[name]
    settings = {**settings, "collector": CollectorConfig(kind, workers=2)}
    straight = train(config(tmp_path / "straight", trainer, settings), evaluate=False)
    run = stopped_run(tmp_path / "stopped", trainer, settings)
    resume(run.path, evaluate=False)
    _assert_equal(_all_of(straight), _all_of(run))
