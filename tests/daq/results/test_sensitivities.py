"""Sensitivities that are off within what is stated: intervals hold the truth."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from daq.bench.sensitivity import KnownSensitivity, known_sensitivities
from daq.estimation.contributions import with_sensitivities
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot_builder import stated_sensitivities
from daq.formats.arrays import recording_of_arrays
from daq.results.facts.channels import CertificateDiffers, SensitivitiesDiffer
from daq.results.result import Result

RATE, OWN, SNR = 100.0, 0.03, 300.0
BAND = (2.0, 40.0)


def held(method: str, seed: int) -> tuple[list[bool], list[bool]]:
    """Return which intervals hold the truth, by scatter alone and with what is known."""
    rng = np.random.default_rng(seed)
    motion = np.sqrt(SNR) * rng.standard_normal(12_000)
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


@pytest.mark.parametrize("method", ["two-channel", "three-channel", "three-sensor"])
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
