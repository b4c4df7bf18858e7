"""Stated UTC against the motion: what drifts is found and corrected, what does not is left."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.studies.synthesis import synthesise
from daq.clocks.aligned_recording import AlignedRecording, take_drift
from daq.clocks.clock_model import ClockSource
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.segments.stated_times import compare, drift_of
from daq.estimation.settings import Settings
from daq.protocols.block import Block
from daq.recording.reader import Recording
from daq.results.facts.clocks import (
    ClockNotUnderstood,
    ClockSet,
    ClocksMayExplain,
    SamplesUncounted,
    StatedTimesDrift,
    StatedTimesUnchecked,
)
from daq.results.result import Result
from estimator.spectra.welch import WelchSettings
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World
from tests.daq.clock_facts import clock_facts
from tests.daq.clocks.recordings import Sensor, arriving, create, write

LONG, STUDY = pytest.mark.long, pytest.mark.study
SETTINGS = Settings(segment=2.0, methods=("three-sensor",))
RATE, SECONDS, NOISE = 50.0, 480.0, 1e-6  # unit²/Hz
PPM = (0.0, 1.0, -2.0)
BAND = slice(2, 40)  # 1 to 20 Hz


def huddle(snr: float, ppm: tuple[float, ...]) -> dict[str, Sensor]:
    """Return sensors of one motion that state the UTC of their nominal rate."""
    return {
        name: Sensor(counts.copy(), rate=RATE, utc=True)
        for name, counts in _counts(snr, ppm).items()
    }


@functools.cache
def _counts(snr: float, ppm: tuple[float, ...]) -> dict[str, np.ndarray]:
    scenario = Scenario.from_dict(
        {
            "seed": 6,
            "motion": {"spectra": [{"shape": "white", "level": snr * NOISE}]},
            "sensors": {
                name: {
                    "sampling_rate": RATE,
                    "noise": [{"shape": "white", "level": NOISE}],
                    "clock": {"ppm": each},
                }
                for name, each in zip("abcd", ppm, strict=False)
            },
        }
    )
    world = World(scenario)
    return {
        name: np.round(1e6 * world.samples(name, 0, round(SECONDS * RATE))).astype(np.int32)
        for name in scenario.names
    }


@pytest.mark.parametrize("snr", [1e3, pytest.param(1e5, marks=LONG)])
def test_sensors_whose_stated_times_drift_are_aligned_by_the_motion(
    tmp_path: Path, snr: float
) -> None:
    snapshot = estimate([write(tmp_path / "r.h5", huddle(snr, PPM))], SETTINGS)
    found = snapshot.results["three-sensor"]
    ratio = found.noise_psd[BAND].mean(axis=0) / (1e12 * NOISE)
    error = found.cov[BAND].mean(axis=0) / np.sqrt(len(found.cov[BAND]) / 1.94)
    assert (np.abs(ratio - 1) < 5 * error).all()  # neighbours at Hann windows: 1 + 2 (4/9 + 1/36)
    for clock, ppm in zip(snapshot.clocks, PPM, strict=True):
        assert clock.source is ClockSource.DEVICE_UTC
        drift = abs(ppm) * 1e-6 * SECONDS / np.sqrt(12)
        assert clock.corrected == pytest.approx(drift, rel=0.1, abs=1e-9)
    (fact,) = clock_facts(snapshot)
    assert fact.reference == "a"
    assert fact.corrected == pytest.approx({"b": 138e-6, "c": 276e-6}, rel=0.05)


def test_the_sensor_that_drifts_against_all_others_is_named(tmp_path: Path) -> None:
    snapshot = estimate([write(tmp_path / "r.h5", huddle(1e4, (2.0, 0.0, 0.0)))], SETTINGS)
    (fact,) = clock_facts(snapshot)
    assert fact.reference == "b"
    assert fact.corrected == pytest.approx({"a": 276e-6}, rel=0.05)


def test_drift_is_found_where_every_segment_has_a_gap(tmp_path: Path) -> None:
    sensors = huddle(1e4, PPM)
    sensors["b"].gaps = tuple((first, first + 5) for first in range(40, 24_000, 250))
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], replace(SETTINGS, segment=10.0))
    assert snapshot.bridged is not None
    assert snapshot.n_segments == snapshot.bridged.n_segments
    drift = abs(PPM[2]) * 1e-6 * SECONDS / np.sqrt(12)
    assert snapshot.clocks[2].corrected == pytest.approx(drift, rel=0.1)


@pytest.mark.parametrize("first", [18_000, pytest.param(8000, marks=LONG)])
def test_a_beginning_without_motion_does_not_hide_a_drift(tmp_path: Path, first: int) -> None:
    sensors, noise = huddle(1e4, PPM), np.random.default_rng(2)
    for sensor in sensors.values():
        sensor.counts[:first] = noise.integers(-10, 10, (first, 1))
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS)
    assert snapshot.clocks[2].corrected > 5e-5
    assert all(clock.residual < 2e-5 for clock in snapshot.clocks)
    found = snapshot.results["three-sensor"]
    ratio = found.noise_psd[BAND].mean(axis=0) / (1e12 * NOISE)
    assert ratio == pytest.approx(1 - first / (SECONDS * RATE), rel=0.1)  # it is nearly zero first


def test_a_first_sensor_without_the_motion_is_not_the_reference(tmp_path: Path) -> None:
    sensors = huddle(1e4, PPM)
    noise = np.random.default_rng(3).integers(-10_000, 10_000, (24_000, 1), dtype=np.int32)
    first = Sensor(noise, rate=RATE, utc=True)
    snapshot = estimate([write(tmp_path / "r.h5", {"0": first} | sensors)], SETTINGS)
    found = snapshot.results["three-sensor"]
    ratio = found.noise_psd[BAND, 1:].mean(axis=0) / (1e12 * NOISE)
    assert np.abs(ratio - 1).max() < 0.1
    assert snapshot.diagnostics.synchronisation.reference == "a"
    drifting, unchecked = clock_facts(snapshot)
    assert drifting.reference == "a"
    assert isinstance(unchecked, StatedTimesUnchecked)
    assert unchecked.sensors == ("0",)


def test_a_drift_that_segments_are_too_short_for_widens_the_intervals(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5", huddle(0.8, (0.0, 60.0, -60.0)))
    short, longer = (estimate([path], replace(SETTINGS, segment=each)) for each in (1.0, 10.0))
    assert [clock.drifts for clock in short.clocks] == [False, True, True]
    assert set(clock_facts(short)[0].uncorrected) == {"b", "c"}
    assert [clock.drifts for clock in longer.clocks] == [False, False, False]
    for snapshot in (short, longer):
        means = Result(snapshot, SETTINGS).means("three-sensor", (1.0, 20.0))
        for mean in means:
            assert mean.low[0] < 1e12 * NOISE < mean.high[0]


def test_a_broken_sensor_does_not_condemn_the_clock_that_it_shares_with_the_reference() -> None:
    sources: list[Any] = [
        SimpleNamespace(device_utc=True, doubted=False, drift=None, clock_name=name)
        for name in "aabbcc"
    ]
    take_drift(sources, {0: 0.0, 1: 1e-3, 2: np.nan, 3: 1e-4, 4: np.nan}, 0)
    assert [each.drift for each in sources[:4]] == [0.0, 0.0, 1e-4, 1e-4]
    assert np.isnan([each.drift for each in sources[4:]]).all()


def test_what_is_said_of_times_is_that_of_all_recordings(tmp_path: Path) -> None:
    later = huddle(1e4, (0.0, 0.0, 0.0))
    for sensor in later.values():
        sensor.start, sensor.counts = 1000.0, sensor.counts[:6000]
    drifting = write(tmp_path / "1.h5", huddle(1e4, PPM))
    snapshot = estimate([drifting, write(tmp_path / "2.h5", later)], SETTINGS)
    assert clock_facts(snapshot)[0].corrected["c"] == pytest.approx(276e-6, rel=0.05)


def test_a_few_seconds_are_said_not_to_be_compared(tmp_path: Path) -> None:
    sensors = huddle(1e4, (0.0, 0.0, 0.0))
    for sensor in sensors.values():
        sensor.counts = sensor.counts[:1500]
    snapshot = estimate([write(tmp_path / "r.h5", sensors)], SETTINGS)
    (fact,) = clock_facts(snapshot)
    assert isinstance(fact, StatedTimesUnchecked)
    assert fact.sensors == ("b", "c")


def test_stated_times_that_agree_with_the_motion_are_used_as_they_are(tmp_path: Path) -> None:
    path = write(tmp_path / "r.h5", huddle(1e4, (0.0, 0.0, 0.0)))
    snapshot = estimate([path], SETTINGS)
    nominal = estimate([path], replace(SETTINGS, clocks="nominal"))
    assert [(clock.corrected, clock.residual) for clock in snapshot.clocks] == 3 * [(0.0, 0.0)]
    assert np.array_equal(snapshot.csm, nominal.csm, equal_nan=True)
    assert not clock_facts(snapshot)


@pytest.mark.parametrize(
    ("ppm", "every"), [(PPM, 8000), pytest.param((*PPM, 0.0), 600, marks=LONG)]
)
def test_drift_is_corrected_while_the_recording_grows(
    tmp_path: Path, ppm: tuple[float, ...], every: int
) -> None:
    """A fourth sensor has no UTC: segments wait to be measured when the drift is found."""
    sensors = huddle(1e4, ppm)
    if len(ppm) > 3:
        sensors["d"].utc = False
    path = tmp_path / "r.h5"
    writer = create(path, sensors)
    corrected = []
    with Estimation([path], SETTINGS) as estimation:
        for block in arriving(sensors):
            writer.append(block)
            if block.first_sample % every == 0 and block.sensor == "c":
                writer.commit()
                estimation.update()
                corrected += [each.corrected for each in estimation.snapshot().clocks[2:3]]
        writer.close()
        live = estimation.finish()
    offline = estimate([path], SETTINGS)
    assert corrected[-1] > 1e-4
    assert [clock.corrected for clock in live.clocks] == [c.corrected for c in offline.clocks]
    shown, expected = (each.results["three-sensor"].noise_psd for each in (live, offline))
    np.testing.assert_allclose(shown, expected, rtol=1e-9)
    assert np.abs(shown[BAND].mean(axis=0) / (1e12 * NOISE) - 1).max() < 0.1


def delays(seed: int, n: int = 64) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return delays that scatter as they are said to."""
    std = np.full(n, 1e-6)
    return np.arange(float(n)), np.random.default_rng(seed).normal(0, std), std


