"""The common grid: what passes, what is interpolated, what is invalid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.resampling import reach
from daq.errors import CannotAlignError
from daq.protocols.block import Block
from daq.recording.reader import Recording
from tests.daq.clocks.recordings import (
    ORIGIN,
    Sensor,
    blocks,
    counts,
    create,
    later,
    write,
    written,
)


def test_samples_of_one_clock_are_bit_exact_for_any_division_of_reads(tmp_path: Path) -> None:
    raw = {name: counts(5000, 2, seed) for seed, name in enumerate("abc")}
    path = write(tmp_path / "r.h5", {n: Sensor(c, clock="one") for n, c in raw.items()})
    with Recording.open(path) as recording:
        aligned = AlignedRecording(recording)
        assert aligned.is_exact
        assert aligned.n_available == 5000
        assert aligned.dims == (2, 2, 2)
        whole, valid = aligned.read(0, 5000)
        assert valid.all()
        assert np.array_equal(whole, np.hstack([*raw.values()]).astype(float))
        assert np.array_equal(aligned.read(1234, 4321)[0], whole[1234:4321])


LATE, EARLY, N = 7000, 13_000, 20_000  # samples at 100 Hz: more than a minute from either end


def with_one_apart(names: str, *, utc: bool) -> dict[str, Sensor]:
    """Return sensors of which the last begins late and ends early; they state UTC or run freely."""
    sensors = {n: Sensor(counts(N, 1, ord(n)), clock=n, utc=utc) for n in names[:-1]}
    last = names[-1]
    sensors[last] = Sensor(counts(EARLY - LATE, 1, 1), clock=last, utc=utc, start=LATE / 100)
    return sensors


def test_a_fourth_sensor_that_begins_late_and_ends_early_is_absent_meanwhile(
    tmp_path: Path,
) -> None:
    path = write(tmp_path / "r.h5", with_one_apart("abcd", utc=True))
    with Recording.open(path) as recording:
        aligned = AlignedRecording(recording)
        assert not aligned.measurable
        assert aligned.n_available == N
        samples, valid = aligned.read(0, N)
        assert np.isfinite(samples[:, :3]).all()
        np.testing.assert_array_equal(np.flatnonzero(valid), np.arange(LATE, EARLY))
        np.testing.assert_array_equal(np.isfinite(samples[:, 3]), valid)
        assert aligned.common == (LATE, EARLY)
        assert aligned.shortened == {}
        begin = aligned.start_utc_ns + 10 * 10**9
        assert AlignedRecording(recording, start_utc_ns=begin).start_utc_ns == begin


@pytest.mark.parametrize(("names", "utc"), [("abc", True), ("abcd", False)])
def test_two_sensors_and_free_clocks_have_the_common_span_which_is_shorter(
    tmp_path: Path, names: str, utc: bool
) -> None:
    path = write(tmp_path / "r.h5", with_one_apart(names, utc=utc))
    with Recording.open(path) as recording:
        aligned = AlignedRecording(recording)
        assert aligned.n_available == pytest.approx(EARLY - LATE, abs=2 * reach() + 1)
        assert list(aligned.shortened) == [names[-1]]
        late, early = aligned.shortened[names[-1]]
        assert late == pytest.approx(70.0, abs=0.01)
        assert early == pytest.approx(70.0, abs=0.01)
        begin = aligned.start_utc_ns
        only = AlignedRecording(recording, start_utc_ns=begin, end_utc_ns=begin + 10**10)
        assert only.shortened == {}  # nothing else is wanted


def test_a_growing_recording_waits_for_samples_of_all_sensors(tmp_path: Path) -> None:
    sensors = with_one_apart("abcd", utc=True)
    writer = written(tmp_path / "r.h5", sensors)
    writer.commit()
    with Recording.open(tmp_path / "r.h5") as recording:
        aligned = AlignedRecording(recording)
        assert aligned.n_available == EARLY
        assert aligned.shortened == {}
        writer.close()
        aligned.refresh()
        assert aligned.n_available == N


@pytest.mark.parametrize("shared", [True, False])
def test_a_gap_is_invalid_for_all_sensors_and_other_samples_are_valid(
    tmp_path: Path, shared: bool
) -> None:
    clock = {name: "one" if shared else name for name in "abc"}
    sensors = {n: Sensor(counts(4000, 1, ord(n)), clock=clock[n]) for n in "abc"}
    sensors["b"].gaps = ((1530, 1571),)
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        aligned = AlignedRecording(recording)
        _, valid = aligned.read(0, aligned.n_available)
        invalid = np.flatnonzero(~valid)
        # Interpolated samples need their neighbours as well.
        margin = 0 if shared else reach()
        start = 0 if shared else reach()
        assert invalid[0] + start >= 1530 - margin - 1
        assert invalid[-1] + start <= 1570 + margin + 1
        assert np.all(np.diff(invalid) == 1)
        assert len(invalid) >= 41


def _band_limited(times: NDArray[np.float64], seed: int, edge: float) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    frequency = rng.uniform(0.2, edge, 40)
    phase = rng.uniform(0, 2 * np.pi, 40)
    return np.asarray(np.cos(2 * np.pi * np.outer(times, frequency) + phase).sum(axis=1))


def test_free_running_sensors_are_aligned_on_the_grid(tmp_path: Path) -> None:
    sensors = {}
    for name, ppm, start in (("a", 0.0, 0.0), ("b", 18.0, 0.0123), ("c", -20.0, 0.0371)):
        rate = 100.0 * (1 + ppm * 1e-6)
        times = start + np.arange(60_000) / rate
        signal = np.round(1e6 * _band_limited(times, 3, 44.0)).astype(np.int32)
        sensors[name] = Sensor(signal[:, None], rate=rate, nominal=100.0, start=start, clock=name)
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        aligned = AlignedRecording(recording)
        assert not aligned.is_exact
        samples, valid = aligned.read(0, aligned.n_available)
        assert valid.all()
        for column in (1, 2):
            error = samples[:, column] - samples[:, 0]
            # Arrival times to 1 ns; the interpolation's 100 dB; quantisation far below.
            assert np.std(error) < 1e-5 * np.std(samples[:, 0])
        for state, ppm in zip(aligned.clocks, (0.0, 18.0, -20.0), strict=True):
            assert state.ppm == pytest.approx(ppm, abs=0.01)


def test_unequal_rates_are_resampled_to_the_lowest_without_aliases(tmp_path: Path) -> None:
    times = {"a": np.arange(20_000) / 100.0, "b": np.arange(50_000) / 250.0}
    sensors = {}
    for name, rate in (("a", 100.0), ("b", 250.0)):
        signal = 1e6 * _band_limited(times[name], 5, 40.0)
        if rate > 100:
            signal += 1e6 * np.cos(2 * np.pi * 90 * times[name])
        sensors[name] = Sensor(np.round(signal).astype(np.int32)[:, None], rate=rate, clock=name)
    with Recording.open(write(tmp_path / "r.h5", sensors)) as recording:
        aligned = AlignedRecording(recording)
        assert aligned.sampling_rate == 100.0
        samples, valid = aligned.read(0, aligned.n_available)
        inner = samples[valid]
        assert np.std(inner[:, 1] - inner[:, 0]) < 1e-5 * np.std(inner[:, 0])


def test_a_restart_begins_a_new_clock_epoch(tmp_path: Path) -> None:
    first = Sensor(counts(3000, 1, 1), clock="a")
    other = Sensor(counts(3000, 1, 2), clock="b", restarts=(1500,))

    def restarted(block: Block) -> Block:
        """Return it 0.37 samples later."""
        late = 3_700_000 if block.sensor == "b" and block.first_sample >= 1500 else 0
        return replace(block, received=later(block.received, late))

    path = write(tmp_path / "r.h5", {"a": first, "b": other}, restarted)
    with Recording.open(path) as recording:
        aligned = AlignedRecording(recording)
        assert [state.n_epochs for state in aligned.clocks] == [1, 2]
        delays = aligned.delays(np.array([500.0, 2500.0]))
        moved = (delays[1] - delays[0])[1] - (delays[1] - delays[0])[0]
        assert moved == pytest.approx(3.7e-3, abs=1e-5)


def test_blocks_read_in_several_steps_are_contiguous(tmp_path: Path) -> None:
    raw = {name: counts(17_000, 1, seed) for seed, name in enumerate("ab")}
    gaps = ((16_384, 16_386),)
    sensors = {n: Sensor(c, 10.0, clock="one", gaps=gaps) for n, c in raw.items()}
    writer = create(tmp_path / "r.h5", sensors)
    for name, sensor in sensors.items():
        for block in blocks(name, sensor, 0.1 if name == "a" else 5.0):  # of a, a block each
            writer.append(block)
    writer.close()
    with Recording.open(tmp_path / "r.h5") as recording:
        aligned = AlignedRecording(recording)
        samples, valid = aligned.read(0, aligned.n_available)
        assert len(recording.sensors[0].blocks) == 16_998
        assert len(samples) == 17_000
        assert np.flatnonzero(~valid).tolist() == [16_384, 16_385]
        assert np.array_equal(samples[valid], np.hstack([*raw.values()])[valid].astype(float))


def test_a_growing_file_is_read_up_to_its_committed_rows(tmp_path: Path) -> None:
    sensors = {name: Sensor(counts(2000, 1, ord(name)), clock="one") for name in "abc"}
    writer = create(tmp_path / "r.h5", sensors)
    with Recording.open(tmp_path / "r.h5") as recording:
        aligned = AlignedRecording(recording)
        assert aligned.n_available == 0
        written = {name: blocks(name, sensor) for name, sensor in sensors.items()}
        for some in written.values():
            for block in some[:20]:
                writer.append(block)
        committed = min(each.rows for each in writer.commit().sensors.values())
        aligned.refresh()
        assert aligned.n_available == committed >= 900
        with pytest.raises(CannotAlignError, match=f"{committed} available"):
            aligned.read(900, 1100)
        for some in written.values():
            for block in some[20:]:
                writer.append(block)
        writer.close()
        aligned.refresh()
        assert aligned.n_available == 2000
        assert np.array_equal(aligned.read(0, 2000)[0][:, 1], sensors["b"].counts[:, 0])


def test_a_grid_faster_than_a_sensor_is_refused(tmp_path: Path) -> None:
    sensors = {name: Sensor(counts(500, 1, 1), clock="one") for name in "abc"}
    with (
        Recording.open(write(tmp_path / "r.h5", sensors)) as recording,
        pytest.raises(CannotAlignError, match="expected at most 100 Hz"),
    ):
        AlignedRecording(recording, sampling_rate=200.0)


def test_clocks_are_aligned_after_an_hour_of_suspension(tmp_path: Path) -> None:
    # CLOCK_MONOTONIC stands still in suspend; the sensors' counters do not.
    hour, n_before, n_after = 3600.0, 30_000, 30_000
    writer_of, found = {}, []
    for name, ppm, start in (("a", 0.0, 0.0), ("b", 18.0, 0.0123), ("c", -20.0, 0.0371)):
        rate = 100.0 * (1 + ppm * 1e-6)
        lost = round(hour * rate)
        index = np.concatenate([np.arange(n_before), n_before + lost + np.arange(n_after)])
        times = start + index / rate
        signal = np.round(1e6 * _band_limited(times, 3, 44.0)).astype(np.int32)
        sensor = Sensor(signal[:, None], rate=rate, nominal=100.0, start=start, clock=name)
        writer_of[name] = sensor
        for block in blocks(name, sensor):
            if block.first_sample < n_before:
                found.append(block)
                continue
            # It counts on; the host has slept for all of the hour.
            arrival = start + (block.end_sample + lost - 1) / rate - hour + sensor.late
            shift = round(arrival * 1e9) + ORIGIN.monotonic_ns - block.received.monotonic_ns
            at = later(block.received, shift)
            found.append(replace(block, first_sample=block.first_sample + lost, received=at))
    writer = create(tmp_path / "r.h5", writer_of)
    for block in found:
        writer.append(block)
    writer.close()
    with Recording.open(tmp_path / "r.h5") as recording:
        aligned = AlignedRecording(recording)
        assert [clock.n_epochs for clock in aligned.clocks] == [2, 2, 2]
        samples, valid = aligned.read(0, aligned.n_available)
        assert n_before + n_after - 200 < len(samples) < n_before + n_after
        assert np.count_nonzero(~valid) < 200  # two seconds, with the kernel's neighbours
        middle = int(np.flatnonzero(~valid)[0])
        for rows in (slice(0, middle), slice(middle + 200, None)):
            for column in (1, 2):
                error = samples[rows, column] - samples[rows, 0]
                assert np.std(error) < 1e-4 * np.std(samples[rows, 0])
