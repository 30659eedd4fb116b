"""Advantages, losses and updates of MAPPO against torch.distributions and loops written out."""

from __future__ import annotations

import copy

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.modules import set_recurrent_mode

from modgnn_rl import make_model
from modgnn_rl.configs.schema import FlockingConfig, MAPPOConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.trainers.collectors.local import FlockCollector
from modgnn_rl.trainers.ppo.learner import RECEIVERS, Improver

WORLD = FlockingConfig(max_steps=8)  # flights end in the middle of the rounds
FLOCKS, AGENTS, STEPS = 4, 5, 10


def _improver(name="pair_force", *, model=None, world=WORLD, **settings):
    policy = make_model(name, hidden=8, seed=0, **(model or {}))
    small = {"window": 3, "epochs": 1, "batches": 2, "critic_hidden": 8}
    return Improver(policy, MAPPOConfig(**{**small, **settings}), world.state_key, seed=0)


def _collector(improver, *, world=WORLD, steps=STEPS):
    return FlockCollector(world, FLOCKS, AGENTS, (improver.actor, Reynolds.for_env(world)), steps=steps, seed=0)


def _weights(module):
    return torch.cat([value.flatten().double() for value in module.state_dict().values()])


@pytest.mark.parametrize(
    ("name", "model"),
    [("mpnn", {}), ("mpnn", {"layers": 2}), ("pair_force", {"layers": 2}), ("modgnn_mlp", {"hops": 2})],
)
@pytest.mark.parametrize("world", [WORLD, FlockingConfig(max_steps=8, dropout_rate=2.0, delay=1)])
def test_before_the_first_update_what_was_flown_is_recomputed_exactly(name, model, world):
    improver = _improver(name, model=model, world=world)
    collector = _collector(improver, world=world)
    before, began = copy.deepcopy(improver.actor.state_dict()), 0
    for _ in range(3):
        flights = collector.continue_flights()
        began += int(flights["is_init"][:, 1:].sum())
        assert abs(improver.improve(flights, only_critic=True)["kl_approx"]) < 1e-6
    assert began > 0
    assert all(torch.equal(value, before[key]) for key, value in improver.actor.state_dict().items())
    assert torch.equal(_weights(improver.flown), _weights(improver.policy))


def test_without_burn_in_learned_messages_would_not_be_those_flown():
    """What the law above guards against: messages that came into a round are of older weights."""
    improver = _improver("mpnn", model={"layers": 2})
    assert improver.burn_in == 2
    collector = _collector(improver)
    collector.continue_flights()
    with torch.no_grad():
        for parameter in improver.policy.parameters():
            parameter.mul_(1.5)
    flights = collector.continue_flights()
    with set_recurrent_mode(True):
        action = improver.policy(flights.select(*improver.policy.in_keys, strict=False))["agents", "action"]
    difference = (action - flights["agents", "loc"]).abs().amax((0, 2, 3))
    assert difference[2:].max() < 1e-5
    # The same without the stored messages, as it is at windows in the middle of a round.
    part = flights[:, 1:].exclude("messages").select(*improver.policy.in_keys, strict=False)
    with set_recurrent_mode(True):
        action = improver.policy(part)["agents", "action"]
    difference = (action - flights["agents", "loc"][:, 1:]).abs().amax((0, 2, 3))
    assert difference[0] > 1e-4
    assert difference[2:].max() < 1e-5


def _gae(reward, value, next_value, done, discount, trace):
    """Generalised advantages of one agent, as a loop; the end of a flight is worth what its last state is worth."""
    advantage, later = [0.0] * len(reward), 0.0
    for t in reversed(range(len(reward))):
        surprise = (1 - discount) * reward[t] + discount * next_value[t] - value[t]
        later = surprise + discount * trace * (0.0 if done[t] else later)
        advantage[t] = later
    return advantage


@pytest.mark.parametrize("world", [WORLD, FlockingConfig(max_steps=8, dropout_rate=2.0)])
def test_advantages_are_those_of_a_loop(world):
    improver = _improver(discount=0.9, trace=0.8, world=world)
    flights = _collector(improver, world=world).continue_flights()
    flights["next", "terminated"][1, 4] = flights["next", "done"][1, 4] = True  # two ends that are no truncation
    flights["next", "terminated"][2, 5] = flights["next", "done"][2, 5] = True
    improver.judge(flights)
    value, next_value = (
        improver.critic(part.clone())["agents", "state_value"].detach() for part in (flights, flights["next"])
    )
    assert bool(flights["next", "truncated"].any())
    expected = torch.zeros(FLOCKS, STEPS, AGENTS)
    for flock in range(FLOCKS):
        for agent in range(AGENTS):
            of_agent = [
                tensor[flock, :, agent, 0].tolist()
                for tensor in (flights["next", "agents", "reward"], value, next_value)
            ]
            done = flights["next", "done"][flock, :, 0].tolist()
            expected[flock, :, agent] = torch.tensor(_gae(*of_agent, done, 0.9, 0.8))
    torch.testing.assert_close(
        flights["agents", "value_target"].squeeze(-1), expected + value.squeeze(-1), rtol=1e-4, atol=1e-5
    )
    flown = flights["agents", "controlled"]
    normalised = (expected - expected[flown].mean()) / expected[flown].std()
    torch.testing.assert_close(flights["agents", "advantage"].squeeze(-1), normalised, rtol=1e-3, atol=1e-4)


