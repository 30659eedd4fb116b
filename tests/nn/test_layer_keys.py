"""Submodules by name and key: what they read, how they are put in, shared and frozen."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.errors import InputError
from modgnn_rl.nn.communication import Adjacency, GraphAttention, Laplacian
from modgnn_rl.nn.topology import Topology
from tests.nn.helpers import dense, random_window, run

FEATURES, AGENTS, STEPS = 2, 4, 5
ACTION = ("agents", "action")


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


class _Concatenated(nn.Module):
    """A network of all that it reads, side by side."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.network = dense(inputs, outputs)

    def forward(self, *parts: Tensor) -> Tensor:
        return self.network(torch.cat(parts, -1))


# What keyed submodules read.


def test_a_keyed_f_com_reads_both_ends_the_receivers_data_and_the_link() -> None:
    keys = ["sender", "receiver", ("own", "observation"), ("own", "goal"), "input"]
    keys += [("edge", "weight"), ("edge", "feature")]
    network = _Concatenated(FEATURES * 4 + 1 + 1 + 3, 2)
    f_com = TensorDictModule(network, keys, ["y"])
    layer = ModGNNLayer(1, f_com=f_com)
    data = random_window(3, STEPS)
    results = []
    for form in ("edges", "dense"):
        policy = ModGNN(layer, edge_weight="weight", edge_feature="feature", form=form).double()
        results.append(run(policy, data)[ACTION])
    observation, goal = data["agents", "observation"], data["agents", "goal"]
    expected = observation.clone()
    for b, t, i, j in data["adjacency"].nonzero().tolist():
        if t:
            ends = (observation[b, t - 1, j], observation[b, t - 1, i])
            mine = (observation[b, t, i], goal[b, t, i], observation[b, t, i])
            link = (data["weight"][b, t, i, j].view(1), data["feature"][b, t, i, j])
            expected[b, t, i] += network(*ends, *mine, *link)
    for result in results:
        torch.testing.assert_close(result, expected)


@pytest.mark.parametrize("form", ["edges", "dense"])
def test_a_keyed_f_pre_reads_the_link_and_its_layers_input(form: str) -> None:
    """In a second layer that is the observation and the first one's output."""
    first = ModGNNLayer(1, f_final=dense(FEATURES, 3))
    keys = ["data", "input", ("own", "goal"), ("edge", "weight")]
    network = _Concatenated((FEATURES + 3) * 2 + 1 + 1, 2)
    second = ModGNNLayer(1, f_pre=[dense(FEATURES + 3, 2), TensorDictModule(network, keys, ["out"])])
    policy = ModGNN([first, second], edge_weight="weight", form=form).double()
    data = random_window(STEPS)
    # f_pre of hop 0 is plain here: there is no link.
    observation, goal = data["agents", "observation"], data["agents", "goal"]
    weight = data["weight"]
    middle = first(observation, Topology(data["adjacency"], AGENTS, weight=weight))[0]
    seen = torch.cat((observation, middle), -1)
    expected = second.f_pre[0](seen)
    for t, i, j in data["adjacency"].nonzero().tolist():
        if t:
            y = weight[t, i, j] * (seen[t - 1, j] - seen[t - 1, i])
            expected[t, i] += network(y, seen[t, i], goal[t, i], weight[t, i, j].view(1))
    torch.testing.assert_close(run(policy, data)[ACTION], expected)


def test_own_data_are_found_where_the_policy_is_told() -> None:
    def policy(name: str, **keys: Any) -> ModGNN:
        f_final = TensorDictModule(torch.mul, ["data", ("own", name)], ["out"])
        return ModGNN(ModGNNLayer(1, f_final=f_final), **keys)

    data = random_window(STEPS)
    expected = run(policy("goal"), data)[ACTION]
    elsewhere = data.clone()
    elsewhere["world", "target"] = elsewhere["agents"].pop("goal")
    elsewhere["world"].batch_size = [STEPS]
    renamed = policy("goal", own={"goal": ("world", "target")})
    assert ("world", "target") in renamed.in_keys
    torch.testing.assert_close(run(renamed, elsewhere)[ACTION], expected)
    deep = policy("goal", own={("goal",): ("world", "target")})
    torch.testing.assert_close(run(deep, elsewhere)[ACTION], expected)
    # Another datum under the name of the observation.
    zoomed = policy("observation", own={"observation": ("agents", "zoomed")})
    data["agents", "zoomed"] = data["agents", "goal"]
    torch.testing.assert_close(run(zoomed, data)[ACTION], expected)


