"""Sensors that state UTC, and clocks that restart, on one grid."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.synthesis import Latency, synthesise
from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.arrival_times import ArrivalTimes
from daq.clocks.clock_model import MeasuredDelays
from daq.clocks.device_utc import corrected, from_device_utc
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.protocols.block import Block
from daq.recording.reader import Recording
from sim_devices.world.scenario import Scenario
from tests.daq.clocks.recordings import ORIGIN, Sensor, blocks, counts, create, write


def test_exact_times_align_samples_and_give_the_start(tmp_path: Path) -> None:
    raw = {name: counts(3000, 1, seed) for seed, name in enumerate("abc")}
    starts = {"a": 0.0055, "b": 0.1255, "c": 0.0355}  # 12 and 3 samples later
    sensors = {n: Sensor(c, utc=True, start=starts[n]) for n, c in raw.items()}
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        aligned = AlignedRecording(recording)
        assert aligned.is_exact
        samples, valid = aligned.read(0, aligned.n_available)
        assert len(samples) == 3000 - 12
        assert valid.all()
        expected = [raw["a"][12:, 0], raw["b"][:2988, 0], raw["c"][9:2997, 0]]
        assert np.array_equal(samples, np.stack(expected, axis=1).astype(float))
        assert aligned.start_utc_ns == 1_468_458_000_125_500_000


@pytest.mark.parametrize("ahead", [0.0, 0.3, 30.0, -30.0, 10_800.0])  # of the host's UTC
def test_a_sensor_with_utc_is_aligned_with_others_for_any_host_utc(
    tmp_path: Path, ahead: float
) -> None:
    sensors = {
        "a": Sensor(counts(3000, 1, 1), start=0.5),
        "b": Sensor(counts(3000, 1, 2), start=0.7, utc=True, utc_ahead=ahead),
        "c": Sensor(counts(3000, 1, 3), start=0.6, utc=True, utc_ahead=ahead),
    }
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        aligned = AlignedRecording(recording)
        offsets = [clock.offset for clock in aligned.clocks]
        assert offsets == pytest.approx([0.5, 0.7, 0.6], abs=1e-3)
        assert offsets[1] - offsets[2] == pytest.approx(0.1, abs=1e-9)
        assert 2800 < aligned.n_available < 3000


def test_unsynchronised_channels_delay_a_device_without_shifting_it(tmp_path: Path) -> None:
    sensors = {
        "a": Sensor(counts(6000, 1, 1)),
        "b": Sensor(counts(6000, 1, 2), utc=True, late=7.5),
    }
    writer = create(tmp_path / "r.h5", sensors)
    for name, seconds in (("a", 0.5), ("b", 10.0)):
        for block in blocks(name, sensors[name], seconds):
            writer.append(block)
    writer.close()
    with Recording.open(tmp_path / "r.h5") as recording:
        delays = AlignedRecording(recording).delays(np.array([3000.0]))
        assert np.ptp(delays) < 1e-3


@pytest.mark.parametrize("ahead", [3, -40])
def test_a_correction_of_device_utc_moves_no_samples(tmp_path: Path, ahead: int) -> None:
    sensors = {
        "a": Sensor(counts(6000, 1, 1)),
        "b": Sensor(counts(6000, 1, 2), utc=True, late=0.5, restarts=(500,)),
    }

    def corrected(block: Block) -> Block:
        stated = block.device_counter
        if stated is not None and block.first_sample < 500:
            stated += ahead * 10**9
        return replace(block, device_counter=stated)

    with Recording.open(write(tmp_path / "r.h5", sensors, corrected)) as recording:
        aligned = AlignedRecording(recording)
        at = (4000.0 + ORIGIN.utc_ns * 1e-7 - aligned.start_utc_ns * 1e-7) * np.ones(1)
        assert np.ptp(aligned.delays(at)) < 1e-3


@pytest.mark.parametrize("has_gps", [True, False])
def test_sensors_without_utc_are_in_the_time_of_those_with_it(
    tmp_path: Path, *, has_gps: bool
) -> None:
    sensor = {"sampling_rate": 100.0, "noise": [{"shape": "white", "level": 1e-8}]}
    scenario = Scenario.from_dict(
        {
            "seed": 1,
            "motion": {"spectra": [{"shape": "white", "level": 1e-12}]},
            "sensors": {
                "a": sensor | {"clock": {"ppm": 20.0}},
                "b": sensor | {"clock": {"ppm": -5.0}},
            },
        }
    )
    path = tmp_path / "r.h5"
    synthesise(path, scenario, duration=600, utc={"a": 0.0}, has_gps=has_gps, computer_ppm=30.0)
    with Recording.open(path) as recording:
        stated, other = AlignedRecording(recording).clocks
    assert stated.ppm == pytest.approx(20 if has_gps else 0, abs=0.01)
    assert other.ppm - stated.ppm == pytest.approx(
        -25, abs=3 * other.residual / 600 * 12**0.5 * 1e6
    )
    assert other.residual < 1e-4  # 5e-3 is what 30 ppm would leave


@pytest.mark.long
def test_utc_that_drifts_is_corrected_though_the_computer_has_another_date(tmp_path: Path) -> None:
    sensor = {"sampling_rate": 50.0, "noise": [{"shape": "white", "level": 1e-12}]}
    scenario = Scenario.from_dict(
        {
            "seed": 1,
            "motion": {"spectra": [{"shape": "white", "level": 1e-8}]},
            "sensors": {
                n: sensor | {"clock": {"ppm": p}} for n, p in zip("abc", (0, 5, -3), strict=True)
            },
        }
    )
    path = tmp_path / "r.h5"
    synthesise(path, scenario, duration=480, utc={"a": 3600.0, "b": 3600.0}, has_gps=False)
    snapshot = estimate([path], Settings(segment=2.0))
    drift = 5e-6 * 480 / np.sqrt(12)
    assert [clock.refined for clock in snapshot.clocks] == [False, True, True]
    assert snapshot.clocks[1].corrected == pytest.approx(drift, rel=0.1)
    noise = snapshot.results["three-sensor"].noise_psd[2:40].mean(axis=0)
    assert np.abs(noise / 1e-12 - 1).max() < 0.1


def test_a_drift_is_counted_within_epochs_and_not_between_dates() -> None:
    index = [np.arange(0.0, 500.0), np.arange(500.0, 6000.0)]
    seconds = [index[0] / 100.0 - 40 * 365 * 86_400, index[1] / 100.0]
    spans = [(0, 500, index[0], seconds[0]), (500, 6000, index[1], seconds[1])]
    stated = from_device_utc("a", spans, sampling_rate=100.0, moved=0.0)
    found = replace(stated, state=replace(stated.state, refined=True))
    assert corrected(stated, found, moved=0.0).state.corrected < 1e-6


# --- clocks that restart ---------------------------------------------------------------------


SECONDS, NOISE = 160.0, 1e-14
POLLED = Latency("batching", 16e-3)


def three_sensors(path: Path, lost: dict[str, list[float]]) -> Path:
    """Write a recording of sensors that each lost 0.4 s at times, an unknown number of samples."""
    sensors = {
        name: {
            "sampling_rate": 50.0,
            "noise": {"shape": "white", "level": NOISE},
            "clock": {"ppm": ppm},
        }
        for name, ppm in zip("abc", (0, 10, -20), strict=True)
    }
    motion = {"spectra": [{"shape": "white", "level": 1e6 * NOISE}]}
    scenario = Scenario.from_dict({"motion": motion, "sensors": sensors, "seed": 4})
    return synthesise(
        path,
        scenario,
        duration=SECONDS,
        block=0.5,
        latency=POLLED,
        lost={name: [(at, at + 0.4) for at in every] for name, every in lost.items()},
        restarts=True,
    )


@pytest.mark.parametrize(
    "lost",
    [
        {"b": [82.0, 84.0]},
        {"b": np.arange(5, 155, 7.0).tolist()},
        {"a": np.arange(5, 155, 7.0).tolist()},
        {
            "a": [5.0, 50.0, 95.0, 140.0],
            "b": [5.0, 55.0, 105.0],
            "c": [5.0, 40.0, 75.0, 110.0, 145.0],
        },
    ],
    ids=["twice", "every segment", "every segment of the reference", "all sensors"],
)
def test_the_noise_is_the_true_one(tmp_path: Path, lost: dict[str, list[float]]) -> None:
    snapshot = estimate([three_sensors(tmp_path / "r.h5", lost)])
    band = (snapshot.frequency > 1) & (snapshot.frequency < 20)
    found = snapshot.results["three-sensor"].noise_psd[band].mean(axis=0)
    assert np.abs(10 * np.log10(found / NOISE)).max() < 1.0  # placed by arrivals 30 dB
    assert [state.n_epochs for state in snapshot.clocks] == [
        1 + len(lost.get(name, [])) for name in "abc"
    ]


def test_an_epoch_that_is_not_placed_is_not_used(tmp_path: Path) -> None:
    recording = Recording.open(three_sensors(tmp_path / "r.h5", {"b": [80.0, 85.0]}))
    with closing(recording):
        aligned = AlignedRecording(recording)
        at = np.setdiff1d(np.arange(250.0, 7750, 250), [4000.0, 4250.0])
        _, before = aligned.read(0, aligned.n_available)
        std = np.column_stack([np.zeros(len(at)), np.full((len(at), 2), 1e-7)])
        aligned.learn(at[::-1], np.zeros((len(at), 3)), std=std, frame_delays=lambda: np.zeros(3))
        aligned.set_clocks()
        _, after = aligned.read(0, len(before))
    epoch = slice(81 * 50, 83 * 50)
    assert before[epoch].all()
    assert not after[epoch].any()
    elsewhere = np.r_[0:3900, 4400 : len(after)]
    assert np.array_equal(before[elsewhere], after[elsewhere])


def test_restarts_of_the_reference_leave_no_epoch_without_an_arrival() -> None:
    rng = np.random.default_rng(0)
    arrivals = ArrivalTimes(100.0, 0, 0)
    rows = np.zeros(
        240,
        [(name, np.int64) for name in
         ("first_sample", "n_samples", "monotonic_ns", "device_counter", "flags")],
    )  # fmt: skip
    rows["first_sample"], rows["n_samples"] = np.arange(240) * 50, 50
    rows["monotonic_ns"] = (np.arange(1, 241) * 0.5 + rng.exponential(1e-3, 240)) * 1e9
    arrivals.add(rows)
    index = np.arange(500.0, 11_500, 500)
    restarts = np.sort(rng.integers(-100, 13_000, 300))
    measured = MeasuredDelays(index, index / 100, np.full(len(index), 1e-6), restarts)
    clock = arrivals.solve("a", measured)
    assert clock.state.n_epochs == 1
    assert len(clock.epochs) > 100
    assert np.abs(clock.at(index) - index / 100).max() < 1e-3
