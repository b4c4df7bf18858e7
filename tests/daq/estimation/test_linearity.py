"""What is not linear is a fact, in the interval, and subtracted on request; equal rounding."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from scipy import signal

from daq.estimation.estimation import estimate
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.formats.memory import RecordingInMemory
from daq.results.band_summary import Spectrum
from daq.results.calibration import calibrate
from daq.results.facts.channels import NoiseDependsOnMotion, NotLinear, RoundedAlike
from daq.results.result import Result
from daq.results.uncertainty_budget import Budget
from estimator.checks.advice import Rank
from estimator.checks.advice_on_noise import ResponseChanges
from estimator.checks.instants import Form
from estimator.levels.contributions import Source

RATE, N_SAMPLES = 100.0, 30_000
EDGES = np.array([1.0, 5.0, 10.0, 20.0, 40.0])


@pytest.mark.parametrize("linearise", [False, True])
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_a_square_is_in_the_interval_or_subtracted(linearise: bool, scale: float) -> None:
    rng = np.random.default_rng(47)
    motion = 1e3 * rng.standard_normal((N_SAMPLES, 1))
    curved = motion + 2e-3 * motion**2 / motion.std()
    arrays = {
        name: scale * (each + rng.standard_normal((N_SAMPLES, 1)))
        for name, each in zip("ABC", (motion, curved, motion), strict=True)
    }
    settings = Settings(segment=5.0, linearise=linearise, axis_tolerance={"": 0.0})
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], settings)
    (fact,) = (each for each in Result(snapshot, settings).facts if isinstance(each, NotLinear))
    assert fact.channels == ("B.1",)
    assert fact.shares[0] == pytest.approx(8 / 9, abs=0.1)  # (2e-3)**2 * 2 * 1e6 over 1
    assert fact.rank is (Rank.TO_KNOW if linearise else Rank.DELAYS)
    assert fact.is_subtracted is linearise
    assert not snapshot.dependent  # squares and cubes are all that bends
    result = next(iter(snapshot.results.values()))
    found = (
        Result(snapshot, settings)
        .spectrum(result.method)
        .levels(np.searchsorted(snapshot.frequency, EDGES))
    )
    low, high = found.ends()
    truth = 2 / RATE * scale**2
    held = (low < truth) & (truth < high)
    assert held[:, 1].all()
    assert held.mean() > 0.85  # 12 intervals of 95 %
    error = found.mean[:, 1] / truth - 1
    assert np.abs(error).max() < 2.5 if linearise else error.min() > 6


def test_instants_that_sway_are_in_the_interval() -> None:
    """Their noise is ``(2 pi f tau)**2`` of the motion: four times that of the sensor at 20 Hz."""
    rng = np.random.default_rng(46)
    time, tau = np.arange(N_SAMPLES) / RATE, 1.6e-5
    motion = 1e3 * rng.standard_normal((N_SAMPLES, 3))
    spectrum = np.fft.rfft(motion, axis=0)
    slope = np.fft.irfft(
        spectrum * 2j * np.pi * np.fft.rfftfreq(N_SAMPLES, 1 / RATE)[:, None], axis=0
    )
    arrays = {
        name: each @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + rng.standard_normal(each.shape)
        for name, each in {
            "A": motion,
            "B": motion + np.sqrt(2) * tau * np.sin(1.7 * time)[:, None] * slope,
            "C": motion,
        }.items()
    }
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], Settings(segment=5.0))
    result = Result(snapshot, Settings(segment=5.0))
    (fact,) = (each for each in result.facts if isinstance(each, NoiseDependsOnMotion))
    assert fact.sensors == ("B",)
    assert fact.instants == pytest.approx(tau, rel=0.4)
    found = result.spectrum(result.method).levels(np.searchsorted(snapshot.frequency, EDGES))
    low, high = found.ends()
    truth = 2 / RATE
    assert found.mean[2, 3:6].min() > 3 * truth
    assert ((low < truth) & (truth < high))[:, 3:6].all()
    assert np.isfinite(low[:, :3]).all()


def test_the_square_of_a_displacement_delays_the_result_of_its_few_frequencies() -> None:
    rng = np.random.default_rng(48)
    motion = 1e3 * rng.standard_normal((N_SAMPLES, 3))
    far, slow = motion[:, 0], signal.butter(2, 0.3, "high", fs=RATE, output="sos")
    for _ in range(2):
        far = signal.sosfilt(slow, np.cumsum(far))
    bent = motion.copy()
    bent[:, 0] += 2e-3 * motion[:, 0].std() * far**2 / far.var()
    arrays = {
        name: each @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + rng.standard_normal(each.shape)
        for name, each in {"A": motion, "C": motion}.items()
    }
    arrays["B"] = bent + rng.standard_normal(bent.shape)
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], Settings())
    result = Result(snapshot, Settings())
    (fact,) = (each for each in result.facts if isinstance(each, NoiseDependsOnMotion))
    assert (fact.channels, fact.rank) == (("B.1",), Rank.DELAYS)
    edges = np.searchsorted(snapshot.frequency, [0.6, 1.0])
    found = result.spectrum(result.method).levels(edges)
    assert found.mean[0, 6] > 30 * 2 / RATE
    assert found.ends()[0][0, 6] < 2 / RATE


@pytest.mark.parametrize("form", get_args(Form))
def test_each_form_of_dependence_has_words(form: Form) -> None:
    fact = NoiseDependsOnMotion(
        rank=Rank.DELAYS,
        sensors=("A",),
        channels=("A.X",),
        form=form,
        evidence=8.0,
        instants=3e-5 if form == "instants" else None,
        gain=0.02 if form == "gain" else None,
    )
    line, explanation, action = fact.words.line, *str(fact.words).split(". ")[:2]
    assert "A" in line
    assert len({line, explanation, action}) == 3
    assert ("30 µs" in line, "2 %" in line or "2%" in line) == (form == "instants", form == "gain")


def test_a_linear_bench_has_no_such_fact_and_the_same_numbers() -> None:
    rng = np.random.default_rng(48)
    motion = 1e3 * rng.standard_normal((N_SAMPLES, 1))
    arrays = {name: motion + rng.standard_normal((N_SAMPLES, 1)) for name in "ABC"}
    recording = recording_of_arrays(arrays, sampling_rate=RATE)
    one, other = (estimate([recording], Settings(linearise=each)) for each in (False, True))
    assert not one.nonlinear
    assert not one.dependent
    for name, noise in one.results.items():
        np.testing.assert_array_equal(noise.noise_psd, other.results[name].noise_psd)


def test_a_square_is_no_change_of_a_gain() -> None:
    """It follows the loudness of the motion, as a gain that changes would."""
    rng = np.random.default_rng([47, 1])
    motion = 1e3 * rng.standard_normal((N_SAMPLES, 3))
    arrays = {}
    for name in "ABC":
        felt = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        if name == "A":
            felt[:, 0] += 2e-2 * felt[:, 0] ** 2 / felt[:, 0].std()
        arrays[name] = felt + rng.standard_normal((N_SAMPLES, 3))
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], Settings(segment=2.5))
    assert snapshot.nonlinear[0].column == 0
    assert not [e for e in snapshot.diagnostics.advice if isinstance(e, ResponseChanges)]


def test_a_compressed_gain_is_uncertain_by_what_it_lacks() -> None:
    """At 12 times the standard deviation of the motion, tanh takes 1/144 of the gain."""
    rng = np.random.default_rng([47, 2])
    motion = 300 * rng.standard_normal((N_SAMPLES, 1))
    arrays = {name: motion + rng.standard_normal((N_SAMPLES, 1)) for name in "ABC"}
    arrays["B"] = 3600 * np.tanh(motion / 3600) + rng.standard_normal((N_SAMPLES, 1))
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], Settings(segment=5.0))
    for reference, bent in (("A", {"B"}), ("B", {"A", "C"})):
        found = calibrate(Result(snapshot, Settings(segment=5.0)), None, reference=reference)
        by_sensor = {
            budget.sensor: each.relative
            for budget in found.budgets
            for each in budget.components
            if budget.quantity == "sensitivity" and each.source == "linearity"
        }
        assert max(by_sensor.values()) < 1.3 / 144
        assert [by_sensor[each] for each in bent] == pytest.approx([1 / 144] * len(bent), rel=0.3)


def test_a_dead_zone_beside_red_motion_leaves_noise_no_lower_end_anywhere() -> None:
    """Squares and cubes explain it in long waves alone, and it is 100 times the noise elsewhere."""
    rng = np.random.default_rng([47, 4])
    frequency = np.maximum(np.fft.rfftfreq(N_SAMPLES, 1 / RATE), 0.1)[:, None]
    spectrum = np.fft.rfft(rng.standard_normal((N_SAMPLES, 1)), axis=0) / frequency
    motion = np.fft.irfft(spectrum, axis=0)
    motion *= 1e3 / motion.std()
    arrays = {name: motion + rng.standard_normal((N_SAMPLES, 1)) for name in "ABC"}
    arrays["B"] -= np.clip(motion, -20, 20)
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], Settings())
    result = Result(snapshot, Settings())
    spectrum_of_noise = result.spectrum(next(iter(snapshot.results)))
    found = spectrum_of_noise.levels(np.searchsorted(snapshot.frequency, EDGES))
    low, high = found.ends()
    assert found.mean[:, 1].min() > 5 * 2 / RATE
    assert ((low[:, 1] < 2 / RATE) & (high[:, 1] > 2 / RATE)).all()


def bent(kind: str, n: int = N_SAMPLES, seed: int = 3) -> RecordingInMemory:
    """Three sensors at 20 dB, the second of which is bent unseen."""
    rng = np.random.default_rng([47, seed])
    motion = 10 * rng.standard_normal((n, 1))
    arrays = {name: motion + rng.standard_normal((n, 1)) for name in "ABC"}
    if kind == "tanh":
        arrays["B"] += 120 * np.tanh(motion / 120) - motion
    elif kind == "dead zone":
        arrays["B"] -= np.clip(motion, -0.2, 0.2)
    elif kind == "play":  # less than a step: the last direction decides
        arrays["B"] -= 0.2 * np.sign(np.diff(motion, axis=0, prepend=0.0))
    elif kind == "stands still":
        for at in range(1000, n, 3000):
            arrays["B"][at : at + 30] = 0.0
    return recording_of_arrays(arrays, sampling_rate=RATE)


def gains_of(*recordings: RecordingInMemory, calibrates: bool) -> list[Budget]:
    settings = Settings(segment=5.0, calibrates=calibrates)
    found = calibrate(Result(estimate(recordings, settings), settings), None)
    assert not found.untested
    return list(found.whole_band("sensitivity"))


@pytest.mark.parametrize(
    ("kind", "calibrates", "within", "steadily"),
    [
        ("tanh", False, 1.0, 0.02),
        ("dead zone", False, 1.0, 0.02),
        ("stands still", False, 1.0, 0.02),
        ("tanh", True, 1.0, 0.015),
        ("dead zone", True, 1.0, 0.02),
        ("stands still", True, 0.7, 0.01),
        ("play", True, 0.7, 0.015),
    ],
)
def test_what_bends_a_channel_unseen_is_in_the_uncertainty_of_its_gain(
    kind: str, calibrates: bool, within: float, steadily: float
) -> None:
    """At 20 dB, no test shows what takes 1/144 or 1.6 % of a gain, or what it lacks for 1 %."""
    gain, steady = gains_of(bent(kind), calibrates=calibrates)
    assert abs(gain.value - 1) < within * gain.expanded < within * 0.04
    assert abs(steady.value - 1) < steady.expanded < steadily


def test_what_may_bend_channels_is_less_in_longer_recordings() -> None:
    """By the root of the length, and for some segments hardly more than the gains' scatter."""
    short, long, some = (
        max(each.expanded for each in gains_of(bent("", n, 5), calibrates=calibrates))
        for n, calibrates in ((N_SAMPLES, True), (6 * N_SAMPLES, True), (6 * N_SAMPLES, False))
    )
    assert long == pytest.approx(short / 6**0.5, rel=0.25)
    assert some > 2 * long


