"""Small tensor functions that the environment, the expert and the policies share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from modgnn_rl.utils.internals import is_functorch_active

__all__ = [
    "clip_to_ball",
    "flatnonzero",
    "is_transformed",
    "mask_rows",
    "pair_blocks",
    "pair_differences",
    "pair_distances",
    "squared_norm",
    "stack_padded",
]

PAIRS_IN_BLOCK = {"cpu": 2**16}  # pairs computed at a time; they fit the cache of one core
PAIRS_IN_BLOCK_ELSEWHERE = 2**24


def is_transformed() -> bool:
    """Whether code runs under a compiler or a ``torch.func`` transform, where shapes must not depend on data."""
    return torch.compiler.is_compiling() or is_functorch_active()


def flatnonzero(mask: Tensor) -> Tensor:
    """Indices where a mask [E] is true, ascending, int64; on the CPU computed by NumPy, ten times faster than torch."""
    if mask.device.type == "cpu" and not is_transformed():
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero().squeeze(-1)


def mask_rows(value: Tensor, rows: Tensor, other: float = 0.0) -> Tensor:
    """Set the rows [R, ...] where a mask [R] is false to ``other``; NaN there reaches no gradient."""
    # torch.where costs far more than this test, which does not stall a CPU.
    if value.device.type == "cpu" and not is_transformed() and rows.all():
        return value
    filling = torch.full((), other, dtype=value.dtype, device=value.device)
    return torch.where(rows.view(-1, *[1] * (value.ndim - 1)), value, filling)


def stack_padded(tensors: Sequence[Tensor]) -> Tensor:
    """Stack K tensors [..., D_k] of different widths, padded with zeros: [..., K, D]."""
    width = max(tensor.shape[-1] for tensor in tensors)
    return torch.stack([pad(tensor, (0, width - tensor.shape[-1])) for tensor in tensors], -2)


def clip_to_ball(vector: Tensor, radius: float) -> Tensor:
    """Project vectors [..., D] onto the ball of the given radius: ``x min(1, radius / |x|)``.

    Its gradient exists everywhere, also at the origin.
    """
    norm = squared_norm(vector.unbind(-1)).clamp(min=1e-16).sqrt()
    return vector * (radius / norm).clamp(max=1.0).unsqueeze(-1)


def pair_differences(vector: Tensor, receivers: slice | None = None) -> tuple[Tensor, ...]:
    """Pairwise differences ``x_j - x_i`` of vectors [..., N, D], one tensor [..., R, N] per component.

    With separate components all further operations are pointwise, several times faster on a CPU than [..., R, N, D].

    Args:
        vector: vectors x.
        receivers: the R agents i; default: all.
    """
    theirs = vector.movedim(-1, 0).contiguous()
    ours = theirs if receivers is None else theirs[..., receivers]
    return (theirs.unsqueeze(-2) - ours.unsqueeze(-1)).unbind()


def pair_blocks(position: Tensor) -> Iterator[tuple[slice, slice]]:
    """Split all pairs of [B, N, D] into blocks that fit the cache: whole flocks, or some agents of one against all.

    Yields:
        the flocks and the agents of each block, in the order of ``position.flatten(0, 1)``.
    """
    flocks, agents = position.shape[:2]
    budget = PAIRS_IN_BLOCK.get(position.device.type, PAIRS_IN_BLOCK_ELSEWHERE)
    whole, part = max(1, budget // max(1, agents) ** 2), max(1, budget // max(1, agents))
    for flock in range(0, max(1, flocks), whole):  # an empty batch is one empty block
        for agent in range(0, max(1, agents), part):
            yield slice(flock, min(flock + whole, flocks)), slice(agent, min(agent + part, agents))


def squared_norm(components: Sequence[Tensor]) -> Tensor:
    """Sum of squares of components, each given as a separate tensor."""
    first, *others = components
    total = first * first
    for component in others:
        total = torch.addcmul(total, component, component)
    return total


def pair_distances(position: Tensor) -> Tensor:
    """Distances of all pairs [..., N, 3] -> [..., N, N]; infinite on the diagonal (no agent is its own neighbour)."""
    square = squared_norm(pair_differences(position))
    if torch.compiler.is_compiling():
        return square.masked_fill(torch.eye(square.shape[-1], dtype=torch.bool, device=square.device), torch.inf).sqrt()
    square.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    return square.sqrt()
