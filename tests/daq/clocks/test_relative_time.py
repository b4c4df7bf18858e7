"""How the times of two sensors are known against each other, also where both have one clock."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.clock_model import ClockSource, ClockState, OffsetSource, RelativeTime
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from tests.daq.clocks.recordings import Sensor, counts, write


def clock(sensor: str, source: ClockSource) -> ClockState:
    return ClockState(sensor, source, 0.0, 0.0, 0.0, 0.0, 0.0, 1)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"shared_clock": "rack"}, RelativeTime.STATED),
        (
            {"shared_clock": "rack", "offset_source": OffsetSource.SAMPLES},
            RelativeTime.WHOLE_SAMPLES,
        ),
        ({"source": ClockSource.DEVICE_UTC}, RelativeTime.STATED),
        ({"source": ClockSource.DEVICE_UTC, "refined": True}, RelativeTime.ALIGNED),
        ({"source": ClockSource.DEVICE_UTC, "corrected": 1e-6}, RelativeTime.ALIGNED),
        ({"source": ClockSource.DEVICE_UTC, "drifts": True}, RelativeTime.ALIGNED),
        ({"source": ClockSource.NOMINAL_RATE}, RelativeTime.WHOLE_SAMPLES),
        ({"source": ClockSource.NOMINAL_RATE, "residual": math.nan}, RelativeTime.ALIGNED),
        ({"source": ClockSource.SAMPLE_INSTANTS}, RelativeTime.ALIGNED),
        ({}, RelativeTime.ALIGNED),
    ],
)
def test_how_times_of_two_sensors_are_known(
    changed: dict[str, Any], expected: RelativeTime
) -> None:
    common = {key: changed[key] for key in ("source", "shared_clock") if key in changed}
    one = replace(clock("a", ClockSource.ARRIVAL_TIMES), **common)
    other = replace(clock("b", ClockSource.ARRIVAL_TIMES), **changed)

    assert one.relative_time(other) is other.relative_time(one) is expected


def test_utc_tells_nothing_of_a_sensor_without_it() -> None:
    stated = clock("a", ClockSource.DEVICE_UTC)

    assert stated.relative_time(clock("b", ClockSource.ARRIVAL_TIMES)) is RelativeTime.ALIGNED


# --- sensors of one clock --------------------------------------------------------------------


@pytest.mark.parametrize("begun", [0.0, 8.0])  # seconds after the recording was created
def test_sensors_of_one_clock_with_different_starts_are_aligned_exactly(
    tmp_path: Path, begun: float
) -> None:
    raw = counts(5000, 1, 8)
    sensors = {
        "a": Sensor(raw[:4000], clock="one", start=begun),
        "b": Sensor(raw[137:4600], clock="one", start=begun + 1.37, late=1.2e-3),
        "c": Sensor(raw[60:4700], clock="one", start=begun + 0.60, late=2.9e-3, restarts=(2000,)),
    }
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        aligned = AlignedRecording(recording)
        samples, valid = aligned.read(0, aligned.n_available)
        assert valid.all()
        assert len(samples) == 4000 - 137
        assert np.array_equal(samples, np.repeat(raw[137:4000], 3, axis=1).astype(float))
        assert {clock.source for clock in aligned.clocks} == {ClockSource.SHARED_CLOCK}
        assert {clock.shared_clock for clock in aligned.clocks} == {"one"}
        by_arrivals = OffsetSource.ARRIVAL_TIMES
        assert [clock.offset_source for clock in aligned.clocks] == [None, by_arrivals, by_arrivals]


def test_the_motion_gives_the_offset_of_shared_clocks_if_arrivals_cannot(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    motion = np.cumsum(rng.standard_normal((12_200, 1)), axis=0)

    def seen(first: int, seed: int) -> NDArray[np.int32]:
        noise = np.random.default_rng(seed).standard_normal((12_000, 1))
        return np.round(1e5 * (motion[first : first + 12_000] + 0.01 * noise)).astype(np.int32)

    sensors = {
        "a": Sensor(seen(0, 1), clock="one"),
        "b": Sensor(seen(0, 2), clock="one"),
        "c": Sensor(seen(50, 3), clock="one", start=0.5, late=27e-3),  # nearly three samples late
    }
    path = write(tmp_path / "r.h5", sensors)
    apart = {}
    for clocks in ("arrivals", "refined"):
        snapshot = estimate([path], Settings(segment=4.0, clocks=clocks))
        apart[clocks] = -100.0 * (snapshot.drift[:, 3] - snapshot.drift[:, 1])
        beside = snapshot.clocks[1]  # with "a" in every block
        assert (beside.shared_clock, beside.offset_source) == ("one", None)
    assert np.allclose(apart["arrivals"], -53.0)
    assert np.allclose(apart["refined"], -50.0)
    apart_by = snapshot.clocks[2]
    assert (apart_by.shared_clock, apart_by.offset_source) == ("one", OffsetSource.SAMPLES)
    assert np.median(snapshot.results["three-sensor"].noise_psd[10:, 2]) < 2 * 1e6 / 50


def test_a_shared_clock_has_a_rate(tmp_path: Path) -> None:
    rate = 100.0 * (1 + 18e-6)
    sensors = {
        n: Sensor(counts(60_000, 1, 1), rate=rate, nominal=100.0, clock="one") for n in "abc"
    }
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        aligned = AlignedRecording(recording)
        assert aligned.is_exact
        for state in aligned.clocks:
            assert state.ppm == pytest.approx(18.0, abs=0.01)
            assert state.ppm_std < 0.01
