"""Samples in memory are estimated as the same samples in an imported file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.foreign_sensor import ForeignSensor, finite_stretches
from daq.formats.importer import import_files
from daq.formats.memory import RecordingInMemory, SensorInMemory
from daq.formats.readers.npz import read_npz

RATE = 200.0


def arrays(dtype: str = "float64", holes: int = 0) -> dict[str, NDArray[np.generic]]:
    """Make three triaxial sensors on one motion, with some rows that are not numbers."""
    rng = np.random.default_rng(3)
    motion = rng.normal(size=(13_000, 3))
    found = {}
    for name in "ABC":
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        samples = 1e5 * (motion @ turn + 0.1 * rng.normal(size=motion.shape))
        if holes:
            samples[rng.integers(2000, len(samples), holes), rng.integers(3)] = np.nan
        found[name] = samples.astype(dtype)
    return found


def in_memory(sensors: tuple[ForeignSensor, ...]) -> RecordingInMemory:
    return RecordingInMemory(
        [
            SensorInMemory(
                sensor,
                tuple(Channel(name=c, sensitivity=1.0, unit="counts") for c in sensor.channels),
            )
            for sensor in sensors
        ],
        "arrays",
    )


def same(a: Snapshot, b: Snapshot) -> None:
    assert a.channels == b.channels
    assert (a.n_segments, a.n_dropped, a.left_out) == (b.n_segments, b.n_dropped, b.left_out)
    np.testing.assert_array_equal(a.csm, b.csm, strict=True)
    assert a.results.keys() == b.results.keys()
    for method, noise in a.results.items():
        for name in ("noise_psd", "cov", "low", "high", "flags"):
            np.testing.assert_array_equal(getattr(noise, name), getattr(b.results[method], name))


@pytest.mark.parametrize(
    ("dtype", "holes", "options"),
    [
        pytest.param("float64", 0, {"methods": ("all",)}, marks=pytest.mark.long),
        pytest.param("int32", 0, {"segment": 1.0, "window": "blackman"}, marks=pytest.mark.long),
        ("float32", 40, {"segment": 0.5, "reject": True}),
        ("float64", 5, {"segment": 2.0, "octaves": True, "detrend": "linear"}),
    ],
)
def test_memory_gives_the_estimate_of_the_file_to_the_bit(
    tmp_path: Path, dtype: str, holes: int, options: dict[str, object]
) -> None:
    source, out = tmp_path / "arrays.npz", tmp_path / "arrays.h5"
    np.savez(source, sampling_rate=RATE, **arrays(dtype, holes))  # type: ignore[arg-type]  # allow_pickle is no sensor
    import_files([source], out)
    settings = Settings(**options)  # type: ignore[arg-type]  # of several types
    memory = in_memory(read_npz(source))
    found = estimate([memory], settings)
    same(found, estimate([out], settings))
    if holes:
        assert found.n_dropped > 0


def test_sensors_that_begin_apart_and_at_other_rates_are_brought_onto_one_grid(
    tmp_path: Path,
) -> None:
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    found = arrays()
    np.savez(first, sampling_rate=RATE, A=found["A"], B=found["B"])
    np.savez(second, sampling_rate=100.0, C=found["C"][::2], start_time="1970-01-01T00:00:00.003")
    import_files([first, second], tmp_path / "both.h5")
    memory = in_memory((*read_npz(first), *read_npz(second)))
    settings = Settings(segment=2.0)
    same(estimate([memory], settings), estimate([tmp_path / "both.h5"], settings))


def test_rows_are_read_across_gaps() -> None:
    counts = np.arange(24.0).reshape(12, 2)
    counts[[3, 8]] = np.nan
    stretches = finite_stretches(counts, start_utc_ns=0, sampling_rate=10.0)
    sensor = SensorInMemory(ForeignSensor("A", ("X", "Y"), 10.0, stretches, "arrays"), ())
    whole = counts[np.isfinite(counts).all(axis=1)]
    assert sensor.n_samples == 10
    for first in range(11):
        for last in range(first, 11):
            np.testing.assert_array_equal(sensor.counts(first, last), whole[first:last])
    np.testing.assert_array_equal(sensor.counts(), whole)
    assert sensor.gaps["first_sample"].tolist() == [3, 8]
    assert sensor.gaps["missing"].tolist() == [1, 1]
    with pytest.raises(IndexError, match="rows 4 to 11"):
        sensor.counts(4, 11)
    with pytest.raises(RecordingError, match="no instants"):
        sensor.instants_ns()


def test_an_open_recording_is_closed_with_its_estimate(tmp_path: Path) -> None:
    source = tmp_path / "arrays.npz"
    np.savez(source, sampling_rate=RATE, **arrays())  # type: ignore[arg-type]  # allow_pickle is no sensor
    with Estimation([in_memory(read_npz(source))], Settings(segment=1.0)) as estimation:
        assert estimation.update()
        assert estimation.recordings[0].closed
        assert estimation.finish().n_segments == 129
