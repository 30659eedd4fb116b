"""Gates, ensembles and disturbances: who flies, whose messages go on, and what is left alone."""

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
from modgnn_rl.experiment.training import train
from modgnn_rl.tracking.checkpoint import load_checkpoint
from modgnn_rl.trainers.collectors.behaviour import ActionNoise, Ensemble, SafetyGate, disagreement, ensemble_std
from modgnn_rl.trainers.collectors.flocks import FlockBuffer

FLOCKS, AGENTS = 6, 4


def _step(seed=0):
    generator = torch.Generator().manual_seed(seed)
    agents = {name: torch.randn(FLOCKS, AGENTS, 3, generator=generator) for name in ("action", "expert_action")}
    agents["controlled"] = (torch.arange(AGENTS) > 0).expand(FLOCKS, -1).clone()
    agents["ensemble_std"] = torch.rand(FLOCKS, AGENTS, generator=generator)
    return TensorDict({"agents": TensorDict(agents, FLOCKS)}, FLOCKS)


def test_disagreement_is_the_root_mean_square_over_those_that_are_flown():
    step = _step()
    step["agents", "controlled"][0] = False
    step["agents", "action"][:, 0] = torch.nan  # nobody flies the leader
    expected = []
    for flock in range(FLOCKS):
        agents = [agent for agent in range(AGENTS) if step["agents", "controlled"][flock, agent]]
        difference = (step["agents", "action"] - step["agents", "expert_action"])[flock, agents]
        expected.append(difference.square().sum(-1).mean().sqrt() if agents else torch.tensor(0.0))
    torch.testing.assert_close(disagreement(step), torch.stack(expected))


def test_spread_is_the_root_mean_square_over_those_that_are_flown():
    step = _step()
    torch.testing.assert_close(ensemble_std(step), step["agents", "ensemble_std"][:, 1:].square().mean(-1).sqrt())


@pytest.mark.parametrize("measure", [disagreement, ensemble_std])
def test_the_expert_flies_exactly_where_the_measure_is_above_the_threshold(measure):
    step = _step()
    value = measure(step)
    threshold = float(value.median())  # the flock in the middle is not above it
    flown = SafetyGate(measure, threshold)(step.clone())
    strays = value > threshold
    assert 0 < strays.sum() < FLOCKS
    assert torch.equal(flown["expert_flies"].squeeze(-1), strays)
    for flock in range(FLOCKS):
        whose = "expert_action" if strays[flock] else "action"
        assert torch.equal(flown["agents", "action"][flock], step["agents", whose][flock])
    assert torch.equal(flown["agents", "expert_action"], step["agents", "expert_action"])


def test_a_gate_behind_a_mixture_adds_to_what_the_expert_flies():
    step = _step()
    mixed = torch.tensor([True, False] * 3).unsqueeze(-1)
    step["expert_flies"] = mixed
    step["agents", "action"] = torch.where(
        mixed.unsqueeze(-1), step["agents", "expert_action"], step["agents", "action"]
    )
    flown = SafetyGate(disagreement, 1e-3)(step.clone())
    assert flown["expert_flies"].all()
    flown = SafetyGate(disagreement, 1e3)(step.clone())
    assert torch.equal(flown["expert_flies"], mixed)


def _flocks(policies, gate, **settings):
    config = DAggerConfig(stride=1, capacity=1000, batch_size=16, **settings)
    return FlockBuffer(
        FlockingConfig(max_steps=7),
        config,
        FLOCKS,
        AGENTS,
        policies,
        Reynolds(),
        steps=10,
        hold_steps=10,
        gate=gate,
        seed=0,
    )


@pytest.mark.parametrize("measure", [disagreement, ensemble_std])
def test_in_flight_messages_go_on_while_the_expert_flies(measure):
    policies = [make_model("pair_force", hidden=8, seed=seed) for seed in range(3)]
    thresholds = {}
    for threshold, share in ((1e-6, 1.0), (1e6, 0.0)):
        flocks = _flocks(policies, SafetyGate(measure, threshold))
        rollouts = flocks.fly(0.0)
        thresholds[share] = rollouts
        # At the first step nobody has heard of anybody: all members stand still.
        flies = rollouts["expert_flies"]
        assert (flies | rollouts["is_init"]).all() if share else not flies.any()
        same = (rollouts["agents", "action"] == rollouts["agents", "expert_action"]).flatten(2).all(-1)
        assert torch.equal(same, flies.squeeze(-1))
        going_on = ~rollouts["is_init"][:, 1:, 0]
        sent = rollouts["agents", "observation"][:, :-1].unsqueeze(-2)
        assert torch.equal(rollouts["messages"][:, 1:][going_on], sent[going_on])
    assert not torch.equal(thresholds[1.0]["agents", "observation"], thresholds[0.0]["agents", "observation"])


