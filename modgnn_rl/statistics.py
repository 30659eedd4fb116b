"""Summaries over flocks with bootstrap intervals, in plain numpy.

The unit of all statistics is the flock (one episode): agents and time steps of one flock are not independent, so
average over them first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modgnn_rl.errors import InputError

__all__ = ["Summary", "interquartile_mean", "paired_difference", "summarise"]

BLOCK = 1 << 20  # values that are resampled at once


@dataclass(frozen=True)
class Summary:
    """What a table shows of one metric over flocks, in the unit of the metric."""

    mean: float
    std: float
    """Standard deviation over flocks, with n - 1 in the denominator; 0 for a single flock."""
    median: float
    low: float
    """Lower end of the confidence interval of the mean."""
    high: float
    """Upper end of the confidence interval of the mean."""
    n: int
    """Number of flocks."""


def summarise(
    values: ArrayLike, *, rng: np.random.Generator, confidence: float = 0.95, resamples: int = 2000
) -> Summary:
    """Mean, spread and percentile bootstrap interval of the mean (Efron 1979).

    The order of the values does not matter: equal sets and generators give equal summaries.

    Args:
        values: ``[F]``, one finite number for each flock.
        rng: source of the resampling.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: bootstrap samples, at least 1.

    Raises:
        InputError: no values, a value that is not finite, or a setting out of range.
    """
    data = _checked(values)
    if not 0 < confidence < 1 or resamples < 1:
        raise InputError(
            f"confidence={confidence}, resamples={resamples}: give a confidence between 0 and 1 and resamples >= 1"
        )
    block = max(1, BLOCK // data.size)
    draws = [min(block, resamples - done) for done in range(0, resamples, block)]
    means = np.concatenate([data[rng.integers(data.size, size=(count, data.size))].mean(1) for count in draws])
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return Summary(
        mean=float(data.mean()),
        std=float(data.std(ddof=1)) if data.size > 1 else 0.0,
        median=float(np.median(data)),
        low=float(low),
        high=float(high),
        n=data.size,
    )


def paired_difference(
    a: ArrayLike, b: ArrayLike, *, rng: np.random.Generator, confidence: float = 0.95, resamples: int = 2000
) -> Summary:
    """Summary of ``a - b``, where both were measured on the same flocks (same starting states, same order).

    Args:
        a: ``[F]``, finite.
        b: ``[F]``, finite.
        rng: source of the resampling.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: bootstrap samples, at least 1.

    Raises:
        InputError: different numbers of flocks, or as :func:`summarise`.
    """
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if first.shape != second.shape:
        raise InputError(f"shapes {first.shape} and {second.shape} cannot be paired; give values of the same flocks")
    return summarise(first - second, rng=rng, confidence=confidence, resamples=resamples)


def interquartile_mean(values: ArrayLike) -> float:
    """Mean of the middle half: the lowest and the highest ``floor(F / 4)`` values are left out.

    Args:
        values: ``[F]``, finite.

    Raises:
        InputError: no values, or a value that is not finite.
    """
    data = _checked(values)
    cut = data.size // 4
    return float(data[cut : data.size - cut].mean())


def _checked(values: ArrayLike) -> NDArray[np.float64]:
    """Return the values sorted, as float64, or raise InputError."""
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 1 or data.size == 0:
        raise InputError(f"values have shape {data.shape}; expected one number for each of at least one flock")
    bad = int((~np.isfinite(data)).sum())
    if bad:
        raise InputError(f"{bad} of {data.size} values are not finite; leave those flocks out and report their share")
    return np.sort(data)
