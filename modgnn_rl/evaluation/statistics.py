"""Summaries over episodes and seeds with bootstrap intervals, in plain numpy.

The unit of all statistics is the episode of a flock: its agents and time steps are not independent, so average over
them first.

The bootstrap is hierarchical, with two levels (Davison and Hinkley 1997): a resample picks seeds with replacement and,
within each of these, episodes with replacement; with one seed, it is Efron's (1979). The stratified bootstrap of
Agarwal et al. (2021) differs: it resamples runs within each task and keeps all tasks. Intervals are percentiles of the
resamples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

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

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Summary:
    """A metric over episodes, in its unit."""

    mean: float
    std: float
    """Standard deviation over episodes, with n - 1 in the denominator; 0 for a single episode."""
    median: float
    low: float
    """Lower end of the confidence interval of the mean."""
    high: float
    """Upper end of the confidence interval of the mean."""
    n: int
    """Number of episodes."""


@dataclass(frozen=True)
class Interval:
    """A value with its confidence interval."""

    value: float
    low: float
    high: float


def summarise(
    values: ArrayLike, *, rng: np.random.Generator, confidence: float = 0.95, resamples: int = 2000
) -> Summary:
    """Mean, standard deviation, median, and bootstrap interval of the mean.

    The order of the values does not matter: equal sets and generators give equal summaries.

    Args:
        values: ``[F]``, one finite number per episode.
        rng: random numbers of the bootstrap.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: number of bootstrap samples, at least 1.

    Raises:
        InputError: no values, a value that is NaN or infinite, or a setting out of range.
    """
    data = _checked(values)
    _check_settings(confidence, resamples)
    means = _bootstrap(data[None], lambda rows: rows.mean(1), rng, resamples)
    low, high = _percentiles(means, confidence, "linear")
    return Summary(
        mean=float(data.mean()),
        std=float(data.std(ddof=1)) if data.size > 1 else 0.0,
        median=float(np.median(data)),
        low=low,
        high=high,
        n=data.size,
    )


def paired_difference(
    a: ArrayLike, b: ArrayLike, *, rng: np.random.Generator, confidence: float = 0.95, resamples: int = 2000
) -> Summary:
    """Summary of ``a - b``, both from the same initial states in the same order.

    Args:
        a: ``[F]``, finite.
        b: ``[F]``, finite.
        rng: random numbers of the bootstrap.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: number of bootstrap samples, at least 1.

    Raises:
        InputError: different numbers of episodes, or as :func:`summarise`.
    """
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if first.shape != second.shape:
        raise InputError(f"shapes {first.shape} and {second.shape} cannot be paired; give values of the same episodes")
    return summarise(first - second, rng=rng, confidence=confidence, resamples=resamples)


def interquartile_mean(values: ArrayLike) -> float:
    """Interquartile mean (IQM): the mean without the lowest and the highest ``floor(F / 4)`` values.

    Args:
        values: ``[F]``, finite.

    Raises:
        InputError: no values, or a value that is NaN or infinite.
    """
    return float(_interquartile_means(_checked(values)[None])[0])


def interquartile_interval(
    values: ArrayLike, *, rng: np.random.Generator, confidence: float = 0.95, resamples: int = 2000
) -> Interval:
    """Interquartile mean over seeds and episodes, with its bootstrap interval.

    With one seed, the interval covers the variation between episodes only.

    Args:
        values: ``[S, F]``, one row per seed and one column per episode; infinite values count as the worst.
        rng: random numbers of the bootstrap.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: number of bootstrap samples, at least 1.

    Raises:
        InputError: no values, a NaN, or a setting out of range.
    """
    data = _checked_matrix(values)
    _check_settings(confidence, resamples)
    samples = _bootstrap(data, _interquartile_means, rng, resamples)
    return Interval(float(_interquartile_means(data.reshape(1, -1))[0]), *_percentiles(samples, confidence, "nearest"))


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

    Episodes are Agarwal's tasks, seeds the runs: if both policies had the same initial states, each episode is compared
    with itself, for all pairs of seeds. The bootstrap resamples the seeds of each policy, and the episodes,
    independently of each other.

    Args:
        better: ``[S, F]``, one row per seed and one column per episode; lower is better.
        worse: ``[T, G]``, the same of the other policy.
        rng: random numbers of the bootstrap.
        paired: episode f of both started in the same state (F = G); else every episode is compared with every other.
        confidence: coverage of the interval, above 0 and below 1.
        resamples: number of bootstrap samples, at least 1.

    Raises:
        InputError: no values, a NaN, a setting out of range, or different numbers of episodes to pair.
    """
    x, y = _checked_matrix(better), _checked_matrix(worse)
    _check_settings(confidence, resamples)
    if paired and x.shape[1] != y.shape[1]:
        raise InputError(f"{x.shape[1]} and {y.shape[1]} episodes cannot be paired; give values of the same episodes")
    if paired:
        a, b, axes = x[:, None], y[None], "stf,rs,rt,rf->r"
    else:
        a, b, axes = x[:, None, :, None], y[None, :, None, :], "stfg,rs,rt,rf,rg->r"
    wins = (a < b) + (a == b) / 2
    # Of each axis, how often a resample contains each index, as a fraction [R, length].
    weights = [rng.multinomial(n, np.full(n, 1 / n), size=resamples) / n for n in wins.shape]
    samples = np.einsum(axes, wins, *weights, optimize=True)
    return Interval(float(wins.mean()), *_percentiles(samples, confidence, "nearest"))


