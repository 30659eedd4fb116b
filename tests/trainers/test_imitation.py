"""The imitation loss against a plain computation, and the laws of its augmentations."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from modgnn_rl import ModGNN, ModGNNLayer, make_model
from modgnn_rl.trainers.imitation import imitation_loss, random_receivers, random_rotations, rotate

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
def test_loss_and_gradient_of_some_receivers_are_those_of_the_whole_flock(name):
    """Dropping the links to the others is an economy, never another loss."""
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


def test_the_loss_leaves_the_batch_alone():
    batch = _batch(1, messages=1)
    before = batch.clone()
    imitation_loss(make_model("gcn", seed=0), batch, batch["agents", "controlled"][:, -1])
    assert (batch == before).all()


def test_stored_messages_and_messages_made_anew_give_the_same_gradient():
    """A policy that sends plain data may train on stored messages; a window that makes them anew agrees with it."""
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
def test_receivers_are_controlled_and_as_many_as_asked_for(count, agents, seed):
    generator = torch.Generator().manual_seed(seed)
    controlled = torch.rand(6, agents, generator=generator) < 0.7
    receivers = random_receivers(controlled, count, generator)
    assert not (receivers & ~controlled).any()
    assert (receivers.sum(-1) == controlled.sum(-1).clamp(max=count)).all()


def test_every_controlled_agent_gets_its_turn():
    controlled = torch.tensor([False, True, True, True, True]).expand(4000, 5)
    share = random_receivers(controlled, 2, torch.Generator().manual_seed(0)).float().mean(0)
    torch.testing.assert_close(share, torch.tensor([0.0, 0.5, 0.5, 0.5, 0.5]), atol=0.03, rtol=0)


def test_rotations_are_rotations_and_uniform():
    rotations = random_rotations(5000, torch.zeros((), dtype=torch.float64), torch.Generator().manual_seed(0))
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, identity)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(5000, dtype=torch.float64))
    # For uniform rotations the entries have mean 0 and mean square 1/3.
    assert rotations.mean(0).abs().max() < 0.03
    assert (rotations.square().mean(0) - 1 / 3).abs().max() < 0.03


def test_rotate_turns_each_vector_by_the_matrix_of_its_sample():
    rotations = random_rotations(4, torch.zeros(()), torch.Generator().manual_seed(0))
    data = torch.randn(4, 1, 5, 6, generator=torch.Generator().manual_seed(1))
    turned = rotate(data, rotations)
    for sample in range(4):
        for part in (slice(0, 3), slice(3, 6)):
            expected = data[sample, ..., part] @ rotations[sample].T
            torch.testing.assert_close(turned[sample, ..., part], expected)