def test_identical_members_have_no_spread_and_different_ones_have_that_of_the_formula():
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


def _flown(policy, behaviour, steps=6):
    env = FlockingEnv(3, AGENTS, config=FlockingConfig(max_steps=4), seed=0)
    env = TransformedEnv(env, Compose(InitTracker(), get_primers_from_module(policy, warn=False)))
    return env.rollout(steps, behaviour, break_when_any_done=False)


@pytest.mark.parametrize(
    ("name", "model"), [("pair_force", {"hops": 2}), ("mpnn", {"hops": 2}), ("mpnn", {"layers": 2})]
)
def test_each_member_has_messages_of_its_own(name, model):
    """Along the ensemble's rollouts, each acts and remembers as if it were alone there."""
    members = [make_model(name, hidden=8, seed=seed, **model) for seed in range(3)]
    ensemble = Ensemble(members)
    with torch.no_grad():
        together = _flown(ensemble, ensemble)
        assert bool(together["is_init"][:, 1:].any())
        actions = []
        for number, member in enumerate(members):
            # The same rollouts: the first member flies, and another one thinks along with messages of its own.
            alone = _thinking_along(member, together)
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


def _thinking_along(member, rollouts):
    """What a policy would do and remember, one step after the other, on rollouts that another one flew."""
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


def test_an_ensemble_of_two_flies_through_an_environment_as_its_first_member_alone():
    members = [make_model("mpnn", hidden=8, layers=2, seed=seed) for seed in range(2)]
    ensemble = Ensemble(members)
    with torch.no_grad():
        together, alone = _flown(ensemble, ensemble), _flown(members[0], members[0])
    for key in (("agents", "observation"), ("agents", "action"), "messages"):
        assert torch.equal(together[key].nan_to_num(7.0), alone[key].nan_to_num(7.0))


def test_a_disturbance_has_the_stated_standard_deviation_and_leaves_labels_alone():
    step = TensorDict({"agents": {"action": torch.zeros(500, 8, 3), "expert_action": torch.ones(500, 8, 3)}}, 500)
    disturbance = ActionNoise(0.2, torch.Generator().manual_seed(0))
    flown = [disturbance(step.clone())["agents"] for _ in range(2)]
    for agents in flown:
        assert agents["action"].mean().abs() < 0.01
        assert agents["action"].std().item() == pytest.approx(0.2, rel=0.03)
        assert (agents["expert_action"] == 1).all()
    assert (flown[0]["action"] != flown[1]["action"]).all()  # at every step anew
    disturbance.scale = 0.0
    assert torch.equal(disturbance(step.clone())["agents", "action"], step["agents", "action"])


def test_disturbed_flights_are_labelled_with_the_expert_of_the_states_that_they_meet():
    flocks = _flocks([make_model("pair_force", hidden=8, seed=0)], None)
    flocks.action_noise.scale = 0.3
    rollouts = flocks.fly(1.0)
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
def test_a_run_of_dagger_is_fixed_by_its_seed(tmp_path, settings, model):
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


def test_a_strict_gate_lets_the_expert_fly_and_a_lax_one_does_not(tmp_path):
    shares = []
    for threshold in (1e-6, 1e6):
        run = _run(
            tmp_path,
            ModelConfig(name="pair_force", hidden=8),
            gate="disagreement",
            gate_threshold=threshold,
            beta=0.0,
        )
        shares.append([line["4/expert_fraction"] for line in run.read_metrics()[1:]])
    assert shares == [[1.0] * 4, [0.0] * 4]


def test_a_run_stops_on_a_plateau(tmp_path):
    settings = {"plateau_rounds": 1, "plateau_gain": 1.0, "beta_rounds": 1, "beta": 0.0}
    metrics = _run(tmp_path, ModelConfig(name="pair_force", hidden=8), **settings).read_metrics()
    assert [line["step"] for line in metrics] == [0, 1, 2, 3]  # the first that counts is the second
