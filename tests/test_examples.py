"""The examples run in short form, and do what they say."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

EXAMPLES = Path(__file__).parent.parent / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_own_f_pre_learns_what_each_role_does():
    errors, ignorant = example("own_f_pre").main(num_envs=8, num_agents=8, steps=32, rounds=3, updates=30)
    assert errors[-1] < 0.2 * errors[0]
    assert ignorant > 2 * errors[-1]


def test_own_f_com_finds_the_gains_of_the_expert_when_it_hears_everybody():
    results = example("own_f_com").main(comm_ranges=(2.0, 100.0), num_envs=4, num_agents=8, steps=48)
    (near_cohesion, *_), near_error = results[2.0]
    (cohesion, separation, alignment), error = results[100.0]
    assert cohesion == pytest.approx(0.06, rel=0.05)
    assert separation == pytest.approx(0.8, rel=0.05)
    assert 0.0 < alignment < 0.1
    assert error < 1e-3
    assert near_error > 0.05
    assert near_cohesion > 0.1  # few pull for all


def test_modgnn_learns_on_vmas():
    pytest.importorskip("vmas")
    module = example("modgnn_on_vmas")
    returns = module.main(num_envs=16, num_agents=3, steps=60, iterations=5)
    assert len(returns) == 5
    assert sum(returns[-2:]) / 2 > 0.3  # without communication it is about 0.1


def test_the_loss_of_the_vmas_example_sees_the_messages_that_were_flown():
    pytest.importorskip("vmas")
    module = example("modgnn_on_vmas")
    torch.manual_seed(0)
    env = module.make_env(num_envs=4, num_agents=3, steps=6, seed=0)
    check_env_specs(env)
    assert not env.reset()["adjacency"].diagonal(dim1=-2, dim2=-1).any()
    actor = module.make_actor(env, hops=2)
    critic: TensorDictModule = module.make_critic(num_agents=3)
    loss_module = module.make_loss(actor, critic)
    size = {"frames_per_batch": 4 * 10, "total_frames": 4 * 30}
    for number, flights in enumerate(Collector(env, actor, **size, auto_register_policy_transforms=True)):
        begins = flights["is_init"].squeeze(-1)
        assert begins.any(1).all()
        assert (flights["messages"].flatten(2).nan_to_num().abs().sum(-1) > 0)[~begins].all()
        if number:
            assert not begins[:, 0].all()  # batches go on where the last one stopped
        with torch.no_grad():
            loss_module.value_estimator(flights)
            losses = loss_module(flights)
        # The policy has not changed, so what it does in a window is what it did step by step.
        assert losses["kl_approx"].abs().max() < 1e-5
        assert losses["clip_fraction"] == 0
    flights["messages"].zero_()
    with torch.no_grad():
        assert loss_module(flights)["kl_approx"].abs().max() > 1e-4  # the messages before the window count
