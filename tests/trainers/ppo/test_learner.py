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
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.trainers.collectors.local import LocalCollector, RolloutSpec
from modgnn_rl.trainers.ppo.learner import RECEIVERS, PPOLearner

ENV = FlockingConfig(max_steps=8)  # rollouts end in the middle of the rounds
FLOCKS, AGENTS, STEPS = 4, 5, 10


def _learner(name="pair_force", *, model=None, env_config=ENV, **settings):
    policy = make_model(name, hidden=8, seed=0, **(model or {}))
    small = {"window": 3, "epochs": 1, "num_minibatches": 2, "critic_hidden": 8}
    return PPOLearner(policy, FlockingTask(env_config), MAPPOConfig(**{**small, **settings}), seed=0)


def _collector(learner, *, env_config=ENV, steps=STEPS):
    spec = RolloutSpec(FlockingTask(env_config).training_env, FLOCKS, AGENTS, steps, seed=0)
    return LocalCollector(spec, (learner.actor, Reynolds.for_env(env_config)))


def _weights(module):
    return torch.cat([value.flatten().double() for value in module.state_dict().values()])


@pytest.mark.parametrize(
    ("name", "model"),
    [("mpnn", {}), ("mpnn", {"layers": 2}), ("pair_force", {"layers": 2}), ("modgnn_mlp", {"hops": 2})],
)
@pytest.mark.parametrize("env_config", [ENV, FlockingConfig(max_steps=8, dropout_rate=2.0, delay=1)])
def test_before_the_first_update_the_collected_actions_are_recomputed_exactly(name, model, env_config):
    learner = _learner(name, model=model, env_config=env_config)
    collector = _collector(learner, env_config=env_config)
    before, began = copy.deepcopy(learner.actor.state_dict()), 0
    for _ in range(3):
        rollouts = collector.collect()
        began += int(rollouts["is_init"][:, 1:].sum())
        assert abs(learner.update(rollouts, critic_only=True)["kl_approx"]) < 1e-6
    assert began > 0
    assert all(torch.equal(value, before[key]) for key, value in learner.actor.state_dict().items())
    assert torch.equal(_weights(learner.ema_policy), _weights(learner.policy))


def test_without_burn_in_learned_messages_would_differ_from_those_collected():
    """What the law above guards against: messages that came into a round are of older weights."""
    learner = _learner("mpnn", model={"layers": 2})
    assert learner.burn_in == 2
    collector = _collector(learner)
    collector.collect()
    with torch.no_grad():
        for parameter in learner.policy.parameters():
            parameter.mul_(1.5)
    rollouts = collector.collect()
    with set_recurrent_mode(True):
        action = learner.policy(rollouts.select(*learner.policy.in_keys, strict=False))["agents", "action"]
    difference = (action - rollouts["agents", "loc"]).abs().amax((0, 2, 3))
    assert difference[2:].max() < 1e-5
    # The same without the stored messages, as it is at windows in the middle of a round.
    part = rollouts[:, 1:].exclude("messages").select(*learner.policy.in_keys, strict=False)
    with set_recurrent_mode(True):
        action = learner.policy(part)["agents", "action"]
    difference = (action - rollouts["agents", "loc"][:, 1:]).abs().amax((0, 2, 3))
    assert difference[0] > 1e-4
    assert difference[2:].max() < 1e-5


def _gae(reward, value, next_value, done, discount, trace):
    """Generalised advantages of one agent, as a loop; the end of a rollout is worth what its last state is worth."""
    advantage, later = [0.0] * len(reward), 0.0
    for t in reversed(range(len(reward))):
        surprise = (1 - discount) * reward[t] + discount * next_value[t] - value[t]
        later = surprise + discount * trace * (0.0 if done[t] else later)
        advantage[t] = later
    return advantage


@pytest.mark.parametrize("env_config", [ENV, FlockingConfig(max_steps=8, dropout_rate=2.0)])
def test_advantages_equal_those_of_a_loop(env_config):
    learner = _learner(gamma=0.9, gae_lambda=0.8, env_config=env_config)
    rollouts = _collector(learner, env_config=env_config).collect()
    rollouts["next", "terminated"][1, 4] = rollouts["next", "done"][1, 4] = True  # two ends that are no truncation
    rollouts["next", "terminated"][2, 5] = rollouts["next", "done"][2, 5] = True
    learner.compute_advantages(rollouts)
    value, next_value = (
        learner.critic(part.clone())["agents", "state_value"].detach() for part in (rollouts, rollouts["next"])
    )
    assert bool(rollouts["next", "truncated"].any())
    expected = torch.zeros(FLOCKS, STEPS, AGENTS)
    for flock in range(FLOCKS):
        for agent in range(AGENTS):
            of_agent = [
                tensor[flock, :, agent, 0].tolist()
                for tensor in (rollouts["next", "agents", "reward"], value, next_value)
            ]
            done = rollouts["next", "done"][flock, :, 0].tolist()
            expected[flock, :, agent] = torch.tensor(_gae(*of_agent, done, 0.9, 0.8))
    torch.testing.assert_close(
        rollouts["agents", "value_target"].squeeze(-1), expected + value.squeeze(-1), rtol=1e-4, atol=1e-5
    )
    controlled = rollouts["agents", "controlled"]
    normalised = (expected - expected[controlled].mean()) / expected[controlled].std()
    torch.testing.assert_close(rollouts["agents", "advantage"].squeeze(-1), normalised, rtol=1e-3, atol=1e-4)


