"""Agents that do not exist, have failed, or see what is no number: nobody else feels them, nor do the gradients."""

from __future__ import annotations

import functools
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.errors import InputError
from modgnn_rl.nn.communication import GraphAttention, MessagePassing
from modgnn_rl.nn.topology import FORMS
from tests.nn.helpers import numbers

FEATURES, STEPS = 2, 5
STARTS = ("mask", "zero", "repeat")
NO_NUMBERS = (torch.nan, torch.inf, -torch.inf)
seeds = st.integers(0, 999)
forms = st.sampled_from(FORMS)


def relu_network(inputs: int, outputs: int) -> nn.Module:
    """One in which an infinity would become 0 * infinity on the way back."""
    return nn.Sequential(nn.Linear(inputs, 4), nn.ReLU(), nn.Linear(4, outputs))


def make_layer(hops: int, start: str = "mask", inputs: int = FEATURES, kind: str = "rewritten") -> ModGNNLayer:
    """All submodules learned; the f_com of ``links`` reads weight and feature of its link."""
    networks = {"rewritten": None, "attention": GraphAttention(3, 3, 3)}
    f_com = (
        networks[kind] if kind in networks else MessagePassing(nn.Sequential(nn.Linear(3 + 3 + 1 + 2, 3), nn.Tanh()))
    )
    f_pre, f_mid = [relu_network(3, 4) for _ in range(hops + 1)], [relu_network(4, 3) for _ in range(hops + 1)]
    return ModGNNLayer(hops, relu_network(inputs, 3), f_com, f_pre, f_mid, relu_network(3, 2), start=start)


def make_policy(hops: list[int], start: str, kind: str, form: str) -> ModGNN:
    layers = [make_layer(k, start, FEATURES + 2 * number, kind) for number, k in enumerate(hops)]
    keys: dict[str, Any] = {"edge_weight": "weight", "edge_feature": "feature"} if kind == "links" else {}
    policy = ModGNN(layers, **keys, form=form).double()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter *= 2  # so that later hops are felt
    return policy


def random_flight(*batch: int, agents: int) -> TensorDict:
    shape = (*batch, agents, agents)
    return TensorDict(
        {
            "agents": {"observation": numbers(*batch, agents, FEATURES)},
            "adjacency": (torch.rand(shape) < 0.6) & ~torch.eye(agents, dtype=torch.bool),
            "weight": numbers(*shape),
            "feature": numbers(*shape, 2),
            "is_init": torch.rand(*batch, 1) < 0.2,
        },
        batch,
    )


def run(policy: ModGNN, data: TensorDict) -> tuple[Tensor, Tensor]:
    with set_recurrent_mode(True):
        out = policy(data.clone(recurse=False))
    return out["agents", "action"], out["next", "messages"]


def padded(rollouts: list[TensorDict], size: int, rubbish: float) -> TensorDict:
    """Flocks of different size in one batch: rubbish data, and links all over what does not exist."""
    filled = []
    for rollout in rollouts:
        agents = rollout["adjacency"].shape[-1]
        data = TensorDict({"is_init": rollout["is_init"]}, [STEPS])
        observation = torch.full((STEPS, size, FEATURES), rubbish, dtype=torch.float64)
        data["agents", "observation"] = torch.cat((rollout["agents", "observation"], observation[:, agents:]), 1)
        data["agents", "mask"] = (torch.arange(size) < agents).expand(STEPS, -1)
        for name, fill in (("adjacency", True), ("weight", rubbish), ("feature", rubbish)):
            value = rollout[name]
            data[name] = value.new_full((STEPS, size, size, *value.shape[3:]), fill)
            data[name][:, :agents, :agents] = value
        filled.append(data)
    return torch.stack(filled)


@pytest.mark.parametrize("kind", ["rewritten", "attention", "links"])
@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=8)
@given(
    hops=st.lists(st.integers(0, 3), min_size=1, max_size=2),
    start=st.sampled_from(STARTS),
    sizes=st.lists(st.integers(1, 4), min_size=1, max_size=3),
    rubbish=st.sampled_from([1.7e308, *NO_NUMBERS]),
    seed=seeds,
)
def test_a_flock_in_a_padded_batch_is_as_it_is_alone(
    kind: str, form: str, hops: list[int], start: str, sizes: list[int], rubbish: float, seed: int
) -> None:
    torch.manual_seed(seed)
    policy = make_policy(hops, start, kind, form)
    rollouts = [random_flight(STEPS, agents=agents) for agents in sizes]
    observations = [rollout["agents", "observation"].requires_grad_() for rollout in rollouts]
    together = padded(rollouts, 4, rubbish)
    action, messages = run(policy, together)
    wanted = (*observations, *policy.parameters())
    expected = torch.zeros(())
    ours = torch.autograd.grad(action.square().sum(), wanted, materialize_grads=True, allow_unused=True)
    for number, (rollout, agents) in enumerate(zip(rollouts, sizes, strict=True)):
        alone, sent = run(policy, rollout)
        torch.testing.assert_close(action[number, :, :agents], alone)
        torch.testing.assert_close(messages[number, :, :agents], sent, equal_nan=True)
        assert not action[number, :, agents:].any()
        held = messages[number, :, agents:].isfinite()
        assert not held.all(-1).any()
        expected = expected + alone.square().sum()
    theirs = torch.autograd.grad(expected, wanted, materialize_grads=True, allow_unused=True)
    torch.testing.assert_close(ours, theirs)
    with torch.no_grad():
        torch.testing.assert_close(run(policy, together)[0], action)


