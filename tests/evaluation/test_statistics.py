"""Summaries against closed forms, invariances and the coverage they promise."""

from __future__ import annotations

import dataclasses
import statistics

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modgnn_rl.errors import InputError
from modgnn_rl.evaluation import statistics as module
from modgnn_rl.evaluation.statistics import (
    interquartile_interval,
    interquartile_mean,
    paired_difference,
    probability_of_improvement,
    summarise,
)

FLOCKS = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@settings(max_examples=30, deadline=None)
@given(FLOCKS, st.randoms(use_true_random=False))
def test_moments_order_and_bounds(values: list[float], random: object) -> None:
    summary = summarise(values, rng=rng(), resamples=50)
    assert summary.mean == pytest.approx(statistics.fmean(values), rel=1e-9, abs=1e-9)
    assert summary.median == pytest.approx(statistics.median(values))
    spread = statistics.stdev(values) if len(values) > 1 else 0.0
    assert summary.std == pytest.approx(spread, rel=1e-9, abs=1e-6)
    assert summary.n == len(values)
    assert min(values) - 1e-9 <= summary.low <= summary.high <= max(values) + 1e-9
    shuffled = values.copy()
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    assert summarise(shuffled, rng=rng(), resamples=50) == summary


def test_constant_values() -> None:
    summary = summarise([2.5] * 7, rng=rng())
    assert dataclasses.astuple(summary) == (2.5, 0.0, 2.5, 2.5, 2.5, 7)


def test_interval_of_normal_data_has_the_width_of_theory() -> None:
    values = rng(1).normal(size=400)
    summary = summarise(values, rng=rng(2), resamples=4000)
    error = values.std() / 20
    assert summary.low == pytest.approx(values.mean() - 1.96 * error, abs=0.15 * error)
    assert summary.high == pytest.approx(values.mean() + 1.96 * error, abs=0.15 * error)


@pytest.mark.parametrize(("confidence", "least", "most"), [(0.95, 0.90, 0.98), (0.5, 0.42, 0.58)])
def test_coverage(confidence: float, least: float, most: float) -> None:
    samples = rng(3).normal(loc=1.0, size=(400, 40))
    intervals = [summarise(row, rng=rng(i), confidence=confidence, resamples=200) for i, row in enumerate(samples)]
    assert least < np.mean([interval.low <= 1.0 <= interval.high for interval in intervals]) < most


def test_paired_difference_uses_the_pairing() -> None:
    easy_or_hard = rng(4).normal(scale=100, size=50)
    summary = paired_difference(easy_or_hard + 1, easy_or_hard, rng=rng())
    assert summary.mean == pytest.approx(1.0)
    assert summary.std == pytest.approx(0.0, abs=1e-12)
    assert summary.low == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("values", "expected"),
    [([5, 8, 4, 38, 8, 6, 9, 7, 7, 3, 1, 6], 6.5), ([4.0], 4.0), ([1, 2, 6], 3.0), ([-1e9, 1, 3, 1e9], 2.0)],
)
def test_interquartile_mean(values: list[float], expected: float) -> None:
    assert interquartile_mean(values) == pytest.approx(expected)


def test_bad_values_are_refused() -> None:
    for call in (lambda v: summarise(v, rng=rng()), interquartile_mean):
        with pytest.raises(InputError, match="1 of 3 values are NaN or infinite"):
            call([1.0, float("nan"), 2.0])
        with pytest.raises(InputError, match="shape"):
            call([])
        with pytest.raises(InputError, match="shape"):
            call([[1.0, 2.0]])


@pytest.mark.parametrize("bad", [{"confidence": 0.0}, {"confidence": 1.0}, {"confidence": 95}, {"resamples": 0}])
def test_bad_settings_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InputError, match="confidence"):
        summarise([1.0, 2.0], rng=rng(), **bad)  # type: ignore[arg-type]


def test_pairs_need_equal_shapes() -> None:
    with pytest.raises(InputError, match="paired"):
        paired_difference([1.0, 2.0], [1.0], rng=rng())


def test_the_interquartile_interval_has_the_width_of_theory() -> None:
    """The 25 % trimmed mean of normal data has 1.195 times the variance of the mean (Stigler; Wilcox)."""
    values = rng(1).normal(size=(1, 2000))
    found = interquartile_interval(values, rng=rng(2), resamples=1500)
    assert found.value == pytest.approx(interquartile_mean(values[0]))
    error = np.sqrt(1.195 / 2000)
    assert found.high - found.low == pytest.approx(2 * 1.96 * error, rel=0.1)


