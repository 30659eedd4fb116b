"""The exploring actor against torch's normal distribution, and against its policy."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Independent, Normal
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from modgnn_rl import make_model
from modgnn_rl.trainers.ppo.actor import GaussianActor

FLOCKS, AGENTS, HOPS = 4, 5, 2


def _step(*steps):
    """Data of one step, or of a window."""
    generator = torch.Generator().manual_seed(0)
    shape = (FLOCKS, *steps)
    observation = torch.randn(*shape, AGENTS, 6, generator=generator)
    adjacency = torch.rand(*shape, AGENTS, AGENTS, generator=generator) < 0.6
    data = TensorDict({"agents": TensorDict({"observation": observation}, shape)}, shape)
    data["adjacency"] = adjacency & ~torch.eye(AGENTS, dtype=torch.bool)
    data["is_init"] = torch.zeros(*shape, 1, dtype=torch.bool)
    data["messages"] = torch.randn(*shape, AGENTS, HOPS, 6, generator=generator)
    return data


def _actor(name="modgnn_mlp", noise=0.3):
    return GaussianActor(make_model(name, hops=HOPS, hidden=8, seed=0), noise)


def test_the_log_probability_is_that_of_a_normal_distribution():
    actor = _actor(noise=0.4)
    torch.manual_seed(0)
    agents = actor(_step())["agents"]
    mean = actor.policy(_step())["agents", "action"]
    expected = Independent(Normal(mean, 0.4), 1).log_prob(agents["action"])
    assert expected.shape == (FLOCKS, AGENTS)
    torch.testing.assert_close(agents["action_log_prob"], expected)
    torch.testing.assert_close(agents["loc"], mean)
    torch.testing.assert_close(agents["scale"], torch.full_like(mean, 0.4))


def test_samples_have_the_given_mean_and_standard_deviation():
    actor, data = _actor(noise=0.4), _step()
    torch.manual_seed(0)
    deviation = torch.stack([actor(data.clone())["agents", "action"] for _ in range(60)]) - actor(data)["agents", "loc"]
    assert deviation.mean().abs() < 0.02
    assert deviation.std().item() == pytest.approx(0.4, rel=0.03)
    assert (deviation[0] - deviation[1]).abs().min() > 0


@pytest.mark.parametrize("name", ["pair_force", "moment_force", "modgnn_mlp", "mpnn"])
def test_without_exploration_it_acts_exactly_like_the_policy(name):
    policy = make_model(name, hidden=8, seed=0)
    actor, data = GaussianActor(policy), _step().exclude("messages")
    data["is_init"].fill_(True)
    expected = policy(data.clone())
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found = actor(data.clone())
    assert torch.equal(found["agents", "action"], expected["agents", "action"])
    assert torch.equal(found["next", "messages"].nan_to_num(7.0), expected["next", "messages"].nan_to_num(7.0))


def test_exploring_does_not_change_the_messages():
    actor, data = _actor(), _step()
    assert torch.equal(actor(data.clone())["next", "messages"], actor.policy(data.clone())["next", "messages"])


def test_means_of_receivers_are_exact_and_others_are_zero():
    actor, window = _actor("mpnn"), _step(4).exclude("messages")
    receivers = torch.rand(FLOCKS, 4, AGENTS, generator=torch.Generator().manual_seed(1)) < 0.4
    with set_recurrent_mode(True):
        everyone = actor.get_dist(window.clone())
        some = actor.get_dist(window.clone().set(("agents", "receivers"), receivers))
    assert 0 < receivers.sum() < receivers.numel()
    torch.testing.assert_close(some.mean[receivers], everyone.mean[receivers])
    assert (some.mean[~receivers] == 0).all()
    assert torch.equal(some.stddev, everyone.stddev)


def test_the_policy_is_not_copied():
    policy = make_model("gcn", hops=HOPS, seed=0)
    actor = GaussianActor(policy, 0.2)
    assert actor.policy is policy
    own = {id(parameter) for parameter in actor.parameters()}
    assert {id(parameter) for parameter in policy.parameters()} < own
    assert len(own) == len(list(policy.parameters())) + 1
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
    assert actor(_step())["agents", "loc"].abs().max() == 0


def test_the_log_probability_has_the_gradients_of_the_formula():
    """``d log p / d log sigma = |a - mu|^2 / sigma^2 - 3`` for three components."""
    actor, data = _actor(noise=0.4), _step()
    action = torch.randn(FLOCKS, AGENTS, 3, generator=torch.Generator().manual_seed(2))
    dist = actor.get_dist(data.clone())
    (found,) = torch.autograd.grad(dist.log_prob(action).sum(), [actor.module[0].log_scale])
    square = (action - actor.policy(data.clone())["agents", "action"]).square().sum(-1)
    torch.testing.assert_close(found, (square / 0.4**2 - 3).sum())
    assert actor.noise == pytest.approx(0.4)
    with torch.no_grad():
        actor.module[0].log_scale.add_(math.log(2))
    assert actor.noise == pytest.approx(0.8)


def test_sigma_is_learned_with_the_policy():
    actor = _actor()
    before = copy.deepcopy(actor.state_dict())
    optimizer = torch.optim.SGD(actor.parameters(), lr=0.1)
    (-actor.get_dist(_step()).log_prob(torch.zeros(FLOCKS, AGENTS, 3)).sum()).backward()
    optimizer.step()
    assert all(not torch.equal(value, before[name]) for name, value in actor.state_dict().items())
