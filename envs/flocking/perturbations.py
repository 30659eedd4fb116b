"""Perturbations: packet loss, delay, uneven radio ranges, sensor noise, dropout of agents, wind.

Policies see them only through adjacency, observation and mask. All are off by default. They use their own random
generator, so rollouts with and without them have the same initial positions and the same leaders.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.snapshots import Stateful

__all__ = ["Perturbations"]


class Perturbations(Stateful):
    """Perturbations of B flocks of N agents; see the settings of `FlockingConfig` that begin with "perturbation:".

    Attributes:
        active: agents that have not dropped out, bool [B, N]; the leader never drops out.
        send_range: distance within which each agent is heard, m [B, N]; None: ``comm_range`` for all agents.

    Args:
        config: settings of the environment.
        num_envs: flocks B.
        num_agents: agents N.
        device: device of the state.
        dtype: floating-point type.
    """

    STATE = ("active", "send_range", "gust", "delayed")

    def __init__(
        self, config: FlockingConfig, num_envs: int, num_agents: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        self.config = config
        self.shape = (num_envs, num_agents)
        self.real: dict[str, Any] = {"device": device, "dtype": dtype}
        self.generator = torch.Generator(device)
        self.active = torch.ones(self.shape, dtype=torch.bool, device=device)
        self.send_range = torch.full(self.shape, config.comm_range, **self.real) if config.range_spread else None
        self.gust = torch.zeros(num_envs, 1, 3, **self.real)
        self.delayed = torch.zeros(config.delay, *self.shape, 6, **self.real)  # states, newest first

    def reset(self, mask: Tensor, state: Tensor) -> None:
        """Start a new episode in some flocks.

        Args:
            mask: these flocks, bool [B, 1].
            state: positions, m, and velocities, m/s, of all flocks [B, N, 6].
        """
        config = self.config
        self.active = self.active | mask
        if self.send_range is not None:
            factor = 1 + config.range_spread * (2 * self._uniform(*self.shape) - 1)
            self.send_range = torch.where(mask, config.comm_range * factor, self.send_range)
        if config.wind:
            self.gust = torch.where(mask.unsqueeze(-1), config.wind * self._normal(*self.gust.shape), self.gust)
        if config.delay:
            self.delayed = torch.where(mask.unsqueeze(-1), state, self.delayed)

    def step(self) -> Tensor | None:
        """Advance dropout and wind by one control period.

        Returns:
            acceleration by the wind, m/s^2 [B, 1, 3]; None without wind. It is an Ornstein-Uhlenbeck process with
            standard deviation ``wind`` and correlation time ``wind_time``, the same for all agents of a flock.
        """
        config, period = self.config, 1 / self.config.control_frequency
        if config.dropout_rate:
            sample = self._uniform(*self.shape)
            stays = sample >= -math.expm1(-config.dropout_rate * period)
            returns = sample < -math.expm1(-period / config.dropout_time)
            self.active = torch.where(self.active, stays, returns)
            self.active[:, 0] = True
        if not config.wind:
            return None
        kept = math.exp(-period / config.wind_time)
        fresh = config.wind * math.sqrt(1 - kept**2)
        self.gust = kept * self.gust + fresh * self._normal(*self.gust.shape)
        return self.gust

    def observe(self, state: Tensor, *, is_new: bool = True) -> Tensor:
        """What agents observe of their states: those of ``delay`` steps ago, with sensor noise.

        Args:
            state: current positions, m, and velocities, m/s [B, N, 6].
            is_new: whether a control step has passed since the last call.

        Returns:
            observations [B, N, 6]; ``state`` itself without delay and noise.
        """
        config = self.config
        if config.delay:
            newest, state = state, self.delayed[-1]
            if is_new:
                self.delayed = torch.cat((newest.unsqueeze(0), self.delayed[:-1]))
        if config.position_noise or config.velocity_noise:
            scale = state.new_tensor([config.position_noise] * 3 + [config.velocity_noise] * 3)
            state = state + scale * self._normal(*state.shape)
        return state

    def sample_delivered(self, *shape: int) -> Tensor | None:
        """Sample which messages arrive, bool of the given shape, one entry per edge; None without packet loss."""
        return self._uniform(*shape) >= self.config.message_loss if self.config.message_loss else None

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, **self.real)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, **self.real)