def drift(at: np.ndarray, late: np.ndarray, std: np.ndarray, *, nominal: bool = True) -> float:
    return drift_of(at, late, std, nominal=nominal, duration=64.0, sampling_rate=RATE)


def test_steady_delays_are_never_called_drifting() -> None:
    found = {
        drift(*delays(seed), nominal=nominal) for seed in range(250) for nominal in (False, True)
    }
    assert found == {0.0}


def test_delays_that_drift_by_three_standard_deviations_are() -> None:
    at, steady, std = delays(1)
    drifting = steady + 1e-5 * at / at[-1]
    assert drift(at, drifting, std) == pytest.approx(1e-5 / np.sqrt(12), rel=0.1)
    far = steady + 1e-4 * at / at[-1]
    known = at < 32  # the rest can no longer be measured
    assert drift(at, far, np.where(known, std, np.inf)) == pytest.approx(2.9e-5, rel=0.1)
    assert np.isnan(drift(at[:15], drifting[:15], std[:15]))


def test_scatter_of_measured_delays_alone_is_waves_that_cross_a_nominal_bench() -> None:
    at, steady, std = delays(2)
    assert drift(at, 10 * steady, std) == 0
    assert drift(at, 10 * steady, std, nominal=False) > 0


def test_delays_that_nobody_knows_do_not_count() -> None:
    at, steady, std = delays(3)
    unknown = np.where(at % 2 == 0, np.inf, std)
    wild = np.where(at % 2 == 0, 1e-3 * at, steady)
    assert drift(at, wild, unknown) == 0


