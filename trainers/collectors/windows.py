"""Windows of rollouts: the samples that policies learn from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase

from modgnn_rl.configs.schema import ImitationConfig
from modgnn_rl.models.blocks import is_equivariant
from modgnn_rl.nn.modgnn import ModGNN

__all__ = ["are_alike", "as_windows", "reservoir_places", "stores_messages", "window_of"]


def reservoir_places(
    seen: int, count: int, capacity: int, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Reservoir sampling (Vitter 1985): which of new items replace which, so that all ever seen are kept alike.

    Args:
        seen: items seen before, at least ``capacity``.
        count: new items.
        capacity: items kept.
        generator: source of randomness.

    Returns:
        places in the store, and the new items that go there, int64 [R] each; no place comes twice.
    """
    items = torch.arange(count)
    chance = torch.rand(count, generator=generator, dtype=torch.float64)
    drawn = (chance * (seen + items + 1)).long()
    stays = drawn < capacity
    place, item = drawn[stays], items[stays]
    last = torch.full((capacity,), -1).scatter_reduce(0, place, item, "amax")  # a later item goes over an earlier one
    place = (last >= 0).nonzero().squeeze(-1)
    return place, last[place]


def window_of(policies: Sequence[ModGNN], settings: ImitationConfig) -> int:
    """Steps of the windows that policies learn from: one, with the stored messages, where that is enough."""
    if are_alike(policies) and stores_messages(policies[0]) and not settings.hide_velocity:
        return 1
    return max(policy.window for policy in policies)


def stores_messages(policy: ModGNN) -> bool:
    """Whether a policy is trained with the messages that it received in closed loop; if not, windows make them anew.

    They must hold no trace of a parameter, and turn with a rotated state: as sums of observations do, and as all does
    that an equivariant policy sends, whose states need no rotation.
    """
    return policy.sends_plain_data and (len(policy.layers) == 1 or is_equivariant(policy))


def as_windows(rollouts: TensorDictBase, length: int, stride: int) -> TensorDictBase:
    """Cut rollouts [B, T] into overlapping windows [B * n, length] whose last steps are ``every`` steps apart."""
    last = torch.arange(length - 1, rollouts.shape[1], stride, device=rollouts.device)
    steps = last.unsqueeze(-1) + torch.arange(1 - length, 1, device=rollouts.device)
    return rollouts[:, steps].flatten(0, 1)


def are_alike(policies: Sequence[ModGNN]) -> bool:
    """Whether policies differ in their weights only."""
    return len({str(policy) + str([value.shape for value in policy.state_dict().values()]) for policy in policies}) == 1
