"""Gates, ensembles and action noise: who acts, and that messages and labels are not affected."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import get_primers_from_module

from modgnn_rl import load_policy, make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig, ModelConfig, TrainConfig
from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, Ensemble, SafetyGate, disagreement, ensemble_std
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffer

FLOCKS, AGENTS = 6, 4


def _step(seed=0):
    generator = torch.Generator().manual_seed(seed)
    agents = {name: torch.randn(FLOCKS, AGENTS, 3, generator=generator) for name in ("action", "expert_action")}
    agents["controlled"] = (torch.arange(AGENTS) > 0).expand(FLOCKS, -1).clone()
    agents["ensemble_std"] = torch.rand(FLOCKS, AGENTS, generator=generator)
    return TensorDict({"agents": TensorDict(agents, FLOCKS)}, FLOCKS)


def test_disagreement_is_the_root_mean_square_over_controlled_agents():
    step = _step()
    step["agents", "controlled"][0] = False
    step["agents", "action"][:, 0] = torch.nan  # the policy does not control the leader
    expected = []
    for flock in range(FLOCKS):
        agents = [agent for agent in range(AGENTS) if step["agents", "controlled"][flock, agent]]
        difference = (step["agents", "action"] - step["agents", "expert_action"])[flock, agents]
        expected.append(difference.square().sum(-1).mean().sqrt() if agents else torch.tensor(0.0))
    torch.testing.assert_close(disagreement(step), torch.stack(expected))


def test_ensemble_std_is_the_root_mean_square_over_controlled_agents():
    step = _step()
    torch.testing.assert_close(ensemble_std(step), step["agents", "ensemble_std"][:, 1:].square().mean(-1).sqrt())


@pytest.mark.parametrize("measure", [disagreement, ensemble_std])
def test_the_expert_acts_exactly_where_the_measure_is_above_the_threshold(measure):
    step = _step()
    value = measure(step)
    threshold = float(value.median())  # the flock in the middle is not above it
    gated = SafetyGate(measure, threshold)(step.clone())
    is_above = value > threshold
    assert 0 < is_above.sum() < FLOCKS
    assert torch.equal(gated["expert_acts"].squeeze(-1), is_above)
    for flock in range(FLOCKS):
        expected = "expert_action" if is_above[flock] else "action"
        assert torch.equal(gated["agents", "action"][flock], step["agents", expected][flock])
    assert torch.equal(gated["agents", "expert_action"], step["agents", "expert_action"])


def test_a_gate_after_a_mixture_only_adds_flocks_in_which_the_expert_acts():
    step = _step()
    mixed = torch.tensor([True, False] * 3).unsqueeze(-1)
    step["expert_acts"] = mixed
    step["agents", "action"] = torch.where(
        mixed.unsqueeze(-1), step["agents", "expert_action"], step["agents", "action"]
    )
    gated = SafetyGate(disagreement, 1e-3)(step.clone())
    assert gated["expert_acts"].all()
    gated = SafetyGate(disagreement, 1e3)(step.clone())
    assert torch.equal(gated["expert_acts"], mixed)


def _buffer(policies, gate, **settings):
    config = DAggerConfig(stride=1, capacity=1000, batch_size=16, **settings)
    spec = RolloutSpec(FlockingTask(FlockingConfig(max_steps=7)).training_env, FLOCKS, AGENTS, steps=10, seed=0)
    return make_buffer(spec, config, policies, Reynolds(), hold_steps=10, gate=gate)


@pytest.mark.parametrize("measure", [disagreement, ensemble_std])
def test_messages_are_updated_while_the_expert_acts(measure):
    policies = [make_model("pair_force", hidden=8, seed=seed) for seed in range(3)]
    rollouts_by_beta = {}
    for threshold, beta in ((1e-6, 1.0), (1e6, 0.0)):
        buffer = _buffer(policies, SafetyGate(measure, threshold))
        rollouts = buffer.collect(0.0)
        rollouts_by_beta[beta] = rollouts
        # Without messages, at the first step, all members output zero.
        acts = rollouts["expert_acts"]
        assert (acts | rollouts["is_init"]).all() if beta else not acts.any()
        same = (rollouts["agents", "action"] == rollouts["agents", "expert_action"]).flatten(2).all(-1)
        assert torch.equal(same, acts.squeeze(-1))
        continues = ~rollouts["is_init"][:, 1:, 0]
        sent = rollouts["agents", "observation"][:, :-1].unsqueeze(-2)
        assert torch.equal(rollouts["messages"][:, 1:][continues], sent[continues])
    assert not torch.equal(
        rollouts_by_beta[1.0]["agents", "observation"], rollouts_by_beta[0.0]["agents", "observation"]
    )


def test_ensemble_std_is_zero_for_identical_members_and_else_follows_the_formula():
    steps = TensorDict(
        {"agents": {"observation": torch.randn(2, AGENTS, 6, generator=torch.Generator().manual_seed(0))}}, 2
    )
    steps["adjacency"] = ~torch.eye(AGENTS, dtype=torch.bool).expand(2, -1, -1)
    steps["is_init"] = torch.ones(2, 1, dtype=torch.bool)
    alike = Ensemble([make_model("mpnn", hops=0, hidden=8, seed=3) for _ in range(3)])
    assert alike(steps.clone())["agents", "ensemble_std"].abs().max() < 1e-7
    members = [make_model("mpnn", hops=0, hidden=8, seed=seed) for seed in range(3)]
    found = Ensemble(members)(steps.clone())
    actions = torch.stack([member(steps.clone())["agents", "action"] for member in members])
    assert torch.equal(found["agents", "action"], actions[0])
    # The mean over members of the squared distance from their mean: the trace of the biased covariance.
    torch.testing.assert_close(found["agents", "ensemble_std"], actions.var(0, correction=0).sum(-1).sqrt())


def _rollout(policy, behaviour, steps=6):
    env = FlockingEnv(3, AGENTS, config=FlockingConfig(max_steps=4), seed=0)
    env = TransformedEnv(env, Compose(InitTracker(), get_primers_from_module(policy, warn=False)))
    return env.rollout(steps, behaviour, break_when_any_done=False)


@pytest.mark.parametrize(
    ("name", "model"), [("pair_force", {"hops": 2}), ("mpnn", {"hops": 2}), ("mpnn", {"layers": 2})]
)
def test_each_member_has_its_own_messages(name, model):
    """On the ensemble's rollouts, each member computes the actions and messages that it would compute alone."""
    members = [make_model(name, hidden=8, seed=seed, **model) for seed in range(3)]
    ensemble = Ensemble(members)
    with torch.no_grad():
        together = _rollout(ensemble, ensemble)
        assert bool(together["is_init"][:, 1:].any())
        actions = []
        for number, member in enumerate(members):
            # The same rollouts: the first member acts, and another one computes actions with its own messages.
            alone = _recompute(member, together)
            key = "messages" if number == 0 else f"messages_{number}"
            mine, theirs = (rollouts.nan_to_num(7.0) for rollouts in (together["next", key], alone["messages"]))
            torch.testing.assert_close(mine, theirs)
            actions.append(alone["action"])
    torch.testing.assert_close(together["agents", "action"], actions[0])
    torch.testing.assert_close(
        together["agents", "ensemble_std"], torch.stack(actions).var(0, correction=0).sum(-1).sqrt()
    )
    if name == "mpnn":
        assert not torch.equal(together["messages"].nan_to_num(7.0), together["messages_1"].nan_to_num(7.0))


