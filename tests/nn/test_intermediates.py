"""Intermediate results by key, against a computation by hand in dense tensors."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn

from modgnn_rl import ModGNN, ModGNNLayer
from modgnn_rl.errors import InputError
from tests.nn.helpers import dense, random_window, run

FEATURES, AGENTS, STEPS = 2, 4, 5
ACTION = ("agents", "action")


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def full_policy() -> ModGNN:
    f_pre, f_mid = [dense(3, 4) for _ in range(3)], [dense(4, 3) for _ in range(3)]
    first = ModGNNLayer(2, dense(FEATURES, 3), nn.Bilinear(3, 3, 3), f_pre, f_mid, dense(3, 2))
    second = ModGNNLayer(1, dense(FEATURES + 2, 3), None, dense(3, 4), dense(4, 3), dense(3, 2))
    policy = ModGNN([first, second]).double()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter *= 2  # so that later hops are felt
    return policy


def by_hand(layer: ModGNNLayer, seen: Tensor, adjacency: Tensor, exists: Tensor) -> dict[tuple[str, ...], Tensor]:
    """All that a layer computes in one flock's window [T], in dense tensors, for agents that always or never exist."""
    there = exists.unsqueeze(-1)
    c = torch.where(there, layer.f_input(seen), 0.0)
    linked = (adjacency & exists.unsqueeze(-1) & exists.unsqueeze(-2)).unsqueeze(-1)
    found: dict[tuple[str, ...], Tensor] = {("f_input",): c}
    held, processed, total = c, torch.where(there, layer.f_pre[0](c), 0.0), torch.zeros(())
    young = torch.arange(len(seen)).view(-1, 1, 1)
    for hop in range(layer.hops + 1):
        old = there & (young >= hop)
        if hop:
            found["messages", str(hop - 1)] = torch.where(there & (young >= hop - 1), held, torch.nan)
            before = held.roll(1, 0)
            ends = before.unsqueeze(1).expand(-1, AGENTS, -1, -1), before.unsqueeze(2).expand(-1, -1, AGENTS, -1)
            lively = linked & (young >= hop).unsqueeze(-1)
            y = torch.where(lively, layer.f_com[hop - 1](*(end.contiguous() for end in ends)), 0.0)
            found["f_com", str(hop)] = y
            found["f_pre", str(hop)] = torch.where(lively, layer.f_pre[hop](y), 0.0)
            held, processed = y.sum(2), found["f_pre", str(hop)].sum(2)
        else:
            found["f_pre", "0"] = processed
        found["sum", str(hop)] = processed
        found["f_mid", str(hop)] = torch.where(old, layer.f_mid[hop](processed), 0.0)
        total = total + found["f_mid", str(hop)]
    found["f_final",] = torch.where(there, layer.f_final(total), 0.0)
    return found


def all_by_hand(policy: ModGNN, data: TensorDict) -> dict[tuple[str, ...], Tensor]:
    """All that the layers compute in a window [T]."""
    seen, found = data["agents", "observation"], {}
    exists = data.get(("agents", "mask"), torch.ones(seen.shape[:-1], dtype=torch.bool))
    for number, layer in enumerate(policy.layers):
        results = by_hand(layer, seen, data["adjacency"], exists)
        found.update({("layers", str(number), *key): value for key, value in results.items()})
        seen = torch.cat((seen, results["f_final",]), -1)
    return found


