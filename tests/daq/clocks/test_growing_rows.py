"""Rows that come a few at a time, and quantiles as numpy has them, to the bit."""

import numpy as np
import pytest

from daq.clocks.quantiles import median, quantile
from daq.clocks.sensor_reader import GrowingRows


def test_rows_stay_in_order_and_earlier_looks_do_not_change() -> None:
    rows, looks = GrowingRows(np.float64, 2), []
    expected = np.arange(400.0).reshape(-1, 2)
    for part in np.split(expected, [1, 3, 90, 91]):
        rows.add(part)
        looks.append(rows.values)
    assert np.array_equal(rows.values, expected)
    assert [len(look) for look in looks] == [1, 3, 90, 91, 200]
    assert all(np.array_equal(look, expected[: len(look)]) for look in looks)
    kept = rows.values
    rows.clear()
    rows.add(-expected[:4])
    assert np.array_equal(rows.values, -expected[:4])
    assert np.array_equal(kept, expected)


# --- median and quantiles --------------------------------------------------------------------


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