# Failing and coming back, against the formula as loops.


def with_failures(layer: ModGNNLayer, data: TensorDict) -> tuple[Tensor, Tensor]:
    """One flock [T]: outputs, and messages with NaN for what an agent does not hold, ``start="mask"``."""
    observation, graph, exists = data["agents", "observation"], data["adjacency"], data["agents", "mask"]
    steps, agents = exists.shape
    sees = observation.isfinite().all(-1)

    @functools.cache
    def message(k: int, i: int, t: int) -> Tensor | None:
        """m_i^(k)(t), or None."""
        if t < 0 or not exists[t, i] or (k == 0 and not sees[t, i]):
            return None
        if k == 0:
            return layer.f_input(observation[t, i])
        heard = incoming(k, i, t)
        return None if heard is None else sum(heard, torch.zeros(3, dtype=torch.float64))

    @functools.cache
    def incoming(k: int, i: int, t: int) -> list[Tensor] | None:
        """y_ij^(k)(t) of the neighbours that are there and hold something, or None if i itself holds nothing."""
        mine = None if data["is_init"][t] else message(k - 1, i, t - 1)
        if mine is None:
            return None
        neighbours = [j for j in range(agents) if graph[t, i, j] and exists[t, j]]
        theirs = [message(k - 1, j, t - 1) for j in neighbours]
        return [layer.f_com[k - 1](heard, mine) for heard in theirs if heard is not None]

    def output(i: int, t: int) -> Tensor:
        if not exists[t, i]:
            return torch.zeros(2, dtype=torch.float64)
        own = message(0, i, t)
        if own is None:
            return torch.full((2,), torch.nan, dtype=torch.float64)
        total = layer.f_mid[0](layer.f_pre[0](own))
        for k in range(1, layer.hops + 1):
            heard = incoming(k, i, t)
            if heard is not None:
                terms: list[Any] = [layer.f_pre[k](y) for y in heard]
                total = total + layer.f_mid[k](sum(terms, torch.zeros(4, dtype=torch.float64)))
        return layer.f_final(total)

    def sent(k: int, i: int, t: int) -> Tensor:
        held = message(k, i, t)
        return torch.full((3,), torch.nan, dtype=torch.float64) if held is None else held

    outputs = torch.stack([torch.stack([output(i, t) for i in range(agents)]) for t in range(steps)])
    rows = [sent(k, i, t) for t in range(steps) for i in range(agents) for k in range(layer.hops)]
    messages = torch.stack(rows) if rows else torch.zeros(0, 3, dtype=torch.float64)
    return outputs, messages.view(steps, agents, layer.hops, 3)


@settings(max_examples=40)
@given(hops=st.integers(0, 3), agents=st.integers(1, 4), form=forms, seed=seeds, rubbish=st.sampled_from(NO_NUMBERS))
@torch.no_grad()
def test_agents_that_fail_come_back_with_nothing(hops: int, agents: int, form: str, seed: int, rubbish: float) -> None:
    """Away, an agent is silent and its action is zero; what it held before it fell silent is gone."""
    torch.manual_seed(seed)
    layer = make_layer(hops).double()
    data = random_flight(2, 6, agents=agents)
    data["agents", "mask"] = torch.rand(2, 6, agents) < 0.75
    data["agents", "observation"][torch.rand(2, 6, agents) < 0.1] = rubbish
    policy = ModGNN(layer, form=form)
    action, messages = run(policy, data)
    for flock in range(2):
        outputs, sent = with_failures(layer, data[flock])
        torch.testing.assert_close(action[flock], outputs, equal_nan=True)
        torch.testing.assert_close(messages[flock], sent, equal_nan=True)
    memory = messages[:, 0] * torch.nan
    for t in range(6):
        step = data[:, t].clone()
        step["messages"] = memory
        policy(step)
        memory = step["next", "messages"]
        torch.testing.assert_close(step["agents", "action"], action[:, t], equal_nan=True)
        torch.testing.assert_close(memory, messages[:, t], equal_nan=True)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("form", ["edges", "dense"])
