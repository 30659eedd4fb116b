"""Rollouts of imitation learning: continued, labelled, cut into windows."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from modgnn_rl import ModGNN, ModGNNLayer, make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig, TrainConfig
from modgnn_rl.envs.flocking.expert import Reynolds, reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffer, make_buffers
from modgnn_rl.trainers.collectors.windows import slice_windows


def _buffer(policy, seed=0):
    spec = RolloutSpec(FlockingTask(FlockingConfig()).training_env, num_envs=4, num_agents=5, steps=10, seed=seed)
    settings = DAggerConfig(stride=2, capacity=1000, batch_size=16)
    return make_buffer(spec, settings, [policy], Reynolds(), hold_steps=10)


def test_windows_are_stride_steps_apart():
    rollouts = TensorDict({"step": torch.arange(10).expand(3, 10), "flock": torch.arange(3).unsqueeze(1).expand(3, 10)})
    windows = slice_windows(rollouts.auto_batch_size_(2), length=3, stride=4)
    assert windows["step"].tolist() == [[0, 1, 2], [4, 5, 6]] * 3
    assert (windows["flock"] == windows["flock"][:, :1]).all()


def test_rollouts_continue_with_their_messages():
    buffer = _buffer(make_model("pair_force", seed=0))
    first, second = buffer.collect(0.0).clone(), buffer.collect(0.0)
    torch.testing.assert_close(first["next", "agents", "observation"][:, -1], second["agents", "observation"][:, 0])
    sent = second["agents", "observation"][:, :-1].unsqueeze(-2)
    torch.testing.assert_close(second["messages"][:, 1:], sent)
    torch.testing.assert_close(second["messages"][:, :1], first["agents", "observation"][:, -1:].unsqueeze(-2))


def test_every_state_is_labelled_with_the_expert_action():
    buffer = _buffer(make_model("pair_force", seed=0))
    buffer.extend(buffer.collect(0.5))
    batch = buffer.buffer.sample()
    position, velocity = batch["agents", "observation"].split(3, -1)
    expected = reynolds(position, velocity, cohesion=0.06, separation=0.8, alignment=0.02, max_speed=0.92)
    torch.testing.assert_close(batch["agents", "expert_action"], expected)


@pytest.mark.parametrize("beta", [0.0, 1.0])
def test_data_tell_where_the_expert_acts(beta):
    rollouts = _buffer(make_model("gcn", seed=0)).collect(beta)
    same = torch.isclose(rollouts["agents", "action"], rollouts["agents", "expert_action"]).all(-1).all(-1)
    assert same.all() if beta else not same.any()
    assert (rollouts["expert_acts"] == bool(beta)).all()


def test_new_weights_are_used_at_once():
    policy = make_model("gcn", seed=0)
    buffer = _buffer(policy)
    buffer.collect(0.0)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
    assert buffer.collect(0.0)["agents", "action"].abs().max() == 0


def test_data_depend_on_the_seed_only():
    first, again, other = (_buffer(make_model("gcn", seed=0), seed=seed) for seed in (1, 1, 2))
    rollouts = [buffer.collect(0.5) for buffer in (first, again, other)]
    for buffer, collected in zip((first, again), rollouts, strict=False):
        buffer.extend(collected)
    assert (rollouts[0] == rollouts[1]).all()
    assert not (rollouts[0]["agents", "observation"] == rollouts[2]["agents", "observation"]).all(-1).any()
    assert (first.buffer.sample() == again.buffer.sample()).all()


def test_learned_messages_are_not_stored_but_windows_are():
    policy = ModGNN(ModGNNLayer(2, f_input=nn.Linear(6, 4), f_final=nn.Linear(4, 3)))
    buffer = _buffer(policy)
    buffer.extend(buffer.collect(0.0))
    batch = buffer.buffer.sample()
    assert batch.batch_size == (16, 3)
    assert "messages" not in batch.keys()  # noqa: SIM118 - a TensorDict, not a dict


def test_sizes_have_equally_many_agents_in_all():
    config = TrainConfig(env=FlockingConfig(num_agents=[4, 8, 32]), trainer=DAggerConfig(num_envs=6))
    task = FlockingTask(config.env)
    buffers = make_buffers(config, task, [make_model("gcn", seed=0)], steps=2, hold_steps=2)
    shapes = [buffer.collect(0.0)["adjacency"].shape for buffer in buffers.values()]
    assert shapes == [(16, 2, 4, 4), (8, 2, 8, 8), (2, 2, 32, 32)]