def _bootstrap(data: Array, statistic: Callable[[Array], Array], rng: np.random.Generator, resamples: int) -> Array:
    """A statistic of resamples of the data [S, F]: seeds with replacement, then episodes within each seed.

    Args:
        data: one row per seed, one column per episode.
        statistic: of the rows of resampled values [R, S * F], gives [R].
        rng: random numbers.
        resamples: R.
    """
    seeds = rng.integers(len(data), size=(resamples, len(data), 1))
    block = max(1, BLOCK // data.size)
    found = []
    for start in range(0, resamples, block):
        some = seeds[start : start + block]
        episodes = rng.integers(data.shape[1], size=(len(some), *data.shape))
        found.append(statistic(data[some, episodes].reshape(len(some), -1)))
    return np.concatenate(found)


def _percentiles(samples: Array, confidence: float, method: Literal["linear", "nearest"]) -> tuple[float, float]:
    """Ends of the confidence interval; with infinite samples, ``nearest``, which never averages two of them."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(samples, [tail, 1 - tail], method=method)
    return float(low), float(high)


def _interquartile_means(rows: Array) -> Array:
    """Interquartile mean of each row [R, n] -> [R]."""
    cut = rows.shape[1] // 4
    return np.asarray(np.sort(rows, axis=1)[:, cut : rows.shape[1] - cut].mean(1))


def _check_settings(confidence: float, resamples: int) -> None:
    if not 0 < confidence < 1 or resamples < 1:
        raise InputError(
            f"confidence={confidence}, resamples={resamples}: give a confidence between 0 and 1 and resamples >= 1"
        )


def _checked_matrix(values: ArrayLike) -> Array:
    """The values as float64 [S, F].

    Raises:
        InputError: they have another shape, or contain a NaN.
    """
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 2 or data.size == 0:
        raise InputError(f"values have shape {data.shape}; expected one row per seed and one column per episode")
    if bad := int(np.isnan(data).sum()):
        raise InputError(f"{bad} of {data.size} values are NaN; replace the values of such episodes by infinity")
    return data


def _checked(values: ArrayLike) -> Array:
    """The values sorted, as float64 [F].

    Raises:
        InputError: they have another shape, or one is NaN or infinite.
    """
    data = np.asarray(values, dtype=np.float64)
    if data.ndim != 1 or data.size == 0:
        raise InputError(f"values have shape {data.shape}; expected one number for each of at least one episode")
    if bad := int((~np.isfinite(data)).sum()):
        raise InputError(f"{bad} of {data.size} values are NaN or infinite; leave such episodes out and say how many")
    return np.sort(data)
