"""What agents held one step earlier, and what stands in for it where they held nothing: at the start of episodes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from modgnn_rl.utils.tensors import mask_rows

__all__ = ["STARTS", "MaskStart", "RepeatStart", "ZeroStart", "previous_step"]

PassOn = Callable[[int, Tensor, Tensor], Tensor]


def previous_step(
    data: Tensor, held: Tensor, stored: Tensor | None = None, is_init: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Shift the data of a window by one step.

    Args:
        data: what the agents hold at each step [*B, T, N, D].
        held: whether they hold it, bool [*B, T, N].
        stored: what they held in the step before the window [*B, N, D]; NaN or infinite: nothing. Default: nothing.
        is_init: steps at which an episode begins, so that nothing is held from the step before, bool [*B, T].

    Returns:
        what each node held one step earlier [R, D], zero where it held nothing, and whether it held it, bool [R].
    """
    stored_held = torch.full_like(held[..., 0, :], stored is not None)
    if stored is None:
        stored = torch.zeros_like(data[..., 0, :, :])
    before = torch.cat((stored.unsqueeze(-3), data[..., :-1, :, :]), -3)
    held_before = torch.cat((stored_held.unsqueeze(-2), held[..., :-1, :]), -2) & before.isfinite().all(-1)
    if is_init is not None:
        held_before = held_before & ~is_init.unsqueeze(-1)
    before, held_before = before.flatten(0, -2), held_before.flatten()
    return mask_rows(before, held_before), held_before


class MaskStart:
    """What an agent does not hold contributes nothing.

    One instance follows one forward pass of a layer.

    Args:
        data: the encoded observations [R, D], the data of hop 0.
        valid: which agents exist and observe finite data, bool [R].
    """

    def __init__(self, data: Tensor, valid: Tensor) -> None:
        self.data, self.valid = data, valid

    def fill(self, before: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """Fill in what was not held one step earlier.

        Args:
            before: what each node held one step earlier [R, D].
            held: whether it held it, bool [R].

        Returns:
            the same after filling in.
        """
        return before, held

    def advance(self, hop: int, pass_on: PassOn) -> None:
        """Go to the next hop.

        Args:
            hop: the hop that ends.
            pass_on: what nodes send on at a hop, from what they held [R, D], bool [R] -> [R, D'].
        """


class ZeroStart(MaskStart):
    """What an agent does not hold is zero."""

    def fill(self, before: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """See `MaskStart.fill`."""
        return before, torch.ones_like(held)


class RepeatStart(MaskStart):
    """Before an episode, its first observation and graph are repeated backwards in time."""

    def fill(self, before: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """See `MaskStart.fill`."""
        self.known = self.valid & self.data.isfinite().all(-1)
        return torch.where((held | ~self.known).unsqueeze(-1), before, self.data), held | self.known

    def advance(self, hop: int, pass_on: PassOn) -> None:
        """See `MaskStart.advance`."""
        self.data = pass_on(hop, self.data, self.known)


STARTS = {"mask": MaskStart, "zero": ZeroStart, "repeat": RepeatStart}
