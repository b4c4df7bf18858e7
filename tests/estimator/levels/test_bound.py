"""The bound without a model, and what widens an interval."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.levels.bands import band_levels
from estimator.levels.contributions import Source, contribution, widened
from estimator.levels.interval import unpredicted
from tests.estimator.csm_models import wishart


@pytest.mark.parametrize("n_sensors", [3, 5, 12])
def test_the_noise_is_below_the_bound_whatever_the_dimension_of_the_motion(n_sensors: int) -> None:
    """Vertical sensors a degree off plumb in strong three-dimensional motion."""
    rng = np.random.default_rng(n_sensors)
    n, n_bins = 135, 60
    lean = np.radians(1.0) * rng.standard_normal((n_sensors, 2))
    axes = np.column_stack([np.ones(n_sensors), lean])
    csm = (5e4 * axes @ axes.T + np.eye(n_sensors)).astype(np.complex128)
    sample = wishart(csm, n, rng, n_draws=n_bins)
    level, cumulants = unpredicted(sample, dims=(1,) * n_sensors, n_effective=np.full(n_bins, n))
    band = band_levels(level, cumulants, np.array([0, n_bins]), np.ones(1))
    low, high = band.interval()
    exact = 1 / np.diag(np.linalg.inv(csm)).real
    assert np.all(exact >= 1)
    assert np.mean((low[0] <= exact) & (exact <= high[0])) > 0.6  # 95 % each; few channels
    assert np.all(high[0] > 1)
    if n_sensors == 12:
        assert np.all(exact < 3)  # 12 sensors leave 8 directions without motion


def test_equal_sensors_are_within_one_dimension_of_it() -> None:
    csm = (1e6 * np.ones((5, 5)) + np.eye(5)).astype(np.complex128)[None]
    level, _ = unpredicted(csm, dims=(1,) * 5, n_effective=np.array([1e9]))
    np.testing.assert_allclose(level, 1 + 1 / 4, rtol=1e-3)


def test_too_few_averages_and_dead_channels_bound_nothing() -> None:
    csm = np.broadcast_to(np.eye(4, dtype=np.complex128), (2, 4, 4)).copy()
    csm[1, 0, 0] = 0
    level, _ = unpredicted(csm, dims=(1,) * 4, n_effective=np.array([6.0, 100.0]))
    assert np.isnan(level).all()


def test_offsets_add_and_shares_move_both_ends() -> None:
    low, high = np.array([[1.0, -1.0]]), np.array([[3.0, 2.0]])
    clocks = contribution(Source.CLOCKS, (1, 2), below=0.25, above=0.5)
    misfit = contribution(Source.MISFIT, (1, 2), share=0.5)
    found = widened(low, high, (clocks, misfit))
    np.testing.assert_allclose(found[0], [[0.75 * 0.5, -1.25]])
    np.testing.assert_allclose(found[1], [[3.5 * 1.5, 2.5 * 1.5]])
    alone = widened(low, high, (clocks, misfit), without={Source.CLOCKS})
    np.testing.assert_allclose(alone[1], [[4.5, 3.0]])
    unknown = contribution(Source.MISFIT, (1, 2), share=np.inf)
    assert np.isneginf(widened(low, high, (unknown,))[0]).all()
    assert np.isposinf(widened(low, high, (unknown,))[1]).all()
    missing = np.full((1, 2), np.nan)
    assert np.isnan(widened(missing, missing, (unknown,))[1]).all()


def test_a_contribution_concerns_every_band_that_it_overlaps() -> None:
    share = np.zeros((6, 1))
    share[2] = 0.3
    below = np.arange(6.0)[:, None]
    found = contribution(Source.MISFIT, (6, 1), below=below, share=share).in_bands(
        np.array([0, 3, 6]), np.ones((6, 1)), np.full((6, 1), 2.0)
    )
    np.testing.assert_allclose(found.share[:, 0], [0.1, 0.0])
    np.testing.assert_allclose(found.below[:, 0], [1.0, 4.0])


def test_nothing_is_known_of_a_band_of_a_part_of_which_nothing_is() -> None:
    share = np.full((6, 1), 0.2)
    share[4] = np.inf
    found = contribution(Source.MISFIT, (6, 1), share=share).in_bands(
        np.array([0, 3, 6]), np.ones((6, 1)), np.ones((6, 1))
    )
    np.testing.assert_allclose(found.share[:, 0], [0.2, np.inf])