def test_what_bends_a_channel_is_as_much_in_many_short_recordings() -> None:
    """Of 11 segments each, of which none tells by itself."""
    parts = [bent("dead zone", 3_000, seed) for seed in range(10)]
    gain, _ = gains_of(*parts, calibrates=True)
    one, _ = gains_of(bent("dead zone"), calibrates=True)
    assert gain.expanded == pytest.approx(one.expanded, rel=0.25)
    assert abs(gain.value - 1) < gain.expanded


def test_each_of_very_many_recordings_tells_a_little_of_linearity() -> None:
    """Of more than 96, the share of each was less than half a segment, and none was tested."""
    recordings = []
    for seed in range(120):
        rng = np.random.default_rng([47, seed])
        motion = 1e3 * rng.standard_normal((1000, 1))
        arrays = {name: motion + rng.standard_normal((1000, 1)) for name in "ABC"}
        arrays["B"] += 2e-6 * motion**2
        recordings.append(recording_of_arrays(arrays, sampling_rate=RATE))
    snapshot = estimate(recordings, Settings(segment=5.0))
    assert [each.column for each in snapshot.nonlinear] == [1]


def test_too_few_segments_tell_of_no_linearity_and_that_is_said() -> None:
    recording, settings = bent("", 6_000), Settings(segment=5.0, calibrates=True)
    few = replace(settings, segment=10.0)
    told, untold = (
        calibrate(Result(estimate([recording], each), each), None) for each in (settings, few)
    )
    assert (told.untested, untold.untested) == ((), ("A", "B", "C"))


