"""The learner of imitation: learning rate, moving average, determinism."""

from __future__ import annotations

import copy
import itertools

import pytest
import torch

from modgnn_rl import make_model
from modgnn_rl.configs.schema import DAggerConfig, FlockingConfig
from modgnn_rl.envs.flocking.expert import Reynolds
from modgnn_rl.envs.flocking.task import FlockingTask
from modgnn_rl.trainers.collectors.local import RolloutSpec
from modgnn_rl.trainers.collectors.rollout_buffer import make_buffer
from modgnn_rl.trainers.imitation.learner import ImitationLearner, cosine_learning_rate

TASK = FlockingTask(FlockingConfig())
RATES = (3e-3, 1e-3, 1e-4)


@pytest.fixture(scope="module")
def rollouts():
    settings = DAggerConfig(capacity=500, batch_size=64)
    spec = RolloutSpec(TASK.training_env, 8, 6, steps=40, seed=0)
    return make_buffer(spec, settings, [make_model("gcn", seed=0)], Reynolds(), hold_steps=40)


def _learner(**settings):
    return ImitationLearner(
        make_model("pair_force", seed=0), TASK, DAggerConfig(batch_size=64, **settings), (20, 60), seed=0
    )


def test_the_learning_rate_passes_its_three_values_without_jumps():
    rates = [cosine_learning_rate(step, RATES, (20, 60)) for step in range(80)]
    assert rates[0] == pytest.approx(RATES[0])
    assert rates[20] == pytest.approx(RATES[1])
    assert rates[60] == rates[79] == pytest.approx(RATES[2])
    assert max(abs(a - b) for a, b in itertools.pairwise(rates)) < 2e-4
    assert all(b <= a for a, b in itertools.pairwise(rates))


def test_fitting_lowers_the_loss(rollouts):
    rollouts.extend(rollouts.collect(1.0))
    learner = _learner()
    before = learner.validate(rollouts.buffer)
    learner.fit(rollouts.buffer, 60)
    assert learner.validate(rollouts.buffer) < 0.7 * before
    assert learner.updates_done == 60
    assert learner.learning_rate == pytest.approx(RATES[2])


def test_the_acting_policy_has_the_moving_average_of_the_weights(rollouts):
    rollouts.extend(rollouts.collect(1.0))
    learner = _learner(ema_decay=0.9)
    expected = copy.deepcopy(learner.policy.state_dict())
    for update in range(5):
        learner.fit(rollouts.buffer, 1)
        for key, value in learner.policy.state_dict().items():
            expected[key] = value.clone() if update == 0 else 0.9 * expected[key] + 0.1 * value
    for key, value in learner.ema_policy.state_dict().items():
        torch.testing.assert_close(value, expected[key])


def test_the_seed_determines_the_weights():
    weights = []
    for _ in range(2):
        settings = DAggerConfig(capacity=500, batch_size=64)
        learner = _learner()
        spec = RolloutSpec(TASK.training_env, 8, 6, steps=40, seed=0)
        data = make_buffer(spec, settings, [learner.ema_policy], Reynolds(), hold_steps=40)
        data.extend(data.collect(0.5))
        learner.fit(data.buffer, 5)
        weights.append(torch.cat([parameter.flatten() for parameter in learner.ema_policy.parameters()]))
    assert torch.equal(*weights)


def test_without_updates_the_loss_is_nan(rollouts):
    assert torch.isnan(torch.tensor(_learner().fit(rollouts.buffer, 0)))
