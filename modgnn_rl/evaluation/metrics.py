"""Metrics of every task: the error against the expert, the reward, and success.

Each is registered with what tables and dashboards need to know of it; `modgnn_rl.metrics` explains the options.
"""

from __future__ import annotations

import torch
from torch import Tensor

from modgnn_rl.registry import METRICS

__all__ = ["action_error", "agent_reward", "is_solved"]


@METRICS.register(
    "error",
    title="error",
    unit="",
    better="lower",
    about="mean squared error of the action against the expert's, per component (of discrete actions: fraction that "
    "differs), over the agents the policy controls",
    inputs=("difference", "controlled"),
    over_time="mean",
    cell="{mean:.3f} ± {std:.3f} [{low:.3f}, {high:.3f}]",
    replay=True,
)
def action_error(difference: Tensor, controlled: Tensor) -> Tensor:
    """Mean difference from the expert's actions, over the agents that the policy controls.

    ``sum_i c_i d_i / sum_i c_i`` with ``c = controlled``; with ``d_i = |u_i - u*_i|^2 / D`` the paper's "Error". Values
    of the other agents have no influence, not even a NaN.

    Args:
        difference: of each agent, see `modgnn_rl.actions.ActionSpace.difference` ``[*B, N]``.
        controlled: the agents that the policy controls, bool ``[*B, N]``.

    Returns:
        ``[*B]``, in the unit of the difference, (m/s)^2 for velocities; NaN for a flock without controlled agents.
    """
    return torch.where(controlled, difference, 0.0).sum(-1) / controlled.sum(-1)


@METRICS.register(
    "reward",
    title="reward",
    unit="",
    better="higher",
    about="reward of an agent, summed over the episode",
    inputs=("reward",),
    over_time="sum",
    cell="{mean:.1f} [{low:.1f}, {high:.1f}]",
)
def agent_reward(reward: Tensor) -> Tensor:
    """Reward of each agent in a step, ``[*B, N]``, as the environment gives it."""
    return reward


@METRICS.register(
    "success",
    title="success",
    unit="%",
    better="higher",
    about="fraction of episodes in which the task was solved at some step",
    inputs=("success",),
    over_time="any",
    cell="{mean:.0%}",
)
def is_solved(success: Tensor) -> Tensor:
    """Whether the task is solved in the state after a step, bool ``[*B]``."""
    return success
