"""Behaviour cloning on a dataset: validation episodes are kept apart, and a dataset that does not fit is refused."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from modgnn_rl import make_model
from modgnn_rl.configs.schema import (
    BCConfig,
    CollectConfig,
    FlockingConfig,
    ModelConfig,
    TrainConfig,
)
from modgnn_rl.data.collect import collect_dataset
from modgnn_rl.data.dataset import EpisodeDataset, EpisodeWindows
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.tracking.run_folder import RunFolder
from modgnn_rl.trainers.imitation.learner import ImitationLearner

ENV = FlockingConfig(num_agents=5)
EPISODES, STEPS = 6, 30


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "set"
    return collect_dataset(CollectConfig(env=ENV, episodes=EPISODES, steps=STEPS, num_envs=4, output=str(path)))


def run_bc(
    runs: Path, dataset: Path, *, env: FlockingConfig = ENV, model: str = "pair_force", **settings: Any
) -> RunFolder:
    small = {"batch_size": 16, "cloning_steps": 10, "cloning_updates": 20, "num_val_envs": 2, "capacity": 10}
    trainer = BCConfig(dataset=str(dataset), **{**small, **settings})
    config = TrainConfig(env=env, model=ModelConfig(name=model, hops=2), trainer=trainer, runs=str(runs))
    return train(config, evaluate=False)


def test_validation_episodes_are_not_trained_on(tmp_path: Path, dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: dict[range, set[int]] = {}
    windows = EpisodeDataset.windows

    def watched(storage: EpisodeWindows, index: torch.Tensor) -> Any:
        absolute = index + storage.episodes.start * STEPS
        read.setdefault(storage.episodes, set()).update((absolute // STEPS).tolist())
        return windows(storage.dataset, absolute, storage.length)

    monkeypatch.setattr(EpisodeWindows, "get", watched)
    metrics = run_bc(tmp_path, dataset).read_metrics()
    assert read == {range(4): {0, 1, 2, 3}, range(4, 6): {4, 5}}
    assert len(metrics) == 20
    assert {"5/loss", "5/validation_loss"} <= set(metrics[0])
    assert "5/error" in metrics[-1]


def test_a_learner_fits_a_dataset(dataset: Path) -> None:
    policy = make_model("modgnn_mlp", hops=2, seed=0)
    buffer = EpisodeDataset.open(dataset).buffer(policy.window, 64, generator=torch.Generator().manual_seed(0))
    learner = ImitationLearner(policy, FlockingTask(FlockingConfig()), BCConfig(ema_decay=0.9), (60, 60), seed=0)
    before = learner.validate(buffer)
    learner.fit(buffer, 60)
    assert learner.validate(buffer) < 0.5 * before


def test_the_seed_determines_a_run_and_checkpoints_keep_its_generators(tmp_path: Path, dataset: Path) -> None:
    runs = [run_bc(tmp_path, dataset, model="modgnn_mlp") for _ in range(2)]
    assert runs[0].metrics_file.read_bytes() == runs[1].metrics_file.read_bytes()
    states = [load_checkpoint(run.checkpoints).tensors["generators"]["validation-5.batches"] for run in runs]
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], torch.Generator().manual_seed(0).get_state())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"env": FlockingConfig(num_agents=5, separation_gain=0.7)}, r"env.separation_gain=0.7 \(there 0.8\)"),
        ({"env": FlockingConfig(num_agents=[5, 6])}, r"env.num_agents=\[5, 6\] \(there 5\)"),
        ({"num_val_envs": 6}, r"num_val_envs=6 leaves nothing to train on of the 6 episodes"),
        ({"dataset": "nowhere"}, "nowhere is not a dataset of rollouts"),
    ],
)
def test_a_dataset_that_does_not_fit_is_refused_before_a_run_is_created(
    tmp_path: Path, dataset: Path, settings: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        run_bc(tmp_path, **{"dataset": dataset, **settings})
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_dataset_is_refused_before_a_run_is_created(tmp_path: Path, dataset: Path) -> None:
    file = dataset / "shard_00001" / "state.memmap"
    before = file.read_bytes()
    try:
        file.write_bytes(os.urandom(len(before)))
        with pytest.raises(InputError, match=r"shard_00001 is damaged .the content of state.memmap has changed"):
            run_bc(tmp_path, dataset)
    finally:
        file.write_bytes(before)
    assert list(tmp_path.iterdir()) == []
