"""Perturbations: what each of them changes, and that it changes nothing else."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs

from modgnn_rl.envs import FlockingEnv
from modgnn_rl.envs.flocking.expert import LocalReynolds, Reynolds
from modgnn_rl.models.factory import make_model

PERTURBATIONS: dict[str, dict[str, Any]] = {
    "message_loss": {"message_loss": 0.3},
    "delay": {"delay": 3},
    "range_spread": {"range_spread": 0.5},
    "noise": {"position_noise": 0.1, "velocity_noise": 0.05},
    "dropout": {"dropout_rate": 1.0, "dropout_time": 0.5},
    "wind": {"wind": 1.0},
}
ALL = {name: value for kind in PERTURBATIONS.values() for name, value in kind.items()}
STATE = ("agents", "state")


def rollout(
    steps: int = 30, *, num_envs: int = 3, num_agents: int = 6, seed: int = 0, **settings: Any
) -> TensorDictBase:
    """A rollout of the expert."""
    env = FlockingEnv(num_envs, num_agents, seed=seed, **settings)
    expert = Reynolds.for_env(env.config, action=("agents", "action"))
    return env.rollout(steps, expert, break_when_any_done=False)


def idle(td: TensorDictBase) -> TensorDictBase:
    """A policy with zero actions."""
    td["agents", "action"] = torch.zeros_like(td["agents", "observation"][..., :3])
    return td


@pytest.mark.parametrize("settings", [*PERTURBATIONS.values(), ALL], ids=[*PERTURBATIONS, "all"])
@pytest.mark.parametrize("graph", ["matrix", "links"])
def test_specs_hold(settings: dict[str, Any], graph: str) -> None:
    check_env_specs(FlockingEnv(2, 5, seed=0, graph=graph, **settings))


@pytest.mark.parametrize("settings", [*PERTURBATIONS.values(), ALL], ids=[*PERTURBATIONS, "all"])
def test_one_seed_determines_them(settings: dict[str, Any]) -> None:
    first, second, other = (rollout(seed=seed, **settings) for seed in (1, 1, 2))
    assert bool((first == second).all())
    assert not torch.equal(first["agents", "observation"], other["agents", "observation"])


@pytest.mark.parametrize("settings", PERTURBATIONS.values(), ids=PERTURBATIONS)
def test_initial_positions_and_leaders_do_not_depend_on_perturbations(settings: dict[str, Any]) -> None:
    worlds = [FlockingEnv(3, 4, seed=0, **chosen) for chosen in ({}, settings)]
    for env in worlds:
        env.rollout(20, idle, break_when_any_done=False)
    starts = [FlockingEnv(3, 4, seed=0, **chosen).reset() for chosen in ({}, {**settings, "position_noise": 1e-9})]
    torch.testing.assert_close(starts[1][STATE], starts[0]["agents", "observation"])
    assert torch.equal(worlds[0].target_velocity[:, 0], worlds[1].target_velocity[:, 0])


@pytest.mark.parametrize("settings", [*PERTURBATIONS.values(), ALL], ids=[*PERTURBATIONS, "all"])
def test_a_partial_reset_leaves_the_other_flocks_alone(settings: dict[str, Any]) -> None:
    env = FlockingEnv(3, 5, seed=0, **settings)
    td = env.rollout(10)[:, -1]["next"].clone()
    td["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(td.clone())
    for key in [("agents", "observation"), "adjacency", ("agents", "controlled")]:
        assert torch.equal(after[key][[0, 2]], td[key][[0, 2]]), key
    assert not torch.equal(after["agents", "observation"][1], td["agents", "observation"][1])


@pytest.mark.parametrize("settings", PERTURBATIONS.values(), ids=PERTURBATIONS)
@pytest.mark.parametrize("model", ["pair_force", "modgnn_mlp"])
def test_policies_roll_out_unchanged(settings: dict[str, Any], model: str) -> None:
    env = TransformedEnv(FlockingEnv(2, 5, seed=0, **settings), InitTracker())
    policy = make_model(model, seed=0)
    env.append_transform(policy.make_tensordict_primer())
    rollouts = env.rollout(30, policy, break_when_any_done=False)
    assert bool(rollouts["agents", "action"].isfinite().all())


# Messages


def test_the_packet_loss_rate_holds_for_each_direction() -> None:
    whole, lossy = (FlockingEnv(50, 16, seed=0, message_loss=loss, comm_range=100.0).reset() for loss in (0, 0.25))
    links = whole["adjacency"]
    lost = links & ~lossy["adjacency"]
    assert not (lossy["adjacency"] & ~links).any()
    assert float(lost.sum() / links.sum()) == pytest.approx(0.25, abs=0.02)  # of 12,000
    both = (lost & lost.mT).sum() / links.sum()
    assert float(both) == pytest.approx(0.25**2, abs=0.01)
    assert not FlockingEnv(2, 8, seed=0, message_loss=1.0).reset()["adjacency"].any()


@pytest.mark.parametrize("delay", [1, 4])
def test_delayed_observations_are_those_of_some_steps_ago(delay: int) -> None:
    rollouts = rollout(20, delay=delay)
    seen, state = rollouts["agents", "observation"], rollouts[STATE]
    assert torch.equal(seen[:, delay:], state[:, :-delay])
    assert torch.equal(seen[:, :delay], state[:, :1].expand_as(seen[:, :delay]))
    assert torch.equal(rollouts["next", "agents", "observation"][:, :-1], seen[:, 1:])


def test_the_delay_restarts_with_each_episode() -> None:
    env = FlockingEnv(2, 3, seed=0, delay=2, max_steps=5)
    rollouts = env.rollout(12, break_when_any_done=False)
    for start in (0, 5, 10):
        assert torch.equal(rollouts["agents", "observation"][:, start], rollouts[STATE][:, start])


def test_ranges_belong_to_senders_and_are_constant_over_an_episode() -> None:
    env = FlockingEnv(20, 12, seed=0, range_spread=0.5, max_steps=10)
    rollouts = env.rollout(10)
    reach = env.perturbations.send_range
    assert reach is not None
    assert 0.5 * 3.5 <= float(reach.min()) < 2.0 < 5.0 < float(reach.max()) <= 1.5 * 3.5
    position = rollouts["agents", "observation"][..., :3]
    distance = torch.cdist(position, position, compute_mode="donot_use_mm_for_euclid_dist")
    expected = (distance <= reach[:, None, None, :]) & ~torch.eye(12, dtype=torch.bool)
    assert torch.equal(rollouts["adjacency"], expected)
    assert not torch.equal(rollouts["adjacency"], rollouts["adjacency"].mT)
    env.reset()
    assert env.perturbations.send_range is not None
    assert not torch.equal(env.perturbations.send_range, reach)


# Sensors


def test_noise_is_white_with_the_given_standard_deviation() -> None:
    rollouts = rollout(50, num_envs=10, num_agents=8, position_noise=0.2, velocity_noise=0.03)
    error = rollouts["agents", "observation"] - rollouts[STATE]
    assert float(error[..., :3].std()) == pytest.approx(0.2, rel=0.03)
    assert float(error[..., 3:].std()) == pytest.approx(0.03, rel=0.03)
    assert abs(float((error[:, 1:] * error[:, :-1]).mean() / error.square().mean())) < 0.03


def test_the_expert_reads_the_true_state_and_policies_the_observation() -> None:
    env = FlockingEnv(3, 6, seed=0, position_noise=0.5)
    td = env.reset()
    truth = TensorDict({"agents": {"observation": td[STATE]}}, [3])
    labels = Reynolds.for_env(env.config)(td.clone())["agents", "expert_action"]
    assert torch.equal(labels, Reynolds.for_env(FlockingEnv(1, 1).config)(truth)["agents", "expert_action"])
    assert LocalReynolds.for_env(env.config).in_keys[0] == ("agents", "observation")


# Dropout


def test_a_dropped_out_agent_hovers_and_neither_sends_nor_receives() -> None:
    env = FlockingEnv(4, 6, seed=0, dropout_rate=1e-9, dropout_time=1e9, comm_range=100.0)
    env.reset()
    out = torch.zeros(4, 6, dtype=torch.bool)
    out[:, 2] = True
    env.perturbations.active = ~out
    td = env.reset().update(env.full_action_spec.zero())
    assert bool(td["agents", "mask"].all())  # a reset ends all dropouts
    env.perturbations.active = ~out
    td["agents", "action"] = torch.full((4, 6, 3), 0.5)
    td["agents", "action"][:, 2] = math.nan  # ignored
    after = env.step(td)["next"]
    assert torch.equal(after["agents", "mask"], ~out)
    assert not after["agents", "controlled"][:, [0, 2]].any()
    assert not after["adjacency"][:, 2].any()
    assert not after["adjacency"][:, :, 2].any()
    assert bool(after["adjacency"][:, 3, 4].all())
    assert not env.target_velocity[:, 2].any()


def test_dropouts_start_and_end_at_their_rates() -> None:
    env = FlockingEnv(200, 6, seed=0, dropout_rate=0.5, dropout_time=2.0)
    env.reset()
    there = []
    for _ in range(480):
        env.perturbations.step()
        there.append(env.perturbations.active.clone())
    running = torch.stack(there)[:, :, 1:].double()
    assert bool(torch.stack(there)[:, :, 0].all())  # never the leader
    # Two states with rates 0.5 and 1 / 2.0 per second: half of the time each, in the long run.
    assert float(running[240:].mean()) == pytest.approx(0.5, abs=0.03)
    left = (running[:-1] == 1) & (running[1:] == 0)
    assert float(left.sum() / running[:-1].sum() * 48) == pytest.approx(0.5, abs=0.03)


def test_dropped_out_agents_influence_no_other() -> None:
    env = TransformedEnv(FlockingEnv(2, 6, seed=0, dropout_rate=1.0, dropout_time=0.3), InitTracker())
    policy = make_model("modgnn_mlp", hops=2, seed=0)
    env.append_transform(policy.make_tensordict_primer())
    rollouts = env.rollout(40, policy, break_when_any_done=False)
    mask = rollouts["agents", "mask"]
    assert bool((~mask).any())
    poisoned = rollouts.clone()
    poisoned["agents", "observation"][~mask] = math.nan
    actions = [policy(td.exclude(("agents", "action")))["agents", "action"] for td in (rollouts, poisoned)]
    assert torch.equal(actions[0][mask], actions[1][mask])


# Wind


def test_gusts_have_the_given_standard_deviation_and_correlation_time() -> None:
    env = FlockingEnv(300, 2, seed=0, wind=0.5, wind_time=0.5)
    env.reset()
    gusts: list[Tensor] = []
    for _ in range(96):
        gust = env.perturbations.step()
        assert gust is not None
        gusts.append(gust)
    series = torch.stack(gusts).squeeze(2)
    assert float(series.std()) == pytest.approx(0.5, rel=0.05)
    lag = (series[24:] * series[:-24]).mean() / series.square().mean()
    assert float(lag) == pytest.approx(math.exp(-1), abs=0.05)  # 24 steps are 0.5 s


def test_wind_pushes_a_whole_flock() -> None:
    still, windy = (rollout(30, num_envs=2, num_agents=5, wind=strength) for strength in (0.0, 1.0))
    moved = (windy["agents", "observation"] - still["agents", "observation"])[:, -1, :, :3]
    assert float(moved.norm(dim=-1).min()) > 0.01
    # The expert reacts to relative positions, which a common push does not change; only the leader differs.
    assert float((moved - moved.mean(1, keepdim=True)).norm(dim=-1).max()) < 0.3 * float(moved.norm(dim=-1).min())
