"""Median and quantiles against those of numpy, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from daq.clocks.quantiles import median, quantile


@pytest.mark.parametrize("n", [1, 2, 3, 4, 9, 10, 101, 256])
def test_they_are_those_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).standard_normal(n) * 1e-3
    assert median(values) == np.median(values)
    assert median(values.tolist()) == np.median(values)
    for share in (0.0, 0.1, 0.5, 0.9, 1.0):
        assert quantile(values, share) == np.quantile(values, share)


@pytest.mark.parametrize("special", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("n", [1, 4, 7])
def test_the_median_of_values_that_are_not_finite(n: int, special: float) -> None:
    values = np.arange(float(n))
    values[0] = special
    np.testing.assert_array_equal(median(values), np.median(values))


def test_the_median_of_nothing_is_unknown() -> None:
    assert np.isnan(median([]))
