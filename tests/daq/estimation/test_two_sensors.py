"""One and two sensors, from samples to facts; the samples share no code with the simulators."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.band_summary import data_interval
from daq.results.facts import FewSensors, NoiseNotIdentified, SteadyGainsAssumed
from daq.results.result import Result
from estimator.self_noise.result import Flag, Refusal

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot

RATE, SECONDS = 50.0, 1500
SETTINGS = Settings(segment=2.0)
BAND = (2.0, 20.0)
NOISE = (1.0, 0.5)
"""Variances of the noise of the sensors, white."""


def samples(
    rng: np.random.Generator, *, change: float, snr: float = 30.0, d: int = 3, gain: float = 0.0
) -> dict[str, np.ndarray]:
    """Return two sensors in any direction; the level of their motion changes by so many dB.

    The first one's gain follows the level: by `gain` for ten times the power.
    """
    n, step = round(RATE * SECONDS), round(RATE * 40)
    knots = np.arange(0, n + step, step)
    level = np.interp(np.arange(n), knots, change * rng.standard_normal(len(knots)))
    motion = np.sqrt(snr) * rng.standard_normal((n, d)) * 10 ** (level / 20)[:, None]
    found = {}
    for number, (name, noise) in enumerate(zip("AB", NOISE, strict=True)):
        turn = np.linalg.qr(rng.standard_normal((d, d)))[0]
        follows = 1 + gain * level / 10 * (number == 0)
        found[name] = (motion @ turn.T) * follows[:, None] + np.sqrt(noise) * rng.standard_normal(
            (n, d)
        )
    return found


def estimated(sensors: dict[str, np.ndarray], settings: Settings = SETTINGS) -> Snapshot:
    return estimate([recording_of_arrays(sensors, RATE)], settings)


@pytest.mark.parametrize(
    ("d", "settings"),
    [
        (1, SETTINGS),
        (3, SETTINGS),
        (3, replace(SETTINGS, reject=True)),
        (3, replace(SETTINGS, octaves=True)),
        (1, replace(SETTINGS, octaves=True, reject=True)),
    ],
)
def test_two_sensors_have_a_noise_where_the_motion_changes(d: int, settings: Settings) -> None:
    held, errors = [], []
    for seed in range(4):
        rng = np.random.default_rng([d, seed])
        snapshot = estimated(samples(rng, change=6.0, d=d), settings)
        noise = snapshot.results["multi-part"]
        means = Result(snapshot, settings).means(noise.method, BAND)
        truth = 2 / RATE * np.repeat(NOISE, d)
        held += [m.low[0] <= t <= m.high[0] for m, t in zip(means, truth, strict=True)]
        errors += [m.mean[0] / t - 1 for m, t in zip(means, truth, strict=True)]
        kinds = {type(fact) for fact in Result(snapshot, settings).facts}
        assert SteadyGainsAssumed in kinds
    assert np.mean(held) >= 0.8  # 8 or 24 intervals of 95 %
    assert abs(np.mean(errors)) < 0.1


def test_steady_motion_leaves_an_upper_limit_and_says_what_is_missing() -> None:
    snapshot = estimated(samples(np.random.default_rng(3), change=0.0))
    noise = snapshot.results["multi-part"]
    assert np.all(noise.flags[2:-6] & Flag.UNIDENTIFIED)
    truth = 2 / RATE * np.repeat(NOISE, 3)
    for mean, true in zip(Result(snapshot, SETTINGS).means(noise.method, BAND), truth, strict=True):
        assert mean.low[0] <= 0 < true < mean.high[0]
    (fact,) = (f for f in Result(snapshot, SETTINGS).facts if isinstance(f, NoiseNotIdentified))
    assert fact.refusal is Refusal.STEADY
    assert fact.change < 0.2
    assert len(fact.channels) == 6


def test_a_gain_that_follows_the_loudness_by_a_percent_gives_no_noise() -> None:
    rng = np.random.default_rng(5)
    snapshot = estimated(samples(rng, change=6.0, snr=1000, gain=0.01))
    noise = snapshot.results["multi-part"]
    refused = (noise.flags[1:-6] & Flag.UNIDENTIFIED) != 0
    assert refused.mean() > 0.7
    causes = {
        f.refusal for f in Result(snapshot, Settings()).facts if isinstance(f, NoiseNotIdentified)
    }
    assert Refusal.GAIN_FOLLOWS in causes


def test_one_sensor_shows_its_spectrum() -> None:
    rng = np.random.default_rng(7)
    snapshot = estimated({"A": rng.standard_normal((20_000, 2))})
    assert not snapshot.results
    result = Result(snapshot, replace(SETTINGS, band=BAND))
    (low, high), mean = data_interval(result), result.data
    assert np.all((low < mean) & (mean < high) & (high / low < 1.2))
    assert np.all((low < 2 / RATE) & (high > 2 / RATE))
    assert any(isinstance(fact, FewSensors) for fact in Result(snapshot, Settings()).facts)


def test_parts_of_a_recording_hold_all_of_it() -> None:
    """Orientation and gain of a pair need no third sensor."""
    rng = np.random.default_rng(9)
    motion = rng.standard_normal((60_000, 2))
    turn = np.deg2rad(20.0)
    matrix = 1.03 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    noisy = 0.1 * rng.standard_normal((2, 60_000, 2))
    snapshot = estimated({"A": motion + noisy[0], "B": motion @ matrix.T + noisy[1]})
    diagnosis = snapshot.diagnostics.diagnosis
    assert diagnosis is not None
    (pair,) = diagnosis.responses
    assert pair.rotation_deg == pytest.approx(20.0, abs=4 * pair.rotation_error_deg)
    np.testing.assert_allclose(pair.gains, 1.03, atol=0.01)
    assert np.all(np.abs(pair.gains - 1.03) < 4 * pair.gain_errors)
    assert np.all(pair.gain_errors < 0.005)
