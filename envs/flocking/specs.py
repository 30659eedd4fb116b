"""TorchRL specs of the flocking environment."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data import Binary, Bounded, Composite, Unbounded

from modgnn_rl.configs.schema import FlockingConfig

__all__ = ["edge_capacity", "make_specs"]


def edge_capacity(config: FlockingConfig, num_agents: int) -> int:
    """Length E of each flock's edge list with ``graph="links"``."""
    return num_agents * min(config.max_links, max(1, num_agents - 1))


def make_specs(
    config: FlockingConfig,
    num_envs: int,
    num_agents: int,
    *,
    has_mask: bool,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Composite]:
    """The specs of B flocks of N agents, see `modgnn_rl.envs.flocking.env.FlockingEnv` for keys and shapes.

    Args:
        config: settings of the environment.
        num_envs: flocks B.
        num_agents: agents N.
        has_mask: whether ``("agents", "mask")`` is emitted.
        device: device of all tensors.
        dtype: floating-point type.

    Returns:
        specs by the name of TorchRL's property: ``observation_spec``, ``full_action_spec`` and so on.
    """
    batch, agents = torch.Size([num_envs]), (num_envs, num_agents)
    real: dict[str, Any] = {"device": device, "dtype": dtype}
    flag: dict[str, Any] = {"device": device, "dtype": torch.bool}
    observed: dict[str, Any] = {
        "observation": Unbounded((*agents, 6), **real),
        "controlled": Binary(shape=agents, **flag),
    }
    if config.hides_state:
        observed["state"] = Unbounded((*agents, 6), **real)
    if has_mask:
        observed["mask"] = Binary(shape=agents, **flag)
    adjacency: Any = Binary(shape=(*agents, num_agents), **flag)
    if config.graph == "links":
        shape = (num_envs, 2, edge_capacity(config, num_agents))
        adjacency = Bounded(-1, num_agents - 1, shape, device=device, dtype=torch.int64)
    action = Bounded(-config.max_speed, config.max_speed, (*agents, 3), **real)
    reward = Unbounded((*agents, 1), **real)
    done = {name: Binary(shape=(num_envs, 1), **flag) for name in ("done", "terminated", "truncated")}
    return {
        "observation_spec": Composite(agents=Composite(**observed, shape=batch), adjacency=adjacency, shape=batch),
        "full_action_spec": Composite(agents=Composite(action=action, shape=batch), shape=batch),
        "full_reward_spec": Composite(agents=Composite(reward=reward, shape=batch), shape=batch),
        "full_done_spec": Composite(**done, shape=batch),
    }
