"""ModGNN against its formula, written as loops, and the laws that follow from it."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from modgnn_rl import InputError, ModGNN, ModGNNLayer, make_model
from tests.nn.helpers import dense

FEATURES, WIDTH = 3, 4
STARTS = ("mask", "zero", "repeat")


class _Pairwise(nn.Module):
    """An f_com that is neither linear nor zero at zero."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * width, width)

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        return self.linear(torch.cat((sender, receiver), -1)).tanh()


def full_layer(hops: int, start: str = "mask", inputs: int = FEATURES, shared: bool = False) -> ModGNNLayer:
    """A layer with all submodules, in which no two widths are equal by need."""
    f_pre = dense(WIDTH, 6) if shared else [dense(WIDTH, 6) for _ in range(hops + 1)]
    f_mid = dense(6, 2) if shared else [dense(6, 2) for _ in range(hops + 1)]
    return ModGNNLayer(hops, dense(inputs, WIDTH), _Pairwise(WIDTH), f_pre, f_mid, dense(2, 3), start=start).double()


def bare_layer(hops: int, start: str = "mask") -> ModGNNLayer:
    return ModGNNLayer(hops, start=start)


def keyed_layer(hops: int, start: str = "mask") -> ModGNNLayer:
    """Every submodule reads the agent's own observation, f_final a further datum too."""

    def keyed(inputs: int, outputs: int) -> TensorDictModule:
        concatenated = _Concatenated(dense(inputs + FEATURES, outputs))
        return TensorDictModule(concatenated, in_keys=["data", ("own", "observation")], out_keys=["data"])

    f_final = TensorDictModule(
        _Concatenated(dense(2 + 1, 3)), in_keys=["data", ("own", "sensors", "battery")], out_keys=["out"]
    )
    f_pre: list[nn.Module | None] = [keyed(WIDTH, WIDTH) for _ in range(hops)]
    return ModGNNLayer(
        hops, keyed(FEATURES, WIDTH), None, [*f_pre, None], keyed(WIDTH, 2), f_final, start=start
    ).double()


class _Concatenated(nn.Module):
    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *parts: Tensor) -> Tensor:
        return self.network(torch.cat(parts, -1))


def random_graph(*shape: int, agents: int, share: float = 0.5) -> Tensor:
    return (torch.rand(*shape, agents, agents) < share) & ~torch.eye(agents, dtype=torch.bool)


def random_data(*batch: int, agents: int, share: float = 0.5) -> TensorDict:
    """Observations, graphs, batteries and episode starts of a window [*B, T]."""
    sensors = {"battery": torch.rand(*batch, agents, 1, dtype=torch.float64)}
    observation = torch.randn(*batch, agents, FEATURES, dtype=torch.float64)
    return TensorDict(
        {
            "agents": {"observation": observation, "sensors": sensors},
            "adjacency": random_graph(*batch, agents=agents, share=share),
            "is_init": torch.rand(*batch, 1) < 0.3,
        },
        batch,
    )


def run_window(policy: ModGNN, data: TensorDict) -> tuple[Tensor, Tensor]:
    with set_recurrent_mode(True):
        out = policy(data.clone())
    return out["agents", "action"], out["next", "messages"]


def same(ours: Tensor, theirs: Tensor) -> None:
    torch.testing.assert_close(ours, theirs, rtol=1e-11, atol=1e-11, equal_nan=True)


# The formula, written as loops over steps, agents, hops and neighbours.


def call(module: nn.Module, data: Tensor | None, own: dict[Any, Tensor]) -> Tensor:
    if isinstance(module, TensorDictModule):
        return module.module(data, *(own[key[1:]] for key in module.in_keys[1:]))
    return module(data)


