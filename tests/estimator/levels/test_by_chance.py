"""Levels that are known but for a factor, beside draws (JCGM 101)."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.levels.contributions import Source, by_chance, contribution, deviation
from estimator.levels.interval import NORMAL_95, interval


@pytest.mark.parametrize("averages", [20.0, 200.0, 5000.0])
@pytest.mark.parametrize("relative", [0.005, 0.05, 0.2])
def test_ends_are_those_of_draws(averages: float, relative: float) -> None:
    """A PSD of so many averages over the square of a sensitivity: quantiles of 2.5 and 97.5 %."""
    rng = np.random.default_rng(4)
    level = np.array([[1.0]])
    cumulants = np.array([1 / averages, 1 / averages**2, 1 / averages**3]).reshape(3, 1, 1)
    scatter = interval(level, cumulants)
    low, high = by_chance(level, *scatter, NORMAL_95 * 2 * np.array([relative]))
    true = 1 / rng.gamma(averages, 1 / averages, 400_000)
    true = true * np.exp(2 * relative * rng.standard_normal(true.size))
    expected = np.quantile(true, [0.025, 0.975])
    found = np.log([low[0, 0], high[0, 0]])
    np.testing.assert_allclose(found, np.log(expected), rtol=0.03)
    assert low <= scatter[0]
    assert high >= scatter[1]


def test_without_a_factor_nothing_changes_and_no_end_moves_inwards() -> None:
    level = np.array([[1.0, -0.1, 0.5, np.nan]])
    low, high = np.array([[0.5, -1.0, 0.7, np.nan]]), np.array([[2.0, 1.0, 0.9, np.nan]])
    same = by_chance(level, low, high, np.zeros(4))
    np.testing.assert_array_equal(same, (low, high))
    wide = by_chance(level, low, high, np.full(4, 0.1))
    known = np.isfinite(level)
    assert (wide[0][known] < low[known]).all()
    assert (wide[1][known] > high[known]).all()
    assert np.isnan(wide[0][~known]).all()
    unknown = by_chance(level, np.full((1, 4), -np.inf), np.full((1, 4), np.inf), 0.1)
    assert np.isneginf(unknown[0][known]).all()
    assert np.isposinf(unknown[1][known]).all()


def test_deviations_add_by_squares_and_can_be_left_out() -> None:
    shape = (3, 2)
    parts = (
        contribution(Source.SENSITIVITY, shape, deviation=np.array([0.03, 0.0])),
        contribution(Source.TEMPERATURE, shape, deviation=np.array([0.04, 0.01])),
        contribution(Source.CLOCKS, shape, below=1.0),
    )
    np.testing.assert_allclose(deviation(parts), [0.05, 0.01])
    np.testing.assert_allclose(deviation(parts, without={Source.SENSITIVITY}), [0.04, 0.01])
    assert deviation(()) == 0
    below, above = parts[0].adds(0, np.array([2.0]))
    assert below == pytest.approx(2 * (1 - np.exp(-NORMAL_95 * 0.03)))
    assert above == pytest.approx(2 * (np.exp(NORMAL_95 * 0.03) - 1))