def _recompute(member, rollouts):
    """The actions and messages of a policy, step by step, on rollouts in which another one acts."""
    messages, actions, sent = None, [], []
    for step in rollouts.select(("agents", "observation"), "adjacency", "is_init").unbind(1):
        given = step.clone()
        if messages is not None:
            given["messages"] = messages
        result = member(given)
        messages = result["next", "messages"]
        actions.append(result["agents", "action"])
        sent.append(messages)
    return {"action": torch.stack(actions, 1), "messages": torch.stack(sent, 1)}


def test_an_ensemble_of_two_acts_as_its_first_member_alone():
    members = [make_model("mpnn", hidden=8, layers=2, seed=seed) for seed in range(2)]
    ensemble = Ensemble(members)
    with torch.no_grad():
        together, alone = _rollout(ensemble, ensemble), _rollout(members[0], members[0])
    for key in (("agents", "observation"), ("agents", "action"), "messages"):
        assert torch.equal(together[key].nan_to_num(7.0), alone[key].nan_to_num(7.0))


def test_a_disturbance_has_the_stated_standard_deviation_and_leaves_labels_alone():
    step = TensorDict({"agents": {"action": torch.zeros(500, 8, 3), "expert_action": torch.ones(500, 8, 3)}}, 500)
    disturbance = ActionNoise(0.2, torch.Generator().manual_seed(0))
    noisy = [disturbance(step.clone())["agents"] for _ in range(2)]
    for agents in noisy:
        assert agents["action"].mean().abs() < 0.01
        assert agents["action"].std().item() == pytest.approx(0.2, rel=0.03)
        assert (agents["expert_action"] == 1).all()
    assert (noisy[0]["action"] != noisy[1]["action"]).all()  # independent in each step
    disturbance.scale = 0.0
    assert torch.equal(disturbance(step.clone())["agents", "action"], step["agents", "action"])


