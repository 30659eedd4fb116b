"""A policy under torch's transformations: compilation, vmap and its kin, export, other numbers, copies."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.func import functional_call, grad, jvp, stack_module_state, vjp, vmap
from torch.utils.checkpoint import checkpoint
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.nn import aggregation, graph, topology
from modgnn_rl.nn.communication import GraphAttention, MessagePassing
from tests.nn.helpers import numbers

FEATURES, AGENTS, STEPS = 2, 4, 4
ACTION = ("agents", "action")
FORMS = pytest.mark.parametrize("form", ["edges", "dense"])


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def network(inputs: int, outputs: int, between: type[nn.Module] = nn.Tanh) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 4), between(), nn.Linear(4, outputs))


def message_layer(hops: int, inputs: int = FEATURES) -> ModGNNLayer:
    """Weights and features of links, and a keyed f_pre."""
    f_com = MessagePassing(nn.Sequential(nn.Linear(2 * 3 + 1 + 2, 3), nn.Tanh()))
    product = TensorDictModule(torch.mul, ["data", ("own", "gain")], ["out"])
    f_pre = [network(3, 3), *[product] * hops]
    return ModGNNLayer(hops, network(inputs, 3), f_com, f_pre, [network(3, 3) for _ in f_pre], network(3, FEATURES))


def attention_layer(hops: int, inputs: int = FEATURES) -> ModGNNLayer:
    return ModGNNLayer(hops, network(inputs, 4), GraphAttention(4, 4, 2), network(4, 3), None, network(3, FEATURES))


def relu_layer(hops: int, inputs: int = FEATURES) -> ModGNNLayer:
    """One that is rewritten where links are listed."""
    f_pre = [network(3, 3, nn.ReLU) for _ in range(hops + 1)]
    return ModGNNLayer(hops, network(inputs, 3), f_pre=f_pre, f_final=network(3, FEATURES))


def make_policy(*layers: Callable[..., ModGNNLayer], hops: int = 1, form: str = "auto") -> ModGNN:
    built = [make(hops, FEATURES * (number + 1)) for number, make in enumerate(layers)]
    return ModGNN(built, edge_weight="weight", edge_feature="feature", form=form).double()


def random_window(*batch: int) -> TensorDict:
    """A window with all that a policy may read."""
    shape = (*batch, AGENTS, AGENTS)
    agents = {"observation": numbers(*batch, AGENTS, FEATURES), "gain": numbers(*batch, AGENTS, 1)}
    agents["mask"] = torch.rand(*batch, AGENTS) < 0.8
    return TensorDict(
        {
            "agents": agents,
            "adjacency": torch.rand(shape) < 0.5,
            "weight": torch.rand(shape, dtype=torch.float64),
            "feature": numbers(*shape, 2),
            "is_init": torch.rand(*batch, 1) < 0.2,
        },
        batch,
    )


def run(policy: nn.Module, data: TensorDict) -> Tensor:
    with set_recurrent_mode(True):
        return policy(data.clone())[ACTION]


# Compilation.


def compiled(policy: ModGNN) -> nn.Module:
    """As one graph, without a break."""
    return torch.compile(policy, backend="aot_eager", fullgraph=True, dynamic=False)  # type: ignore[return-value]


@pytest.mark.slow
def test_a_compiled_policy_runs_and_learns_from_windows() -> None:
    policy, data = make_policy(message_layer), random_window(2, STEPS)
    results = []
    for action in (run(compiled(policy), data), run(policy, data)):
        results.append([action, *torch.autograd.grad(action.square().sum(), tuple(policy.parameters()))])
    torch.testing.assert_close(*results)


@torch.no_grad()
def test_a_compiled_policy_runs_step_by_step() -> None:
    policy, data = make_policy(attention_layer), random_window(2)
    data["messages"] = numbers(2, AGENTS, 1, 4)
    found, expected = compiled(policy)(data.clone()), policy(data.clone())
    torch.testing.assert_close(found[ACTION], expected[ACTION])
    torch.testing.assert_close(found["next", "messages"], expected["next", "messages"], equal_nan=True)


def test_a_policy_is_exported_with_static_shapes() -> None:
    class Step(nn.Module):
        def __init__(self, policy: ModGNN) -> None:
            super().__init__()
            self.policy = policy

        def forward(self, observation: Tensor, adjacency: Tensor, messages: Tensor) -> tuple[Tensor, Tensor]:
            data = {"agents": {"observation": observation}, "adjacency": adjacency, "messages": messages}
            data["is_init"] = torch.zeros(*observation.shape[:-2], 1, dtype=torch.bool)
            out = self.policy(TensorDict(data, observation.shape[:-2]))
            return out[ACTION], out["next", "messages"]

    policy = ModGNN(relu_layer(1)).double().requires_grad_(False)
    data = random_window(2)
    inputs = (data["agents", "observation"], data["adjacency"], numbers(2, AGENTS, 1, 3))
    exported = torch.export.export(Step(policy), inputs).module()
    other = (inputs[0].flip(0), ~inputs[1], inputs[2].flip(1))
    torch.testing.assert_close(exported(*other), Step(policy)(*other))


# Functions of the weights.


def by_weights(policy: ModGNN, data: TensorDict) -> Callable[[dict[str, Tensor], Tensor], Tensor]:
    """The actions as a function of weights and observations."""

    def act(weights: dict[str, Tensor], observation: Tensor) -> Tensor:
        given = data.clone().set(("agents", "observation"), observation)
        with set_recurrent_mode(True):
            # One module in several places: torch ties its weights by itself, but then forgets to take them back.
            return functional_call(policy, weights, (given,), tie_weights=False)[ACTION]

    return act


@pytest.mark.parametrize("layers", [(message_layer, attention_layer), (relu_layer,)])
def test_an_ensemble_is_a_loop_over_its_members(layers: tuple[Callable[..., ModGNNLayer], ...]) -> None:
    members = [make_policy(*layers, hops=2) for _ in range(3)]
    kept = copy.deepcopy(members[0])
    data = random_window(2, STEPS)
    weights, _ = stack_module_state(members)
    act, observation = by_weights(members[0], data), data["agents", "observation"]
    found = vmap(act, (0, None))(weights, observation)
    gradients = vmap(grad(lambda *inputs: act(*inputs).square().sum()), (0, None))(weights, observation)
    for number, member in enumerate(members):
        action = run(member, data)
        torch.testing.assert_close(found[number], action)
        theirs = torch.autograd.grad(action.square().sum(), tuple(member.parameters()))
        for (name, _), their in zip(member.named_parameters(), theirs, strict=True):
            torch.testing.assert_close(gradients[name][number], their)
    for mine, before in zip(members[0].parameters(), kept.parameters(), strict=True):
        assert torch.equal(mine, before)


def test_flocks_may_be_mapped_over() -> None:
    policy, data = ModGNN(relu_layer(2)).double(), random_window(3, STEPS)

    def act(observation: Tensor, adjacency: Tensor) -> Tensor:
        flock = {"agents": {"observation": observation}, "adjacency": adjacency}
        with set_recurrent_mode(True):
            return policy(TensorDict(flock, [STEPS]))[ACTION]

    inputs = data["agents", "observation"], data["adjacency"]
    torch.testing.assert_close(vmap(act)(*inputs), torch.stack([act(*flock) for flock in zip(*inputs, strict=True)]))


def test_products_with_the_jacobian_agree() -> None:
    policy, data = make_policy(message_layer, attention_layer), random_window(2, STEPS)
    act, weights = by_weights(policy, data), dict(policy.named_parameters())
    observation = data["agents", "observation"]
    direction = numbers(*observation.shape)
    action, along = jvp(lambda seen: act(weights, seen), (observation,), (direction,))  # type: ignore[misc]
    torch.testing.assert_close(action, run(policy, data))
    covector = numbers(*action.shape)
    (back,) = vjp(lambda seen: act(weights, seen), observation)[1](covector)
    torch.testing.assert_close((along * covector).sum(), (back * direction).sum())
    seen = observation.clone().requires_grad_()
    (expected,) = torch.autograd.grad(act(weights, seen), seen, covector)
    torch.testing.assert_close(back, expected)


# Gradients.


@FORMS
@pytest.mark.parametrize("layers", [(message_layer, attention_layer), (relu_layer, relu_layer)])
def test_gradients_of_a_policy_by_finite_differences(
    form: str, layers: tuple[Callable[..., ModGNNLayer], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graph, "BLOCK", {"cpu": 3})
    monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", 0)
    policy, data = make_policy(*layers, form=form), random_window(1, 3)
    links = (data["weight"], data["feature"]) if layers[0] is message_layer else ()
    inputs = [data["agents", "observation"], *links]

    def act(observation: Tensor, *values: Tensor) -> Tensor:
        given = data.clone().set(("agents", "observation"), observation)
        for name, value in zip(("weight", "feature"), values[: len(links)], strict=False):
            given[name] = value
        return run(policy, given)

    wanted = [value.requires_grad_() for value in inputs]
    assert torch.autograd.gradcheck(act, (*wanted, *policy.parameters()), fast_mode=True)


@FORMS
def test_a_checkpointed_policy_has_the_same_gradients(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", 0)
    policy, data = make_policy(message_layer, relu_layer, form=form), random_window(2, STEPS)
    results = []
    for action in (run(policy, data), checkpoint(run, policy, data, use_reentrant=False)):
        results.append([action, *torch.autograd.grad(action.square().sum(), tuple(policy.parameters()))])
    torch.testing.assert_close(*results)


# Other numbers.


@FORMS
@pytest.mark.parametrize("stored", [0, 1000])
def test_autocast_stays_close_and_keeps_the_messages_as_they_are(
    form: str, stored: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(aggregation, "MAX_STORED_EDGES", stored)
    policy, data = make_policy(message_layer, relu_layer, hops=2, form=form).float(), random_window(3, STEPS).float()
    data["adjacency"], data["is_init"] = data["adjacency"].bool(), data["is_init"].bool()
    data["agents", "mask"] = data["agents", "mask"].bool()

    def results() -> list[Tensor]:
        with set_recurrent_mode(True):
            out = policy(data.clone())
        assert out["next", "messages"].dtype == torch.float32
        action = out[ACTION].float()
        return [action, *torch.autograd.grad(action.square().sum(), tuple(policy.parameters()))]

    expected = results()
    with torch.autocast("cpu", torch.bfloat16):
        found = results()
    assert not torch.equal(found[0], expected[0])
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.isfinite().all()
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0.05 * float(theirs.detach().abs().max()) + 1e-3)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
@pytest.mark.parametrize("make", [message_layer, attention_layer, relu_layer])
@FORMS
def test_a_policy_moves_to_other_numbers(dtype: torch.dtype, make: Callable[..., ModGNNLayer], form: str) -> None:
    policy, data = make_policy(make, hops=2, form=form), random_window(3, STEPS)
    expected = run(policy, data)
    assert policy.to(dtype) is policy
    for key in (("agents", "observation"), ("agents", "gain"), "weight", "feature"):
        data[key] = data[key].to(dtype)
    with set_recurrent_mode(True):
        out = policy(data.clone())
    assert out[ACTION].dtype == out["next", "messages"].dtype == dtype
    torch.testing.assert_close(out[ACTION].double(), expected, rtol=0, atol={8: 1e-12, 4: 1e-5, 2: 0.1}[dtype.itemsize])
    out[ACTION].sum().backward()
    assert all(parameter.grad is None or parameter.grad.dtype == dtype for parameter in policy.parameters())


# Copies.


@torch.no_grad()
def test_copies_keep_keys_requests_and_what_is_shared() -> None:
    shared = network(3, 3)
    layers = [ModGNNLayer(1, network(2 * k, 3), None, shared, shared, network(3, FEATURES)) for k in (1, 2)]
    keys: dict[str, Any] = {
        "observation": ("flock", "state"),
        "adjacency": "links",
        "action": "u",
        "messages": "memory",
    }
    policy = ModGNN(layers, **keys).double().request("layers.1.f_com.1", rename={"layers.1.f_com.1": "heard"})
    window = random_window(2, STEPS)
    flock = {"state": window["agents", "observation"]}
    data = TensorDict({"flock": flock, "links": window["adjacency"]}, [2, STEPS])

    def act(one: nn.Module) -> TensorDict:
        with set_recurrent_mode(True):
            return one(data.clone()).select("u", "heard", ("next", "memory"))

    expected = act(policy)
    file = io.BytesIO()
    torch.save(policy.state_dict(), file)
    copied, pickled = copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))
    loaded = copy.deepcopy(policy)
    for parameter in (*loaded.parameters(), *policy.parameters()):
        parameter.zero_()
    file.seek(0)
    loaded.load_state_dict(torch.load(file, weights_only=True))
    for one in (copied, pickled, loaded):
        assert one.num_parameters == policy.num_parameters
        assert one.layers[0].f_pre[0] is one.layers[1].f_mid[1]
        for key, value in act(one).items(True, True):
            torch.testing.assert_close(value, expected[key], rtol=0, atol=0, equal_nan=True)


# Steps and windows with everything at once.


@settings(max_examples=20)
@given(
    form=st.sampled_from(topology.FORMS),
    start=st.sampled_from(["mask", "zero", "repeat"]),
    seed=st.integers(0, 99),
    stored=st.sampled_from([0, 1000]),
)
@torch.no_grad()
def test_steps_make_the_window_and_memory_is_finite(form: str, start: str, seed: int, stored: int) -> None:
    """Two layers with K = 2 and 1, weights, features, own data, a mask, and resets of some flocks in mid-window."""
    torch.manual_seed(seed)
    policy = ModGNN(
        [message_layer(2), attention_layer(1, 2 * FEATURES)], edge_weight="weight", edge_feature="feature", form=form
    ).double()
    for layer in policy.layers:
        layer.start = start
    data = random_window(3, 7)
    data["is_init"][:, 0] = torch.tensor([[True], [False], [False]])
    memory = torch.where(torch.rand(3, AGENTS, 3, 1) < 0.3, torch.nan, numbers(3, AGENTS, 3, 4))
    data["messages"] = memory.unsqueeze(1).expand(-1, 7, *memory.shape[1:])
    with set_recurrent_mode(True):
        whole = policy(data.clone())
        data["agents", "mask"][:, 3:] = True
        data["is_init"][:, 3:] = False
        settled = policy(data.clone())
        late = data[:, -policy.window :].exclude("messages", "is_init")
        if start == "mask":
            torch.testing.assert_close(policy(late)[ACTION][:, -1], settled[ACTION][:, -1])
    for t in range(7):
        step = data.clone()[:, t].set("messages", memory)
        step["agents", "mask"], step["is_init"] = whole["agents", "mask"][:, t], whole["is_init"][:, t]
        step = policy(step)
        memory = step["next", "messages"]
        torch.testing.assert_close(step[ACTION], whole[ACTION][:, t], equal_nan=True)
        torch.testing.assert_close(memory, whole["next", "messages"][:, t], equal_nan=True)
