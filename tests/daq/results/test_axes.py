"""Axes off plumb and sensitivities that are off: no interval excludes the truth."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from daq.bench.estimate_settings import from_text, to_table
from daq.bench.sensitivity import KnownSensitivity, known_sensitivities
from daq.estimation.contributions import with_sensitivities
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.estimation.snapshot_builder import stated_sensitivities
from daq.formats.arrays import recording_of_arrays
from daq.results.facts.channels import CertificateDiffers, SensitivitiesDiffer
from daq.results.result import Result
from estimator.checks.advice_on_noise import SharedNoise
from estimator.levels.contributions import across

RATE, SNR = 100.0, 5e4
BANDS = ((2.0, 10.0), (10.0, 30.0), (5.0, 6.0))


def leaning(n_sensors: int, degrees: float, seed: int, snr: float = SNR) -> dict[str, np.ndarray]:
    """Return samples of vertical sensors of unit noise whose axes are off by so much, rms."""
    rng = np.random.default_rng(seed)
    motion = np.sqrt(snr) * rng.standard_normal((30_000, 3))
    lean = np.radians(degrees) / np.sqrt(2) * rng.standard_normal((n_sensors, 2))
    axis = np.c_[np.ones(n_sensors), lean] * (1 + 0.01 * rng.standard_normal((n_sensors, 1)))
    noise = rng.standard_normal((30_000, n_sensors))
    return {f"s{n:02}": (motion @ axis[n] + noise[:, n])[:, None] for n in range(n_sensors)}


def covered(samples: dict[str, np.ndarray], settings: Settings) -> tuple[float, float]:
    """Estimate; return the share of intervals that hold the truth, and the median upper end."""
    return held_by(estimate([recording_of_arrays(samples, RATE)], settings), settings)


def held_by(snapshot: Snapshot, settings: Settings) -> tuple[float, float]:
    """Return the share of intervals that hold the truth, and the median upper end over it."""
    assert not any(isinstance(each, SharedNoise) for each in snapshot.diagnostics.advice)
    (noise,) = snapshot.results.values()
    truth = 2 / RATE
    ends = np.array(
        [
            (float(mean.low[0]) / truth, float(mean.high[0]) / truth)
            for band in BANDS
            for mean in Result(snapshot, settings).means(noise.method, band)
        ]
    )
    held = (ends[:, 0] <= 1) & (ends[:, 1] >= 1)
    return float(held.mean()), float(np.median(ends[:, 1]))


@pytest.mark.parametrize("n_sensors", [3, 5, pytest.param(12, marks=pytest.mark.long)])
def test_no_interval_excludes_the_truth_of_sensors_off_plumb(n_sensors: int) -> None:
    shares, ends = zip(
        *(covered(leaning(n_sensors, 1.0, seed), Settings(segment=2.0)) for seed in range(3)),
        strict=True,
    )
    assert np.mean(shares) >= 0.95
    if n_sensors == 12:  # as many as determine motion in all dimensions
        assert np.median(ends) < 10**0.08


def test_axes_that_lean_are_no_gradients_of_the_motion() -> None:
    """Positions fitted to leans would be wrong at all frequencies alike."""
    shares = []
    for seed in range(2):
        recording = recording_of_arrays(leaning(6, 0.6, seed, snr=7e3), RATE)
        snapshot = estimate([recording], Settings(segment=2.0))
        assert not any(each.gradients for each in snapshot.diagnostics.dimensions)
        shares.append(held_by(snapshot, Settings(segment=2.0))[0])
    assert np.mean(shares) >= 0.93


@pytest.mark.long
def test_leans_that_no_test_of_the_model_sees_widen_intervals() -> None:
    shares = [covered(leaning(7, 0.15, seed, 2e3), Settings(segment=2.0))[0] for seed in range(3)]
    assert np.mean(shares) >= 0.93


def test_a_stated_tolerance_replaces_the_usual_one() -> None:
    samples = leaning(3, 0.0, 1)
    usual, exact = (
        covered(samples, Settings(segment=2.0, axis_tolerance=each))[1] for each in ({}, {"": 0.0})
    )
    assert exact < 1.1
    assert usual > 1.4  # the bound ends it; motion across the axes would allow 60


def test_tolerances_are_by_sensor_and_nothing_to_triaxial_ones() -> None:
    settings = Settings(axis_tolerance={"B": 0.5})
    found = np.degrees(settings.axis_tolerances("ABC", (1, 1, 1)))
    np.testing.assert_allclose(found, [1.0, 0.5, 1.0])
    assert settings.axis_tolerances("ABC", (3, 3, 3)) == (0.0, 0.0, 0.0)
    # a single channel beside two triaxial sensors is known, whatever its axis
    np.testing.assert_allclose(np.degrees(settings.axis_tolerances("ABC", (3, 3, 1))), [1, 0.5, 0])
    assert settings.across_axes("ABC", (3, 3, 1))[2] == 0.0


@pytest.mark.parametrize("tolerances", [(1, 1, 1), (0, 1, 1), (1, 0, 0), (1, 0.3, 0.3)])
@pytest.mark.parametrize("known", [0.0, 1.0])
def test_the_share_bounds_what_leaning_sensors_add(
    tolerances: tuple[float, ...], known: float
) -> None:
    rng = np.random.default_rng(3)
    leans = known * rng.standard_normal((3, 2))
    a = leans + np.array(tolerances)[:, None] / np.sqrt(2) * rng.standard_normal((20_000, 3, 2))
    most = across(np.array(tolerances, float), leans if known else None)
    for i, j, k in ((0, 1, 2), (1, 0, 2), (2, 0, 1)):
        added = np.sum((a[:, i] - a[:, j]) * (a[:, i] - a[:, k]), axis=1)
        assert np.mean(added <= most[i]) >= 0.965
        assert np.mean(added >= -most[i]) >= 0.965


def test_known_leans_leave_their_difference_and_what_remains() -> None:
    lean = {"A": (1.0, 0.5), "B": (1.0, 0.5), "C": (1.0, 0.5)}
    same = Settings(lean=lean).across_axes("ABC", (1, 1, 1))
    rest = Settings(axis_tolerance={"": 0.1}).across_axes("ABC", (1, 1, 1))
    np.testing.assert_allclose(same, rest)
    other = Settings(lean=lean | {"C": (-1.0, 0.5)}, axis_tolerance={"": 0.0})
    found = other.across_axes("ABC", (1, 1, 1))
    np.testing.assert_allclose(found, np.radians(2.0) ** 2 * np.array([0, 0, 1]), atol=1e-12)


def test_intervals_with_known_leans_are_narrower_and_hold_the_truth() -> None:
    samples = leaning(3, 1.0, 4)
    rng = np.random.default_rng(4)
    rng.standard_normal((30_000, 3))
    exact = np.degrees(np.radians(1.0) / np.sqrt(2) * rng.standard_normal((3, 2)))
    lean = {f"s{n:02}": (float(exact[n, 0]), float(exact[n, 1])) for n in range(3)}
    settings = Settings(segment=2.0)
    usual, known = (covered(samples, each) for each in (settings, replace(settings, lean=lean)))
    assert usual[0] == known[0] == 1.0
    assert known[1] <= usual[1]


def test_tolerances_as_text_and_in_the_bench_file() -> None:
    assert from_text("axis_tolerance", ["0.2", "B=0.05"]) == {"": 0.2, "B": 0.05}
    assert to_table(Settings(axis_tolerance={"": 0.2}))["axis_tolerance"] == 0.2
    table = to_table(Settings(axis_tolerance={"": 0.2, "B": 0.05}))["axis_tolerance"]
    assert table == {"": 0.2, "B": 0.05}
    assert from_text("lean", ["B=0.3,-0.1"]) == {"B": (0.3, -0.1)}
    for wrong in ("B=0.3", "0.3,0.1", "B=a,b"):
        with pytest.raises(ValueError, match="two angles"):
            from_text("lean", [wrong])
    with pytest.raises(ValueError, match="from 0 to 45 degrees"):
        from_text("axis_tolerance", ["-1"])


def test_a_dead_channel_neither_warns_nor_explains_noise_that_others_share() -> None:
    rng = np.random.default_rng(1)
    motion, shared = 10 * rng.standard_normal(30_000), 0.7 * rng.standard_normal(30_000)
    samples = {
        f"s{n}": (motion + rng.standard_normal(30_000) + (shared if n < 2 else 0.0))[:, None]
        for n in range(4)
    } | {"s4": np.zeros((30_000, 1))}
    settings = Settings(segment=2.0, methods=("three-sensor",))
    snapshot = estimate([recording_of_arrays(samples, RATE)], settings)  # warnings are errors
    assert any(isinstance(each, SharedNoise) for each in snapshot.diagnostics.advice)


# --- sensitivities ---------------------------------------------------------------------------


OWN, RATIO = 0.03, 300.0
BAND = (2.0, 40.0)


def held(method: str, seed: int) -> tuple[list[bool], list[bool]]:
    """Return which intervals hold the truth, by scatter alone and with what is known."""
    rng = np.random.default_rng(seed)
    motion = np.sqrt(RATIO) * rng.standard_normal(12_000)
    gains = 1 + OWN * rng.standard_normal(3)
    samples = {
        name: (gain * (motion + rng.standard_normal(12_000)))[:, None]
        for name, gain in zip("ABC", gains, strict=True)
    }
    settings = Settings(segment=1.0, methods=(method,), axis_tolerance={"": 0.0})
    exact = estimate([recording_of_arrays(samples, RATE)], settings)
    names = [(label.sensor, label.channel) for label in exact.channels]
    stated = with_sensitivities(exact, dict.fromkeys(names, KnownSensitivity(own=OWN)))
    alone, known = (Result(each, settings).means(method, BAND) for each in (exact, stated))
    by_scatter = [each.scatter for each in alone if each.scatter is not None]
    return (
        [bool(low[0] <= 2 / RATE <= high[0]) for low, high in by_scatter],
        [bool(each.low[0] <= 2 / RATE <= each.high[0]) for each in known],
    )


@pytest.mark.parametrize(
    "method", ["two-channel", "three-sensor", pytest.param("three-channel", marks=pytest.mark.long)]
)
def test_intervals_hold_the_truth_with_sensitivities_off_as_stated(method: str) -> None:
    """Of 24 intervals 23 should; 20 leaves room for chance (p = 0.01)."""
    draws = [held(method, seed) for seed in range(8)]
    exact, stated = (np.array([draw[n] for draw in draws]) for n in (0, 1))
    assert stated.sum() >= 20, stated.mean()
    assert exact.sum() < 18, exact.mean()  # scatter alone is too narrow


def test_temperatures_and_certificates_are_in_the_interval() -> None:
    """By squares, in logarithms."""
    rng = np.random.default_rng(3)
    samples = {name: rng.standard_normal((6000, 1)) for name in "ABC"}
    settings = Settings(segment=1.0, methods=("three-sensor",), axis_tolerance={"": 0.0})
    snapshot = estimate([recording_of_arrays(samples, RATE)], settings)
    widths = {}
    for name, known in {
        "exact": KnownSensitivity(),
        "stated": KnownSensitivity(own=0.03),
        "warm": KnownSensitivity(own=0.03, coefficient=0.004, temperatures=(13.0, 33.0)),
    }.items():
        channels = [(label.sensor, label.channel) for label in snapshot.channels]
        found = with_sensitivities(snapshot, dict.fromkeys(channels, known))
        mean = Result(found, settings).means("three-sensor", BAND)[0]
        widths[name] = float(np.log(mean.high[0] / abs(mean.mean[0])))
        bins = found.results["three-sensor"]
        assert (bins.high >= snapshot.results["three-sensor"].high)[np.isfinite(bins.high)].all()
    by_temperature = 1.96 * 2 * 0.04 / np.sqrt(3)
    assert widths["stated"] == pytest.approx(np.hypot(widths["exact"], 1.96 * 0.06), rel=1e-3)
    assert widths["warm"] == pytest.approx(np.hypot(widths["stated"], by_temperature), rel=1e-3)


@pytest.mark.parametrize(
    ("wrong", "certificate", "words"),
    [
        (1.0, 9.80665, r"9.81 times .* \(g in place of m/s², or the reverse\)\. The other sensors"),
        (9.80665, 9.80665, r"9.81 times .* \(g in place of m/s², or the reverse\)\. Correct"),
        (1.0, -1.0, r"-1 times the sensitivity in the bench file\. The other sensors agree"),
        (1.0, 1.04, None),
    ],
)
def test_a_certificate_that_contradicts_the_bench_file_is_a_fact(
    wrong: float, certificate: float, words: str | None
) -> None:
    rng = np.random.default_rng(5)
    motion = 30 * rng.standard_normal(12_000)
    samples = {name: motion + rng.standard_normal(12_000) for name in "ABC"}
    samples["A"] *= wrong
    settings = Settings(segment=1.0, axis_tolerance={"": 0.0})
    one = {name: values[:, None] for name, values in samples.items()}
    snapshot = estimate([recording_of_arrays(one, RATE)], settings)
    ((_, name),) = {(each.sensor, each.channel) for each in snapshot.channels if each.sensor == "A"}
    stated = {"value": certificate, "expanded_uncertainty": 0.01}
    channel: dict[str, Any] = {"name": name, "sensitivity": 1.0, "certificate": stated}
    table = {"sensors": [{"name": "A", "channels": [channel]}]}
    found = Result(with_sensitivities(snapshot, known_sensitivities(table)), settings)
    facts = [str(each) for each in found.facts if isinstance(each, CertificateDiffers)]
    assert len(facts) == (words is not None)
    assert all(re.search(words or "", each) for each in facts), facts


def test_recordings_are_estimated_by_the_sensitivities_and_tolerances_of_all() -> None:
    def recording(sensitivity: float, **stated: float) -> Any:  # noqa: ANN401 - of a recording
        channel = {"name": "X", "sensitivity": sensitivity, **stated}
        known = known_sensitivities({"sensors": [{"name": "A", "channels": [channel]}]})
        return SimpleNamespace(outline=SimpleNamespace(sensitivities=known), readings=())

    first = recording(1e7)
    same = stated_sensitivities([first, recording(1e7, tolerance=0.1)])["A", "X"]
    assert same.own == pytest.approx(0.1 / np.sqrt(3))
    assert not same.spread
    none: Any = SimpleNamespace(outline=None, readings=())
    known = stated_sensitivities([first, recording(1.25e7), none])
    assert known["A", "X"].spread == pytest.approx(0.2)
    rng = np.random.default_rng(3)
    motion = 30 * rng.standard_normal((6000, 1))
    samples = {name: motion + rng.standard_normal((6000, 1)) for name in "ABC"}
    settings = Settings(segment=1.0, axis_tolerance={"": 0.0})
    snapshot = estimate([recording_of_arrays(samples, RATE)], settings)
    label = snapshot.channels[0]
    named = {(label.sensor, label.channel): known["A", "X"]}
    facts = Result(with_sensitivities(snapshot, named), settings).facts
    (fact,) = (each for each in facts if isinstance(each, SensitivitiesDiffer))
    assert fact.needs_action
    assert f"{label.name} differ between the recordings by 20 %" in str(fact)