def test_noisy_rollouts_are_labelled_with_the_expert_action_of_their_states():
    buffer = _buffer([make_model("pair_force", hidden=8, seed=0)], None)
    buffer.collector.action_noise.scale = 0.3
    rollouts = buffer.collect(1.0)
    label = Reynolds()(rollouts.select(("agents", "observation")))["agents", "expert_action"]
    torch.testing.assert_close(rollouts["agents", "expert_action"], label)
    noise = rollouts["agents", "action"] - rollouts["agents", "expert_action"]
    assert noise.std().item() == pytest.approx(0.3, rel=0.1)


def _run(runs, model, **settings):
    small = {"num_envs": 1, "batch_size": 16, "capacity": 100, "cloning_steps": 6, "cloning_updates": 4}
    small |= {"rounds": 4, "steps_per_round": 6, "updates_per_round": 2, "hold_steps": 3, "num_val_envs": 1}
    trainer = DAggerConfig(**{**small, **settings})
    env = FlockingConfig(num_agents=4, max_steps=20)
    config = TrainConfig(env=env, model=model, trainer=trainer, runs=str(runs), threads=1)
    return train(config, evaluate=False)


@pytest.mark.parametrize(
    ("settings", "model"),
    [
        ({"gate": "disagreement", "gate_threshold": 0.3}, ModelConfig(name="pair_force", hidden=8)),
        pytest.param(
            {"gate": "ensemble", "gate_threshold": 0.05, "ensemble": 3},
            ModelConfig(name="pair_force", hidden=8),
            marks=pytest.mark.slow,
        ),
        ({"gate": "ensemble", "gate_threshold": 0.05, "ensemble": 2}, ModelConfig(name="mpnn", layers=2, hidden=8)),
        ({"replacement": "reservoir", "capacity": 20}, ModelConfig(name="pair_force", hidden=8)),
        pytest.param({"hide_velocity": 0.5}, ModelConfig(name="modgnn_mlp", hidden=8), marks=pytest.mark.slow),
    ],
)
def test_a_dagger_run_depends_on_its_seed_only(tmp_path, settings, model):
    runs = [_run(tmp_path, model, **settings) for _ in range(2)]
    assert runs[0].metrics_file.read_bytes() == runs[1].metrics_file.read_bytes()
    metrics = runs[0].read_metrics()
    assert [line["step"] for line in metrics] == list(range(5))
    checkpoint = load_checkpoint(runs[0].checkpoints)
    members = settings.get("ensemble", 1)
    assert checkpoint.state["learners"] == [model.name, *(f"ensemble_{number}" for number in range(1, members))]
    weights = load_policy(runs[0].path).state_dict()
    assert all(torch.equal(value, weights[name]) for name, value in checkpoint.tensors["policy"].items())
    for number in range(1, members):
        other = checkpoint.tensors[f"ensemble_{number}.policy"]
        assert any(not torch.equal(value, weights[name]) for name, value in other.items())


def test_the_expert_acts_with_a_strict_gate_and_not_with_a_lax_one(tmp_path):
    fractions = []
    for threshold in (1e-6, 1e6):
        run = _run(
            tmp_path,
            ModelConfig(name="pair_force", hidden=8),
            gate="disagreement",
            gate_threshold=threshold,
            beta=0.0,
        )
        fractions.append([line["4/expert_fraction"] for line in run.read_metrics()[1:]])
    assert fractions == [[1.0] * 4, [0.0] * 4]


def test_a_run_stops_on_a_plateau(tmp_path):
    settings = {"plateau_rounds": 1, "plateau_gain": 1.0, "beta_rounds": 1, "beta": 0.0}
    metrics = _run(tmp_path, ModelConfig(name="pair_force", hidden=8), **settings).read_metrics()
    assert [line["step"] for line in metrics] == [0, 1, 2, 3]  # the first that counts is the second
