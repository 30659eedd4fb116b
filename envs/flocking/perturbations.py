"""What goes wrong outside: lost and late messages, uneven radios, noisy sensors, agents that drop out, gusts.

Policies see it only through adjacency, observation and mask, so that each of them copes with it unchanged. All faults
are off by default, and draw from a generator of their own: rollouts with and without them have the same starts and the
same leaders.
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
    """The faults of B flocks of N agents; see the settings of `FlockingConfig` that begin with "fault:".

    Attributes:
        running: agents that have not dropped out, bool [B, N]; the leader never does.
        reach: distance within which each agent is heard, m [B, N]; None: ``comm_range``, all of them.

    Args:
        config: the world.
        num_envs: flocks B.
        num_agents: agents N.
        device: where they are.
        dtype: floating-point type.
    """

    STATE = ("running", "reach", "gust", "late")

    def __init__(
        self, config: FlockingConfig, num_envs: int, num_agents: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        self.config = config
        self.shape = (num_envs, num_agents)
        self.real: dict[str, Any] = {"device": device, "dtype": dtype}
        self.generator = torch.Generator(device)
        self.running = torch.ones(self.shape, dtype=torch.bool, device=device)
        self.reach = torch.full(self.shape, config.comm_range, **self.real) if config.range_spread else None
        self.gust = torch.zeros(num_envs, 1, 3, **self.real)
        self.late = torch.zeros(config.delay, *self.shape, 6, **self.real)  # the newest first

    def reset(self, mask: Tensor, state: Tensor) -> None:
        """Begin anew in the flocks of the mask, bool [B, 1], from their states [B, N, 6]."""
        config = self.config
        self.running = self.running | mask
        if self.reach is not None:
            spread = 1 + config.range_spread * (2 * self._uniform(*self.shape) - 1)
            self.reach = torch.where(mask, config.comm_range * spread, self.reach)
        if config.wind:
            self.gust = torch.where(mask.unsqueeze(-1), config.wind * self._normal(*self.gust.shape), self.gust)
        if config.delay:
            self.late = torch.where(mask.unsqueeze(-1), state, self.late)

    def step(self) -> Tensor | None:
        """Let a control period pass for radios, agents and wind.

        Returns:
            what the wind adds to the acceleration, m/s^2 [B, 1, 3], None without wind: gusts with a standard deviation
            of ``wind`` that change within ``wind_time`` (an Ornstein-Uhlenbeck process), the same for a whole flock.
        """
        config, period = self.config, 1 / self.config.control_frequency
        if config.dropout_rate:
            lot = self._uniform(*self.shape)
            stays = lot >= -math.expm1(-config.dropout_rate * period)
            returns = lot < -math.expm1(-period / config.dropout_time)
            self.running = torch.where(self.running, stays, returns)
            self.running[:, 0] = True
        if not config.wind:
            return None
        kept = math.exp(-period / config.wind_time)
        fresh = config.wind * math.sqrt(1 - kept**2)
        self.gust = kept * self.gust + fresh * self._normal(*self.gust.shape)
        return self.gust

    def observe(self, state: Tensor, *, is_new: bool = True) -> Tensor:
        """What agents know of their states [B, N, 6]: those of ``delay`` steps ago, with noise; the state if neither.

        Args:
            state: position and velocity now.
            is_new: whether a step has passed since the last call.
        """
        config = self.config
        if config.delay:
            newest, state = state, self.late[-1]
            if is_new:
                self.late = torch.cat((newest.unsqueeze(0), self.late[:-1]))
        if config.position_noise or config.velocity_noise:
            scale = state.new_tensor([config.position_noise] * 3 + [config.velocity_noise] * 3)
            state = state + scale * self._normal(*state.shape)
        return state

    def arrived(self, *links: int) -> Tensor | None:
        """Which of the messages over so many links arrive, bool; None: all."""
        return self._uniform(*links) >= self.config.message_loss if self.config.message_loss else None

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator, **self.real)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator, **self.real)