def by_the_formula(layer: ModGNNLayer, seen: Tensor, data: TensorDict) -> tuple[Tensor, Tensor]:
    """One flock [T]: outputs x [T, N, O] and messages m [T, N, K, D]; NaN where an agent holds nothing."""
    steps, agents, _ = seen.shape
    graph, observation = data["adjacency"], data["agents", "observation"]
    battery = data["agents", "sensors", "battery"]

    def own(t: int, i: int) -> dict[Any, Tensor]:
        return {("observation",): observation[t, i], ("sensors", "battery"): battery[t, i]}

    nothing = torch.zeros_like(call(layer.f_input, seen[0, 0], own(0, 0)))

    @functools.cache
    def aggregate(k: int, i: int, t: int, begin: int) -> Tensor | None:
        """m_i^(k)(t) in the episode that began at ``begin``; None for what nobody holds."""
        if t < begin and layer.start == "zero":
            return nothing
        if t - k < begin and layer.start == "mask":
            return None
        now = max(t, begin)
        return call(layer.f_input, seen[now, i], own(now, i)) if k == 0 else sum(incoming(k, i, t, begin), nothing)

    @functools.cache
    def incoming(k: int, i: int, t: int, begin: int) -> list[Tensor]:
        """y_ij^(k)(t) of all neighbours."""
        neighbours = graph[max(t, begin), i].nonzero().view(-1).tolist()
        mine = aggregate(k - 1, i, t - 1, begin)
        f_com = layer.f_com[k - 1]
        return [f_com(aggregate(k - 1, j, t - 1, begin), mine) for j in neighbours]

    def processed(k: int, y: Tensor | None, t: int, i: int) -> Tensor:
        return call(layer.f_pre[k], y, own(t, i))

    def output(i: int, t: int, begin: int) -> Tensor:
        total = call(layer.f_mid[0], processed(0, aggregate(0, i, t, begin), t, i), own(t, i))
        for k in range(1, layer.hops + 1):
            if layer.start != "mask" or t - begin >= k:
                terms = [processed(k, y, t, i) for y in incoming(k, i, t, begin)]
                hop = sum(terms, torch.zeros_like(processed(k, nothing, t, i)))
                total = total + call(layer.f_mid[k], hop, own(t, i))
        return call(layer.f_final, total, own(t, i))

    begin, outputs, messages = 0, [], []
    for t in range(steps):
        begin = t if data["is_init"][t] else begin
        outputs.append(torch.stack([output(i, t, begin) for i in range(agents)]))
        held = [aggregate(k, i, t, begin) for i in range(agents) for k in range(layer.hops)]
        rows = [nothing * torch.nan if m is None else m for m in held]
        messages.append(torch.stack(rows) if rows else seen.new_zeros(0))
    return torch.stack(outputs), torch.stack(messages).view(steps, agents, layer.hops, len(nothing))


@given(
    make=st.sampled_from([full_layer, bare_layer, keyed_layer]),
    hops=st.integers(0, 3),
    start=st.sampled_from(STARTS),
    flocks=st.integers(1, 2),
    steps=st.integers(1, 5),
    agents=st.integers(1, 4),
    share=st.sampled_from([0.0, 0.5, 1.0]),
    seed=st.integers(0, 99),
)
@torch.no_grad()
def test_one_layer_is_the_formula(
    make: Callable[..., ModGNNLayer],
    hops: int,
    start: str,
    flocks: int,
    steps: int,
    agents: int,
    share: float,
    seed: int,
) -> None:
    torch.manual_seed(seed)
    layer = make(hops, start)
    data = random_data(flocks, steps, agents=agents, share=share)
    action, messages = run_window(ModGNN(layer), data)
    for flock in range(flocks):
        expected = by_the_formula(layer, data["agents", "observation"][flock], data[flock])
        same(action[flock], expected[0])
        same(messages[flock], expected[1])


@settings(max_examples=15)
@given(hops=st.lists(st.integers(0, 2), min_size=2, max_size=3), start=st.sampled_from(STARTS), seed=st.integers(0, 99))
@torch.no_grad()
def test_a_later_layer_sees_the_outputs_of_all_earlier_ones(hops: list[int], start: str, seed: int) -> None:
    torch.manual_seed(seed)
    layers = [full_layer(k, start, inputs=FEATURES + 3 * index) for index, k in enumerate(hops)]
    layers.append(bare_layer(1, start))  # its messages are wider than the others
    data = random_data(1, 4, agents=3)
    action, messages = run_window(ModGNN(layers), data)
    seen, first = data["agents", "observation"][0], 0
    for layer in layers:
        output, sent = by_the_formula(layer, seen, data[0])
        same(messages[0, :, :, first : first + layer.hops, : sent.shape[-1]], sent)
        seen, first = torch.cat((seen, output), -1), first + layer.hops
    same(action[0], output)
    assert messages.shape == (1, 4, 3, sum(hops) + 1, seen.shape[-1] - output.shape[-1])


# Steps and windows.


def policies(start: str = "mask") -> dict[str, ModGNN]:
    return {
        "full": ModGNN(full_layer(2, start)),
        "bare": ModGNN(bare_layer(3, start)),
        "keyed": ModGNN(keyed_layer(1, start)),
        "shared": ModGNN(full_layer(2, start, shared=True)),
        "two layers": ModGNN([full_layer(2, start), bare_layer(1, start)]),
        "hopless": ModGNN(full_layer(0, start)),
    }


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def steps_of(policy: ModGNN, data: TensorDict, messages: Tensor | None) -> tuple[Tensor, Tensor]:
    """Run a window [B, T] step by step; what was stored when an episode begins is rubbish."""
    actions, sent = [], []
    for t in range(data.shape[1]):
        step = data[:, t].clone()
        if messages is not None:
            rubbish = torch.randn_like(messages)
            step["messages"] = torch.where(step["is_init"][..., None, None], rubbish, messages)
        step = policy(step)
        messages = step["next", "messages"]
        actions.append(step["agents", "action"])
        sent.append(messages)
    return torch.stack(actions, 1), torch.stack(sent, 1)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("name", policies())
@torch.no_grad()
def test_steps_make_the_window(name: str, start: str) -> None:
    policy = policies(start)[name]
    data = random_data(4, 7, agents=4)
    data["is_init"][:2, 0] = False  # these two continue from stored messages
    earlier = run_window(policy, random_data(4, 5, agents=4))[1][:, -1]
    data["messages"] = earlier.unsqueeze(1).expand(-1, 7, *earlier.shape[1:])
    whole = run_window(policy, data)
    for ours, theirs in zip(steps_of(policy, data.exclude("messages"), earlier), whole, strict=True):
        same(ours, theirs)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("name", policies())
