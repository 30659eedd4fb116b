"""Leaders: the properties of each kind of trajectory."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.leader import Leader, WaypointLeader, make_leader

EVERYBODY = torch.ones(500, 1, dtype=torch.bool)
CPU = torch.device("cpu")


def lead(steps: int, position: Tensor | None = None, **settings: Any) -> tuple[Leader, Tensor]:
    """Target velocities [T, B, 3] of leaders that follow them exactly."""
    config = FlockingConfig(**settings)
    leader = make_leader(config, len(EVERYBODY), CPU, torch.float64)
    generator = torch.Generator().manual_seed(0)
    leader.reset(EVERYBODY, generator)
    position = torch.zeros(len(EVERYBODY), 3, dtype=torch.float64) if position is None else position
    velocities = []
    for _ in range(steps):
        velocity = leader.step(position, generator)
        position = position + velocity / config.control_frequency
        velocities.append(velocity)
    return leader, torch.stack(velocities)


def test_noise_is_a_random_walk_of_the_velocity_from_rest() -> None:
    _, velocities = lead(480, leader_noise=0.1, leader_max_speed=torch.inf)
    variance = velocities.square().mean((1, 2))
    seconds = torch.arange(1, 481) / 48
    # 1,500 walks: the standard error of a variance is 4 %.
    torch.testing.assert_close(variance, 0.01 * seconds.double(), rtol=0.15, atol=0)


def test_noise_stays_in_its_ball() -> None:
    _, velocities = lead(480, leader_noise=1.0, leader_max_speed=0.5)
    assert float(velocities.norm(dim=-1).max()) == pytest.approx(0.5)


def test_a_circle_closes() -> None:
    radius, speed = 2.0, 0.5
    steps = round(2 * torch.pi * radius / speed * 48)
    _, velocities = lead(steps, leader="circle", leader_radius=radius, leader_speed=speed)
    path = (velocities / 48).cumsum(0)
    torch.testing.assert_close(velocities.norm(dim=-1), torch.full_like(velocities[..., 0], speed))
    assert float(path[-1].norm(dim=-1).max()) < 0.02
    assert not velocities[..., 2].any()
    centre = path.mean(0)
    torch.testing.assert_close((path - centre).norm(dim=-1), torch.full_like(path[..., 0], radius), rtol=0.01, atol=0)
    headings = torch.atan2(velocities[0, :, 1], velocities[0, :, 0])
    assert float(headings.std()) > 1.5  # initial headings in all directions


def test_waypoints_are_reached_one_after_the_other() -> None:
    leader, _ = lead(1, leader="waypoints", leader_radius=1.0, leader_speed=0.5)
    assert isinstance(leader, WaypointLeader)
    generator = torch.Generator().manual_seed(1)
    position, visited = torch.zeros(len(EVERYBODY), 3, dtype=torch.float64), torch.zeros(len(EVERYBODY))
    for _ in range(480):
        before = leader.waypoint
        velocity = leader.step(position, generator)
        changed = (leader.waypoint != before).any(-1)
        assert not (changed & ((before - position).norm(dim=-1) > 0.31)).any()
        visited += changed
        position = position + velocity / 48
        torch.testing.assert_close(velocity.norm(dim=-1), torch.full((500,), 0.5, dtype=torch.float64))
    assert float(visited.mean()) > 3
    assert float(position.norm(dim=-1).max()) <= 1.0


@pytest.mark.parametrize("kind", ["noise", "waypoints", "circle"])
def test_a_partial_reset_leaves_the_other_leaders_alone(kind: str) -> None:
    leader, _ = lead(50, leader=kind)
    before = {name: value.clone() for name, value in vars(leader).items() if isinstance(value, Tensor)}
    leader.reset(torch.arange(500).unsqueeze(-1) < 3, torch.Generator().manual_seed(3))
    for name, value in before.items():
        assert torch.equal(getattr(leader, name)[3:], value[3:])
