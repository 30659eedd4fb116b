"""Leaders: the trajectories of agent 0 of each flock, which the policy does not control."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.snapshots import Stateful
from modgnn_rl.utils.tensors import clip_to_ball

__all__ = ["CircleLeader", "Leader", "NoiseLeader", "WaypointLeader", "make_leader"]

ARRIVED = 0.3  # m; a waypoint counts as reached within this distance


class Leader(Stateful, ABC):
    """The target velocities of the leaders of B flocks.

    Args:
        config: settings of the environment.
        num_envs: flocks B.
        device: device of the state.
        dtype: floating-point type.
    """

    def __init__(self, config: FlockingConfig, num_envs: int, device: torch.device, dtype: torch.dtype) -> None:
        self.config = config
        self.zero = torch.zeros(num_envs, 3, device=device, dtype=dtype)

    @abstractmethod
    def reset(self, mask: Tensor, generator: torch.Generator) -> None:
        """Start a new trajectory in the flocks of the mask, bool [B, 1]."""

    @abstractmethod
    def step(self, position: Tensor, generator: torch.Generator) -> Tensor:
        """The target velocity for the next control period, m/s [B, 3].

        Args:
            position: of the leaders, m [B, 3].
            generator: source of randomness; the numbers sampled do not depend on the positions.
        """


class NoiseLeader(Leader):
    """Integrated noise: ``v <- clip(v + N(0, leader_noise^2 dt))``, from rest."""

    STATE = ("velocity",)

    def __init__(self, config: FlockingConfig, num_envs: int, device: torch.device, dtype: torch.dtype) -> None:
        super().__init__(config, num_envs, device, dtype)
        self.velocity = self.zero
        self.scale = config.leader_noise * config.control_frequency**-0.5

    def reset(self, mask: Tensor, generator: torch.Generator) -> None:
        """Come to rest."""
        self.velocity = self.velocity.masked_fill(mask, 0.0)

    def step(self, position: Tensor, generator: torch.Generator) -> Tensor:
        """Add noise to the target velocity."""
        noise = _normal(self.zero, generator)
        self.velocity = clip_to_ball(self.velocity + self.scale * noise, self.config.leader_max_speed)
        return self.velocity


class WaypointLeader(Leader):
    """Straight lines at ``leader_speed`` between waypoints, which are uniform in the ball of ``leader_radius``."""

    STATE = ("waypoint",)

    def __init__(self, config: FlockingConfig, num_envs: int, device: torch.device, dtype: torch.dtype) -> None:
        super().__init__(config, num_envs, device, dtype)
        self.waypoint = self.zero

    def reset(self, mask: Tensor, generator: torch.Generator) -> None:
        """Sample the first waypoint."""
        self.waypoint = torch.where(mask, self._sample(generator), self.waypoint)

    def step(self, position: Tensor, generator: torch.Generator) -> Tensor:
        """Move towards the waypoint, or towards a new one if it has been reached."""
        arrived = torch.linalg.vector_norm(self.waypoint - position, dim=-1, keepdim=True) < ARRIVED
        self.waypoint = torch.where(arrived, self._sample(generator), self.waypoint)
        return self.config.leader_speed * torch.nn.functional.normalize(self.waypoint - position, dim=-1)

    def _sample(self, generator: torch.Generator) -> Tensor:
        direction = torch.nn.functional.normalize(_normal(self.zero, generator), dim=-1)
        fraction = torch.rand(len(self.zero), 1, generator=generator, device=self.zero.device, dtype=self.zero.dtype)
        return self.config.leader_radius * fraction.pow(1 / 3) * direction


class CircleLeader(Leader):
    """A horizontal circle of ``leader_radius`` at ``leader_speed``, with a random initial heading."""

    STATE = ("heading",)

    def __init__(self, config: FlockingConfig, num_envs: int, device: torch.device, dtype: torch.dtype) -> None:
        super().__init__(config, num_envs, device, dtype)
        self.heading = self.zero[:, :1]
        self.turn = config.leader_speed / config.leader_radius / config.control_frequency

    def reset(self, mask: Tensor, generator: torch.Generator) -> None:
        """Sample the heading, rad."""
        turns = torch.rand(self.heading.shape, generator=generator, device=self.zero.device, dtype=self.zero.dtype)
        self.heading = torch.where(mask, 2 * torch.pi * turns, self.heading)

    def step(self, position: Tensor, generator: torch.Generator) -> Tensor:
        """Advance along the circle."""
        velocity = torch.cat((self.heading.cos(), self.heading.sin(), torch.zeros_like(self.heading)), -1)
        self.heading = self.heading + self.turn
        return self.config.leader_speed * velocity


def _normal(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=generator, device=like.device, dtype=like.dtype)


LEADERS: dict[str, type[Leader]] = {"noise": NoiseLeader, "waypoints": WaypointLeader, "circle": CircleLeader}


def make_leader(config: FlockingConfig, num_envs: int, device: torch.device, dtype: torch.dtype) -> Leader:
    """Create the leader that ``config.leader`` names."""
    return LEADERS[config.leader](config, num_envs, device, dtype)
