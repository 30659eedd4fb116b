"""ModGNN against numbers computed with other people's libraries."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import set_recurrent_mode

from modgnn_rl import ModGNN, ModGNNLayer

FIXTURES = Path(os.environ.get("MODGNN_RL_FIXTURES", Path(__file__).parents[1] / "fixtures"))


def _window(observation: torch.Tensor, adjacency: torch.Tensor) -> TensorDict:
    agents = TensorDict({"observation": observation}, observation.shape[:2])
    return TensorDict({"agents": agents, "adjacency": adjacency}, observation.shape[:2])


def _mlp(fixture: dict, name: str) -> nn.Sequential:
    layers: list[nn.Module] = []
    for index in (0, 2, 4):
        weight = torch.from_numpy(fixture[f"{name}.{index}.weight"])
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        linear.weight.data, linear.bias.data = weight, torch.from_numpy(fixture[f"{name}.{index}.bias"])
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


@pytest.mark.parametrize("hops", [1, 2, 3])
def test_outputs_and_gradients_of_the_authors_library(hops: int) -> None:
    with np.load(FIXTURES / "modgnn_authors.npz") as file:
        fixture = {key.removeprefix(f"K{hops}/"): file[key] for key in file.files if key.startswith(f"K{hops}/")}
    f_pre = [_mlp(fixture, f"f_pre.{hop}") for hop in range(hops + 1)]
    f_mid = [_mlp(fixture, f"f_mid.{hop}") for hop in range(hops + 1)]
    policy = ModGNN(ModGNNLayer(hops, f_pre=f_pre, f_mid=f_mid, f_final=_mlp(fixture, "f_final")))
    observation = torch.from_numpy(fixture["observation"]).requires_grad_()
    with set_recurrent_mode(True):
        action = policy(_window(observation, torch.from_numpy(fixture["adjacency"]).bool()))["agents", "action"]
    expected = torch.from_numpy(fixture["output_from_t_equal_K"])
    assert _relative(action[:, hops:], expected) < 1e-5

    action[:, hops:].square().mean().backward()
    assert _relative(observation.grad, torch.from_numpy(fixture["grad_observation"])) < 1e-5
    for name, parameter in policy.layers[0].named_parameters():
        assert _relative(parameter.grad, torch.from_numpy(fixture[f"grad/{name}"])) < 1e-5, name


def _relative(ours: torch.Tensor | None, theirs: torch.Tensor) -> float:
    assert ours is not None
    return float((ours.detach() - theirs).abs().max() / theirs.abs().max())


@pytest.mark.parametrize("start", ["mask", "zero"])
def test_delayed_graph_filter_of_alegnn(start: str) -> None:
    with np.load(FIXTURES / "delayed_filter.npz") as file:
        fixture = {key: torch.from_numpy(file[key]) for key in file.files}
    taps = fixture["taps"]  # [F, K + 1, G]
    hops = taps.shape[1] - 1
    f_mid = []
    for hop in range(hops + 1):
        linear = nn.Linear(taps.shape[2], taps.shape[0], bias=False, dtype=torch.float64)
        linear.weight.data = taps[:, hop]
        f_mid.append(linear)

    class AddBias(nn.Module):
        def forward(self, data: torch.Tensor) -> torch.Tensor:
            return data + fixture["bias"].view(-1)

    policy = ModGNN(ModGNNLayer(hops, f_mid=f_mid, f_final=AddBias(), start=start))
    with set_recurrent_mode(True):
        action = policy(_window(fixture["observation"], fixture["adjacency"].bool()))["agents", "action"]
    assert (action - fixture["output"]).abs().max() < 1e-12