def test_computing_advantages_leaves_the_rollouts_unchanged():
    learner = _learner()
    rollouts = _collector(learner).collect()
    before = rollouts.clone()
    learner.compute_advantages(rollouts)
    for key, value in before.items(include_nested=True, leaves_only=True):
        assert torch.equal(rollouts[key].nan_to_num(7.0), value.nan_to_num(7.0)), key


def _losses(learner, rollouts, receivers, kl_coef):
    learner.loss.kl_coef = kl_coef
    learner.compute_advantages(rollouts)
    batch = rollouts.copy()
    batch[RECEIVERS] = receivers
    batch["collector", "mask"] = receivers.unsqueeze(-1)
    return learner.loss(batch)


def test_losses_equal_those_of_torch_distributions():
    learner = _learner("modgnn_mlp", noise=0.4, entropy_coef=0.01)
    rollouts = _collector(learner).collect()
    with torch.no_grad():
        for parameter in learner.actor.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    receivers = rollouts["agents", "controlled"] & (torch.arange(AGENTS) != 3)
    losses = _losses(learner, rollouts, receivers, kl_coef=0.7)
    with set_recurrent_mode(True):
        mean, old = (
            policy(rollouts.select(*policy.in_keys, strict=False))["agents", "action"]
            for policy in (learner.policy, learner.reference_policy)
        )
    sigma = learner.actor.noise
    now, reference = (Independent(Normal(centre, sigma), 1) for centre in (mean, old))
    torch.testing.assert_close(losses["loss_kl"], 0.7 * kl_divergence(now, reference)[receivers].mean())
    torch.testing.assert_close(losses["loss_entropy"], -0.01 * now.entropy()[receivers].mean())

    log_ratio = (now.log_prob(rollouts["agents", "action"]) - rollouts["agents", "action_log_prob"])[receivers]
    ratio, advantage = log_ratio.exp(), rollouts["agents", "advantage"].squeeze(-1)[receivers]
    assert 0 < ((ratio - 1).abs() > 0.2).float().mean() < 1
    gain = torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage)
    torch.testing.assert_close(losses["loss_objective"], -gain.mean(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(losses["kl_approx"], (ratio - 1 - log_ratio).mean(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(losses["clip_fraction"], ((ratio - 1).abs() > 0.2).float().mean())


@pytest.mark.parametrize(("name", "model"), [("pair_force", {}), ("mpnn", {"layers": 2})])
def test_the_leader_and_the_burn_in_do_not_affect_gradients(name, model):
    """Whatever advantages and targets they have, the weights after an update are the same."""
    weights = []
    for garbage in (0.0, 1e3):
        learner = _learner(name, model=model)
        rollouts = _collector(learner).collect()
        compute_advantages = learner.compute_advantages

        def spoiled(rollouts, compute_advantages=compute_advantages, garbage=garbage):
            compute_advantages(rollouts)
            for key in ("advantage", "action_log_prob"):
                rollouts["agents", key][:, :, 0] += garbage

        learner.compute_advantages = spoiled
        learner.update(rollouts, kl_coef=0.1)
        weights.append((_weights(learner.policy), _weights(learner.actor)))
    assert torch.equal(weights[0][0], weights[1][0])
    assert torch.equal(weights[0][1], weights[1][1])


def test_steps_of_the_burn_in_do_not_count():
    learner = _learner("mpnn", model={"layers": 2})
    seen = []
    forward = learner.loss.forward

    def watched(batch):
        seen.append((batch[RECEIVERS].clone(), batch["agents", "controlled"].clone()))
        return forward(batch)

    learner.loss.forward = watched
    learner.update(_collector(learner).collect())
    assert len(seen) == 2
    assert sum(len(chosen) for chosen, _ in seen) == FLOCKS * ((STEPS - 2) // 3)  # windows of 2 + 3 steps
    for chosen, controlled in seen:
        assert not chosen[:, :2].any()
        assert (chosen[:, 2:] == controlled[:, 2:]).all()  # as many agents as fit


def test_a_large_kl_penalty_keeps_the_policy_near_the_reference_policy():
    moved = []
    for kl_coef in (0.0, 1e3):
        learner = _learner("modgnn_mlp", learning_rate=3e-3, epochs=2)
        collector = _collector(learner)
        for _ in range(3):
            rollouts = collector.collect()
            learner.update(rollouts, kl_coef=kl_coef)
        data = rollouts.select(*learner.policy.in_keys, strict=False)
        with torch.no_grad(), set_recurrent_mode(True):
            action, before = (
                policy(data.copy())["agents", "action"] for policy in (learner.policy, learner.reference_policy)
            )
        moved.append(float((action - before)[rollouts["agents", "controlled"]].square().mean().sqrt()))
    assert moved[1] < 0.3 * moved[0]


def test_the_loss_of_the_critic_falls():
    learner = _learner(critic_learning_rate=1e-2, epochs=4)
    rollouts = _collector(learner).collect()
    losses = [learner.update(rollouts.clone(), critic_only=True)["loss_critic"] for _ in range(6)]
    assert losses[-1] < 0.5 * losses[0]


def test_updates_change_policy_sigma_and_average():
    learner = _learner(ema_decay=0.5)
    before = {name: value.clone() for name, value in learner.actor.state_dict().items()}
    learner.update(_collector(learner).collect())
    assert learner.updates_done == 2
    assert all(not torch.equal(value, before[name]) for name, value in learner.actor.state_dict().items())
    assert not torch.equal(_weights(learner.ema_policy), _weights(learner.policy))
    began = torch.cat([value.flatten().double() for name, value in before.items() if "policy" in name])
    assert torch.equal(_weights(learner.reference_policy), began)
