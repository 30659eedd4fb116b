"""Summaries against closed forms, invariances and the coverage they promise."""

from __future__ import annotations

import dataclasses
import statistics

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modgnn_rl.errors import InputError
from modgnn_rl.statistics import interquartile_mean, paired_difference, summarise

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
        with pytest.raises(InputError, match="1 of 3 values are not finite"):
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
