"""The flocking reward against its formula written as a loop, and its invariances."""

from __future__ import annotations

import math

import pytest
import torch

from modgnn_rl.envs.rewards import flocking_reward


def test_reward_equals_its_formula() -> None:
    generator = torch.Generator().manual_seed(0)
    position, velocity = torch.randn(2, 3, 5, 3, generator=generator, dtype=torch.float64).unbind(0)
    touching = torch.rand(3, 5, generator=generator) < 0.3
    reward = flocking_reward(position, velocity, touching)
    assert reward.shape == (3, 5, 1)
    assert reward.dtype == torch.float64
    for flock in range(3):
        mean = sum(velocity[flock]) / 5
        for agent in range(5):
            lead = (position[flock, agent] - position[flock, 0]).square().sum().sqrt()
            drift = (velocity[flock, agent] - mean).square().sum().sqrt()
            expected = -0.1 * lead - 0.1 * drift - float(touching[flock, agent])
            assert float(reward[flock, agent]) == pytest.approx(float(expected), rel=1e-12)


def test_agents_that_do_not_exist_neither_count_nor_earn() -> None:
    generator = torch.Generator().manual_seed(2)
    position, velocity = torch.randn(2, 2, 6, 3, generator=generator, dtype=torch.float64).unbind(0)
    touching = torch.rand(2, 6, generator=generator) < 0.5
    alone = flocking_reward(position[:, :4], velocity[:, :4], touching[:, :4])
    position[0, 4:], velocity[:, 4:], position[1, 4:] = math.nan, math.inf, 1e4
    reward = flocking_reward(position, velocity, touching, torch.arange(6).expand(2, 6) < 4)
    torch.testing.assert_close(reward[:, :4], alone)
    assert not reward[:, 4:].any()


def test_reward_is_best_on_the_leader_in_step_and_untouched() -> None:
    together = torch.zeros(1, 4, 3)
    assert not flocking_reward(together, together + 2.0, torch.zeros(1, 4, dtype=torch.bool)).any()


def test_reward_does_not_depend_on_the_place_or_the_common_velocity() -> None:
    generator = torch.Generator().manual_seed(1)
    position, velocity, shift = torch.randn(3, 2, 6, 3, generator=generator, dtype=torch.float64).unbind(0)
    touching = torch.zeros(2, 6, dtype=torch.bool)
    moved = flocking_reward(position + shift[:, :1], velocity + shift[:, 1:2], touching)
    torch.testing.assert_close(moved, flocking_reward(position, velocity, touching))
