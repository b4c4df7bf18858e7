"""The course of a level: changes, drift and contrasts between them."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest
import scipy.stats

from benchmarks.studies.hours import MONDAY, days_of, drawn
from daq.archive.changes import DAYS_PER_YEAR, Course, courses, line, of_loudness
from daq.archive.spectra_file import DAY_NS

DAYS = np.arange(40.0)


def series(
    rng: np.random.Generator, *, n_days: int = 40, n_series: int = 8, scatter: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return levels of 1 with unequal spreads, which scatter more than these say."""
    spread = np.exp(rng.normal(size=(n_days, 1)) * 0.3) * 2e-3 * np.ones(n_series)
    return 1 + scatter * spread * rng.standard_normal((n_days, n_series)), spread


def course_of(level: np.ndarray, spread: np.ndarray, rate: float = 0.01) -> tuple[Course, ...]:
    days = (MONDAY + np.arange(len(level))) * DAY_NS
    return courses(days, level, spread, {}, false_alarm=rate)


@pytest.mark.parametrize("scatter", [1.0, pytest.param(4.0, marks=pytest.mark.long)])
def test_false_alarms_are_rarer_than_stated(scatter: float) -> None:
    rng = np.random.default_rng(5)
    n, rate = 100, 0.05
    alarms = sum(
        any(each.steps for each in course_of(*series(rng, scatter=scatter), rate)) for _ in range(n)
    )
    assert alarms <= scipy.stats.binom.ppf(0.999, n, rate)


def test_a_change_is_found_with_its_day_and_size() -> None:
    level, spread = series(np.random.default_rng(6))
    level[25:, 3] *= 1.02
    level[10, 5] = np.nan
    found = course_of(level, spread)
    assert [len(each.steps) for each in found] == [0, 0, 0, 1, 0, 0, 0, 0]
    (step,) = found[3].steps
    assert [(each.begin, each.end) for each in found[3].segments] == [(0, 25), (25, 40)]
    assert step.low < 10 * np.log10(1.02) < step.high
    assert all(each.decided for each in found)


def test_two_changes_in_ten_years_are_found_to_the_day() -> None:
    level, spread = series(np.random.default_rng(11), n_days=3653, n_series=1)
    level[1000:] *= 1.02
    level[2501:] /= 1.03
    (found,) = course_of(level, spread)
    assert [each.begin for each in found.segments] == [0, 1000, 2501]
    assert found.steps[1].low < -10 * np.log10(1.03) < found.steps[1].high


def test_scatter_from_day_to_day_is_no_change() -> None:
    """What stays within the scatter is not found, though far beyond the stated spread."""
    level, spread = series(np.random.default_rng(7), scatter=20.0)
    level[25:, 3] += 3 * spread[25:, 3]
    assert not any(each.steps for each in course_of(level, spread))


def test_a_drift_is_no_staircase() -> None:
    level, spread = series(np.random.default_rng(12), n_days=400)
    level *= 1 + 1e-4 * np.arange(400)[:, None]
    found = course_of(level, spread)
    assert not any(each.steps for each in found)
    per_year = 10 / np.log(10) * 1e-4 / 1.02 * DAYS_PER_YEAR
    for each in found:
        assert each.segments[0].drift.value == pytest.approx(per_year, rel=0.1)


def test_a_drift_of_ten_years_is_one_of_decibels() -> None:
    """5 dB are no line in power: that would be a staircase."""
    level, spread = series(np.random.default_rng(14), n_days=3653, n_series=2)
    factor = 10 ** (0.05 * np.arange(3653)[:, None] / DAYS_PER_YEAR)
    for each in course_of(level * factor, spread * factor):
        assert not each.steps
        assert each.segments[0].drift.low < 0.5 < each.segments[0].drift.high
        assert each.segments[0].drift.value == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("per_year", [0.0, -6.0])
def test_a_step_is_that_on_its_day_whatever_drifts(per_year: float) -> None:
    """Means of segments of years differ by the drift too, here by up to 7 dB."""
    rng = np.random.default_rng(17)
    days = np.arange(900)
    truth = 10 ** (0.1 * (per_year * days / DAYS_PER_YEAR + 2.0 * (days >= 500)))
    spread = 2e-3 * truth[:, None] * np.ones(40)
    found = course_of(truth[:, None] + spread * rng.standard_normal((900, 40)), spread)
    steps = [each.steps for each in found]
    assert [len(each) for each in steps] == [1] * 40
    assert sum(step.low < 2.0 < step.high for (step,) in steps) >= scipy.stats.binom.ppf(
        0.001, 40, 0.95
    )
    assert all(step.high - step.low < 0.01 for (step,) in steps)


def test_intervals_allow_for_scatter_that_lasts() -> None:
    """Days that follow each other with a correlation of 0.8: independent ones are a ninth."""
    rng = np.random.default_rng(21)
    n_days, n_series, rho = 400, 200, 0.8
    scatter = rng.standard_normal((n_days, n_series))
    for day in range(1, n_days):
        scatter[day] = rho * scatter[day - 1] + np.sqrt(1 - rho**2) * scatter[day]
    level = 1 + 0.04 * scatter
    spread = 2e-3 * level
    steady = [each.segments[0].drift for each in course_of(level, spread) if not each.steps]
    assert len(steady) > 0.9 * n_series
    assert np.mean([each.low < 0 < each.high for each in steady]) > 0.87  # without it, 0.79
    level[200:] *= 10**0.1
    stepped = [each.steps[0] for each in course_of(level, spread) if len(each.steps) == 1]
    assert len(stepped) > 0.9 * n_series
    assert np.mean([each.low < 1 < each.high for each in stepped]) > 0.88  # without it, 0.78


