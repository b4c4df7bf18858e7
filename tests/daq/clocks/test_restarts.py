"""Clocks that restart, again and again: their epochs are placed by the motion, or not used."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.synthesis import Latency, synthesise
from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.arrival_times import ArrivalTimes
from daq.clocks.clock_model import MeasuredDelays
from daq.estimation.estimation import estimate
from daq.recording.reader import Recording
from sim_devices.world.scenario import Scenario

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