@pytest.mark.parametrize(
    ("missing", "sentence"),
    [
        (("agents", "observation"), r"^'agents.observation' is missing from the data; the policy needs it"),
        ("adjacency", r"^'adjacency' is missing from the data; the policy needs it"),
        ("weight", r"^'weight' is missing from the data; the policy needs it: add it, or give another key$"),
        ("feature", r"^'feature' is missing from the data; the policy needs it"),
        (("agents", "goal"), r"^'agents.goal' is missing from the data; a submodule, under 'own.goal', needs it"),
    ],
)
def test_data_that_are_missing_are_named(missing: str | tuple[str, ...], sentence: str) -> None:
    f_final = TensorDictModule(torch.mul, ["data", ("own", "goal")], ["out"])
    policy = ModGNN(ModGNNLayer(1, f_final=f_final), edge_weight="weight", edge_feature="feature").double()
    data = random_window(STEPS)
    del data[missing]
    with pytest.raises(InputError, match=sentence):
        run(policy, data)


@pytest.mark.parametrize("name", ["weight", "feature"])
def test_a_submodule_cannot_read_what_links_do_not_have(name: str) -> None:
    f_com = TensorDictModule(_Concatenated(FEATURES + 1, 2), ["sender", ("edge", name)], ["y"])
    with pytest.raises(InputError, match=rf"reads \('edge', '{name}'\), but the edges have no {name}; see edge_{name}"):
        run(ModGNN(ModGNNLayer(1, f_com=f_com)).double(), random_window(STEPS))


@pytest.mark.parametrize(
    ("key", "shape", "sentence"),
    [
        ("adjacency", (AGENTS, AGENTS), r"the adjacency has shape \(4, 4\), but .* need leading dimensions \(5,\)"),
        ("weight", (3, AGENTS, AGENTS), r"the edge weight has shape \(3, 4, 4\), .* dimensions \(5,\)"),
        (
            ("agents", "goal"),
            (STEPS, 3, 1),
            r"'goal' \(read under 'own'\) has shape \(5, 3, 1\), .* dimensions \(5, 4\)",
        ),
        ("is_init", (STEPS,), r"the flag that an episode begins has shape \(5,\), .* dimensions \(5, 1\)"),
        ("messages", (STEPS, AGENTS, 2, 2), r"the stored messages has shape .*, .* dimensions \(5, 4, 1\)"),
    ],
)
def test_data_of_another_shape_are_refused(key: str, shape: tuple[int, ...], sentence: str) -> None:
    f_final = TensorDictModule(torch.mul, ["data", ("own", "goal")], ["out"])
    policy = ModGNN(ModGNNLayer(1, f_final=f_final), edge_weight="weight").double()
    data = TensorDict(random_window(STEPS).to_dict(), [])
    data[key] = torch.ones(shape, dtype=torch.bool if key in ("adjacency", "is_init") else torch.float64)
    with pytest.raises(InputError, match=sentence):
        run(policy, data)