@pytest.mark.parametrize("relative", [0.02, 0.3])
def test_the_mean_does_not_follow_the_errors_of_days(relative: float) -> None:
    """Deviations go with levels: by their squares alone, low days would count for more."""
    rng = np.random.default_rng(18)
    level = 1 + relative * rng.standard_normal((1000, 20))
    found = course_of(level, relative * level)
    assert sum(len(each.segments) > 1 for each in found) <= 1
    means = [each.segments[0].mean for each in found]
    assert np.abs(np.array(means) - 1).max() < 5 * relative / np.sqrt(1000)


def test_the_mean_of_a_drift_is_that_of_its_middle() -> None:
    level, spread = series(np.random.default_rng(19), n_days=2001, n_series=1)
    factor = 10 ** (0.1 * np.arange(-1000, 1001) / DAYS_PER_YEAR)[:, None]
    (found,) = course_of(level * factor, spread * factor)
    assert found.segments[0].mean == pytest.approx(1.0, rel=1e-3)


def test_a_day_that_is_hardly_known_is_not_taken_into_a_logarithm() -> None:
    """The courses are those of powers: an error of a day moves neither its weight nor the mean."""
    level, spread = series(np.random.default_rng(15), n_days=400, n_series=1)
    level[200] = 0.01 * spread[200]  # 500 standard deviations below
    spread[200] = 1.0
    (found,) = course_of(level, spread)
    assert not found.steps
    assert found.segments[0].drift.low < 0 < found.segments[0].drift.high


def test_few_days_give_no_decision() -> None:
    level, spread = series(np.random.default_rng(8), n_days=7)
    level[4:] *= 3
    found = course_of(level, spread)
    assert not any(each.decided or each.steps for each in found)
    assert np.isnan(found[0].segments[0].drift.value)


def test_a_level_that_may_be_zero_is_not_decided() -> None:
    rng = np.random.default_rng(10)
    (found,) = course_of(rng.standard_normal((40, 1)), np.ones((40, 1)))
    assert not found.decided


def test_the_slope_is_that_of_the_line() -> None:
    spread = np.ones((40, 1))
    level = 100 * np.exp(2e-4 * (DAYS - DAYS.mean())[:, None])
    found = line(DAYS, level[:, 0], (spread * level / 100)[:, 0]).drift
    per_day = 10 / np.log(10) * 0.02 / 100
    assert found.value == pytest.approx(per_day * DAYS_PER_YEAR)
    # Student's quantile, 38 degrees of freedom, times the spread of the slope
    half = 2.0244 / np.sqrt(np.sum((DAYS - DAYS.mean()) ** 2)) / 0.02 * found.value
    assert found.high - found.value == pytest.approx(half, rel=1e-3)


@pytest.mark.parametrize("scatter", [1.0, 4.0])
def test_the_interval_of_the_slope_covers_the_truth(scatter: float) -> None:
    rng = np.random.default_rng(9)
    n = 60
    covered = 0
    for _ in range(n):
        for level, spread in zip(*(each.T for each in series(rng, scatter=scatter)), strict=True):
            found = line(DAYS, level, spread).drift
            covered += found.low < 0 < found.high
    assert covered >= scipy.stats.binom.ppf(0.001, 8 * n, 0.93)


def test_a_contrast_is_that_within_days_and_of_each_segment() -> None:
    rng = np.random.default_rng(13)
    hours = drawn(rng, n_days=60, step_db=3.0, at=22.4, drift_db=2.0, contrast_db=0.5)
    (found,) = courses(*days_of(hours))
    assert [each.begin for each in found.segments] in ([0, 22], [0, 23])
    for each in found.segments:
        assert each.contrast.low < 0.5 < each.contrast.high
        assert each.contrast.high - each.contrast.low < 0.3
    first, second = found.segments
    assert (first.contrast_days, second.contrast_days) in (
        (15, 27),
        (16, 26),
    )  # 44, less those of the change
    assert date.fromordinal(date(1970, 1, 1).toordinal() + MONDAY).weekday() == 0


def test_weekends_alone_have_no_contrast() -> None:
    hours = drawn(np.random.default_rng(14), n_days=60, missing=(0, 1, 2, 3, 4))
    (found,) = courses(*days_of(hours))
    assert found.segments[0].contrast_days == 0
    assert np.isnan(found.segments[0].contrast.value)


def test_a_large_change_among_few_days_is_found() -> None:
    level, spread = series(np.random.default_rng(15), n_days=10, n_series=1)
    level[5:] *= 4
    (found,) = course_of(level, spread)
    assert [each.begin for each in found.segments] == [0, 5]


def test_scatter_that_lasts_for_days_is_no_change() -> None:
    rng = np.random.default_rng(16)
    found = [courses(*days_of(drawn(rng, n_days=60, lasting_db=0.3)))[0] for _ in range(60)]
    assert sum(bool(each.steps) for each in found) <= 10  # without allowing for it, 50


@pytest.mark.parametrize("n_days", [8, 30])
def test_loudness_that_scatters_from_day_to_day_is_in_the_mean_of_days(n_days: int) -> None:
    rng = np.random.default_rng(n_days)
    counts, s = np.full(n_days, 100), np.full(n_days, 0.02)
    drift = np.linspace(1.0, 1.0 + n_days / 300, n_days)
    false = [of_loudness(drift + s * rng.normal(size=n_days), s, counts) for _ in range(400)]
    assert np.count_nonzero(false) <= 16
    loud = [of_loudness(1 + 0.2 * rng.normal(size=n_days), s, counts) for _ in range(400)]
    assert np.median(loud) == pytest.approx(0.2 / np.sqrt(n_days), rel=0.15)
