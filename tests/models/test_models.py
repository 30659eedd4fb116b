"""The models: what they promise about actions, symmetries and weights."""

from __future__ import annotations

import re
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode

from modgnn_rl import load_policy
from modgnn_rl.actions import Ball
from modgnn_rl.configs.schema import (
    DAggerConfig,
    EvaluationConfig,
    FlockingConfig,
    ModelConfig,
    TrainConfig,
)
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.errors import InputError
from modgnn_rl.experiment.training import train
from modgnn_rl.models.blocks import LayerSpec, Scale
from modgnn_rl.models.equivariant import PairForce, VectorSquash
from modgnn_rl.models.factory import configured_model, make_model
from modgnn_rl.nn.modgnn import ModGNN, ModGNNLayer
from modgnn_rl.registry import MODELS

seeds = st.integers(0, 999)
local_models = pytest.mark.parametrize("name", [name for name in MODELS if name != "central"])
# A name, and a number of layers.
CASES = [(name, layers) for name in MODELS for layers in ((1,) if name == "central" else (1, 2))]
models = pytest.mark.parametrize(("name", "layers"), CASES, ids=[f"{name}-{layers}" for name, layers in CASES])


def build(name: str, hops: int = 2, agents: int = 5, **options: Any) -> ModGNN:
    return make_model(name, hops, num_agents=agents, **options)


def rollout(seed: int, agents: int = 5, steps: int = 4) -> tuple[Tensor, Tensor]:
    """Observations of two flocks, float64 [2, T, N, 6], and links within 2 m, some of them one-way."""
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(2, steps, agents, 6, dtype=torch.float64, generator=generator)
    adjacency = torch.rand(2, steps, agents, agents, generator=generator) < 0.7
    return observation, adjacency & ~torch.eye(agents, dtype=torch.bool)


def act(policy: ModGNN, observation: Tensor, adjacency: Tensor) -> Tensor:
    batch = observation.shape[:2]
    window = TensorDict({"agents": {"observation": observation}, "adjacency": adjacency}, batch)
    with set_recurrent_mode(True):
        return policy(window)["agents", "action"]


def random_rotation(seed: int, determinant: int) -> Tensor:
    matrix = torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    orthogonal = torch.linalg.qr(matrix)[0]
    return orthogonal if orthogonal.det().sign() == determinant else -orthogonal


@models
@settings(max_examples=10)
@given(seed=seeds, scale=st.sampled_from([0.0, 1.0, 1e3]))
@torch.no_grad()
def test_actions_stay_in_the_ball(name: str, layers: int, seed: int, scale: float) -> None:
    policy = build(name, layers=layers, head=Ball(0.7, 3), seed=seed).double()
    observation, adjacency = rollout(seed)
    speed = act(policy, scale * observation, adjacency).norm(dim=-1)
    assert speed.isfinite().all()
    assert speed.max() <= 0.7 * (1 + 1e-12)
    if scale > 1 and name == "gcn":
        assert speed.max() > 0.69


