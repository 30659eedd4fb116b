"""The costs against their formulas, written as a loop, and their invariances."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.rewards import COSTS, flocking_costs, flocking_reward, reward_weights
from modgnn_rl.utils.tensors import pair_distances

DISTANCES: Any = {"crowding_distance": 0.9, "collision_distance": 0.5}


def random_step(*shape: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    position, velocity, target = torch.randn(3, *shape, 3, generator=generator, dtype=torch.float64).unbind(0)
    return position, velocity, target


def costs_of(position: Tensor, velocity: Tensor, target: Tensor, exists: Tensor | None = None) -> dict[str, Tensor]:
    return flocking_costs(position, velocity, target, pair_distances(position).amin(-1), exists=exists, **DISTANCES)


def test_costs_equal_their_formulas() -> None:
    position, velocity, target = random_step(3, 5)
    costs = costs_of(position, velocity, target)
    assert list(costs) == list(COSTS)
    for flock in range(3):
        centre, mean = position[flock].mean(0), velocity[flock].mean(0)
        for i in range(5):
            nearest = min(math.dist(position[flock, i], position[flock, j]) for j in range(5) if j != i)
            expected = {
                "leader": math.dist(position[flock, i], position[flock, 0]),
                "cohesion": math.dist(position[flock, i], centre),
                "crowding": max(0.0, 1 - nearest / 0.9) ** 2,
                "collision": float(nearest < 0.5),
                "alignment": math.dist(velocity[flock, i], mean),
                "effort": math.dist(target[flock, i], velocity[flock, i]),
            }
            found = {name: float(cost[flock, i]) for name, cost in costs.items()}
            assert found == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_reward_is_minus_the_weighted_sum_and_ignores_costs_without_weight() -> None:
    costs = {"leader": torch.tensor([[1.0, 2.0]]), "effort": torch.tensor([[3.0, math.nan]])}
    assert flocking_reward(costs, {"leader": 0.5}).tolist() == [[[-0.5], [-1.0]]]
    assert flocking_reward(costs, {}).tolist() == [[[0.0], [0.0]]]
    config = FlockingConfig(leader_cost=0.5, effort_cost=0.0)
    assert "effort" not in reward_weights(config)
    assert reward_weights(config)["leader"] == 0.5


def test_agents_that_do_not_exist_neither_count_nor_get_a_reward() -> None:
    position, velocity, target = random_step(2, 6, seed=2)
    weights = reward_weights(FlockingConfig())
    alone = flocking_reward(costs_of(position[:, :4], velocity[:, :4], target[:, :4]), weights)
    position[:, 4:] = torch.tensor([1e4, 2e4], dtype=torch.float64).unsqueeze(-1)
    velocity[:, 4:], target[:, 4:] = math.inf, math.nan
    exists = torch.arange(6).expand(2, 6) < 4
    reward = flocking_reward(costs_of(position, velocity, target, exists), weights, exists)
    torch.testing.assert_close(reward[:, :4], alone)
    assert not reward[:, 4:].any()


def test_costs_are_zero_at_the_leader_with_equal_velocity_and_no_neighbour() -> None:
    position = torch.zeros(1, 4, 3)
    costs = flocking_costs(position, position + 2.0, position + 2.0, torch.full((1, 4), 1.0), **DISTANCES)
    assert not any(cost.any() for cost in costs.values())


def test_a_single_agent_has_no_collision_or_crowding() -> None:
    costs = costs_of(*random_step(2, 1))
    assert not costs["crowding"].any()
    assert not costs["collision"].any()


def test_costs_are_invariant_to_position_and_common_velocity() -> None:
    position, velocity, target = random_step(2, 6, seed=1)
    shift, drift = random_step(2, 1, seed=3)[:2]
    moved = costs_of(position + shift, velocity + drift, target + drift)
    for name, cost in costs_of(position, velocity, target).items():
        torch.testing.assert_close(moved[name], cost)