@pytest.mark.parametrize("form", ["edges", "dense"])
def test_own_data_may_be_whole_numbers_and_flags(form: str) -> None:
    """Also of an agent that sees nothing, whose data are set to zero."""

    class Roles(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.gain = nn.Embedding(3, FEATURES)

        def forward(self, data: Tensor, role: Tensor, is_leader: Tensor) -> Tensor:
            return data * self.gain(role.squeeze(-1)) * torch.where(is_leader, 2.0, 1.0)

    keys = ["data", ("own", "role"), ("own", "is_leader")]
    f_pre = TensorDictModule(Roles(), keys, ["out"])
    policy = ModGNN(ModGNNLayer(1, f_pre=[None, f_pre]), form=form).double()
    data = random_window(STEPS)
    role, is_leader = torch.randint(3, (STEPS, AGENTS, 1)), torch.rand(STEPS, AGENTS, 1) < 0.5
    data["agents", "role"], data["agents", "is_leader"] = role, is_leader
    observation = data["agents", "observation"]
    observation[2, 0] = torch.nan
    expected = observation.clone()
    for t, i, j in data["adjacency"].nonzero().tolist():
        if t and not observation[t - 1, [i, j]].isnan().any():
            y = observation[t - 1, j] - observation[t - 1, i]
            expected[t, i] += f_pre.module(y, role[t, i], is_leader[t, i])
    torch.testing.assert_close(run(policy, data)[ACTION], expected, equal_nan=True)


# Putting submodules in, sharing and freezing them.


def full_policy() -> ModGNN:
    f_pre, f_mid = [dense(3, 4) for _ in range(3)], [dense(4, 3) for _ in range(3)]
    first = ModGNNLayer(2, dense(FEATURES, 3), nn.Bilinear(3, 3, 3), f_pre, f_mid, dense(3, 2))
    second = ModGNNLayer(1, dense(FEATURES + 2, 3), None, dense(3, 4), dense(4, 3), dense(3, 2))
    policy = ModGNN([first, second]).double()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter *= 2  # so that later hops are felt
    return policy


REPLACED: dict[str, Callable[[], nn.Module]] = {
    "layers.0.f_input": lambda: nn.Linear(FEATURES, 3),
    "layers.0.f_com.1": Adjacency,
    "layers.0.f_pre.2": lambda: nn.Linear(3, 4),
    "layers.1.f_mid.0": lambda: nn.Linear(4, 3),
    "layers.1.f_final": lambda: nn.Linear(3, 2),
}


@pytest.mark.parametrize("name", REPLACED)
def test_one_submodule_is_replaced_by_name(name: str) -> None:
    policy, data, module = full_policy(), random_window(STEPS), REPLACED[name]().double()
    layer, submodule, *hop = name.split(".")[1:]
    before = run(policy, data)[ACTION]
    old = policy.get_submodule(name)
    policy.set_submodule(name, module)
    assert policy.get_submodule(name) is module
    after = run(policy, data)[ACTION]
    assert not torch.allclose(after, before)
    policy.set_submodule(name, old)
    torch.testing.assert_close(run(policy, data)[ACTION], before)
    # As an attribute.
    if hop:
        getattr(policy.layers[int(layer)], submodule)[int(hop[0])] = module
    else:
        setattr(policy.layers[int(layer)], submodule, module)
    torch.testing.assert_close(run(policy, data)[ACTION], after)


def test_one_module_is_set_for_all_hops() -> None:
    policy, data, module = full_policy(), random_window(STEPS), dense(3, 4).double()
    policy.layers[0].f_pre = module  # type: ignore[assignment]
    assert [policy.get_submodule(f"layers.0.f_pre.{hop}") for hop in range(3)] == [module] * 3
    expected = run(policy, data)[ACTION]
    policy.layers[0].f_pre = nn.ModuleList([copy.deepcopy(module) for _ in range(3)])
    torch.testing.assert_close(run(policy, data)[ACTION], expected)
    policy.set_submodule("layers.0.f_pre", module)
    torch.testing.assert_close(run(policy, data)[ACTION], expected)
    policy.layers[0].f_com = None  # type: ignore[assignment]
    assert [type(f_com) for f_com in policy.layers[0].f_com] == [Laplacian, Laplacian]
    policy.layers[0].f_final = None  # type: ignore[assignment]
    assert isinstance(policy.layers[0].f_final, nn.Identity)
    with pytest.raises(InputError, match=r"f_com has 3 modules; hops=2 needs one module, or 2 \(hops 1..2\)"):
        policy.layers[0].f_com = nn.ModuleList([Adjacency() for _ in range(3)])


def test_what_is_shared_is_one_set_of_weights_and_its_gradients_add() -> None:
    """Between hops, between layers, and between two kinds of submodule."""
    shared, other = dense(3, 3), dense(FEATURES, 3)

    def policy(modules: list[nn.Module]) -> ModGNN:
        a, b, c, d, e = modules
        first = ModGNNLayer(1, copy.deepcopy(other), None, [a, b], c, nn.Linear(3, 2))
        second = ModGNNLayer(1, nn.Linear(FEATURES + 2, 3), None, None, [None, d], e)
        return ModGNN([first, second]).double()

    together = policy([shared] * 5)
    separate = policy([copy.deepcopy(shared) for _ in range(5)])
    separate.load_state_dict(together.state_dict())
    size = sum(parameter.numel() for parameter in shared.parameters())
    assert separate.num_parameters == together.num_parameters + 4 * size
    data = random_window(STEPS)
    outputs = [run(policy, data)[ACTION] for policy in (together, separate)]
    torch.testing.assert_close(*outputs)
    for output in outputs:
        output.square().sum().backward()
    names = ["layers.0.f_pre.0", "layers.0.f_pre.1", "layers.0.f_mid.0", "layers.1.f_mid.1", "layers.1.f_final"]
    for place, parameter in shared.named_parameters():
        parts = [separate.get_submodule(name).get_parameter(place).grad for name in names]
        torch.testing.assert_close(parameter.grad, sum(part for part in parts if part is not None))


def test_what_is_frozen_does_not_learn() -> None:
    policy, data = full_policy(), random_window(STEPS)
    policy.get_submodule("layers.0.f_pre.1").requires_grad_(False)
    policy.layers[1].requires_grad_(False)
    before = {name: parameter.detach().clone() for name, parameter in policy.named_parameters()}
    assert policy.num_parameters == sum(p.numel() for p in policy.layers[0].parameters() if p.requires_grad)
    optimiser = torch.optim.SGD(policy.parameters(), lr=0.1)
    run(policy, data)[ACTION].square().sum().backward()
    optimiser.step()
    changed = {name for name, parameter in policy.named_parameters() if not torch.equal(parameter, before[name])}
    frozen = {name for name in before if name.startswith(("layers.0.f_pre.1.", "layers.1."))}
    assert changed == set(before) - frozen


def test_an_f_com_of_its_own_for_each_hop() -> None:
    widths = [3, 4, 6, 2]
    f_com = [nn.Bilinear(3, 3, 4), GraphAttention(4, 6, 2), nn.Bilinear(6, 6, 2)]
    f_mid = [nn.Linear(width, 3) for width in widths]
    layer = ModGNNLayer(3, dense(FEATURES, 3), f_com, f_mid=f_mid).double()
    data = random_window(6)
    action, sent = layer(data["agents", "observation"], data["adjacency"])
    c = layer.f_input(data["agents", "observation"])
    held, total = c, layer.f_mid[0](c)
    for hop in (1, 2, 3):
        before = held.roll(1, 0)
        ends = before.unsqueeze(1).expand(-1, AGENTS, -1, -1), before.unsqueeze(2).expand(-1, -1, AGENTS, -1)
        if hop == 2:  # attention, see its own tests
            topology = Topology(data["adjacency"], AGENTS, form="dense")
            y = f_com[1](*(end.flatten(0, 2) for end in ends), topology.all_edges()).view(6, AGENTS, AGENTS, -1)
        else:
            y = f_com[hop - 1](*(end.contiguous() for end in ends))
        held = torch.where(data["adjacency"].unsqueeze(-1), y, 0.0).sum(2)
        total = total + layer.f_mid[hop](held)
        assert sent.shape == (6, AGENTS, 3, 6)
        if hop < 3:
            torch.testing.assert_close(sent[hop:, :, hop, : widths[hop]], held[hop:])
            assert not sent[hop:, :, hop, widths[hop] :].any()
    torch.testing.assert_close(action[3:], total[3:])


def test_modules_that_work_in_place_spoil_nothing() -> None:
    """Nor what is sent, nor what later layers and keyed submodules read, nor the user's data."""

    def policy(in_place: bool) -> ModGNN:
        def part(inputs: int = FEATURES) -> nn.Module:
            return nn.Sequential(nn.ReLU(in_place), nn.Tanh(), nn.Linear(inputs, FEATURES))

        torch.manual_seed(0)
        keyed = TensorDictModule(torch.mul, ["data", ("own", "observation")], ["out"])
        f_pre = [part(), part(), TensorDictSequential(TensorDictModule(part(), ["data"], ["data"]), keyed)]
        layers = [
            ModGNNLayer(2, part(), None, f_pre, part(), part()),
            ModGNNLayer(1, nn.ReLU(in_place), Adjacency(), nn.ReLU(in_place), nn.ReLU(in_place), nn.ReLU(in_place)),
        ]
        return ModGNN(layers).double()

    data = random_window(2, STEPS)
    results = []
    for in_place in (False, True):
        given = data.clone()
        asked = policy(in_place)
        asked.request(*asked.intermediate_keys)
        with set_recurrent_mode(True), torch.no_grad():
            results.append(asked(given))
        torch.testing.assert_close(given["agents", "observation"], data["agents", "observation"])
    for key in results[0].keys(True, True):
        torch.testing.assert_close(results[1][key], results[0][key], equal_nan=True)