@settings(max_examples=20)
@given(
    form=st.sampled_from(["auto", "edges", "dense"]),
    batch=st.lists(st.integers(1, 2), max_size=2),
    masked=st.booleans(),
    some=st.booleans(),
    listed=st.booleans(),
    seed=st.integers(0, 99),
)
@torch.no_grad()
def test_intermediate_results_are_those_computed_by_hand(
    form: str, batch: list[int], masked: bool, some: bool, listed: bool, seed: int
) -> None:
    torch.manual_seed(seed)
    policy, data = full_policy(), random_window(*batch, STEPS)
    policy.form = form
    if masked:
        exists = torch.rand(*batch, 1, AGENTS) < 0.6
        data["agents", "mask"] = exists.expand(*batch, STEPS, -1)
    wanted = torch.rand(*batch, STEPS, AGENTS) < (0.2 if some else 1.1)
    needed = wanted.clone()  # of the first layer: by whoever acts now, and one step later by its neighbours
    needed[..., :-1, :] |= wanted[..., 1:, :].any(-1, keepdim=True)
    flocks = data.reshape(-1, STEPS)
    expected = [all_by_hand(policy, flock) for flock in flocks]
    names = policy.intermediate_keys
    stacked = {name: torch.stack([found[name] for found in expected]) for name in names}
    places = None
    if listed:
        places = data["adjacency"].flatten(0, -2).flatten().nonzero().squeeze(-1)
        edges = [graph.nonzero().flip(-1).T for graph in flocks["adjacency"].flatten(0, 1)]
        length = max(graph.shape[1] for graph in edges)
        lists = torch.stack([nn.functional.pad(graph, (0, length - graph.shape[1]), value=-1) for graph in edges])
        data["adjacency"] = lists.view(*batch, STEPS, 2, length)
    receivers = [wanted] if some else []
    plain = run(policy, data, *receivers)
    out = run(policy.request(*names), data, *receivers)
    torch.testing.assert_close(out[ACTION], plain[ACTION])
    torch.testing.assert_close(out["next"], plain["next"], equal_nan=True)
    for name in names:
        value, theirs = out[name], stacked[name].reshape(*batch, *stacked[name].shape[1:])
        made = wanted if name[1] == "1" else needed
        if name[2] in ("f_input", "messages"):
            made = needed if name[1] == "1" else torch.ones_like(wanted)
            value, theirs = value[made], theirs[made]
        else:
            theirs = theirs * made.view(*made.shape, *[1] * (theirs.ndim - made.ndim))
        if places is not None and theirs.ndim == len(batch) + 4:
            filled = data["adjacency"][..., 0, :] >= 0
            assert not value[~filled].any()
            value, theirs = value[filled], theirs.flatten(0, -2)[places]
        torch.testing.assert_close(value, theirs, equal_nan=True)


@torch.no_grad()
def test_intermediate_results_of_single_steps_are_those_of_the_window() -> None:
    policy, data = full_policy(), random_window(STEPS)
    names = policy.intermediate_keys
    whole = run(policy.request(*names), data)
    memory = torch.full((AGENTS, 3, 4), torch.nan, dtype=torch.float64)
    for t in range(STEPS):
        step = data[t].clone().set("messages", memory).set("is_init", torch.tensor([t == 0]))
        policy(step)
        memory = step["next", "messages"]
        for name in names:
            torch.testing.assert_close(step[name], whole[name][t], equal_nan=True)


def test_intermediate_results_are_asked_for_by_key() -> None:
    policy, data = full_policy(), random_window(STEPS)
    before = set(run(policy, data).keys(True, True))
    out_keys = list(policy.out_keys)
    assert before == {*data.keys(True, True), ACTION, ("next", "messages")}
    assert policy.request("layers.0.f_com.1", ("layers", "1", "sum", "0")) is policy
    assert policy.out_keys == [*out_keys, ("layers", "0", "f_com", "1"), ("layers", "1", "sum", "0")]
    asked = run(policy, data)
    assert set(asked.keys(True, True)) == before | set(policy.out_keys)
    assert asked["layers", "0", "f_com", "1"].requires_grad  # a loss may use it
    policy.request("layers.0.f_final", rename={"layers.0.f_final": ("agents", "embedding")})
    renamed = run(policy, data)
    assert set(renamed.keys(True, True)) == before | {("agents", "embedding")}
    policy.request(("layers", "0", "f_final"), rename={("layers", "0", "f_final"): "embedding"})
    torch.testing.assert_close(run(policy, data)["embedding"], renamed["agents", "embedding"])
    policy.request()
    assert policy.out_keys == out_keys
    assert set(run(policy, data).keys(True, True)) == before
    with pytest.raises(
        InputError, match=r"'layers.0.f_con.1' is not an intermediate .*; did you mean 'layers.0.f_com.1'\?"
    ):
        policy.request("layers.0.f_con.1")
    with pytest.raises(InputError, match=r"'layers.1.f_com.2' is not an intermediate result of this policy"):
        policy.request("layers.1.f_com.2")
    with pytest.raises(InputError, match=r"'layers.0.f_finall' is renamed but not requested; did you mean"):
        policy.request("layers.0.f_final", rename={"layers.0.f_finall": "embedding"})