@torch.no_grad()
def test_steps_make_the_window_while_agents_come_and_go(start: str, form: str) -> None:
    torch.manual_seed(0)
    policy = make_policy([2, 1], start, "links", form)
    data = random_flight(3, 8, agents=4)
    data["agents", "mask"] = torch.rand(3, 8, 4) < 0.8
    data["agents", "observation"][0, 3:5, 1] = torch.nan
    action, messages = run(policy, data)
    memory = torch.full_like(messages[:, 0], torch.nan)
    for t in range(8):
        step = data[:, t].clone()
        step["messages"] = memory
        policy(step)
        memory = step["next", "messages"]
        torch.testing.assert_close(step["agents", "action"], action[:, t], equal_nan=True)
        torch.testing.assert_close(memory, messages[:, t], equal_nan=True)


# What is no number.


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("rubbish", NO_NUMBERS)
@settings(max_examples=6)
@given(
    hops=st.lists(st.integers(1, 2), min_size=1, max_size=2), form=forms, kind=st.sampled_from(["rewritten", "links"])
)
def test_what_one_agent_cannot_see_poisons_no_gradient(
    start: str, rubbish: float, hops: list[int], form: str, kind: str
) -> None:
    torch.manual_seed(0)
    policy = make_policy(hops, start, kind, form)
    data = random_flight(2, STEPS, agents=4)
    observation = data["agents", "observation"]
    sick = torch.zeros(2, STEPS, 4, dtype=torch.bool)
    sick[0, 1:3, 0] = sick[1, :, 1] = True

    def gradients(value: float) -> list[Tensor]:
        seen = observation.masked_fill(sick.unsqueeze(-1), value).requires_grad_()
        action, _ = run(policy, data.clone().set(("agents", "observation"), seen))
        assert action[sick].isnan().all()
        others = action[~sick]
        assert others.isfinite().all()
        return [others, *torch.autograd.grad(others.square().sum(), (seen, *policy.parameters()))]

    found = gradients(rubbish)
    assert all(gradient.isfinite().all() for gradient in found)
    assert not found[1][sick].any()
    assert any(gradient.any() for gradient in found[2:])
    torch.testing.assert_close(found, gradients(torch.nan))


def test_gradients_next_to_an_agent_that_sees_nothing_are_exact() -> None:
    torch.manual_seed(0)
    layer = ModGNNLayer(2, nn.Linear(FEATURES, 3), None, nn.Sequential(nn.Linear(3, 3), nn.Tanh())).double()
    data = random_flight(4, agents=3)
    observation = data["agents", "observation"]
    observation[1, 0] = torch.nan

    def others(*_: Tensor) -> Tensor:
        return layer(observation, data["adjacency"])[0].nan_to_num()

    assert torch.autograd.gradcheck(others, tuple(layer.parameters()))


class _Logarithm(nn.Module):
    def forward(self, data: Tensor) -> Tensor:
        return data.log()


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("form", ["edges", "dense"])
@torch.no_grad()
def test_data_that_f_input_turns_into_no_numbers_are_not_sent(start: str, form: str) -> None:
    """In a window as in single steps, where a message that is not finite is one not held."""
    torch.manual_seed(0)
    policy = ModGNN(ModGNNLayer(2, _Logarithm(), f_pre=nn.Tanh(), start=start), form=form).double()
    data = random_flight(2, 6, agents=4)
    data["agents", "observation"].abs_()
    data["agents", "observation"][0, 1:3, 0] = -1.0
    data["agents", "observation"][1, 0, 0, 0] = 0.0
    action, messages = run(policy, data)
    assert action[:, :, 1:].isfinite().all()
    memory = torch.full_like(messages[:, 0], torch.nan)
    for t in range(6):
        step = data[:, t].clone().set("messages", memory)
        policy(step)
        memory = step["next", "messages"]
        torch.testing.assert_close(step["agents", "action"], action[:, t], equal_nan=True)


@pytest.mark.parametrize(
    ("mask", "sentence"),
    [
        (torch.ones(2, 3, dtype=torch.bool), r"the mask has shape \(2, 3\), .* dimensions \(2, 4\)"),
        (torch.ones(2, 4), r"the mask has dtype torch.float32; it must be torch.bool"),
    ],
)
def test_a_mask_of_another_kind_is_refused(mask: Tensor, sentence: str) -> None:
    policy, data = ModGNN(ModGNNLayer(1)), random_flight(2, agents=4)
    data["agents"].batch_size = [2]
    data["agents", "mask"] = mask
    with pytest.raises(InputError, match=sentence):
        policy(data)