def test_the_bootstrap_resamples_seeds_and_episodes_within_them() -> None:
    """Seeds that differ while their rollouts do not: a resample averages whole seeds."""
    between = interquartile_interval(np.array([[0.0] * 50, [1.0] * 50]), rng=rng(), resamples=500)
    assert (between.low, between.value, between.high) == (0.0, 0.5, 1.0)
    same = interquartile_interval(np.full((3, 4), 2.5), rng=rng(), resamples=20)
    assert (same.low, same.value, same.high) == (2.5, 2.5, 2.5)
    # Episodes that differ while seeds do not: more seeds with as many episodes narrow the interval.
    rollouts = rng(3).normal(size=100)
    one, four = (interquartile_interval(np.tile(rollouts, (n, 1)), rng=rng(), resamples=800) for n in (1, 4))
    assert (four.high - four.low) == pytest.approx((one.high - one.low) / 2, rel=0.25)


def test_one_infinite_episode_does_not_move_the_interquartile_mean() -> None:
    found = interquartile_interval([[1.0, 2.0, 3.0, 4.0, np.inf, 0.0, 2.0, 3.0]], rng=rng(), resamples=200)
    assert found.value == 2.5


@pytest.mark.parametrize(
    ("better", "worse", "expected"),
    [
        ([[0.0, 0.0]], [[1.0, 1.0]], 1.0),
        ([[1.0, 1.0]], [[0.0, 0.0]], 0.0),
        ([[1.0, 1.0]], [[1.0, 1.0]], 0.5),
        ([[0.0, 10.0]], [[1.0, 11.0]], 1.0),  # each episode is compared with itself
        ([[0.0, 2.0]], [[1.0, 1.0]], 0.5),
        ([[0.0], [2.0]], [[1.0], [3.0]], 0.75),  # three of four pairs of seeds
        ([[0.0], [np.inf]], [[np.inf]], 0.75),
    ],
)
def test_probability_of_improvement_by_hand(
    better: list[list[float]], worse: list[list[float]], expected: float
) -> None:
    found = probability_of_improvement(better, worse, rng=rng(), resamples=50)
    assert found.value == expected
    assert found.low <= found.value <= found.high
    opposite = probability_of_improvement(worse, better, rng=rng(), resamples=50)
    assert opposite.value == pytest.approx(1 - expected)


def test_unpaired_episodes_are_all_compared_with_each_other() -> None:
    found = probability_of_improvement([[0.0, 10.0]], [[1.0, 11.0, 12.0]], rng=rng(), paired=False, resamples=50)
    assert found.value == pytest.approx(5 / 6)


def test_probability_of_improvement_of_normal_data() -> None:
    """P(X < Y) = Phi(d / sqrt 2) for normal data a distance d apart, with the variance of a fraction."""
    x, y = rng(5).normal(size=(1, 4000)), rng(6).normal(loc=1.0, size=(1, 4000))
    found = probability_of_improvement(x, y, rng=rng(7), resamples=800)
    wanted = statistics.NormalDist().cdf(1 / np.sqrt(2))
    error = np.sqrt(wanted * (1 - wanted) / 4000)
    assert found.value == pytest.approx(wanted, abs=4 * error)
    assert found.high - found.low == pytest.approx(2 * 1.96 * error, rel=0.15)


def test_blocks_do_not_change_the_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    values = rng(8).normal(size=(3, 20))
    whole = summarise(values[0], rng=rng()), interquartile_interval(values, rng=rng())
    monkeypatch.setattr(module, "BLOCK", 7 * 60)
    assert (summarise(values[0], rng=rng()), interquartile_interval(values, rng=rng())) == whole


def test_bad_matrices_are_refused() -> None:
    with pytest.raises(InputError, match="cannot be paired"):
        probability_of_improvement([[1.0, 2.0]], [[1.0]], rng=rng())
    with pytest.raises(InputError, match="1 of 2 values are NaN"):
        interquartile_interval([[1.0, float("nan")]], rng=rng())
    with pytest.raises(InputError, match="shape"):
        interquartile_interval([1.0, 2.0], rng=rng())
    with pytest.raises(InputError, match="confidence"):
        probability_of_improvement([[1.0]], [[2.0]], rng=rng(), confidence=95)