def test_without_motion_no_segment_is_read_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(Pass, "whole_segments")
    samples = np.random.default_rng(53).standard_normal((3, N_SAMPLES, 2))
    recording = recording_of_arrays(dict(zip("ABC", samples, strict=True)), sampling_rate=RATE)
    assert not estimate([recording], Settings(segment=5.0)).nonlinear


# --- sensors that are rounded alike ----------------------------------------------------------


COARSE = np.array([10, 30, 100, 250, 450])


def _levels(
    own: float, motion: float, n_sensors: int, n_channels: int, seed: int, *, step: float = 1.0
) -> tuple[np.ndarray, np.ndarray, list[RoundedAlike]]:
    """Return how many intervals with and without the contribution hold the noise, and the fact."""
    rng = np.random.default_rng([28, seed])
    moved = motion * rng.standard_normal((N_SAMPLES, n_channels))
    arrays = {}
    for name in "ABCDE"[:n_sensors]:
        offset = rng.uniform(0, 1, n_channels)
        noise = own * rng.standard_normal((N_SAMPLES, n_channels))
        arrays[name] = np.round(moved + offset + noise).astype(np.int32)
        if step != 1:  # a text of some digits
            arrays[name] = np.round(250 + step * arrays[name], 3)
    settings = Settings(segment=10.0)
    snapshot = estimate([recording_of_arrays(arrays, sampling_rate=RATE)], settings)
    result = next(iter(snapshot.results.values()))
    found = Spectrum(result, snapshot, settings).levels(COARSE)
    truth = step**2 * (own**2 + 1 / 12) * 2 / RATE
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
    ("n_sensors", "n_channels", "step"),
    [
        (3, 1, 1.0),
        (3, 1, 0.002),
        *(pytest.param(*each, 1.0, marks=pytest.mark.long) for each in ((3, 3), (5, 1))),
    ],
)
def test_noise_that_is_rounded_alike_is_within_its_interval(
    n_sensors: int, n_channels: int, step: float
) -> None:
    found = [_levels(0.15, 3.0, n_sensors, n_channels, seed, step=step) for seed in range(4)]
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