def false_peaks(seed: int, share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return steady delays, a share of which lies anywhere in what is searched: 32 samples."""
    at, late, std = delays(seed)
    rng = np.random.default_rng(seed)
    wrong = rng.uniform(size=len(at)) < share
    return at, np.where(wrong, rng.uniform(-32, 32, len(at)) / RATE, late), std


@pytest.mark.parametrize("share", [0.02, 0.06, 0.1, 0.3, 0.6, 1.0])
def test_delays_at_false_peaks_are_not_a_drift(share: float) -> None:
    found = [drift(*false_peaks(seed, share)) for seed in range(100)]
    assert not [each for each in found if each > 0]
    if share != 0.1:
        assert np.isnan(found).mean() == pytest.approx(float(share > 0.1), abs=0.15)


def test_delays_at_false_peaks_do_not_hide_a_drift() -> None:
    for seed in range(100):
        at, late, std = delays(seed)
        drifting = late + 1e-5 * at / at[-1]
        drifting[[seed % 64, 7 * seed % 64, 21 * seed % 64]] = 0.3, -0.5, 0.6
        found = drift(at, drifting, std)
        assert found == pytest.approx(1e-5 / np.sqrt(12), rel=0.2)


def test_delays_of_weak_motion_are_not_false() -> None:
    for seed in range(100):
        at, late, std = delays(seed)
        weak = np.arange(len(at)) % 3 == 0
        late, std = (np.where(weak, 30 * each, each) for each in (late, std))
        assert drift(at, late, std) == 0
        found = drift(at, late + 3e-5 * at / at[-1], std)
        assert found == pytest.approx(3e-5 / np.sqrt(12), rel=0.3)


def test_delays_that_scatter_more_than_predicted_in_a_part_are_not_a_drift() -> None:
    """Where motion is near the noise: 4 ms for 0.7, where it is strong 0.3 for 0.3."""
    found = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        weak = np.arange(64) < 24
        std = np.where(weak, 0.7e-3, 0.3e-3)
        late = rng.normal(0, np.where(weak, 4e-3, 0.3e-3))
        found.append(drift(np.arange(64.0), late, std))
    assert np.mean(np.array(found) > 0) < 0.08  # before, 0.16


def test_single_delays_of_a_part_are_not_a_drift() -> None:
    at, late, std = delays(4)
    std[33:] = np.inf
    late[63], std[63] = 0.3, 1e-6
    assert drift(at, late, std) == 0


@pytest.mark.parametrize("seed", [200, *(pytest.param(n, marks=STUDY) for n in (203, 206))])
def test_exact_times_of_sensors_in_weak_motion_do_not_drift(tmp_path: Path, seed: int) -> None:
    scenario = {
        "seed": seed,
        "motion": {"spectra": [{"shape": "white", "level": 0.3 * NOISE}] * 3},
        "sensors": {
            name: {"sampling_rate": 20.0, "noise": [{"shape": "white", "level": NOISE}] * 3}
            for name in "abc"
        },
    }
    path = synthesise(
        tmp_path / "r.h5",
        Scenario.from_dict(scenario),
        duration=600.0,
        block=1.0,
        utc=dict.fromkeys("abc", 0.0),
    )
    with Recording.open(path) as recording:
        snapshot = estimate([recording], SETTINGS)
    assert not any(clock.drifts or clock.corrected for clock in snapshot.clocks)


def pieces_are_read(
    path: Path, monkeypatch: pytest.MonkeyPatch, settings: Settings = SETTINGS
) -> bool:
    """Return whether a pass reads pieces of the recording, to measure delays in them."""
    read: list[bool] = []

    def compared(aligned: AlignedRecording, settings: Settings, welch: WelchSettings) -> bool:
        read.append(True)
        return compare(aligned, settings, welch)

    monkeypatch.setattr("daq.estimation.segments.segment_pass.compare", compared)
    with Recording.open(path) as recording:
        part = Pass(recording, settings)
        part.finish()
        part.doubt_stated_times()
    return bool(read)


@pytest.mark.parametrize("snr", [10.0, pytest.param(1e3, marks=LONG), 1e5])
@pytest.mark.parametrize("window", ["hann", "rectangular"])
def test_times_that_agree_are_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, snr: float, window: str
) -> None:
    path = write(tmp_path / "r.h5", huddle(snr, (0.0, 0.0, 0.0)))
    settings = replace(SETTINGS, window=window, overlap=0.5 if window == "hann" else 0.0)
    assert not pieces_are_read(path, monkeypatch, settings)


def delayed(counts: np.ndarray, n_samples: float) -> np.ndarray:
    """Return samples that lag, the last of which are now the first."""
    spectrum = np.fft.rfft(counts, axis=0)
    turns = np.arange(len(spectrum)) * n_samples / len(counts)
    spectrum *= np.exp(-2j * np.pi * turns)[:, None]
    return np.round(np.fft.irfft(spectrum, len(counts), axis=0)).astype(np.int32)


@pytest.mark.parametrize("segment", [2.0, pytest.param(10.0, marks=LONG)])
@pytest.mark.parametrize("n_samples", [0.01, 17.0])
def test_steps_of_any_size_are_looked_at_closely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n_samples: float, segment: float
) -> None:
    sensors = huddle(1e3, (0.0, 0.0, 0.0))
    counts = sensors["c"].counts
    counts[15_000:] = delayed(counts, n_samples)[15_000:]
    path = write(tmp_path / "r.h5", sensors)
    assert pieces_are_read(path, monkeypatch, replace(SETTINGS, segment=segment))


@pytest.mark.parametrize("is_stated", [False, True])
@pytest.mark.parametrize(
    ("n_samples", "is_measured"),
    [
        (3.0, True),
        pytest.param(40.0, True, marks=LONG),
        pytest.param(-150.0, False, marks=LONG),
        pytest.param(400.0, False, marks=pytest.mark.study),
    ],
)
def test_a_step_in_the_middle_is_not_taken_for_noise(
    tmp_path: Path, n_samples: float, *, is_measured: bool, is_stated: bool
) -> None:
    """Of the samples under times that go on, or of the times that are stated."""
    sensors = huddle(1e4, (0.0, 0.0, 0.0))
    counts = sensors["c"].counts
    if not is_stated:
        counts[12_000:] = delayed(counts, n_samples)[12_000:]

    def stepped(block: Block) -> Block:
        if not is_stated or block.sensor != "c" or block.first_sample < 12_000:
            return block
        assert block.device_counter is not None
        stated = block.device_counter + round(n_samples / RATE * 1e9)
        return replace(block, device_counter=stated)

    snapshot = estimate([write(tmp_path / "r.h5", sensors, stepped)], SETTINGS)
    low = snapshot.results["three-sensor"].low[BAND].mean(axis=0) / (1e12 * NOISE)
    found = list(clock_facts(snapshot))
    assert {type(each) for each in found} <= {
        StatedTimesDrift,
        ClockNotUnderstood,
        ClockSet,
        SamplesUncounted,
    }
    assert "c" in {sensor for each in found for sensor in each.sensors}
    assert (low < 1.0).all()
    clock = snapshot.clocks[2]
    if is_measured:
        assert clock.corrected or clock.drifts or not clock.is_understood
    elif is_stated:
        (setting,) = clock.settings
        assert setting.step == pytest.approx(n_samples / RATE, abs=1e-3)
    else:  # about half a piece and more: nobody knows by how much
        assert not clock.is_understood or clock.drifts
        may = [
            each for each in Result(snapshot, SETTINGS).facts if isinstance(each, ClocksMayExplain)
        ]
        assert all(math.isfinite(each.error) for each in may)


@pytest.mark.parametrize(
    "ppm", [0.3, *(pytest.param(ppm, marks=LONG) for ppm in (3.0, 60.0, 500.0))]
)
def test_drifts_of_any_rate_are_looked_at_closely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ppm: float
) -> None:
    path = write(tmp_path / "r.h5", huddle(1e4, (0.0, 0.0, ppm)))
    assert pieces_are_read(path, monkeypatch)


def test_weak_motion_and_parts_without_segments_are_looked_at_closely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weak = huddle(0.01, (0.0, 0.0, 0.0))
    assert pieces_are_read(write(tmp_path / "weak.h5", weak), monkeypatch)
    gaps = huddle(1e4, (0.0, 0.0, 0.0))
    gaps["b"].gaps = tuple((first, first + 5) for first in range(6000, 24_000, 60))
    assert pieces_are_read(write(tmp_path / "gaps.h5", gaps), monkeypatch)


@pytest.mark.parametrize(
    ("burst", "n"), [(1.0, 1), pytest.param(1.0, 3, marks=LONG), pytest.param(30.0, 3, marks=LONG)]
)
def test_motion_too_weak_to_show_a_delay_puts_no_sensor_elsewhere(
    tmp_path: Path, burst: float, n: int
) -> None:
    """What noise predicts is strong where few pieces are known, and no sensor follows it."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        motion = np.sqrt(0.03) * rng.standard_normal((30_000, 3))
        motion[10_000:13_000] *= burst
        sensors = {}
        for name in "abcd":
            turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            felt = motion @ turn + rng.standard_normal(motion.shape)
            sensors[name] = Sensor(np.rint(1000 * felt).astype(np.int32), rate=50.0, utc=True)
        clocks = estimate([write(tmp_path / f"{seed}.h5", sensors)], Settings()).clocks
        assert all(each.is_understood for each in clocks)
        assert any(each.unchecked for each in clocks)