@torch.no_grad()
def test_two_halves_with_stored_messages_make_the_whole(name: str, start: str) -> None:
    policy = policies(start)[name]
    data = random_data(3, 8, agents=4)
    data["is_init"][0] = False
    whole, sent = run_window(policy, data)
    late = data[:, 3:].clone()
    late["messages"] = sent[:, 2:-1]
    same(run_window(policy, data[:, :3])[0], whole[:, :3])
    same(run_window(policy, late)[0], whole[:, 3:])


@torch.no_grad()
def test_a_window_without_is_init_begins_an_episode() -> None:
    policy = policies()["full"]
    data = random_data(2, 4, agents=3)
    data["is_init"][:] = False
    data["is_init"][:, 0] = True
    bare = data.exclude("is_init")
    expected = run_window(policy, data)[0]
    same(run_window(policy, bare)[0], expected)
    bare["messages"] = torch.randn(2, 4, 3, 2, WIDTH, dtype=torch.float64)
    same(run_window(policy, bare)[0], expected)
    data["messages"], data["is_init"][1, 0] = bare["messages"], False
    continued = run_window(policy, data)[0]
    same(continued[0], expected[0])
    assert not torch.allclose(continued[1], expected[1])


@pytest.mark.parametrize("name", policies())
@torch.no_grad()
def test_memory_is_finite(name: str) -> None:
    policy = policies()[name]
    assert policy.window == policy.hops + 1
    data = random_data(2, 9, agents=4)
    data["is_init"][:] = False
    exact, sent = run_window(policy, data)
    late = data[:, -policy.window :].clone()
    same(run_window(policy, late)[0][:, -1], exact[:, -1])
    late["messages"] = torch.randn_like(sent[:, -policy.window :])
    same(run_window(policy, late)[0][:, -1], exact[:, -1])
    if policy.hops:
        shorter = late[:, 1:]
        assert not torch.allclose(run_window(policy, shorter)[0][:, -1], exact[:, -1])


@torch.no_grad()
def test_any_batch_dimensions() -> None:
    policy = policies()["keyed"]
    data = random_data(2, 3, 4, agents=3)
    action, messages = run_window(policy, data)
    flat = run_window(policy, data.flatten(0, 1))
    same(action.flatten(0, 1), flat[0])
    same(messages.flatten(0, 1), flat[1])
    lone = data[0, 0].exclude("is_init")
    same(run_window(policy, lone)[0][0], policy(random_step(lone))["agents", "action"])


def random_step(window: TensorDict) -> TensorDict:
    return window[0].clone().set("is_init", torch.ones(1, dtype=torch.bool))


def test_forgetfulness_warns_once() -> None:
    data = random_data(2, agents=3).exclude("is_init")
    policy = policies()["full"]
    with pytest.warns(UserWarning, match=r"remembers no messages: append InitTracker\(\)"):
        policy(data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy(data)
        policies()["hopless"](data.clone())


def test_a_step_in_mid_episode_without_messages_warns() -> None:
    data = random_data(2, agents=3)
    data["is_init"][:] = True
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policies()["full"](data.clone())
    data["is_init"][1] = False
    with pytest.warns(UserWarning, match="'messages' in mid-episode, is missing"):
        policies()["full"](data)


@torch.no_grad()
def test_a_layer_that_sends_nothing_does_not_widen_the_messages() -> None:
    policy = ModGNN([bare_layer(1), ModGNNLayer(0), bare_layer(2)])
    assert run_window(policy, random_data(2, 3, agents=3).exclude("is_init"))[1].shape[-1] == 4 * FEATURES
    last = ModGNN([bare_layer(1), ModGNNLayer(0)])
    assert run_window(last, random_data(2, 3, agents=3))[1].shape[-2:] == (1, FEATURES)


def test_a_sparse_graph_is_read_like_a_dense_one() -> None:
    policy = make_model("modgnn_mlp", seed=0)
    observation = torch.randn(2, 5, 6, generator=torch.Generator().manual_seed(0))
    adjacency = torch.rand(2, 5, 5, generator=torch.Generator().manual_seed(1)) < 0.5
    actions = []
    for graph in (adjacency, adjacency.to_sparse()):
        data = TensorDict({"agents": {"observation": observation}, "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2])
        actions.append(policy(data.set("adjacency", graph))["agents", "action"])
    assert torch.equal(*actions)


def test_tensors_and_lists_of_keys_are_refused_in_one_sentence() -> None:
    policy = make_model("gcn", seed=0)
    with pytest.raises(InputError, match="the policy reads a TensorDict with"):
        policy(torch.zeros(2, 5, 6), torch.zeros(2, 5, 5))
    with pytest.raises(InputError, match="must be one key each"):
        make_model("gcn", observation=[("a", "observation"), ("b", "observation")])
