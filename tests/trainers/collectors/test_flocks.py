"""Rollouts for training: continued, labelled, cut into windows."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from modgnn_rl import ModGNN, ModGNNLayer, make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig, TrainConfig
from modgnn_rl.envs.flocking.expert import Reynolds, reynolds
from modgnn_rl.trainers.collectors.flocks import FlockBuffer, make_buffers
from modgnn_rl.trainers.collectors.windows import as_windows


def _flocks(policy, *, seed=0, steps=10, stride=2, **env_config):
    settings = DAggerConfig(stride=stride, capacity=1000, batch_size=16)
    config = FlockingConfig(**env_config)
    return FlockBuffer(config, settings, 4, 5, [policy], Reynolds(), steps=steps, hold_steps=steps, seed=seed)


def test_windows_end_at_every_so_manyth_step():
    rollouts = TensorDict({"step": torch.arange(10).expand(3, 10), "flock": torch.arange(3).unsqueeze(1).expand(3, 10)})
    windows = as_windows(rollouts.auto_batch_size_(2), length=3, stride=4)
    assert windows["step"].tolist() == [[0, 1, 2], [4, 5, 6]] * 3
    assert (windows["flock"] == windows["flock"][:, :1]).all()


def test_flights_go_on_where_they_were_and_carry_their_messages():
    flocks = _flocks(make_model("pair_force", seed=0))
    first, second = flocks.fly(0.0).clone(), flocks.fly(0.0)
    torch.testing.assert_close(first["next", "agents", "observation"][:, -1], second["agents", "observation"][:, 0])
    sent = second["agents", "observation"][:, :-1].unsqueeze(-2)
    torch.testing.assert_close(second["messages"][:, 1:], sent)
    torch.testing.assert_close(second["messages"][:, :1], first["agents", "observation"][:, -1:].unsqueeze(-2))


def test_every_state_is_labelled_with_the_expert_of_that_state():
    flocks = _flocks(make_model("pair_force", seed=0))
    flocks.keep(flocks.fly(0.5))
    batch = flocks.buffer.sample()
    position, velocity = batch["agents", "observation"].split(3, -1)
    expected = reynolds(position, velocity, cohesion=0.06, separation=0.8, alignment=0.02, max_speed=0.92)
    torch.testing.assert_close(batch["agents", "expert_action"], expected)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_who_flies_is_told(share):
    rollouts = _flocks(make_model("gcn", seed=0)).fly(share)
    same = torch.isclose(rollouts["agents", "action"], rollouts["agents", "expert_action"]).all(-1).all(-1)
    assert same.all() if share else not same.any()
    assert (rollouts["expert_flies"] == bool(share)).all()


def test_new_weights_fly_at_once():
    policy = make_model("gcn", seed=0)
    flocks = _flocks(policy)
    flocks.fly(0.0)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
    assert flocks.fly(0.0)["agents", "action"].abs().max() == 0


def test_one_seed_fixes_the_data():
    first, again, other = (_flocks(make_model("gcn", seed=0), seed=seed) for seed in (1, 1, 2))
    rollouts = [flocks.fly(0.5) for flocks in (first, again, other)]
    for flocks, flown in zip((first, again), rollouts, strict=False):
        flocks.keep(flown)
    assert (rollouts[0] == rollouts[1]).all()
    assert not (rollouts[0]["agents", "observation"] == rollouts[2]["agents", "observation"]).all(-1).any()
    assert (first.buffer.sample() == again.buffer.sample()).all()


def test_learned_messages_are_kept_as_windows_without_the_stale_ones():
    policy = ModGNN(ModGNNLayer(2, f_input=nn.Linear(6, 4), f_final=nn.Linear(4, 3)))
    flocks = _flocks(policy)
    flocks.keep(flocks.fly(0.0))
    batch = flocks.buffer.sample()
    assert batch.batch_size == (16, 3)
    assert "messages" not in batch.keys()  # noqa: SIM118 - a TensorDict, not a dict


def test_sizes_share_the_agents():
    config = TrainConfig(env=FlockingConfig(num_agents=[4, 8, 32]), trainer=DAggerConfig(num_envs=6))
    flocks = make_buffers(config, [make_model("gcn", seed=0)], Reynolds(), steps=2, hold_steps=2)
    shapes = [group.fly(0.0)["adjacency"].shape for group in flocks.values()]
    assert shapes == [(16, 2, 4, 4), (8, 2, 8, 8), (2, 2, 32, 32)]