@models
@settings(max_examples=10)
@given(seed=seeds)
@torch.no_grad()
def test_absolute_position_is_hidden(name: str, layers: int, seed: int) -> None:
    policy = build(name, layers=layers, seed=seed).double()
    is_hidden = name != "modgnn_adjacency"  # its communication forms no differences
    observation, adjacency = rollout(seed)
    shift = torch.tensor([20.0, -7.0, 3.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    expected = act(policy, observation, adjacency)
    moved = act(policy, observation + shift, adjacency)
    assert torch.allclose(moved, expected, rtol=1e-7, atol=1e-7) == is_hidden
    assert not torch.allclose(act(policy, observation + shift.roll(3), adjacency), expected)  # its velocity is not


@settings(max_examples=40)
@given(seed=seeds, hops=st.integers(1, 3), layers=st.integers(1, 3), determinant=st.sampled_from([1, -1]))
@torch.no_grad()
def test_pair_force_turns_with_the_world(seed: int, hops: int, layers: int, determinant: int) -> None:
    policy = make_model("pair_force", hops, seed=seed, head=Ball(1e3, 3), layers=layers).double()
    observation, adjacency = rollout(seed)
    rotation = random_rotation(seed, determinant)
    turned = (observation.unflatten(-1, (2, 3)) @ rotation).flatten(-2)
    action = act(policy, observation, adjacency)
    assert action[:, hops:].abs().max() > 1e-3
    torch.testing.assert_close(act(policy, turned, adjacency), action @ rotation)


@local_models
@torch.no_grad()
def test_agents_are_interchangeable_and_of_any_number(name: str) -> None:
    policy = make_model(name, hops=1, seed=3).double()
    for agents in (1, 2, 9):
        observation, adjacency = rollout(0, agents)
        order = torch.arange(agents - 1, -1, -1)
        action = act(policy, observation, adjacency)
        assert action.shape == (2, 4, agents, 3)
        permuted = act(policy, observation[:, :, order], adjacency[:, :, order][..., order])
        torch.testing.assert_close(permuted, action[:, :, order])


@local_models
@torch.no_grad()
def test_an_agent_without_neighbours_knows_its_own_velocity_only(name: str) -> None:
    policy = make_model(name, hops=1, seed=0).double()
    observation, _ = rollout(0)
    alone = torch.zeros(2, 4, 5, 5, dtype=torch.bool)
    action = act(policy, observation, alone)
    if name == "pair_force":
        assert not action.any()
    else:
        moved = torch.cat((torch.randn(2, 4, 5, 3, dtype=torch.float64), observation[..., 3:]), -1)
        torch.testing.assert_close(act(policy, moved, alone), action)


@models
@pytest.mark.parametrize("case", ["coincident", "at rest", "both"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_where_lengths_vanish(name: str, layers: int, case: str, dtype: torch.dtype) -> None:
    policy = build(name, layers=layers, seed=0).to(dtype)
    observation, adjacency = rollout(0)
    if case != "at rest":
        observation[..., 1, :3] = observation[..., 0, :3]
    if case != "coincident":
        observation[..., 3:] = 0.0
    observation = observation.to(dtype).requires_grad_()
    action = act(policy, observation, adjacency)
    (action - 0.1).square().sum().backward()
    gradients = [observation.grad, *(parameter.grad for parameter in policy.parameters())]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)


@models
def test_gradients_reach_every_parameter(name: str, layers: int) -> None:
    policy = build(name, layers=layers, seed=0, head=Ball(100.0, 3)).double()
    act(policy, *rollout(0, steps=6)).square().sum().backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in policy.parameters())


@pytest.mark.parametrize(("hops", "hidden"), [(1, 32), (3, 8)])
def test_counts_of_parameters(hops: int, hidden: int) -> None:
    def mlp(inputs: int, outputs: int, hidden: int = hidden) -> int:
        return (inputs + 1) * hidden + (hidden + 1) * hidden + (hidden + 1) * outputs

    final = mlp(10, 3)
    attention = 6 * hidden + hidden  # of differences: one matrix, one score for each of its outputs
    later_attention = 2 * hidden * hidden + 2 * hidden
    expected = {
        "modgnn_mlp": (hops + 1) * (mlp(6, 10) + mlp(10, 10)) + final,
        "modgnn_adjacency": (hops + 1) * (mlp(6, 10) + mlp(10, 10)) + final,
        "no_pre": (hops + 1) * mlp(6, 10) + final,
        "no_mid": (hops + 1) * mlp(6, 10) + final,
        "gcn": (hops + 1) * 6 * 3 + 3,
        "gcn_final": (hops + 1) * 6 * 10 + 10 + final,
        "central": (5 * 6 + 1) * hidden + 2 * (hidden + 1) * hidden + (hidden + 1) * 5 * 3,
        "gat": attention + (hops - 1) * later_attention + mlp(6, 10) + hops * mlp(hidden, 10) + final,
        "mpnn": mlp(9, hidden) + (hops - 1) * mlp(2 * hidden, hidden) + mlp(6, 10) + hops * mlp(hidden, 10) + final,
        "pair_force": hops * mlp(7, 3),
        "moment_force": hops * mlp(53, 13),  # of ten vectors and six scalars, sender's and receiver's, beside those
    }
    assert {name: build(name, hops, hidden=hidden).num_parameters for name in MODELS} == expected


def test_the_table_of_models_in_the_documentation_is_true() -> None:
    page = (Path(__file__).parents[2] / "docs" / "modgnn.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)`(, two layers)? \|[^|]*\| ([\d,]+) \| ([\d,]+) \| ([\d,]+) \|$", page, re.MULTILINE)
    assert {name for name, *_ in rows} == set(MODELS)
    for name, two_layers, *counts in rows:
        models = [make_model(name, hops, layers=2 if two_layers else None, num_agents=32) for hops in (1, 2, 3)]
        assert [f"{model.num_parameters:,}" for model in models] == counts, name


def test_the_default_model_of_the_flocking_task_is_listed_first() -> None:
    assert next(iter(MODELS)) == FlockingTask.default_model
    assert ModelConfig().name is None  # the task decides


def shared_hops(spec: LayerSpec) -> ModGNNLayer:
    return ModGNNLayer(spec.hops, f_pre=Scale(), f_mid=nn.Linear(6, 4), f_final=spec.end(nn.Linear(4, spec.outputs)))


@pytest.fixture
def clean_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget what a test registers."""
    monkeypatch.setattr(MODELS, "_added", dict(MODELS._added))


def test_a_registered_model_is_trained_and_loaded_by_its_name(clean_registry: None, tmp_path: Path) -> None:
    MODELS.register("shared_hops")(shared_hops)
    MODELS.register("shared_hops")(shared_hops)  # as when a notebook cell is run again
    assert make_model("shared_hops", hops=3).num_parameters == make_model("shared_hops").num_parameters
    run = train(
        TrainConfig(
            env=FlockingConfig(num_agents=4),
            model=ModelConfig(name="shared_hops"),
            trainer=DAggerConfig(rounds=1, num_envs=2, cloning_steps=10, cloning_updates=2, updates_per_round=2),
            evaluation=EvaluationConfig(num_flocks=2, steps=4),
            runs=str(tmp_path),
        )
    )
    assert load_policy(run.path).layers[0].hops == 1
    with pytest.raises(InputError, match="model 'gcn' is built in; choose another name"):
        MODELS.register("gcn")(shared_hops)


def test_the_number_of_layers_may_be_registered_with_a_model(clean_registry: None) -> None:
    MODELS.register("two_layers", layers=2)(shared_hops)
    assert [len(make_model("two_layers", hops=0, layers=layers).layers) for layers in (None, 1)] == [2, 1]
    assert len(make_model("moment_force").layers) == 2


def test_an_installed_package_provides_models(clean_registry: None, monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("plugged", "modgnn_rl.models.paper:gcn", "modgnn_rl.models")
    monkeypatch.setattr("modgnn_rl.registry.entry_points", lambda **_: EntryPoints([entry]))
    assert make_model("plugged", seed=0).state_dict().keys() == make_model("gcn").state_dict().keys()
    assert "plugged" in MODELS.names()


@torch.no_grad()
def test_gcn_is_linear_inside_the_ball() -> None:
    policy = make_model("gcn", hops=2, head=Ball(1e6, 3), seed=0).double()
    observation, adjacency = rollout(0)
    rest = act(policy, 0 * observation, adjacency)
    once = act(policy, observation, adjacency) - rest
    torch.testing.assert_close(act(policy, 3 * observation, adjacency) - rest, 3 * once)


def test_pair_force_reads_the_receivers_own_velocity() -> None:
    policy = make_model("pair_force", hops=1, seed=0, observation=("flock", "state"), action="u")
    assert ("flock", "state") in policy.in_keys
    assert len(policy.in_keys) == 5
    force = PairForce().double()
    relative, own = torch.randn(2, 7, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moved = own + torch.tensor([1.0, 2, 3, 0, 0, 0])
    assert torch.equal(force(relative, own), force(relative, moved))
    assert not torch.allclose(force(relative, own), force(relative, own * 2))


@torch.no_grad()
def test_renamed_keys_serve_every_model() -> None:
    observation, adjacency = rollout(0)
    for name in MODELS:
        policy = build(name, seed=0, observation="state", adjacency="graph", action="u").double()
        with set_recurrent_mode(True):
            out = policy(TensorDict({"state": observation, "graph": adjacency}, observation.shape[:2]))
        torch.testing.assert_close(out["u"], act(build(name, seed=0).double(), observation, adjacency))


@given(seed=seeds)
@torch.no_grad()
def test_central_reads_all_agents_now_and_no_graph(seed: int) -> None:
    policy = build("central", agents=4, seed=seed, head=Ball(100.0, 3)).double()
    observation, adjacency = rollout(seed, agents=4)
    action = act(policy, observation, adjacency)
    torch.testing.assert_close(act(policy, observation, ~adjacency), action)
    layer = policy.layers[0]
    centred = observation.clone()
    centred[..., :3] -= centred[..., :3].mean(-2, keepdim=True)
    scale = torch.tensor([0.5] * 3 + [1.4] * 3, dtype=torch.float64)
    expected = layer.network((centred * scale).flatten(-2)).unflatten(-1, (4, 3))
    torch.testing.assert_close(action, expected)


@torch.no_grad()
def test_central_masks_agents_and_contains_nan() -> None:
    policy = build("central", agents=4, seed=0).double()
    observation, adjacency = rollout(0, agents=4)
    exists = torch.ones(2, 4, 4, dtype=torch.bool)
    exists[0, 1:, 2] = False
    sick = observation.clone()
    sick[~exists] = torch.nan
    window = TensorDict({"agents": {"observation": sick, "mask": exists}, "adjacency": adjacency}, (2, 4))
    with set_recurrent_mode(True):
        action = policy(window)["agents", "action"]
    assert action.isfinite().all()
    assert not action[~exists].any()
    torch.testing.assert_close(action[1], act(policy, observation, adjacency)[1])


def test_central_serves_one_number_of_agents_and_says_so() -> None:
    policy = build("central", agents=4, seed=0).double()
    with pytest.raises(InputError, match="a central model for 4 agents was given 5"):
        act(policy, *rollout(0, agents=5))
    with pytest.raises(InputError, match="give num_agents"):
        make_model("central")
    with pytest.raises(InputError, match="one layer"):
        build("central", layers=2)
    with pytest.raises(InputError, match=r"works for one number of agents, but env.num_agents=\[8, 16\] has several"):
        configured_model(ModelConfig(name="central"), FlockingTask(FlockingConfig(num_agents=[8, 16])), seed=0)


@pytest.mark.parametrize("layers", [0, 1.5, "2"])
def test_layers_must_be_counted(layers: Any) -> None:
    with pytest.raises(InputError, match="layers="):
        make_model("gcn", layers=layers)


@torch.no_grad()
def test_vectors_and_scalars_are_squashed_to_order_one() -> None:
    data = 50 * torch.randn(9, 8, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    squashed = VectorSquash(2)(data)
    for part in (slice(0, 3), slice(3, 6)):
        length, before = squashed[:, part].norm(dim=-1), data[:, part].norm(dim=-1)
        torch.testing.assert_close(length, before / (1 + before))
        torch.testing.assert_close(torch.linalg.cross(squashed[:, part], data[:, part]), torch.zeros(9, 3).double())
    torch.testing.assert_close(squashed[:, 6:], data[:, 6:] / (1 + data[:, 6:].abs()))


def test_an_unknown_name_is_refused_with_a_suggestion() -> None:
    with pytest.raises(InputError, match=r"model 'pairforce' is not one of .*; did you mean 'pair_force'\?"):
        make_model("pairforce")


@models
def test_a_seed_fixes_the_weights_and_leaves_the_global_generator(name: str, layers: int) -> None:
    def weights(seed: int | None) -> Tensor:
        return nn.utils.parameters_to_vector(build(name, layers=layers, seed=seed).parameters())

    before = torch.get_rng_state()
    first = weights(7)
    assert torch.equal(torch.get_rng_state(), before)
    torch.rand(3)
    assert torch.equal(weights(7), first)
    assert not torch.equal(weights(8), first)
    torch.manual_seed(7)
    assert torch.equal(weights(None), first)
    assert not torch.equal(weights(None), first)


def test_a_seed_leaves_the_accelerators_generators(monkeypatch: pytest.MonkeyPatch) -> None:
    touched: list[int] = []
    monkeypatch.setattr(torch.cuda, "manual_seed_all", touched.append)
    monkeypatch.setattr(torch.cuda, "manual_seed", touched.append)
    make_model("gcn", seed=0)
    assert not touched


@given(seed=seeds, radius=st.floats(0.1, 10.0))
def test_the_head_projects_onto_the_ball(seed: int, radius: float) -> None:
    action = 3 * torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    projected = Ball(radius, 3)(action)
    speed = action.norm(dim=-1)
    torch.testing.assert_close(projected.norm(dim=-1), speed.clamp(max=radius))
    torch.testing.assert_close(torch.linalg.cross(projected, action), torch.zeros_like(action))
    assert ((projected * action).sum(-1) > 0).all()


def test_scale_hides_the_position_and_is_no_weight() -> None:
    data = torch.ones(2, 6)
    assert Scale()(data)[0].tolist() == pytest.approx([0.5] * 3 + [1.4] * 3)
    assert Scale(hide_position=True)(data)[0].tolist() == pytest.approx([0.0] * 3 + [1.4] * 3)
    assert not Scale().state_dict()
