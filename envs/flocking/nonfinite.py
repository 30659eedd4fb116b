"""Detection of NaN, infinite and overflowing values in states and actions, at the cost of one reduction."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from modgnn_rl.errors import NotFinite

__all__ = ["check_finite", "nonfinite_agents", "nonfinite_message"]

REMEDIES = {
    "action": "a policy must return three finite numbers (m/s)",
    "state": "lower gains and dampings or raise env.physics_substeps",
}


def check_finite(
    name: str, value: Tensor, step_count: Tensor, on_nonfinite: str, counts: Tensor | None = None
) -> list[int]:
    """Find the flocks that have to restart because of a value that cannot be computed with.

    Args:
        name: what the values are, one of `REMEDIES`.
        value: one vector per agent [B, N, D].
        step_count: steps since each flock's reset [B, 1].
        on_nonfinite: "stop" or "restart", see `modgnn_rl.configs.schema.FlockingConfig`.
        counts: agents to check, bool [B, N]; default: all.

    Returns:
        indices of the flocks to restart; a RuntimeWarning names the first.

    Raises:
        NotFinite: there is such a value, and ``on_nonfinite="stop"``.
    """
    bad = nonfinite_agents(value, counts)
    if bad is None:
        return []
    reason = nonfinite_message(name, value, bad, step_count)
    if on_nonfinite == "stop":
        raise NotFinite(f"{reason}; {REMEDIES[name]}, or restart such flocks with env.on_nonfinite=restart")
    warnings.warn(f"{reason}; that flock restarts", RuntimeWarning, stacklevel=3)
    flocks: list[int] = bad.any(-1).nonzero().flatten().tolist()
    return flocks


def nonfinite_agents(value: Tensor, counts: Tensor | None = None) -> Tensor | None:
    """Find values that are NaN or infinite, or so large that squared differences of two of them overflow.

    Args:
        value: one vector per agent [B, N, D].
        counts: agents to check, bool [B, N]; default: all.

    Returns:
        agents with such a value, bool [B, N]; None if there are none.
    """
    largest = torch.finfo(value.dtype).max ** 0.5 / 4
    if torch.linalg.vector_norm(value) < largest:
        return None
    bad = ~(torch.linalg.vector_norm(value, dim=-1) < largest)
    if counts is not None:
        bad &= counts
    return bad if bad.any() else None


def nonfinite_message(name: str, value: Tensor, bad: Tensor, step_count: Tensor | None = None) -> str:
    """The first clause of an error message.

    Args:
        name: what the values are.
        value: one vector per agent [B, N, D].
        bad: agents found by `nonfinite_agents`, bool [B, N].
        step_count: steps since each flock's reset [B, 1]; default: not mentioned.
    """
    flock, agent = bad.nonzero()[0].tolist()
    found = value[flock, agent]
    more = int(bad.any(-1).sum()) - 1
    others = f", as in {more} other flock{'s' if more > 1 else ''}" if more else ""
    wrong = "too large to compute with" if found.isfinite().all() else "NaN or infinite"
    when = "" if step_count is None else f" at step {int(step_count[flock])}"
    return f"the {name} of agent {agent} in flock {flock}{when} is {wrong} ({found.tolist()}){others}"
