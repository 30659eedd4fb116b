"""Numbers that nothing can be computed with any more: finding them, at the cost of one reduction, and naming them."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from modgnn_rl.errors import NotFinite

__all__ = ["complaint", "lost_flocks", "unusable"]

REMEDIES = {
    "action": "a policy must give three finite numbers, m/s",
    "state": "lower gains and dampings or raise env.physics_substeps",
}


def lost_flocks(
    name: str, value: Tensor, step_count: Tensor, on_nonfinite: str, counts: Tensor | None = None
) -> list[int]:
    """Find the flocks that cannot fly on, and warn of them or stop.

    Args:
        name: what the values are, one of `REMEDIES`.
        value: of agents [B, N, D].
        step_count: steps that each flock has flown [B, 1].
        on_nonfinite: "stop" or "restart", see `modgnn_rl.configs.schema.FlockingConfig`.
        counts: agents that count, bool [B, N]; default: all.

    Raises:
        NotFinite: there are some, and ``on_nonfinite="stop"``.
    """
    bad = unusable(value, counts)
    if bad is None:
        return []
    reason = complaint(name, value, bad, step_count)
    if on_nonfinite == "stop":
        raise NotFinite(f"{reason}; {REMEDIES[name]}, or let such flocks begin anew with env.on_nonfinite=restart")
    warnings.warn(f"{reason}; that flock begins anew", RuntimeWarning, stacklevel=3)
    flocks: list[int] = bad.any(-1).nonzero().flatten().tolist()
    return flocks


def unusable(value: Tensor, counts: Tensor | None = None) -> Tensor | None:
    """Find values that are not finite, or so large that squared differences of two of them are not.

    Args:
        value: of agents [B, N, D].
        counts: agents that count, bool [B, N]; default: all.

    Returns:
        agents with such a value, bool [B, N]; None where nobody has one.
    """
    largest = torch.finfo(value.dtype).max ** 0.5 / 4
    if torch.linalg.vector_norm(value) < largest:
        return None
    bad = ~(torch.linalg.vector_norm(value, dim=-1) < largest)
    if counts is not None:
        bad &= counts
    return bad if bad.any() else None


def complaint(name: str, value: Tensor, bad: Tensor, step_count: Tensor) -> str:
    """The first clause of an error message.

    Args:
        name: what the values are.
        value: [B, N, D].
        bad: agents whose value is `unusable`, bool [B, N].
        step_count: steps that each flock has flown [B, 1].
    """
    flock, agent = bad.nonzero()[0].tolist()
    found = value[flock, agent]
    more = int(bad.any(-1).sum()) - 1
    others = f", as in {more} other flock{'s' if more > 1 else ''}" if more else ""
    wrong = "too large to compute with" if found.isfinite().all() else "not finite"
    step = int(step_count[flock])
    return f"the {name} of agent {agent} in flock {flock} at step {step} is {wrong} ({found.tolist()}){others}"
