"""What holds for ModGNN whatever its weights: symmetries, missing data, gradients, keys."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.errors import InputError
from modgnn_rl.nn.communication import Adjacency

STEPS, AGENTS, FEATURES = 5, 6, 3
STARTS = ("mask", "zero", "repeat")


class _Pairwise(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(2 * FEATURES, FEATURES)

    def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
        return self.linear(torch.cat((sender, receiver), -1)).tanh()


def dense(inputs: int = FEATURES, outputs: int = FEATURES) -> nn.Module:
    return nn.Sequential(nn.Linear(inputs, 4), nn.Tanh(), nn.Linear(4, outputs))


def make_layer(hops: int = 2, start: str = "mask", inputs: int = FEATURES) -> ModGNNLayer:
    f_pre, f_mid = ([dense() for _ in range(hops + 1)] for _ in range(2))
    return ModGNNLayer(hops, dense(inputs), _Pairwise(), f_pre, f_mid, dense(), start=start).double()


def random_graph(*batch: int, agents: int = AGENTS) -> Tensor:
    return (torch.rand(*batch, agents, agents) < 0.5) & ~torch.eye(agents, dtype=torch.bool)


def random_data(*batch: int, agents: int = AGENTS) -> tuple[Tensor, Tensor]:
    return torch.randn(*batch, agents, FEATURES, dtype=torch.float64), random_graph(*batch, agents=agents)


def as_window(observation: Tensor, adjacency: Tensor) -> TensorDict:
    return TensorDict({"agents": {"observation": observation}, "adjacency": adjacency}, observation.shape[:-2])


def actions(policy: nn.Module, observation: Tensor, adjacency: Tensor) -> Tensor:
    with set_recurrent_mode(True):
        return policy(as_window(observation, adjacency))["agents", "action"]


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


# Symmetries.


@given(order=st.permutations(range(AGENTS)), start=st.sampled_from(STARTS))
@torch.no_grad()
def test_renumbering_the_agents_renumbers_their_actions(order: list[int], start: str) -> None:
    layer = make_layer(start=start)
    observation, adjacency = random_data(STEPS)
    action, messages = layer(observation, adjacency)
    permuted = layer(observation[:, order], adjacency[:, order][:, :, order])
    torch.testing.assert_close(permuted[0], action[:, order])
    torch.testing.assert_close(permuted[1], messages[:, order], equal_nan=True)


@torch.no_grad()
def test_differences_do_not_feel_a_translation() -> None:
    layer = ModGNNLayer(3)
    observation, adjacency = random_data(STEPS)
    shift = torch.tensor([10.0, -3.0, 0.5], dtype=torch.float64)
    # Hop 0 is the observation itself.
    torch.testing.assert_close(layer(observation + shift, adjacency)[0], layer(observation, adjacency)[0] + shift)
    incoming = ModGNNLayer(3, f_com=Adjacency())
    assert not torch.allclose(incoming(observation + shift, adjacency)[0], incoming(observation, adjacency)[0] + shift)


@pytest.mark.parametrize("f_com", [None, Adjacency()])
@torch.no_grad()
def test_without_modules_hops_are_products_of_shift_operators(f_com: nn.Module | None) -> None:
    observation, adjacency = random_data(STEPS)
    shift = adjacency.double()
    if f_com is None:
        shift = shift - torch.diag_embed(shift.sum(-1))
    expected = observation[-1].clone()
    product = torch.eye(AGENTS, dtype=torch.float64)
    for hop in (1, 2, 3):
        product = product @ shift[-hop]
        expected += product @ observation[-1 - hop]
    torch.testing.assert_close(ModGNNLayer(3, f_com=f_com)(observation, adjacency)[0][-1], expected)


@torch.no_grad()
def test_only_links_carry_information_one_step_a_hop() -> None:
    layer = make_layer(hops=2)
    observation, _ = random_data(6)
    chain = torch.diag(torch.ones(AGENTS - 1), -1).bool().expand(6, -1, -1)  # agent i hears agent i - 1
    changed = observation.clone()
    changed[1, 2] += 1.0
    differs = (layer(observation, chain)[0] != layer(changed, chain)[0]).any(-1)
    # What agent 2 sees at step 1 is heard at step 2, and two links on at step 3. Agents 2 and 3 also compare it with
    # their own, and at step 3 with what they themselves sent.
    assert differs.nonzero().tolist() == [[1, 2], [2, 2], [2, 3], [3, 2], [3, 3], [3, 4]]


# Missing data.


@torch.no_grad()
def test_an_agent_that_saw_nan_is_not_heard_and_starts_again() -> None:
    layer = make_layer(hops=1)
    observation, adjacency = random_data(STEPS)
    sick = observation.clone()
    sick[2, 0, 1] = torch.nan
    action = layer(sick, adjacency)[0]
    silent = adjacency.clone()
    silent[3, :, 0] = False
    expected = layer(observation, silent)[0]
    torch.testing.assert_close(action[:, 1:], expected[:, 1:])
    fresh = layer(observation[3:], adjacency[3:])[0][0, 0]
    torch.testing.assert_close(action[3, 0], fresh)
    assert action[2, 0].isnan().all()
    torch.testing.assert_close(action[4], expected[4])


@pytest.mark.parametrize("start", ["mask", "zero"])
@torch.no_grad()
def test_nan_of_one_agent_leaves_all_others_finite(start: str) -> None:
    policy = ModGNN([make_layer(2, start), make_layer(2, start, inputs=2 * FEATURES)])
    observation, adjacency = random_data(8, agents=5)
    observation[[0, 3], 0] = torch.nan
    action = actions(policy, observation, adjacency)
    assert action[:, 1:].isfinite().all()
    assert action.isfinite().all(-1)[:, 0].tolist() == [False, True, True, False, True, True, True, True]


@pytest.mark.parametrize("start", STARTS)
@torch.no_grad()
def test_nan_of_an_isolated_agent_reaches_no_other_agent(start: str) -> None:
    layer = make_layer(2, start)
    observation, adjacency = random_data(STEPS)
    adjacency[:, :, 0] = adjacency[:, 0] = False
    sick = observation.clone()
    sick[:, 0] = torch.nan
    assert torch.equal(layer(sick, adjacency)[0][:, 1:], layer(observation, adjacency)[0][:, 1:])


@torch.no_grad()
def test_a_stored_message_of_nan_is_a_message_not_held() -> None:
    layer = make_layer(2)
    observation, adjacency = random_data(1)
    continues = torch.zeros(1, dtype=torch.bool)
    stored = torch.randn(AGENTS, 2, FEATURES, dtype=torch.float64)
    stored[0] = torch.nan  # agent 0 has just rebooted
    silent = adjacency.clone()
    silent[:, :, 0] = False
    action, sent = layer(observation, adjacency, continues, stored)
    expected, sent_then = layer(observation, silent, continues, stored.nan_to_num())
    torch.testing.assert_close(action[0, 1:], expected[0, 1:])
    torch.testing.assert_close(sent[0, 1:], sent_then[0, 1:])
    torch.testing.assert_close(action[0, 0], layer(observation, adjacency)[0][0, 0])
    assert sent[0, 0].isnan().any(-1).tolist() == [False, True]


@torch.no_grad()
def test_hops_that_the_episode_is_too_young_for_add_nothing() -> None:
    observation, adjacency = random_data(STEPS)
    long, short = make_layer(3), make_layer(1)
    long.load_state_dict(short.state_dict(), strict=False)
    action = long(observation, adjacency)[0]
    torch.testing.assert_close(action[:2], short(observation, adjacency)[0][:2])
    assert not torch.allclose(action[2], short(observation, adjacency)[0][2])


@torch.no_grad()
def test_a_lone_agent_hears_an_empty_sum() -> None:
    layer = make_layer(hops=1)
    observation, adjacency = random_data(3, agents=1)
    data, nothing = layer.f_input(observation), torch.zeros(3, 1, FEATURES, dtype=torch.float64)
    young = layer.f_mid[0](layer.f_pre[0](data))
    old = young + layer.f_mid[1](nothing)
    expected = layer.f_final(torch.cat((young[:1], old[1:])))
    torch.testing.assert_close(layer(observation, adjacency)[0], expected)


# Gradients.


@pytest.mark.parametrize("start", STARTS)
def test_gradients_are_exact_across_the_start_of_an_episode(start: str) -> None:
    layer = make_layer(2, start)
    observation, adjacency = random_data(2, 4, agents=3)
    is_init = torch.zeros(2, 4, dtype=torch.bool)
    is_init[0, 2] = True
    stored = torch.randn(2, 3, 2, FEATURES, dtype=torch.float64)

    def outputs(observation: Tensor, stored: Tensor, *_: Tensor) -> Tensor:
        return layer(observation, adjacency, is_init, stored)[0]

    inputs = (observation.requires_grad_(), stored.requires_grad_(), *layer.parameters())
    assert torch.autograd.gradcheck(outputs, inputs, fast_mode=True)


def test_gradients_reach_every_parameter_of_two_layers() -> None:
    policy = ModGNN([make_layer(2), make_layer(1, inputs=2 * FEATURES)])
    actions(policy, *random_data(2, STEPS)).square().sum().backward()
    for name, parameter in policy.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.abs().max() > 0, name


# Some receivers only.


@given(hops=st.integers(0, 3), start=st.sampled_from(STARTS), share=st.sampled_from([0.0, 0.3, 1.0]))
def test_the_outputs_of_some_receivers_are_those_of_all(hops: int, start: str, share: float) -> None:
    layer = make_layer(hops, start)
    observation, adjacency = random_data(2, STEPS)
    wanted = torch.rand(2, STEPS, AGENTS) < share
    expected, messages = layer(observation.requires_grad_(), adjacency)
    some, same_messages = layer(observation, adjacency, receivers=wanted)
    torch.testing.assert_close(some, expected * wanted.unsqueeze(-1))
    torch.testing.assert_close(same_messages, messages, equal_nan=True)
    parameters = [observation, *layer.parameters()]
    theirs, ours = (
        torch.autograd.grad(output[wanted].square().sum(), parameters, materialize_grads=True)
        for output in (expected, some)
    )
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("recurrent", [True, False])
@torch.no_grad()
def test_some_receivers_of_a_policy_with_keys_and_two_layers(recurrent: bool) -> None:
    def own(factor: str) -> nn.Module:
        return TensorDictModule(torch.mul, ["data", ("own", factor)], ["data"])

    first = ModGNNLayer(1, f_pre=own("load"), f_final=own("load"))
    second = ModGNNLayer(2, dense(2 * FEATURES), f_pre=own("observation"), f_mid=own("load"), f_final=own("load"))
    policy = ModGNN([first, second]).double()
    data = as_window(*random_data(2, STEPS))
    data["agents", "load"] = torch.rand(2, STEPS, AGENTS, 1, dtype=torch.float64)
    data["is_init"] = torch.zeros(2, STEPS, 1, dtype=torch.bool)
    data["messages"] = torch.randn(2, STEPS, AGENTS, 3, FEATURES, dtype=torch.float64)
    wanted = torch.rand(2, STEPS, AGENTS) < 0.4
    with set_recurrent_mode(recurrent):
        expected, some = policy(data.clone()), policy(data.clone(), wanted)
    action = ("agents", "action")
    torch.testing.assert_close(some[action], expected[action] * wanted.unsqueeze(-1))
    first, later = some["next", "messages"].split((1, 2), -2)
    all_first, all_later = expected["next", "messages"].split((1, 2), -2)
    torch.testing.assert_close(first, all_first)
    made = later.isfinite()
    assert made.all() or recurrent  # in a window, of later layers only what the wanted actions depend on
    torch.testing.assert_close(later[made], all_later[made])


@given(hops=st.lists(st.integers(0, 2), min_size=2, max_size=3), seed=st.integers(0, 99))
def test_layers_make_only_what_the_wanted_actions_depend_on(hops: list[int], seed: int) -> None:
    torch.manual_seed(seed)
    policy = ModGNN([make_layer(k, inputs=(1 + index) * FEATURES) for index, k in enumerate(hops)])
    policy.request("layers.0.f_final")
    data = as_window(*random_data(2, STEPS))
    data["adjacency"] = torch.ones(2, STEPS, AGENTS, AGENTS, dtype=torch.bool)
    wanted = torch.zeros(2, STEPS, AGENTS, dtype=torch.bool)
    wanted[0, -1, 2] = True
    with set_recurrent_mode(True):
        out, whole = policy(data.clone(), wanted), policy(data.clone())
        torch.testing.assert_close(out["agents", "action"][wanted], whole["agents", "action"][wanted])
    made = out["layers", "0", "f_final"].any(-1)
    depth = sum(hops[1:])
    assert not made[1].any()
    assert made[0].any(-1).tolist() == [STEPS - 1 - t <= depth for t in range(STEPS)]
    assert made[0, -1].nonzero().tolist() == [[2]]


# Modules and keys.


@torch.no_grad()
def test_one_module_for_all_hops_is_a_list_of_it() -> None:
    f_pre, f_mid = dense(), dense()
    one = ModGNNLayer(2, f_pre=f_pre, f_mid=f_mid).double()
    listed = ModGNNLayer(2, f_pre=[f_pre] * 3, f_mid=[f_mid] * 3).double()
    separate = ModGNNLayer(2, f_pre=[copy.deepcopy(f_pre) for _ in range(3)], f_mid=[f_mid] * 3).double()
    observation, adjacency = random_data(STEPS)
    for other in (listed, separate):
        torch.testing.assert_close(other(observation, adjacency), one(observation, adjacency), equal_nan=True)
    shared_size, separate_size = (sum(p.numel() for p in layer.parameters()) for layer in (listed, separate))
    assert separate_size == 2 * shared_size


@pytest.mark.parametrize("name", ["f_pre", "f_mid"])
@pytest.mark.parametrize("count", [0, 2, 4])
def test_a_list_of_the_wrong_length_is_refused(name: str, count: int) -> None:
    modules: dict[str, Sequence[nn.Module]] = {name: [dense() for _ in range(count)]}
    with pytest.raises(InputError, match=rf"{name} has {count} modules; hops=2 needs one module, or 3"):
        ModGNNLayer(2, **modules)  # type: ignore[arg-type]


@pytest.mark.parametrize("hops", [-1, 1.5, "2", None])
def test_hops_must_be_counted(hops: int) -> None:
    with pytest.raises(InputError, match="hops="):
        ModGNNLayer(hops)


def test_an_unknown_start_is_refused() -> None:
    with pytest.raises(InputError, match="start='none' is not one of mask, zero, repeat"):
        ModGNNLayer(1, start="none")


def test_plain_data_hold_no_trace_of_parameters() -> None:
    assert ModGNN(ModGNNLayer(1, f_pre=dense(), f_final=dense())).sends_plain_data
    assert not ModGNN(ModGNNLayer(1, f_input=dense())).sends_plain_data
    assert ModGNN(ModGNNLayer(1, f_com=_Pairwise())).sends_plain_data  # what it makes of messages is not sent on
    assert not ModGNN(ModGNNLayer(2, f_com=_Pairwise())).sends_plain_data
    assert not ModGNN(ModGNNLayer(2, aggregation="max")).sends_plain_data
    assert ModGNN([ModGNNLayer(1), ModGNNLayer(1, f_pre=dense())]).sends_plain_data
    assert not ModGNN([ModGNNLayer(1, f_pre=dense()), ModGNNLayer(1)]).sends_plain_data


def keyed_policy(**keys: object) -> ModGNN:
    f_pre = TensorDictSequential(
        TensorDictModule(dense(), ["data"], ["hidden"]),
        TensorDictModule(torch.mul, ["hidden", ("own", "observation")], ["product"]),
        TensorDictModule(torch.mul, ["product", ("own", "load")], ["result"]),
    ).select_out_keys("result")
    return ModGNN(ModGNNLayer(1, f_pre=f_pre), **keys).double()  # type: ignore[arg-type]


@torch.no_grad()
def test_keys_can_be_renamed() -> None:
    policy, renamed = (
        keyed_policy(**keys)
        for keys in (
            {},
            {
                "observation": ("flock", "state"),
                "adjacency": ("flock", "graph"),
                "is_init": "begins",
                "messages": "memory",
                "mask": ("flock", "exists"),
                "action": "u",
            },
        )
    )
    renamed.load_state_dict(policy.state_dict())
    observation, adjacency = random_data(2, STEPS)
    load = torch.rand(2, STEPS, AGENTS, 1, dtype=torch.float64)
    begins, batch = torch.rand(2, STEPS, 1) < 0.3, (2, STEPS)
    memory = torch.randn(2, STEPS, AGENTS, 1, FEATURES, dtype=torch.float64)
    data = as_window(observation, adjacency).set(("agents", "load"), load)
    data = data.set("is_init", begins).set("messages", memory)
    flock = {"state": observation, "graph": adjacency, "load": load}
    other = TensorDict({"flock": flock, "begins": begins, "memory": memory}, batch)
    with set_recurrent_mode(True):
        expected, out = policy(data), renamed(other)
    torch.testing.assert_close(out["u"], expected["agents", "action"])
    torch.testing.assert_close(out["next", "memory"], expected["next", "messages"], equal_nan=True)
    keys = {("flock", "state"), ("flock", "graph"), "begins", "memory", ("flock", "exists"), ("flock", "load")}
    assert set(renamed.in_keys) == keys
    assert renamed.out_keys == ["u", ("next", "memory")]


@torch.no_grad()
def test_the_batch_size_of_the_data_is_of_no_account() -> None:
    policy = ModGNN(make_layer())
    observation, adjacency = random_data(2, STEPS)
    data = as_window(observation, adjacency)
    data["is_init"] = torch.rand(2, STEPS, 1) < 0.3
    data["messages"] = torch.randn(2, STEPS, AGENTS, 2, FEATURES, dtype=torch.float64)
    for recurrent in (True, False):
        with set_recurrent_mode(recurrent):
            expected = policy(data.clone())["agents", "action"]
            for batch in ((), (2,)):
                loose = TensorDict(data.to_dict(), batch)
                torch.testing.assert_close(policy(loose)["agents", "action"], expected)


@torch.no_grad()
def test_copies_are_independent_and_equal() -> None:
    policy = ModGNN([make_layer(2), make_layer(1, inputs=2 * FEATURES)])
    data = random_data(STEPS)
    expected = actions(policy, *data)
    copied, pickled = copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))
    loaded = ModGNN([make_layer(2), make_layer(1, inputs=2 * FEATURES)])
    assert not torch.allclose(actions(loaded, *data), expected)
    loaded.load_state_dict(policy.state_dict())
    for parameter in policy.parameters():
        parameter.zero_()
    for other in (copied, pickled, loaded):
        assert torch.equal(actions(other, *data), expected)
    assert actions(copied.float(), data[0].float(), data[1]).dtype == torch.float32


def test_an_f_com_may_change_the_width_between_hops() -> None:
    class Both(nn.Module):
        def forward(self, sender: Tensor, receiver: Tensor) -> Tensor:
            return torch.cat((sender, receiver), -1)

    observation, adjacency = torch.randn(4, 3, 2), torch.ones(4, 3, 3)
    f_mid = [nn.Linear(width, 2) for width in (2, 4, 8)]
    output, sent = ModGNNLayer(2, f_com=Both(), f_mid=f_mid)(observation, adjacency)
    assert output.shape == (4, 3, 2)
    assert sent.shape == (4, 3, 2, 4)
    assert not sent[:, :, 0, 2:].any()
