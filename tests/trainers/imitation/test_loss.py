"""The imitation loss against a plain computation, and the laws of its augmentations."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from modgnn_rl import ModGNN, ModGNNLayer, make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.layout import STATE
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffer
from modgnn_rl.trainers.collectors.windows import slice_windows, uses_stored_messages, window_length
from modgnn_rl.trainers.common.sampling import random_receivers
from modgnn_rl.trainers.imitation.loss import hide_velocities, imitation_loss, random_rotations, rotate, stacked_losses

FLOCKS, AGENTS = 5, 7


def _batch(window, messages=None):
    generator = torch.Generator().manual_seed(0)
    shape = (FLOCKS, window)
    agents = TensorDict(
        {
            "observation": torch.randn(*shape, AGENTS, 6, generator=generator),
            "expert_action": torch.randn(*shape, AGENTS, 3, generator=generator),
            "controlled": (torch.arange(AGENTS) > 0).expand(*shape, AGENTS).clone(),
        },
        shape,
    )
    adjacency = torch.rand(*shape, AGENTS, AGENTS, generator=generator) < 0.6
    batch = TensorDict({"agents": agents, "adjacency": adjacency & ~torch.eye(AGENTS, dtype=torch.bool)}, shape)
    batch["is_init"] = torch.zeros(*shape, 1, dtype=torch.bool)
    if messages is not None:
        batch["messages"] = torch.randn(*shape, AGENTS, messages, 6, generator=generator)
    return batch


@pytest.mark.parametrize("name", ["pair_force", "modgnn_mlp", "gcn"])
def test_loss_and_gradient_of_some_receivers_equal_those_of_the_whole_flock(name):
    """Dropping the edges to the others saves time and does not change the loss."""
    policy = make_model(name, hops=2, seed=0)
    batch = _batch(1, messages=2)
    receivers = random_receivers(batch["agents", "controlled"][:, -1], 3, torch.Generator().manual_seed(1))
    loss = imitation_loss(policy, batch, receivers)
    economical = torch.autograd.grad(loss, list(policy.parameters()))

    step = batch[:, 0].clone()
    action = policy(step)["agents", "action"]
    plain = (action - step["agents", "expert_action"]).square().mean(-1)[receivers].mean()
    torch.testing.assert_close(loss, plain)
    for mine, theirs in zip(economical, torch.autograd.grad(plain, list(policy.parameters())), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)


def test_the_loss_does_not_change_the_batch():
    batch = _batch(1, messages=1)
    before = batch.clone()
    imitation_loss(make_model("gcn", seed=0), batch, batch["agents", "controlled"][:, -1])
    assert (batch == before).all()


def test_stored_and_recomputed_messages_give_the_same_gradient():
    """A policy that sends plain data may train on stored messages; a window that recomputes them agrees with it."""
    policy = make_model("modgnn_mlp", hops=2, seed=0)
    window = _batch(3)
    agents, adjacency = window["agents", "observation"], window["adjacency"]
    layer: ModGNNLayer = policy.layers[0]
    _, sent = layer(agents[:, :2], adjacency[:, :2])
    stored = window[:, 2:].clone()
    stored["messages"] = sent[:, 1:]
    receivers = window["agents", "controlled"][:, -1]
    gradients = [
        torch.autograd.grad(imitation_loss(policy, batch, receivers), list(policy.parameters()))
        for batch in (window, stored)
    ]
    for mine, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)


def test_a_learned_f_input_gets_its_gradient_through_the_window():
    policy = ModGNN(ModGNNLayer(2, f_input=torch.nn.Linear(6, 3)))
    assert not policy.sends_plain_data
    batch = _batch(policy.window)
    imitation_loss(policy, batch, batch["agents", "controlled"][:, -1]).backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in policy.parameters())


@given(count=st.integers(1, 12), agents=st.integers(1, 9), seed=st.integers(0, 1000))
def test_receivers_are_controlled_agents_in_the_number_asked_for(count, agents, seed):
    generator = torch.Generator().manual_seed(seed)
    controlled = torch.rand(6, agents, generator=generator) < 0.7
    receivers = random_receivers(controlled, count, generator)
    assert not (receivers & ~controlled).any()
    assert (receivers.sum(-1) == controlled.sum(-1).clamp(max=count)).all()


def test_every_controlled_agent_is_chosen_equally_often():
    controlled = torch.tensor([False, True, True, True, True]).expand(4000, 5)
    share = random_receivers(controlled, 2, torch.Generator().manual_seed(0)).float().mean(0)
    torch.testing.assert_close(share, torch.tensor([0.0, 0.5, 0.5, 0.5, 0.5]), atol=0.03, rtol=0)


def test_rotations_are_rotations_and_uniform():
    rotations = random_rotations(5000, STATE, torch.zeros((), dtype=torch.float64), torch.Generator().manual_seed(0))
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, identity)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(5000, dtype=torch.float64))
    # For uniform rotations the entries have mean 0 and mean square 1/3.
    assert rotations.mean(0).abs().max() < 0.03
    assert (rotations.square().mean(0) - 1 / 3).abs().max() < 0.03


def test_rotate_applies_the_matrix_of_each_sample_to_its_vectors():
    rotations = random_rotations(4, STATE, torch.zeros(()), torch.Generator().manual_seed(0))
    data = torch.randn(4, 1, 5, 6, generator=torch.Generator().manual_seed(1))
    turned = rotate(data, rotations, 2)
    for sample in range(4):
        for part in (slice(0, 3), slice(3, 6)):
            expected = data[sample, ..., part] @ rotations[sample].T
            torch.testing.assert_close(turned[sample, ..., part], expected)


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("pair_force", {}),
        ("pair_force", {"hops": 2}),
        ("moment_force", {}),
        ("modgnn_mlp", {}),
        ("modgnn_mlp", {"hops": 2}),
        ("gat", {}),
    ],
)
def test_training_on_stored_messages_equals_training_on_windows(name, model):
    """For rollouts with resets in the middle: messages as collected, and as recomputed in windows."""
    policy = make_model(name, hidden=8, seed=0, **model)
    settings = DAggerConfig(stride=3, capacity=1000, batch_size=16)
    spec = RolloutSpec(FlockingTask(FlockingConfig(max_steps=6)).training_env, 4, 4, steps=13, seed=0)
    data = make_buffer(spec, settings, [policy], Reynolds(), hold_steps=13)
    assert uses_stored_messages(policy)
    assert data.windows.window == 1
    rollouts = data.collect(0.3)
    assert bool(rollouts["is_init"][:, policy.window :].any())
    recomputed = slice_windows(rollouts.exclude("messages"), policy.window, stride=3)
    stored = slice_windows(rollouts, 1, stride=1).view(4, 13)[:, policy.window - 1 :: 3].reshape(-1, 1)
    receivers = stored["agents", "controlled"][:, -1]
    losses = [imitation_loss(policy, batch, receivers) for batch in (recomputed, stored)]
    torch.testing.assert_close(losses[0], losses[1])
    gradients = [torch.autograd.grad(loss, list(policy.parameters()), allow_unused=True) for loss in losses]
    for mine, theirs in zip(*gradients, strict=True):
        if mine is None or theirs is None:
            assert mine is theirs  # what has no part in the action
        else:
            torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "model"), [("pair_force", {"layers": 2}), ("modgnn_mlp", {"layers": 2}), ("mpnn", {"layers": 2})]
)
def test_learned_messages_are_not_stored(name, model):
    assert not uses_stored_messages(make_model(name, hidden=8, seed=0, **model))


@pytest.mark.parametrize(
    ("name", "model", "window"),
    [("pair_force", {}, 1), ("moment_force", {}, 3), ("modgnn_mlp", {"hops": 2}, 3), ("gcn", {"layers": 2}, 3)],
)
def test_stacked_losses_and_gradients_equal_those_of_a_loop(name, model, window):
    batch = _batch(window)
    receivers = random_receivers(batch["agents", "controlled"][:, -1], 3, torch.Generator().manual_seed(1))
    receivers[0] = False  # a flock without receivers
    at_once, one_by_one = ([make_model(name, hidden=8, seed=seed, **model) for seed in range(3)] for _ in range(2))
    for policies in (at_once, one_by_one):  # gradients are added to what is there
        for parameter in policies[0].parameters():
            parameter.grad = torch.ones_like(parameter)
    losses = stacked_losses(at_once, batch, receivers)
    for policy, other, loss in zip(at_once, one_by_one, losses, strict=True):
        expected = imitation_loss(other, batch, receivers)
        expected.backward()
        torch.testing.assert_close(loss, expected)
        assert not loss.requires_grad
        for mine, theirs in zip(policy.parameters(), other.parameters(), strict=True):
            wanted = torch.zeros_like(mine) if theirs.grad is None else theirs.grad
            torch.testing.assert_close(mine.grad, wanted, rtol=1e-4, atol=1e-6)


@given(share=st.sampled_from([0.0, 0.3, 1.0]), seed=st.integers(0, 1000))
def test_velocities_of_a_window_are_hidden_all_or_none(share, seed):
    batch = _batch(3)
    before = batch.clone()
    hide_velocities(batch, STATE, share, torch.Generator().manual_seed(seed))
    observation, was = batch["agents", "observation"], before["agents", "observation"]
    assert torch.equal(observation[..., :3], was[..., :3])
    hidden = (observation[..., 3:] == 0).flatten(1)
    kept = (observation[..., 3:] == was[..., 3:]).flatten(1)
    assert (hidden.all(1) | kept.all(1)).all()
    if share in (0.0, 1.0):
        assert hidden.all(1).double().mean() == share
    for key in ("adjacency", ("agents", "expert_action")):
        assert torch.equal(batch[key], before[key])


def test_velocities_are_hidden_in_the_given_fraction_of_windows():
    batch = torch.cat([_batch(1) for _ in range(200)])
    hide_velocities(batch, STATE, 0.3, torch.Generator().manual_seed(0))
    hidden = (batch["agents", "observation"][..., 3:] == 0).flatten(1).all(1)
    assert hidden.double().mean().item() == pytest.approx(0.3, abs=0.05)


def test_hidden_velocities_need_windows():
    """Stored messages hold the velocities."""
    policy = make_model("pair_force", seed=0)
    assert window_length([policy], DAggerConfig()) == 1
    assert window_length([policy], DAggerConfig(hide_velocity=0.1)) == policy.window == 2
    assert window_length([policy, make_model("pair_force", seed=1)], DAggerConfig()) == 1
    assert window_length([policy, make_model("modgnn_mlp", hops=3, seed=0)], DAggerConfig()) == 4
