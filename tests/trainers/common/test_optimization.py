"""NaN and infinity never reach the weights."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from modgnn_rl.configs.schema import DAggerConfig
from modgnn_rl.errors import NotFinite
from modgnn_rl.trainers.common.optimization import MAX_SKIPPED, GuardedOptimizer

ALL = torch.tensor(12)  # agents that count in a batch


def _batch():
    agents = TensorDict({"observation": torch.randn(4, 2, 3, 6), "controlled": torch.ones(4, 2, 3, dtype=torch.bool)})
    messages = torch.full((4, 2, 3, 5), math.nan)  # as of agents that hold none
    return TensorDict({"agents": agents, "messages": messages}, [4, 2])


def _optimizer(on_nonfinite):
    model = nn.Linear(6, 1)
    settings = DAggerConfig(on_nonfinite=on_nonfinite, max_grad_norm=0.5)
    return GuardedOptimizer(model, torch.optim.SGD(model.parameters(), lr=1.0), settings), model


def _backward(model, batch):
    loss = model(batch["agents", "observation"]).square().mean()
    model.zero_grad()
    loss.backward()
    return loss


def _corrupt_data(model, batch):
    batch["agents", "observation"][2, 1, 0, 4] = math.nan
    return _backward(model, batch)


def _corrupt_loss(model, batch):
    with torch.no_grad():
        model.weight[0, 0] = math.inf
    return _backward(model, batch)


def _corrupt_gradient(model, batch):
    loss = _backward(model, batch)
    model.bias.grad.fill_(math.nan)
    return loss


CORRUPTIONS = {
    r"\('agents', 'observation'\) of agent 0 at step 1 of window 2 of its data is nan": _corrupt_data,
    "its loss is (inf|nan) although its data are finite": _corrupt_loss,
    "the gradient of bias is not finite": _corrupt_gradient,
}


def test_a_finite_gradient_is_clipped_and_stepped_along():
    optimizer, model = _optimizer("stop")
    batch = _batch()
    loss = _backward(model, batch)
    norm = torch.cat([p.grad.flatten() for p in model.parameters()]).norm()
    before = torch.cat([p.detach().flatten() for p in model.parameters()])
    assert optimizer.step(1, loss, batch, ALL)
    moved = (torch.cat([p.detach().flatten() for p in model.parameters()]) - before).norm()
    assert optimizer.gradient_norm == pytest.approx(float(norm))
    assert float(moved) == pytest.approx(min(0.5, float(norm)), rel=1e-4)


@pytest.mark.parametrize("on_nonfinite", ["stop", "skip"])
@pytest.mark.parametrize("message", CORRUPTIONS)
def test_no_step_is_taken_and_the_cause_is_named(message, on_nonfinite):
    optimizer, model = _optimizer(on_nonfinite)
    batch = _batch()
    loss = CORRUPTIONS[message](model, batch)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    if on_nonfinite == "stop":
        with pytest.raises(NotFinite, match=f"update 7 was not made because {message}"):
            optimizer.step(7, loss, batch, ALL)
    else:
        with pytest.warns(RuntimeWarning, match=message):
            assert not optimizer.step(7, loss, batch, ALL)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_too_many_skipped_updates_in_a_row_stop_training():
    optimizer, model = _optimizer("skip")

    def skip(times):
        for _ in range(times):
            with pytest.warns(RuntimeWarning, match="training continues"):
                optimizer.step(1, _corrupt_gradient(model, _batch()), _batch(), ALL)

    skip(MAX_SKIPPED - 1)
    assert optimizer.step(1, _backward(model, _batch()), _batch(), ALL)
    skip(MAX_SKIPPED - 1)
    with pytest.raises(NotFinite, match="resume with smaller steps"):
        optimizer.step(1, _corrupt_gradient(model, _batch()), _batch(), ALL)
