"""Drift and change of a level: closed forms, coverage, and the stated rate of false alarms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from daq.archive.changes import DAYS_PER_YEAR, changes, drift

DAYS = np.arange(40.0)


def series(
    rng: np.random.Generator, *, n_days: int = 40, scatter: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Eight series of level 100 with different spreads; `scatter` is in standard deviations."""
    spread = np.full((n_days, 8), 0.5) * rng.uniform(0.5, 1.5, size=(n_days, 1))
    return 100 + scatter * spread * rng.standard_normal((n_days, 8)), spread


@pytest.mark.long
@pytest.mark.parametrize("scatter", [1.0, 4.0])
def test_the_rate_of_false_alarms_is_as_stated(scatter: float) -> None:
    rng = np.random.default_rng(5)
    rate, n = 0.2, 60
    alarms = sum(
        changes(*series(rng, scatter=scatter), false_alarm=rate).found.any() for _ in range(n)
    )
    # At most so many, with a chance of one in a thousand that this test fails by accident.
    assert alarms <= scipy.stats.binom.ppf(0.999, n, rate)
    if scatter == 4.0:  # scatter from day to day is measured, so the rate is reached
        assert alarms >= scipy.stats.binom.ppf(0.001, n, rate / 2)


def test_a_change_is_found_with_its_day_and_size() -> None:
    level, spread = series(np.random.default_rng(6))
    level[25:, 3] *= 1.02
    level[10, 5] = np.nan
    found = changes(level, spread)
    assert list(np.flatnonzero(found.found)) == [3]
    assert found.day[3] == 25
    assert found.low[3] < 10 * np.log10(1.02) < found.high[3]
    assert found.decided.all()


def test_scatter_from_day_to_day_is_no_change() -> None:
    """What stays within the scatter is not found, though far beyond the stated spread."""
    level, spread = series(np.random.default_rng(7), scatter=20.0)
    level[25:, 3] += 3 * spread[25:, 3]
    assert not changes(level, spread).found.any()


def test_few_days_give_no_decision() -> None:
    level, spread = series(np.random.default_rng(8), n_days=7)
    level[4:] *= 3
    found = changes(level, spread)
    assert not found.decided.any()
    assert not found.found.any()
    assert np.isnan(drift(DAYS[:7], level, spread).slope).all()


def test_the_slope_is_that_of_the_line() -> None:
    spread = np.ones((40, 1))
    level = 100 + 0.02 * (DAYS - DAYS.mean())[:, None]
    found = drift(DAYS, level, spread)
    per_day = 10 / np.log(10) * 0.02 / 100
    assert found.slope[0] == pytest.approx(per_day * DAYS_PER_YEAR)
    # Student's quantile, 38 degrees of freedom, times the spread of the slope
    half = 2.0244 / np.sqrt(np.sum((DAYS - DAYS.mean()) ** 2)) / 0.02 * found.slope[0]
    assert found.high[0] - found.slope[0] == pytest.approx(half, rel=1e-3)


@pytest.mark.parametrize("scatter", [1.0, 4.0])
def test_the_interval_of_the_slope_covers_the_truth(scatter: float) -> None:
    rng = np.random.default_rng(9)
    n = 60
    covered = 0
    for _ in range(n):
        found = drift(DAYS, *series(rng, scatter=scatter))
        covered += int(np.sum((found.low < 0) & (found.high > 0)))
    assert covered >= scipy.stats.binom.ppf(0.001, 8 * n, 0.93)


def test_a_level_below_zero_has_no_drift_in_decibels() -> None:
    rng = np.random.default_rng(10)
    assert np.isnan(drift(DAYS, rng.standard_normal((40, 1)), np.ones((40, 1))).slope).all()
