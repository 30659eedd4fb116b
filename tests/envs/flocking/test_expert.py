"""The experts against the paper's equation, written as a double loop, and against symmetries."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.expert import LocalReynolds, Reynolds, reynolds
from modgnn_rl.errors import InputError
from modgnn_rl.nn.topology import as_matrix, reachable
from modgnn_rl.utils.tensors import PAIRS_IN_BLOCK

GAINS: dict[str, Any] = {"cohesion": 0.06, "separation": 0.8, "alignment": 0.02}
FREE: dict[str, Any] = {**GAINS, "max_speed": 1e9}
seeds = st.integers(0, 999)
sizes = st.integers(1, 7)


def flock(seed: int, *shape: int) -> tuple[Tensor, Tensor]:
    """Positions and velocities [*shape, 3], float64."""
    generator = torch.Generator().manual_seed(seed)
    position, velocity = torch.randn(2, *shape, 3, dtype=torch.float64, generator=generator)
    return 3 * position, velocity


def random_graph(seed: int, *batch: int, agents: int, share: float = 0.3) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    graph = torch.rand(*batch, agents, agents, generator=generator) < share
    return graph & ~torch.eye(agents, dtype=torch.bool)


def paper(position: Tensor, velocity: Tensor, visible: Tensor, max_speed: float) -> Tensor:
    """The paper's equation of the expert for one flock [N, 3], in plain Python; then the projection onto the ball."""
    p, v = position.tolist(), velocity.tolist()
    actions = []
    for i in range(len(p)):
        u = [0.0, 0.0, 0.0]
        for j in visible[i].nonzero().view(-1).tolist():
            distance, drift = math.dist(p[i], p[j]), math.dist(v[i], v[j])
            for d in range(3):
                u[d] += GAINS["cohesion"] * (p[j][d] - p[i][d]) * distance
                u[d] += GAINS["separation"] * (p[i][d] - p[j][d]) / distance**3
                u[d] += GAINS["alignment"] * (v[j][d] - v[i][d]) * drift
        speed = math.hypot(*u)
        actions.append([x * min(1.0, max_speed / speed) if speed else 0.0 for x in u])
    return torch.tensor(actions, dtype=torch.float64)


def all_edges(agents: int) -> Tensor:
    return ~torch.eye(agents, dtype=torch.bool)


