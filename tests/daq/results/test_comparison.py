"""Differences between two tests: their interval, and what is not compared."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from daq.bench.sensitivity import KnownSensitivity
from daq.estimation.contributions import with_sensitivities
from daq.results.band_summary import BandMeans
from daq.results.comparison import compare, difference
from daq.results.result import Result
from estimator.self_noise.result import SelfNoise
from tests.tui.example_snapshot import SETTINGS, made_snapshot


def mean_of(level: float, error: float) -> BandMeans:
    """Return a mean with the log-normal interval of this relative error."""
    factor = math.exp(1.96 * error)
    return BandMeans(
        *(np.array([v]) for v in (level, level * error, level / factor, level * factor))
    )


@pytest.mark.parametrize("errors", [(0.03, 0.03), (0.05, 0.2)])
def test_the_interval_covers_the_true_difference(errors: tuple[float, float]) -> None:
    rng = np.random.default_rng(5)
    drawn = np.exp(rng.normal(0, errors, size=(2000, 2)))
    found = [
        difference("A", "X", *(mean_of(v, e) for v, e in zip(pair, errors, strict=True)))
        for pair in drawn.tolist()
    ]
    covered = np.mean([each.low_db <= 0 <= each.high_db for each in found])
    assert covered == pytest.approx(0.95, abs=3.3 * math.sqrt(0.95 * 0.05 / 2000))
    certain = np.mean([each.is_certain for each in found])
    assert certain == pytest.approx(1 - covered)


def test_like_channels_are_compared_in_the_common_band() -> None:
    snapshot = made_snapshot(n_effective=2000.0)
    noise = snapshot.results["three-sensor"]
    scale = np.array([4.0, 8.0, 16.0])[:, None, None]
    doubled = SelfNoise.of(noise.method, 2 * noise.noise_psd, scale * noise.cumulants, noise.flags)
    louder = replace(snapshot, csm=2 * snapshot.csm, results={"three-sensor": doubled})
    other = replace(SETTINGS, band=(2.0, 30.0))
    found = compare(Result(louder, SETTINGS), Result(snapshot, other))
    assert len(found) == 9
    for each in found.values():
        assert each.db == pytest.approx(10 * math.log10(2), abs=1e-6)
        assert each.low_db < each.db < each.high_db
        assert each.is_certain


def test_an_uncertain_sensitivity_is_no_part_of_a_difference() -> None:
    """It is the same in both tests; the temperature may not be."""
    snapshot = made_snapshot(n_effective=2000.0)
    names = [(label.sensor, label.channel) for label in snapshot.channels]
    exact = compare(Result(snapshot, SETTINGS), Result(snapshot, SETTINGS))
    for known, same in (
        (KnownSensitivity(own=0.1), True),
        (KnownSensitivity(own=0.1, coefficient=0.01), False),
    ):
        stated = with_sensitivities(snapshot, dict.fromkeys(names, known.at((0.0, 40.0))))
        found = compare(Result(stated, SETTINGS), Result(stated, SETTINGS))
        assert (found == exact) == same
        assert found[names[0]].high_db >= exact[names[0]].high_db


def test_what_has_nothing_in_common_is_not_compared() -> None:
    snapshot = made_snapshot()
    others = (
        replace(snapshot, unit="m/s"),
        replace(snapshot, results={}),
        replace(snapshot, channels=tuple(replace(c, sensor="Z") for c in snapshot.channels)),
    )
    assert all(
        compare(Result(snapshot, SETTINGS), Result(other, SETTINGS)) == {} for other in others
    )
    apart = replace(SETTINGS, band=(30.0, 40.0))
    assert compare(Result(snapshot, SETTINGS), Result(snapshot, apart)) == {}


def test_a_mean_below_zero_has_no_difference() -> None:
    below = BandMeans(*(np.array([v]) for v in (-1.0, 1.0, -3.0, 1.0)))
    found = difference("A", "X", below, mean_of(1.0, 0.1))
    assert math.isnan(found.db)
    assert not found.is_certain
    vague = BandMeans(*(np.array([v]) for v in (1.0, 1.0, -1.0, 3.0)))
    found = difference("A", "X", vague, mean_of(1.0, 0.1))
    assert found.low_db == -math.inf
    assert math.isfinite(found.high_db)
