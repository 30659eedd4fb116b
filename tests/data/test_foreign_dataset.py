"""Datasets of a task that the library does not know."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from modgnn_rl import EXPERT_ACTION, OBSERVATION, InputError
from modgnn_rl.configs.schema import BCConfig, CollectConfig
from modgnn_rl.data.collect import collect_dataset, describe_dataset
from modgnn_rl.data.dataset import EpisodeDataset
from modgnn_rl.experiment.training import train
from tests.foreign_tasks import Gather, GatherConfig


@pytest.mark.parametrize("actions", ["box", "categorical"])
def test_windows_hold_what_the_environment_emitted(tmp_path, actions):
    env = GatherConfig(actions=actions, max_steps=30)
    folder = collect_dataset(CollectConfig(env=env, episodes=5, steps=30, num_envs=3, output=str(tmp_path / "set")))
    dataset = EpisodeDataset.open(folder)
    windows = dataset.windows(torch.arange(len(dataset)), 2)
    task = dataset.task
    assert windows[OBSERVATION].shape == (150, 2, 4, 4)
    position = task.positions(windows)
    near = torch.cdist(position, position, compute_mode="donot_use_mm_for_euclid_dist") <= env.comm_range
    near.diagonal(dim1=-2, dim2=-1).fill_(False)
    assert torch.equal(windows["adjacency"], near)
    rule = task.rule(windows[OBSERVATION])
    expected = torch.nn.functional.one_hot(rule, 5).float() if actions == "categorical" else rule
    torch.testing.assert_close(windows[EXPERT_ACTION], expected)
    begins = windows["is_init"][..., 0].view(5, 30, 2)
    assert begins[:, 0].all()
    if actions == "box":  # the expert gathers early, and the next episode begins within the rollout
        assert begins[:, 2:, 1].any()
    moved = windows[:, 1][OBSERVATION][..., :2] - windows[:, 0][OBSERVATION][..., :2]
    far = moved.norm(dim=-1).amax(-1) > 0.3  # farther than a robot moves in a step
    assert not (far & ~windows["is_init"][:, 1, 0]).any()


def test_a_policy_is_cloned_from_a_dataset_and_other_settings_are_refused(tmp_path, small_config):
    env = GatherConfig(max_steps=10)
    folder = collect_dataset(CollectConfig(env=env, episodes=4, num_envs=2, output=str(tmp_path / "set")))
    assert "env=gather" in describe_dataset(folder)
    config = small_config(tmp_path / "runs", "bc", env=env, dataset=str(folder), num_val_envs=1)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, name=None))
    assert isinstance(config.trainer, BCConfig)
    train(config, evaluate=False)
    other = dataclasses.replace(config, env=GatherConfig(max_steps=10, comm_range=2.0))
    with pytest.raises(InputError, match=r"env.comm_range=2.0 \(there 1.0\)"):
        train(other, evaluate=False)


def test_a_task_without_an_expert_has_no_dataset(tmp_path, monkeypatch):
    monkeypatch.setattr(Gather, "expert", lambda self: None)
    with pytest.raises(InputError, match="task 'gather' has no expert"):
        collect_dataset(CollectConfig(env=GatherConfig(), output=str(tmp_path / "set")))
    assert not list(tmp_path.iterdir())