@given(seed=seeds, agents=sizes, max_speed=st.sampled_from([0.92, 1e9]))
def test_reynolds_is_the_equation_of_the_paper(seed: int, agents: int, max_speed: float) -> None:
    position, velocity = flock(seed, 2, agents)
    ours = reynolds(position, velocity, **GAINS, max_speed=max_speed)
    visible = random_graph(seed, agents=agents)
    restricted = reynolds(position, velocity, **GAINS, max_speed=max_speed, visible=visible)
    for number in range(2):
        full = paper(position[number], velocity[number], all_edges(agents), max_speed)
        part = paper(position[number], velocity[number], visible, max_speed)
        # The softening of 1e-6 m^2 has a small effect on agents that happen to be close.
        torch.testing.assert_close(ours[number], full, rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(restricted[number], part, rtol=1e-3, atol=1e-4)


def test_softening_is_negligible_at_usual_distances() -> None:
    position = torch.tensor([[0.0, 0, 0], [0.9, 0, 0], [0, 2.5, 0]], dtype=torch.float64)
    velocity = torch.tensor([[0.5, 0, 0], [0, 0.3, 0], [0, 0, -0.8]], dtype=torch.float64)
    expected = paper(position, velocity, all_edges(3), 1e9)
    torch.testing.assert_close(reynolds(position, velocity, **FREE), expected, rtol=5e-6, atol=0)


def test_two_agents_meet_where_cohesion_and_separation_balance() -> None:
    distance = (GAINS["separation"] / GAINS["cohesion"]) ** 0.25  # C_c r^2 = C_s / r^2
    for factor, sign in ((1.0, 0), (1.1, 1), (0.9, -1)):
        position = torch.tensor([[0.0, 0, 0], [factor * distance, 0, 0]], dtype=torch.float64)
        pull = reynolds(position, torch.zeros_like(position), **FREE)[0]
        assert not pull[1:].any()
        assert abs(pull[0]) < 1e-5 if sign == 0 else pull[0].sign() == sign


@given(seed=seeds, agents=sizes)
def test_forces_of_pairs_cancel(seed: int, agents: int) -> None:
    force = reynolds(*flock(seed, agents), **FREE)
    torch.testing.assert_close(force.sum(0) / force.abs().sum().clamp(min=1), torch.zeros(3, dtype=torch.float64))


@given(seed=seeds, agents=sizes, determinant=st.sampled_from([1, -1]))
def test_symmetries(seed: int, agents: int, determinant: int) -> None:
    position, velocity = flock(seed, agents)
    action = reynolds(position, velocity, **GAINS, max_speed=0.92)

    def again(position: Tensor, velocity: Tensor) -> Tensor:
        return reynolds(position, velocity, **GAINS, max_speed=0.92)

    shift = torch.tensor([5.0, -2.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(again(position + shift, velocity - shift), action)
    generator = torch.Generator().manual_seed(seed)
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))[0]
    rotation = rotation if rotation.det().sign() == determinant else -rotation
    torch.testing.assert_close(again(position @ rotation, velocity @ rotation), action @ rotation)
    order = torch.randperm(agents, generator=generator)
    torch.testing.assert_close(again(position[order], velocity[order]), action[order])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coincident_agents_get_finite_actions(dtype: torch.dtype) -> None:
    position, velocity = (x.to(dtype).requires_grad_() for x in (torch.zeros(3, 3), torch.ones(3, 3)))
    action = reynolds(position, velocity, **GAINS, max_speed=0.92)
    assert not action.any()
    action.sum().backward()
    assert position.grad is not None
    assert position.grad.isfinite().all()
    near = torch.tensor([[0.0, 0, 0], [1e-4, 0, 0]], dtype=dtype)
    assert reynolds(near, 0 * near, **GAINS, max_speed=0.92)[0].tolist() == pytest.approx([-0.92, 0, 0])


@given(seed=seeds)
def test_clipping_keeps_the_direction(seed: int) -> None:
    position, velocity = flock(seed, 6)
    free, clipped = (reynolds(position, velocity, **GAINS, max_speed=speed) for speed in (1e9, 0.92))
    torch.testing.assert_close(clipped.norm(dim=-1), free.norm(dim=-1).clamp(max=0.92))
    assert (torch.cosine_similarity(free, clipped, -1) > 1 - 1e-9).all()


def test_the_module_is_the_function_with_the_gains_of_the_environment() -> None:
    position, velocity = flock(0, 2, 4)
    observation = torch.cat((position, velocity), -1)
    data = TensorDict({"agents": {"observation": observation}}, [2])
    env_config = FlockingConfig(cohesion_gain=0.1, separation_gain=0.2, alignment_gain=0.3, max_speed=0.5)
    expert = Reynolds.for_env(env_config, action="u")
    assert expert.in_keys == [("agents", "observation"), ("agents", "mask")]
    assert expert.out_keys == ["u"]
    expected = reynolds(position, velocity, cohesion=0.1, separation=0.2, alignment=0.3, max_speed=0.5)
    assert torch.equal(expert(data)["u"], expected)
    default = Reynolds()(data)["agents", "expert_action"]
    assert torch.equal(default, reynolds(position, velocity, **GAINS, max_speed=0.92))


@given(seed=seeds, flocks=st.integers(0, 3), agents=sizes, budget=st.integers(1, 60))
def test_results_do_not_depend_on_blocks(seed: int, flocks: int, agents: int, budget: int) -> None:
    state, visible = flock(seed, flocks, agents), random_graph(seed, flocks, agents=agents)
    whole = [reynolds(*state, **GAINS, max_speed=0.92, visible=seen) for seen in (None, visible)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PAIRS_IN_BLOCK, "cpu", budget)
        for seen, expected in zip((None, visible), whole, strict=True):
            assert torch.equal(reynolds(*state, **GAINS, max_speed=0.92, visible=seen), expected)


@pytest.mark.slow
def test_the_rule_compiles_without_graph_breaks() -> None:
    """The compiler sums in another order, so results differ by rounding."""
    position, velocity = (value.float() for value in flock(0, 4, 8))
    fast = torch.compile(reynolds, fullgraph=True, dynamic=False)
    choices: list[dict[str, Any]] = [
        {},
        {"visible": random_graph(0, 4, agents=8)},
        {"mask": torch.arange(32).view(4, 8) % 3 > 0},
    ]
    for options in choices:
        expected = reynolds(position, velocity, **GAINS, max_speed=0.92, **options)
        torch.testing.assert_close(fast(position, velocity, **GAINS, max_speed=0.92, **options), expected)


# Visibility.


def as_links(graph: Tensor, capacity: int) -> Tensor:
    """Graphs [B, N, N] as edge lists in random order, with gaps [B, 2, capacity]."""
    links = torch.full((len(graph), 2, capacity), -1)
    for number, one in enumerate(graph):
        receiver, sender = one.nonzero().unbind(-1)
        place = torch.randperm(capacity, generator=torch.Generator().manual_seed(number))[: len(sender)]
        links[number, 0, place], links[number, 1, place] = sender, receiver
    return links


@given(seed=seeds, agents=sizes)
def test_edge_lists_equal_the_matrix(seed: int, agents: int) -> None:
    state, graph = flock(seed, 3, agents), random_graph(seed, 3, agents=agents)
    links = as_links(graph, agents**2 + 3)
    assert torch.equal(as_matrix(links, agents), graph)
    assert torch.equal(as_matrix(graph, agents), graph)
    expected = reynolds(*state, **GAINS, max_speed=0.92, visible=graph)
    torch.testing.assert_close(reynolds(*state, **GAINS, max_speed=0.92, visible=links), expected)
    of_one = reynolds(state[0][0], state[1][0], **GAINS, max_speed=0.92, visible=links[0])
    torch.testing.assert_close(of_one, expected[0])


def test_edges_of_agents_that_do_not_exist_are_errors() -> None:
    links = torch.tensor([[[0, 3], [1, 0]]])
    with pytest.raises(InputError, match="numbers from 0 to 3"):
        reynolds(*flock(0, 1, 3), **GAINS, max_speed=0.92, visible=links)


@given(seed=seeds, agents=sizes, form=st.sampled_from(["all", "matrix", "links"]), junk=st.floats())
def test_absent_agents_neither_see_nor_are_seen(seed: int, agents: int, form: str, junk: float) -> None:
    position, velocity = flock(seed, 2, agents)
    mask = torch.rand(2, agents, generator=torch.Generator().manual_seed(seed)) < 0.6
    graph = random_graph(seed, 2, agents=agents, share=0.6)
    visible = {"all": None, "matrix": graph, "links": as_links(graph, agents**2)}[form]
    seen = all_edges(agents).expand(2, -1, -1) if form == "all" else graph
    expected = reynolds(
        position, velocity, **GAINS, max_speed=0.92, visible=seen & mask.unsqueeze(-1) & mask.unsqueeze(-2)
    )
    position[~mask], velocity[~mask] = junk, junk
    action = reynolds(position, velocity, **GAINS, max_speed=0.92, visible=visible, mask=mask)
    torch.testing.assert_close(action, expected)
    assert not action[~mask].any()


def test_the_expert_reads_the_mask_if_there_is_one() -> None:
    position, velocity = flock(1, 1, 5)
    observation = torch.cat((position, velocity), -1)
    observation[0, 3:] = torch.nan
    data = TensorDict({"agents": {"observation": observation, "mask": torch.arange(5).view(1, 5) < 3}}, [1])
    action = Reynolds()(data)["agents", "expert_action"]
    torch.testing.assert_close(action[:, :3], reynolds(position[:, :3], velocity[:, :3], **GAINS, max_speed=0.92))
    assert not action[:, 3:].any()


def test_the_expert_reads_the_true_state_and_the_local_expert_the_observation() -> None:
    plain, noisy = FlockingConfig(), FlockingConfig(position_noise=0.1)
    assert Reynolds.for_env(plain).in_keys[0] == ("agents", "observation")
    assert Reynolds.for_env(noisy).in_keys[0] == ("agents", "state")
    assert Reynolds.for_env(noisy, observation="o").in_keys[0] == "o"
    assert LocalReynolds.for_env(noisy).in_keys[0] == ("agents", "observation")


def within_hops(graph: Tensor, hops: int) -> Tensor:
    """Breadth-first search from every agent."""
    agents = len(graph)
    found = torch.zeros(agents, agents, dtype=torch.bool)
    for i in range(agents):
        distance, queue = {i: 0}, deque([i])
        while queue:
            j = queue.popleft()
            for k in graph[j].nonzero().view(-1).tolist():
                if k not in distance:
                    distance[k] = distance[j] + 1
                    queue.append(k)
        for j, length in distance.items():
            found[i, j] = 0 < length <= hops
    return found


@given(seed=seeds, agents=sizes, hops=st.integers(1, 5))
def test_reachable_equals_a_breadth_first_search(seed: int, agents: int, hops: int) -> None:
    graph = random_graph(seed, 2, agents=agents)
    found = reachable(graph, hops)
    for number in range(2):
        assert torch.equal(found[number], within_hops(graph[number], hops))


def step(observation: Tensor, adjacency: Tensor, last: Tensor | None, is_init: Tensor | None = None) -> TensorDict:
    data = TensorDict({"agents": {"observation": observation}, "adjacency": adjacency}, observation.shape[:1])
    if last is not None:
        data["last_observation"] = last
    if is_init is not None:
        data["is_init"] = is_init
    return data


@given(seed=seeds, agents=sizes, hops=st.integers(1, 3))
def test_local_reynolds_sees_the_last_observations_through_the_current_graph(seed: int, agents: int, hops: int) -> None:
    yesterday, today = (torch.cat(flock(seed + n, 2, agents), -1) for n in (0, 1))
    graph = random_graph(seed, 2, agents=agents)
    expert = LocalReynolds(hops=hops)
    out = expert(step(today, graph, yesterday, torch.zeros(2, 1, dtype=torch.bool)))
    for number in range(2):
        position, velocity = yesterday[number].split(3, -1)
        visible = within_hops(graph[number], hops)
        expected = paper(position, velocity, visible, 0.92)
        torch.testing.assert_close(out["agents", "expert_action"][number], expected, rtol=1e-3, atol=1e-4)
    assert torch.equal(out["next", "last_observation"], today)
    assert torch.equal(expert(step(today, graph, yesterday))["agents", "expert_action"], out["agents", "expert_action"])


@given(seed=seeds, agents=sizes)
def test_enough_hops_on_a_chain_see_all_agents_one_step_late(seed: int, agents: int) -> None:
    yesterday, today = (torch.cat(flock(seed + n, 1, agents), -1) for n in (0, 1))
    chain = torch.diag_embed(torch.ones(max(agents - 1, 0)), 1).bool() if agents > 1 else torch.zeros(1, 1).bool()
    chain = (chain | chain.mT).unsqueeze(0)
    local = LocalReynolds(hops=max(agents - 1, 1))(step(today, chain, yesterday))
    full = Reynolds()(step(yesterday, chain, None))
    key = ("agents", "expert_action")
    torch.testing.assert_close(local[key], full[key])


def test_the_action_is_zero_at_the_first_step_of_an_episode() -> None:
    yesterday, today = (torch.cat(flock(n, 3, 4), -1) for n in (0, 1))
    graph = all_edges(4).expand(3, 4, 4)
    begins = torch.tensor([[False], [True], [False]])
    expert, key = LocalReynolds(), ("agents", "expert_action")
    free = expert(step(today, graph, yesterday))[key]
    assert free.any(-1).all()
    reset = expert(step(today, graph, yesterday, begins))[key]
    assert torch.equal(reset, free * ~begins.unsqueeze(-1))
    assert not expert(step(today, graph, None, begins))[key].any()
    assert not expert(step(today, graph, None))[key].any()


def test_agents_without_a_stored_observation_are_not_seen() -> None:
    yesterday, today = (torch.cat(flock(n, 1, 4), -1) for n in (0, 1))
    yesterday[0, 2] = torch.nan
    graph = all_edges(4).unsqueeze(0)
    action = LocalReynolds()(step(today, graph, yesterday))["agents", "expert_action"][0]
    rest = [0, 1, 3]
    position, velocity = yesterday[0, rest].split(3, -1)
    torch.testing.assert_close(action[rest], reynolds(position, velocity, **GAINS, max_speed=0.92))
    assert not action[2].any()


@given(seed=seeds, agents=sizes, hops=st.integers(1, 3))
def test_local_reynolds_reads_edge_lists(seed: int, agents: int, hops: int) -> None:
    yesterday, today = (torch.cat(flock(seed + n, 2, agents), -1) for n in (0, 1))
    yesterday[0, 0] = torch.nan
    graph, key = random_graph(seed, 2, agents=agents), ("agents", "expert_action")
    expert = LocalReynolds(hops=hops)
    expected = expert(step(today, graph, yesterday))[key]
    torch.testing.assert_close(expert(step(today, as_links(graph, agents**2), yesterday))[key], expected)


@pytest.mark.parametrize("form", ["matrix", "links"])
def test_an_agent_that_returns_has_no_stored_observation(form: str) -> None:
    """Agent 2 is absent at the second of four steps; its observation then is ignored."""
    states = [torch.cat(flock(n, 1, 4), -1) for n in range(4)]
    states[1][0, 2] = 1.5
    graph = all_edges(4).unsqueeze(0)
    adjacency = graph if form == "matrix" else as_links(graph, 16)
    expert, last, actions = LocalReynolds(), None, []
    for number, state in enumerate(states):
        data = step(state, adjacency, last)
        data["agents", "mask"] = torch.tensor([[True, True, number != 1, True]])
        out = expert(data)
        last = out["next", "last_observation"]
        actions.append(out["agents", "expert_action"])
    assert not actions[0].any()
    rest = [0, 1, 3]
    for number in (1, 2):  # absent, and back without a stored observation: neither seen nor moving
        position, velocity = states[number - 1][:, rest].split(3, -1)
        torch.testing.assert_close(actions[number][:, rest], reynolds(position, velocity, **GAINS, max_speed=0.92))
        assert not actions[number][:, 2].any()
    torch.testing.assert_close(actions[3], reynolds(*states[2].split(3, -1), **GAINS, max_speed=0.92))


@pytest.mark.parametrize("hops", [0, -1, 1.5])
def test_local_reynolds_needs_at_least_one_hop(hops: int) -> None:
    with pytest.raises(InputError, match="hops="):
        LocalReynolds(hops=hops)


def test_keys_of_local_reynolds_can_be_renamed() -> None:
    expert = LocalReynolds(observation="o", adjacency="g", is_init="b", cache="c", mask="m", action="u")
    assert expert.in_keys == ["o", "g", "b", "c", "m"]
    assert expert.out_keys == ["u", ("next", "c")]
