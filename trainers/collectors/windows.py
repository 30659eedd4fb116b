"""Windows of rollouts: the samples that policies learn from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase

from modgnn_rl.configs.schema import ImitationConfig
from modgnn_rl.models.blocks import is_equivariant
from modgnn_rl.nn.modgnn import ModGNN

__all__ = ["have_same_architecture", "reservoir_indices", "slice_windows", "uses_stored_messages", "window_length"]


def slice_windows(rollouts: TensorDictBase, length: int, stride: int) -> TensorDictBase:
    """Cut rollouts [B, T] into overlapping windows [B * n, length] whose last steps are ``stride`` steps apart."""
    last = torch.arange(length - 1, rollouts.shape[1], stride, device=rollouts.device)
    steps = last.unsqueeze(-1) + torch.arange(1 - length, 1, device=rollouts.device)
    return rollouts[:, steps].flatten(0, 1)


def window_length(policies: Sequence[ModGNN], settings: ImitationConfig) -> int:
    """Number of steps in each training sample; 1 if all policies can learn from the stored messages."""
    if have_same_architecture(policies) and uses_stored_messages(policies[0]) and not settings.hide_velocity:
        return 1
    return max(policy.window for policy in policies)


def uses_stored_messages(policy: ModGNN) -> bool:
    """Whether a policy learns from the messages it received in closed loop; otherwise a window recomputes them.

    Such messages must not depend on parameters, and must rotate with the state. Sums of observations do, and so do all
    messages of an equivariant policy, whose training states are not rotated.
    """
    return policy.sends_plain_data and (len(policy.layers) == 1 or is_equivariant(policy))


def have_same_architecture(policies: Sequence[ModGNN]) -> bool:
    """Whether policies differ in their weights only."""
    return len({str(policy) + str([value.shape for value in policy.state_dict().values()]) for policy in policies}) == 1


def reservoir_indices(
    seen: int, count: int, capacity: int, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Reservoir sampling (Vitter 1985): which new items replace which, so that each item is kept equally likely.

    Args:
        seen: number of items so far, at least ``capacity``.
        count: number of new items.
        capacity: number of items that are kept.
        generator: source of randomness.

    Returns:
        indices in the reservoir, all different, and the new items to store there, int64 [R] each.
    """
    items = torch.arange(count)
    chance = torch.rand(count, generator=generator, dtype=torch.float64)
    sampled = (chance * (seen + items + 1)).long()
    is_kept = sampled < capacity
    index, item = sampled[is_kept], items[is_kept]
    last = torch.full((capacity,), -1).scatter_reduce(0, index, item, "amax")  # a later item replaces an earlier one
    index = (last >= 0).nonzero().squeeze(-1)
    return index, last[index]
