"""One and two sensors, from samples to facts; the samples share no code with the simulators."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError, Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.results.band_summary import data_interval
from daq.results.facts.changes import (
    MethodsDiffer,
    NoiseNotIdentified,
    NoisePartShared,
    SteadyGainsAssumed,
)
from daq.results.facts.model import FewSensors
from daq.results.facts.precision import PairCompared
from daq.results.result import Result
from estimator.checks.advice import Advice
from estimator.checks.advice_on_noise import ResponseChanges
from estimator.checks.advice_on_signals import Copies
from estimator.self_noise.result import Flag, Refusal

RATE, SECONDS = 50.0, 1500
SETTINGS = Settings(segment=1.0)
BAND = (2.0, 20.0)
NOISE = (1.0, 0.5)
"""Variances of the noise of the sensors, white."""


def samples(
    rng: np.random.Generator,
    *,
    change: float,
    snr: float = 30.0,
    d: int = 3,
    gain: float = 0.0,
    every: float = 40.0,
    variances: tuple[float, ...] = NOISE,
    shared: float = 0.0,
) -> dict[str, np.ndarray]:
    """Return sensors in any direction; the level of their motion changes by so many dB.

    The first one's gain follows the level: by `gain` for ten times the power. The first two share
    noise of a variance of `shared`, beside their own.
    """
    n, step = round(RATE * SECONDS), round(RATE * every)
    knots = np.arange(0, n + step, step)
    level = np.interp(np.arange(n), knots, change * rng.standard_normal(len(knots)))
    motion = np.sqrt(snr) * rng.standard_normal((n, d)) * 10 ** (level / 20)[:, None]
    found = {}
    alike = np.sqrt(shared) * rng.standard_normal((n, d))
    for number, noise in enumerate(variances):
        turn = np.linalg.qr(rng.standard_normal((d, d)))[0]
        follows = 1 + gain * level / 10 * (number == 0)
        own = np.sqrt(noise) * rng.standard_normal((n, d)) + alike * (number < 2)
        found["ABC"[number]] = (motion @ turn.T) * follows[:, None] + own
    return found


def estimated(sensors: dict[str, np.ndarray], settings: Settings = SETTINGS) -> Snapshot:
    return estimate([recording_of_arrays(sensors, RATE)], settings)


@pytest.mark.parametrize(
    ("d", "settings"),
    [
        (1, SETTINGS),
        (3, SETTINGS),
        pytest.param(3, replace(SETTINGS, reject=True), marks=pytest.mark.long),
        pytest.param(3, replace(SETTINGS, octaves=True), marks=pytest.mark.study),
        pytest.param(3, replace(SETTINGS, octaves=True, reject=True), marks=pytest.mark.long),
    ],
)
def test_two_sensors_have_a_noise_where_the_motion_changes(d: int, settings: Settings) -> None:
    held, errors = [], []
    for seed in range(4 if settings is SETTINGS else 2):
        rng = np.random.default_rng([d, seed])
        snapshot = estimated(samples(rng, change=6.0, d=d), settings)
        noise = snapshot.results["multi-part"]
        means = Result(snapshot, settings).means(noise.method, BAND)
        truth = 2 / RATE * np.repeat(NOISE, d)
        held += [m.low[0] <= t <= m.high[0] for m, t in zip(means, truth, strict=True)]
        errors += [m.mean[0] / t - 1 for m, t in zip(means, truth, strict=True)]
        kinds = {type(fact) for fact in Result(snapshot, settings).facts}
        assert SteadyGainsAssumed in kinds
    assert np.mean(held) >= 0.8  # 4 to 24 intervals of 95 %
    assert abs(np.mean(errors)) < 0.1


def test_steady_motion_leaves_an_upper_limit_and_says_what_is_missing() -> None:
    snapshot = estimated(samples(np.random.default_rng(3), change=0.0))
    noise = snapshot.results["multi-part"]
    assert np.all(noise.flags[2:-6] & Flag.UNIDENTIFIED)
    truth = 2 / RATE * np.repeat(NOISE, 3)
    for mean, true in zip(Result(snapshot, SETTINGS).means(noise.method, BAND), truth, strict=True):
        assert mean.low[0] <= 0 < true < mean.high[0]
        assert mean.outside.all()  # no curve has it as a level
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


def holds(
    snapshot: Snapshot, method: str, variances: tuple[float, ...], settings: Settings = SETTINGS
) -> list[bool]:
    """Return which intervals hold the noise."""
    means = Result(snapshot, settings).means(method, BAND)
    d = len(means) // len(variances)
    truth = 2 / RATE * np.repeat(variances, d)
    return [bool(m.low[0] <= t <= m.high[0]) for m, t in zip(means, truth, strict=True)]


def test_noise_that_two_of_three_sensors_share_is_found_and_given() -> None:
    """One-channel sensors: no other method tells shared noise from motion."""
    own, total = (0.5, 0.5, 1.0), (1.0, 1.0, 1.0)
    rng = np.random.default_rng(11)
    sensors = samples(rng, change=6.0, snr=3.0, d=1, every=150.0, variances=own, shared=0.5)
    plain = estimated(sensors)
    assert all(holds(plain, "three-sensor", total))  # by what the parts contradict
    ends = plain.results["three-sensor"].noise_psd[4:40] * RATE / 2
    assert np.all(ends.mean(axis=0) / total < [0.7, 0.7, 2.0])
    found = {type(fact): fact for fact in Result(plain, SETTINGS).facts}
    part, differ = found[NoisePartShared], found[MethodsDiffer]
    assert isinstance(part, NoisePartShared)
    assert isinstance(differ, MethodsDiffer)
    assert part.sensors == ("A", "B")
    assert not part.is_known
    assert abs(part.share - 0.5) < 4 * part.share_error < 0.3
    assert len(differ.channels) == 3
    assert not changes_of(plain)
    stated = replace(SETTINGS, shared_noise=(("A", "B"),))
    snapshot = estimated(sensors, stated)
    assert all(holds(snapshot, "multi-part", total, stated))
    (known,) = (f for f in Result(snapshot, stated).facts if isinstance(f, NoisePartShared))
    assert known.is_known
    assert abs(known.share - 0.5) < 4 * known.share_error < 0.3
    assert not changes_of(snapshot)


def changes_of(snapshot: Snapshot) -> list[Advice]:
    """Return the findings of gains that change: shared noise looks like one."""
    diagnosis = snapshot.diagnostics.diagnosis
    assert diagnosis is not None
    return [each for each in diagnosis.advice if isinstance(each, ResponseChanges)]


def test_motion_that_changes_lowers_the_scatter_of_three_sensors() -> None:
    narrower, held, n_used = [], [], 0
    equal = (1.0, 1.0, 1.0)
    for seed in range(2):
        rng = np.random.default_rng([13, seed])
        sensors = samples(rng, change=6.0, snr=0.4, every=150.0, variances=equal)
        snapshot = estimated(sensors)
        plain = estimated(sensors, replace(SETTINGS, methods=("three-sensor",)))
        ours, before = (each.results["three-sensor"] for each in (snapshot, plain))
        used = (ours.flags & Flag.CHANGING) != 0
        n_used += used.any()
        assert not (before.flags & Flag.CHANGING).any()
        # the engine's levels beside the paper's formula, which scatters alike here
        np.testing.assert_allclose(ours.noise_psd[~used], before.noise_psd[~used], rtol=0.05)
        narrower += (ours.cumulants[0][used] / before.cumulants[0][used]).tolist()
        held += holds(snapshot, "three-sensor", equal)
        kinds = {type(fact) for fact in Result(snapshot, SETTINGS).facts}
        assert (SteadyGainsAssumed in kinds) == used.any()
        assert MethodsDiffer not in kinds
    assert n_used
    assert np.median(narrower) < 0.8
    assert np.mean(held) > 0.8  # 18 intervals of 95 %; once in 90, fewer


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


@pytest.mark.parametrize("d", [1, 3])
def test_how_two_sensors_compare_is_a_fact_with_errors(d: int) -> None:
    rng = np.random.default_rng(15)
    snapshot = estimated(samples(rng, change=0.0, d=d, snr=8.0))  # no noise is identified
    (fact,) = (each for each in Result(snapshot, SETTINGS).facts if isinstance(each, PairCompared))
    truth = 64 / ((8 + NOISE[0]) * (8 + NOISE[1]))
    assert abs(fact.coherence - truth) < 4 * fact.coherence_error < 0.02
    assert np.all(np.abs(np.array(fact.gains) - 1) < 4 * np.array(fact.gain_errors))
    assert abs(fact.delay) < 4 * fact.delay_error < 1e-3
    assert np.isnan(fact.rotation) == (d == 1)


def test_a_sensor_that_repeats_the_other_is_named() -> None:
    samples = np.random.default_rng(1).standard_normal((12_000, 1))
    with pytest.raises(NoResultError, match="repeats another") as caught:
        estimate([recording_of_arrays({"A": samples, "B": samples}, 100.0)], Settings())
    assert any(isinstance(each, Copies) for each in caught.value.snapshot.diagnostics.advice)
