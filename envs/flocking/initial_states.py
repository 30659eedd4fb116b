"""The states in which episodes start: sampled, or given by the user."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from modgnn_rl.configs.schema import REFERENCE_SIZE, FlockingConfig
from modgnn_rl.envs.flocking.nonfinite import nonfinite_agents, nonfinite_message
from modgnn_rl.envs.flocking.starts import start_positions
from modgnn_rl.errors import InputError

__all__ = ["given_states", "initial_positions", "move_padding_away"]

FAR_APART = 1e4  # m; spacing of the positions given to agents that do not exist


def initial_positions(
    config: FlockingConfig, exists: Tensor, *, is_mixed: bool, generator: torch.Generator, dtype: torch.dtype
) -> Tensor:
    """Sample the initial positions of R flocks, in balls whose volume is proportional to the flocks' sizes.

    Args:
        config: settings of the environment.
        exists: agents that exist, bool [R, N].
        is_mixed: whether flocks differ in size.
        generator: source of randomness; positions are on its device.
        dtype: floating-point type.

    Returns:
        m [R, N, 3]; arbitrary for agents that do not exist.

    Raises:
        InputError: the agents do not fit.
    """
    flocks, agents = exists.shape
    sizes = exists.sum(-1)
    radius = config.start_radius * (sizes / REFERENCE_SIZE).to(dtype) ** (1 / 3)
    return start_positions(
        config.start,
        flocks,
        agents,
        radius if is_mixed else config.start_radius * (agents / REFERENCE_SIZE) ** (1 / 3),
        config.start_distance,
        config.start_clusters,
        generator=generator,
        dtype=dtype,
        exists=exists if is_mixed else None,
    )


def given_states(tensordict: TensorDictBase, exists: Tensor, dtype: torch.dtype) -> Tensor:
    """The states that a user gives to ``reset(tensordict, set_state=True)``.

    Args:
        tensordict: with ``("agents", "state")`` or ``("agents", "observation")`` [B, N, 6].
        exists: agents that exist, bool [B, N].
        dtype: floating-point type.

    Returns:
        positions, m, and velocities, m/s [B, N, 6]; zero for agents that do not exist.

    Raises:
        InputError: the state is missing, has another shape, or is NaN or infinite.
    """
    agents = tensordict.get("agents", TensorDict())
    state = agents.get("state", agents.get("observation", None))
    expected = (*exists.shape, 6)
    if state is None or tuple(state.shape) != expected:
        found = "nothing" if state is None else f"shape {tuple(state.shape)}"
        raise InputError(
            f"reset(..., set_state=True) needs positions and velocities of shape {expected} under "
            f"('agents', 'state'); there is {found}"
        )
    state = state.to(dtype)
    bad = nonfinite_agents(state, exists)
    if bad is not None:
        reason = nonfinite_message("state", state, bad)
        raise InputError(f"{reason}; give finite positions (m) and velocities (m/s)")
    return state.masked_fill(~exists.unsqueeze(-1), 0.0)


def move_padding_away(position: Tensor, exists: Tensor) -> Tensor:
    """Positions, m [R, N, 3], in which agents that do not exist, by bool [R, N], are out of everyone's range."""
    away = torch.arange(1, exists.shape[-1] + 1, device=position.device, dtype=position.dtype) * FAR_APART
    return torch.where(exists.unsqueeze(-1), position, away.unsqueeze(-1))
