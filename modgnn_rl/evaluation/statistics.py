"""Summaries over flocks and seeds with bootstrap intervals, in plain numpy.

The unit of all statistics is the flock (one episode): agents and time steps of one flock are not independent, so
average over them first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modgnn_rl.errors import InputError

__all__ = [
    "Interval",
    "Summary",
    "interquartile_interval",
    "interquartile_mean",
    "paired_difference",
    "probability_of_improvement",
    "summarise",
]

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


@dataclass(frozen=True)
class Interval:
    """A figure with its confidence interval."""

    value: float
    low: float
    high: float


def interquartile_interval(
    values: ArrayLike, *, rng: np.random.Generator, confidence: float = 0.95, resamples: int = 2000
) -> Interval:
    """Interquartile mean over seeds and rollouts, and its stratified bootstrap interval (Agarwal et al. 2021).

    A resample draws seeds with replacement, and then, within each seed drawn, rollouts with replacement. With one seed
    the interval tells of rollouts only.

    Args:
        values: ``[S, F]``, of each seed its rollouts; infinite values are allowed, they count as the worst.
        rng: source of the resampling.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: bootstrap samples, at least 1.

    Raises:
        InputError: no values, a NaN, or a setting out of range.
    """
    data = _checked_matrix(values)
    lot = _Lot(rng, resamples, confidence)
    seeds, rollouts = data.shape
    drawn = data[lot.draw(seeds, (seeds, 1)), lot.draw(rollouts, data.shape)].reshape(resamples, -1)
    return lot.interval(float(_middle_mean(data.reshape(1, -1))[0]), _middle_mean(drawn))


def probability_of_improvement(
    better: ArrayLike,
    worse: ArrayLike,
    *,
    rng: np.random.Generator,
    paired: bool = True,
    confidence: float = 0.95,
    resamples: int = 2000,
) -> Interval:
    """Probability that one policy has a lower value than another: ``P(X < Y) + P(X = Y) / 2`` (Agarwal et al. 2021).

    The rollouts are Agarwal's tasks, the seeds the runs: where both flew the same rollouts, each rollout is compared
    with itself, for all pairs of seeds. The interval is that of a bootstrap over the seeds of each and over the
    rollouts.

    Args:
        better: ``[S, F]``, of each seed of the one its rollouts; lower is better.
        worse: ``[T, G]``, the same of the other.
        rng: source of the resampling.
        paired: rollout f of the one began like rollout f of the other (F = G); else every rollout meets every other.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: bootstrap samples, at least 1.

    Raises:
        InputError: no values, a NaN, a setting out of range, or different rollouts where they should be paired.
    """
    x, y = _checked_matrix(better), _checked_matrix(worse)
    if paired and x.shape[1] != y.shape[1]:
        raise InputError(f"{x.shape[1]} and {y.shape[1]} rollouts cannot be paired; give values of the same rollouts")
    if paired:
        a, b, axes = x[:, None], y[None], "stf,rs,rt,rf->r"
    else:
        a, b, axes = x[:, None, :, None], y[None, :, None, :], "stfg,rs,rt,rf,rg->r"
    wins = (a < b) + (a == b) / 2
    lot = _Lot(rng, resamples, confidence)
    shares = [lot.shares(length) for length in wins.shape]
    return lot.interval(float(wins.mean()), np.einsum(axes, wins, *shares, optimize=True))


@dataclass(frozen=True)
class _Lot:
    """Bootstrap samples, all drawn at once."""

    rng: np.random.Generator
    resamples: int
    confidence: float

    def __post_init__(self) -> None:
        if not 0 < self.confidence < 1 or self.resamples < 1:
            raise InputError(
                f"confidence={self.confidence}, resamples={self.resamples}: give a confidence between 0 and 1 and "
                "resamples >= 1"
            )

    def draw(self, length: int, shape: tuple[int, ...]) -> NDArray[np.int64]:
        """Indices below ``length`` for each resample."""
        return self.rng.integers(length, size=(self.resamples, *shape))

    def shares(self, length: int) -> NDArray[np.float64]:
        """How often each of ``length`` is drawn in each resample, in shares [R, length]."""
        return self.rng.multinomial(length, np.full(length, 1 / length), size=self.resamples) / length

    def interval(self, value: float, drawn: NDArray[np.float64]) -> Interval:
        """Return a figure with the percentiles of its resamples [R]."""
        tail = (1 - self.confidence) / 2
        # Each end is a resample, not a mean of two: one of them may be infinite.
        low, high = np.quantile(drawn, [tail, 1 - tail], method="nearest")
        return Interval(value, float(low), float(high))


def _middle_mean(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interquartile mean of each row [R, n] -> [R]."""
    cut = rows.shape[1] // 4
    return np.asarray(np.sort(rows, axis=1)[:, cut : rows.shape[1] - cut].mean(1))


def _checked_matrix(values: ArrayLike) -> NDArray[np.float64]:
    """Return the values as float64 [S, F], or raise InputError."""
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 2 or data.size == 0:
        raise InputError(f"values have shape {data.shape}; expected one row a seed and one column a rollout")
    if bad := int(np.isnan(data).sum()):
        raise InputError(f"{bad} of {data.size} values are no numbers; count those rollouts as infinite, or say so")
    return data


def _checked(values: ArrayLike) -> NDArray[np.float64]:
    """Return the values sorted, as float64, or raise InputError."""
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 1 or data.size == 0:
        raise InputError(f"values have shape {data.shape}; expected one number for each of at least one flock")
    bad = int((~np.isfinite(data)).sum())
    if bad:
        raise InputError(f"{bad} of {data.size} values are not finite; leave those flocks out and report their share")
    return np.sort(data)
