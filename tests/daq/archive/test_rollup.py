"""Levels of days add to those of bands and of months as those of the spectra do."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.archive.averages import Average, Estimator
from daq.archive.plan import Plan
from daq.archive.rollup import Grid, Rollup, merged_levels, rolled_up, summaries
from daq.archive.spectra_file import Described, Origin, Summary
from daq.bench.channel import Channel
from daq.estimation.settings import Settings
from daq.results.result import Result
from tests.traced_memory import peak_of

RATE = 20.0
CHANNELS = tuple((s, Channel(name="X", sensitivity=1.0, unit="m/s²")) for s in "ABC")
SETTINGS = Settings(segment=10.0, methods=("three-sensor",), equalise="off", bridge=0.0)
PLAN = Plan(
    settings=SETTINGS,
    stretch="hour",
    sampling_rate=RATE,
    sensors=tuple((sensor, (("X", "m/s²"),)) for sensor in "ABC"),
)
ESTIMATOR = Estimator(PLAN, PLAN.noise_settings(SETTINGS), CHANNELS)
DESCRIBED = Described(Origin("run", "run.h5", 1, 1, 1, True), CHANNELS, 9.0, 1.0)
N_SEGMENTS = 60


def drawn(
    rng: np.random.Generator, noise: tuple[float, ...] = (1.0, 2.0, 3.0)
) -> NDArray[np.complex128]:
    """Draw a mean matrix of independent segments without overlap: motion 10, noise its own."""
    shape = (N_SEGMENTS, len(ESTIMATOR.welch.frequencies))
    motion = 10**0.5 * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
    own = rng.standard_normal((*shape, 3)) + 1j * rng.standard_normal((*shape, 3))
    x = (motion[..., None] + own * np.sqrt(noise)) / 2**0.5
    return np.asarray(np.einsum("nfi,nfj->fij", x, x.conj()) / N_SEGMENTS)


def summary_of(csms: list[NDArray[np.complex128]], first_hour: int = 0) -> Summary:
    hour = 3600 * 10**9
    rows = [((first_hour + k) * hour, N_SEGMENTS, csm) for k, csm in enumerate(csms)]
    ((month, found),) = summaries(rows, DESCRIBED, PLAN, PLAN.noise_settings(SETTINGS), {})
    assert month == "1970-01"
    return found


@pytest.mark.parametrize("band", [(0.1, 9.0), (0.5, 1.0), (2.0, 4.0), (0.3, 0.3)])
def test_bands_of_the_grid_are_those_of_the_bins(band: tuple[float, float]) -> None:
    csm = drawn(np.random.default_rng(1))
    grid = Grid.of(ESTIMATOR)
    span = grid.span(band)
    found = grid.levels(summary_of([csm]).levels, [span])
    average = Average()
    average.add(DESCRIBED, 0, N_SEGMENTS, csm)
    snapshot = ESTIMATOR.snapshot(average)
    noise = snapshot.results["three-sensor"]
    wanted = Result(snapshot, SETTINGS).means(noise.method, grid.ends(span))
    low, high = found.ends()
    for column, one in enumerate(wanted):
        assert found.mean[0, 0, column] == pytest.approx(one.mean[0], rel=1e-6)
        # the spread within a fine band counts as equal
        assert found.of_scatter.spread[0, 0, column] == pytest.approx(one.spread[0], rel=0.02)
        assert high[0, 0, column] == pytest.approx(one.high[0], rel=0.02)
        assert low[0, 0, column] == pytest.approx(one.low[0], rel=0.02)


def test_days_in_several_recordings_become_one() -> None:
    rng = np.random.default_rng(2)
    csms = [drawn(rng) for _ in range(6)]
    whole = summary_of(csms).levels[:, 0].astype(float)
    parts = [summary_of(csms[:4]), summary_of(csms[4:], first_hour=4)]
    rows = np.concatenate([each.levels for each in parts], axis=1)
    segments = np.concatenate([each.day_segments for each in parts])
    merged = merged_levels(rows, segments)
    grid = Grid.of(ESTIMATOR)
    one, two = (grid.levels(each[:, None], [grid.span((0.5, 8.0))]) for each in (whole, merged))
    assert np.all(np.abs(one.mean - two.mean) < one.of_scatter.spread / 10)
    np.testing.assert_allclose(one.of_scatter.spread, two.of_scatter.spread, rtol=0.1)
    np.testing.assert_allclose(one.ends()[1], two.ends()[1], rtol=0.02)
    np.testing.assert_allclose(one.of_scatter.cumulants[1:], two.of_scatter.cumulants[1:], rtol=0.5)


def test_a_month_takes_no_more_memory_than_a_few_days() -> None:
    day = summary_of([drawn(np.random.default_rng(4))])
    month = [replace(day, days=day.days + k) for k in range(31)]
    grid = Grid.of(ESTIMATOR)

    def made(n_days: int) -> Rollup:
        return rolled_up(month[:n_days], grid, zone=UTC, whole=N_SEGMENTS, hours=True)

    one = made(1).noise.counts
    np.testing.assert_array_equal(made(31).noise.counts, 31 * one)
    # a density alone takes 20 times the levels of a day
    assert peak_of(lambda: made(31)) < peak_of(lambda: made(4)) + 5 * one.nbytes


@pytest.mark.long
def test_the_interval_of_a_band_of_merged_days_covers_the_truth() -> None:
    """Of noise drawn without the code under test: 95 % of the intervals hold it."""
    rng = np.random.default_rng(3)
    grid = Grid.of(ESTIMATOR)
    inside = []
    for _ in range(40):
        parts = [summary_of([drawn(rng)], first_hour=k) for k in range(3)]
        rows = np.concatenate([each.levels for each in parts], axis=1)
        merged = merged_levels(rows, np.full(3, N_SEGMENTS))
        low, high = grid.levels(merged[:, None], [grid.span((1.0, 4.0))]).ends()
        inside.append((low[0, 0] <= np.arange(1.0, 4)) & (high[0, 0] >= np.arange(1.0, 4)))
    assert np.mean(inside) > 0.9  # binomial, 120 draws of .95; Hann's correlation only widens
