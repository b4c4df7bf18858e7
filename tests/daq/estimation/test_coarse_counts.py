"""Intervals hold the noise of sensors that are rounded alike."""

from __future__ import annotations

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.band_summary import Spectrum
from daq.results.facts.channels import RoundedAlike
from daq.results.result import Result
from estimator.levels.contributions import Source

RATE, N_SAMPLES = 100.0, 30_000
EDGES = np.array([10, 30, 100, 250, 450])


def _levels(
    own: float, motion: float, n_sensors: int, n_channels: int, seed: int
) -> tuple[np.ndarray, np.ndarray, list[RoundedAlike]]:
    """Return how many intervals with and without the contribution hold the noise, and the fact."""
    rng = np.random.default_rng([28, seed])
    moved = motion * rng.standard_normal((N_SAMPLES, n_channels))
    arrays = {}
    for name in "ABCDE"[:n_sensors]:
        offset = rng.uniform(0, 1, n_channels)
        noise = own * rng.standard_normal((N_SAMPLES, n_channels))
        arrays[name] = np.round(moved + offset + noise).astype(np.int32)
    settings = Settings(segment=10.0)
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], settings)
    result = next(iter(snapshot.results.values()))
    found = Spectrum(result, snapshot, settings).levels(EDGES)
    truth = (own**2 + 1 / 12) * 2 / RATE
    held = []
    for without in ((), (Source.COUNTS,)):
        low, high = found.ends(without=without)
        held.append((low <= truth) & (truth <= high))
    return (
        held[0],
        held[1],
        [f for f in Result(snapshot, Settings()).facts if isinstance(f, RoundedAlike)],
    )


@pytest.mark.parametrize(
    ("n_sensors", "n_channels"),
    [(3, 1), *(pytest.param(*each, marks=pytest.mark.long) for each in ((3, 3), (5, 1)))],
)
def test_noise_that_is_rounded_alike_is_within_its_interval(
    n_sensors: int, n_channels: int
) -> None:
    found = [_levels(0.15, 3.0, n_sensors, n_channels, seed) for seed in range(4)]
    held = np.concatenate([each[0].ravel() for each in found])
    without = np.concatenate([each[1].ravel() for each in found])
    assert held.mean() >= 0.95
    # more sensors show it by further dimensions, whose doubt is wider
    assert n_sensors > 3 or without.mean() < 0.6
    for _, _, facts in found:
        (fact,) = facts
        assert {name[0] for name in fact.channels} == set("ABCDE"[:n_sensors])
        # rho(0.045) / (0.15**2 + 1 / 12) = 0.20 of the true noise, more where the estimate is low
        assert 0.12 < fact.share < 0.9


def test_noise_of_a_count_is_not_rounded_alike() -> None:
    held, _, facts = _levels(1.0, 30.0, 3, 1, 0)
    assert held.mean() > 0.7
    assert not facts