def test_judging_leaves_the_flights_as_they_were_flown():
    improver = _improver()
    flights = _collector(improver).continue_flights()
    before = flights.clone()
    improver.judge(flights)
    for key, value in before.items(include_nested=True, leaves_only=True):
        assert torch.equal(flights[key].nan_to_num(7.0), value.nan_to_num(7.0)), key


def _losses(improver, flights, receivers, anchor):
    improver.loss.anchor_coeff = anchor
    improver.judge(flights)
    batch = flights.copy()
    batch[RECEIVERS] = receivers
    batch["collector", "mask"] = receivers.unsqueeze(-1)
    return improver.loss(batch)


def test_losses_are_those_of_torch_distributions():
    improver = _improver("modgnn_mlp", noise=0.4, entropy=0.01)
    flights = _collector(improver).continue_flights()
    with torch.no_grad():
        for parameter in improver.actor.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    receivers = flights["agents", "controlled"] & (torch.arange(AGENTS) != 3)
    losses = _losses(improver, flights, receivers, anchor=0.7)
    with set_recurrent_mode(True):
        mean, old = (
            policy(flights.select(*policy.in_keys, strict=False))["agents", "action"]
            for policy in (improver.policy, improver.anchor)
        )
    sigma = improver.actor.noise
    now, anchor = (Independent(Normal(centre, sigma), 1) for centre in (mean, old))
    torch.testing.assert_close(losses["loss_anchor"], 0.7 * kl_divergence(now, anchor)[receivers].mean())
    torch.testing.assert_close(losses["loss_entropy"], -0.01 * now.entropy()[receivers].mean())

    log_ratio = (now.log_prob(flights["agents", "action"]) - flights["agents", "action_log_prob"])[receivers]
    ratio, advantage = log_ratio.exp(), flights["agents", "advantage"].squeeze(-1)[receivers]
    assert 0 < ((ratio - 1).abs() > 0.2).float().mean() < 1
    gain = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage)
    torch.testing.assert_close(losses["loss_objective"], -gain.mean(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(losses["kl_approx"], (ratio - 1 - log_ratio).mean(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(losses["clip_fraction"], ((ratio - 1).abs() > 0.2).float().mean())


@pytest.mark.parametrize(("name", "model"), [("pair_force", {}), ("mpnn", {"layers": 2})])
def test_the_leader_and_the_burn_in_reach_no_gradient(name, model):
    """Whatever advantages and targets they have, the weights after an update are the same."""
    weights = []
    for rubbish in (0.0, 1e3):
        improver = _improver(name, model=model)
        flights = _collector(improver).continue_flights()
        judge = improver.judge

        def spoiled(flights, judge=judge, rubbish=rubbish):
            judge(flights)
            for key in ("advantage", "action_log_prob"):
                flights["agents", key][:, :, 0] += rubbish

        improver.judge = spoiled
        improver.improve(flights, anchor=0.1)
        weights.append((_weights(improver.policy), _weights(improver.actor)))
    assert torch.equal(weights[0][0], weights[1][0])
    assert torch.equal(weights[0][1], weights[1][1])


def test_steps_of_the_burn_in_are_not_chosen():
    improver = _improver("mpnn", model={"layers": 2})
    seen = []
    forward = improver.loss.forward

    def watched(batch):
        seen.append((batch[RECEIVERS].clone(), batch["agents", "controlled"].clone()))
        return forward(batch)

    improver.loss.forward = watched
    improver.improve(_collector(improver).continue_flights())
    assert len(seen) == 2
    assert sum(len(chosen) for chosen, _ in seen) == FLOCKS * ((STEPS - 2) // 3)  # windows of 2 + 3 steps
    for chosen, controlled in seen:
        assert not chosen[:, :2].any()
        assert (chosen[:, 2:] == controlled[:, 2:]).all()  # as many agents as fit


def test_a_huge_anchor_keeps_the_policy_where_it_began():
    moved = []
    for anchor in (0.0, 1e3):
        improver = _improver("modgnn_mlp", learning_rate=3e-3, epochs=2)
        collector = _collector(improver)
        for _ in range(3):
            flights = collector.continue_flights()
            improver.improve(flights, anchor=anchor)
        data = flights.select(*improver.policy.in_keys, strict=False)
        with torch.no_grad(), set_recurrent_mode(True):
            action, before = (policy(data.copy())["agents", "action"] for policy in (improver.policy, improver.anchor))
        moved.append(float((action - before)[flights["agents", "controlled"]].square().mean().sqrt()))
    assert moved[1] < 0.3 * moved[0]


def test_the_losses_of_a_critic_fall():
    improver = _improver(critic_learning_rate=1e-2, epochs=4)
    flights = _collector(improver).continue_flights()
    losses = [improver.improve(flights.clone(), only_critic=True)["loss_critic"] for _ in range(6)]
    assert losses[-1] < 0.5 * losses[0]


def test_updates_move_policy_sigma_and_average():
    improver = _improver(averaging=0.5)
    before = {name: value.clone() for name, value in improver.actor.state_dict().items()}
    improver.improve(_collector(improver).continue_flights())
    assert improver.updates_done == 2
    assert all(not torch.equal(value, before[name]) for name, value in improver.actor.state_dict().items())
    assert not torch.equal(_weights(improver.flown), _weights(improver.policy))
    began = torch.cat([value.flatten().double() for name, value in before.items() if "policy" in name])
    assert torch.equal(_weights(improver.anchor), began)
