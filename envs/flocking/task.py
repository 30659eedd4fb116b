"""What a trainer needs to know of the flocking task."""

from __future__ import annotations

import functools

import torch

from modgnn_rl.configs.schema import FlockingConfig
from modgnn_rl.envs.flocking.env import FlockingEnv

__all__ = ["training_env_factory"]


def training_env_factory(config: FlockingConfig) -> functools.partial[FlockingEnv]:
    """A function ``make_env(num_envs, num_agents, seed, device)`` of a task, as `RolloutSpec` takes it.

    Its environments do not all reach the end of an episode at the same step. It can be sent to other processes.
    """
    return functools.partial(_make_training_env, config)


def _make_training_env(
    config: FlockingConfig, num_envs: int, num_agents: int, seed: int, device: torch.device | str
) -> FlockingEnv:
    return FlockingEnv(num_envs, num_agents, config=config, seed=seed, device=device, stagger=True)
