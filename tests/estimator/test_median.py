"""The median against that of numpy, to the bit."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.median import median


@pytest.mark.parametrize("n", [1, 2, 3, 4, 9, 10, 101, 256])
def test_it_is_the_one_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).standard_normal((n, 3, 2)) * [1e-9, 1e12]
    values[:, 2] = np.round(values[:, 2])  # equal ones
    assert np.array_equal(median(values), np.median(values, axis=0))
    assert float(median(values[:, 0, 0])) == np.median(values[:, 0, 0])


@pytest.mark.parametrize("special", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("n", [1, 4, 7])
def test_values_that_are_not_finite(n: int, special: float) -> None:
    values = np.arange(2.0 * n).reshape(n, 2)
    values[0, 1] = special
    np.testing.assert_array_equal(median(values), np.median(values, axis=0))
