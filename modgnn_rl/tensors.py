"""Small tensor functions that the environment, the expert and the policies share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

__all__ = [
    "clip_to_ball",
    "is_transformed",
    "keep_rows",
    "pair_differences",
    "pair_distances",
    "squared_norm",
    "stack_padded",
]


def is_transformed() -> bool:
    """Whether a compiler or a transform of ``torch.func`` is at work, under which shapes must not depend on data."""
    return torch.compiler.is_compiling() or torch._C._functorch.maybe_current_level() is not None


def keep_rows(value: Tensor, rows: Tensor, other: float = 0.0) -> Tensor:
    """Value [R, ...] in the rows to keep, bool [R], and ``other`` elsewhere; what is NaN there reaches no gradient."""
    # Choosing costs far more than looking whether there is anything to choose, where looking does not stall a device.
    if value.device.type == "cpu" and not is_transformed() and rows.all():
        return value
    filling = torch.full((), other, dtype=value.dtype, device=value.device)
    return torch.where(rows.view(-1, *[1] * (value.ndim - 1)), value, filling)


def stack_padded(tensors: Sequence[Tensor]) -> Tensor:
    """Stack tensors [..., D_k] of any widths along the last dimension but one, filled up with zeros [..., K, D]."""
    width = max(tensor.shape[-1] for tensor in tensors)
    return torch.stack([pad(tensor, (0, width - tensor.shape[-1])) for tensor in tensors], -2)


def clip_to_ball(vector: Tensor, radius: float) -> Tensor:
    """Project vectors [..., D] onto the ball of the given radius: ``x min(1, radius / |x|)``.

    Its gradient exists everywhere, also at the origin.
    """
    norm = vector.square().sum(-1, keepdim=True).clamp(min=1e-16).sqrt()
    return vector * (radius / norm).clamp(max=1.0)


def pair_differences(vector: Tensor) -> list[Tensor]:
    """Differences of all pairs, one tensor [..., N, N] a component of [..., N, D]: entry i, j is ``x_j - x_i``.

    Separate components keep everything that follows pointwise, several times faster on a CPU than [..., N, N, D].
    """
    return [component.unsqueeze(-2) - component.unsqueeze(-1) for component in vector.unbind(-1)]


def squared_norm(components: Sequence[Tensor]) -> Tensor:
    """Sum of the squares of components that are tensors of their own."""
    first, *others = components
    total = first * first
    for component in others:
        total = torch.addcmul(total, component, component)
    return total


def pair_distances(position: Tensor) -> Tensor:
    """Distances of all pairs [..., N, 3] -> [..., N, N]; infinite on the diagonal: nobody is its own neighbour."""
    square = squared_norm(pair_differences(position))
    square.diagonal(dim1=-2, dim2=-1).fill_(torch.inf)
    return square.sqrt()
