"""Levels above what the other sensors leave unpredicted, or below zero, are withdrawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.results.band_summary import Levels, Spectrum
from daq.results.uncertainty_budget import level_budget
from tests.tui.example_snapshot import SETTINGS, made_snapshot


def levels() -> Levels:
    snapshot = made_snapshot()
    noise = snapshot.results["three-sensor"]
    found = Spectrum(noise, snapshot, SETTINGS).levels(np.array([2, 8, 16]))
    return replace(found, contributions=())


def bounded_by(share: float) -> Levels:
    """Return levels whose bound is this share of them."""
    found = levels()
    scatter = found.of_scatter
    factors = share ** np.arange(2, len(scatter.cumulants) + 2)  # variance, third, fourth
    cumulants = scatter.cumulants * factors.reshape(-1, *(1,) * (scatter.cumulants.ndim - 1))
    return replace(found, bound=replace(scatter, mean=share * scatter.mean, cumulants=cumulants))


def test_a_withdrawn_level_has_no_lower_end() -> None:
    found = bounded_by(0.01)
    low, high = found.ends()
    assert found.withdrawn().all()
    assert np.isneginf(low).all()
    assert (high < 0.1 * found.mean).all()


def test_an_interval_below_zero_is_withdrawn() -> None:
    """Motion across the axes leaves less than nothing: "below 0" was said of 43 dB."""
    found = bounded_by(0.5)
    found = replace(found, of_scatter=replace(found.of_scatter, mean=-found.mean))
    assert (found.of_scatter.interval()[1] < 0).all()  # what this is about
    low, high = found.ends()
    assert found.withdrawn().all()
    assert np.isneginf(low).all()
    assert (high > found.bound.mean).all()
    unknown = np.full_like(found.bound.mean, np.nan)
    _, high = replace(found, bound=replace(found.bound, mean=unknown)).ends()
    assert np.isposinf(high).all()


def test_a_level_below_its_bound_keeps_its_ends() -> None:
    found = bounded_by(100.0)
    low, high = found.ends()
    assert not found.withdrawn().any()
    assert (low > 0.1 * found.mean).all()
    assert (high > found.mean).all()


def test_a_budget_says_that_a_scatter_is_not_known() -> None:
    """`--json` of a bench with a clipped sensor ended in the root of a negative variance."""
    found, labels = bounded_by(0.5), made_snapshot().channels
    scatter = replace(found.of_scatter, cumulants=-found.of_scatter.cumulants)
    budget = level_budget(replace(found, of_scatter=scatter), 0, labels[0], (1.0, 2.0))
    assert np.isinf(budget.components[0].relative)
    assert np.isneginf(budget.interval[0])


@pytest.mark.parametrize("share", [1e-3, 0.01, 0.1, 0.3, 0.6, 0.9, 1.1, 3.0, 100.0])
def test_no_estimate_is_exported_beside_an_interval_that_excludes_it(share: float) -> None:
    """The mean of a band was 194 beside an upper end of 40.7, in JSON and certificates."""
    found, labels = bounded_by(share), made_snapshot().channels
    for column, label in enumerate(labels):
        means = found.of_channel(column)
        for row, (estimate, low, high) in enumerate(
            zip(means.estimate, means.low, means.high, strict=True)
        ):
            budget = level_budget(found, column, label, (1.0, 2.0), row=row)
            is_held = low <= means.mean[row] <= high
            assert np.isnan(estimate) if not is_held else estimate == means.mean[row]
            np.testing.assert_equal(budget.value, estimate)
