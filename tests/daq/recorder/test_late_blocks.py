"""Hosts that stop reading: what their buffers lose is a gap, what they keep is none.

The logger is `tests.peers.text_logger`, which shares no code with the driver.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import TextFormat
from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.recorder.block_writer import BlockWriter
from daq.recorder.late_blocks import LateBlocks
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.writer import RecordingWriter
from tests.peers.text_logger import UNIX, TextLogger

ROWS = TextFormat(columns=(1, 2, 3), whole=True)
RATE = 100.0


def arrival(seconds: float) -> HostTime:
    return HostTime(3_000_000_000_000 + round(seconds * 1e9), round((UNIX + seconds) * 1e9))


def recorded(
    path: Path, logger: TextLogger, reads: list[tuple[bytes, float]]
) -> tuple[NDArray[np.int64], NDArray[np.int64], list[tuple[int, bool]], list[Event]]:
    """Return true and recorded indices of the rows in the file, its gaps and its events."""
    channels = tuple(Channel(name=axis, sensitivity=1.0) for axis in "xyz")
    layout = SensorLayout("A", channels, RATE, np.dtype(np.int32))
    file = RecordingWriter.create(path, sensors=[layout], created=arrival(0))
    writer = BlockWriter(file, {"A": RATE})
    decoder = TextDecoder("A", ROWS, sampling_rate=RATE)
    for data, now in reads:
        writer.write(decoder.receive(data, arrival(now)))
    writer.close(arrival(reads[-1][1]), "the end")
    known = {tuple(row): n for n, row in enumerate(logger.samples.tolist())}
    with Recording.open(path) as recording:
        (sensor,) = recording.sensors
        first, n_samples = (
            sensor.blocks[name].astype(np.int64) for name in ("first_sample", "n_samples")
        )
        starts = np.cumsum(n_samples) - n_samples
        index = np.arange(n_samples.sum()) + np.repeat(first - starts, n_samples)
        rows = sensor.counts(0, sensor.n_samples).tolist()
        gaps = [(int(gap["missing"]), bool(gap["estimated"])) for gap in sensor.gaps]
        events = list(recording.events)
    true = np.array([known.get(tuple(row), -1) for row in rows])
    return true, index, gaps, events


@pytest.mark.parametrize(("stop", "buffer"), [(1.0, 1500), (3.0, 0), (22.0, 4096)])
def test_what_a_stopped_host_loses_is_a_gap_of_estimated_length(
    tmp_path: Path, stop: float, buffer: int
) -> None:
    logger = TextLogger(seconds=40.0 + stop, ppm=50.0)
    reads = logger.stopped(20.0, 20.0 + stop, buffer)
    n_sent = sum(data.count(b"\n") for data, _ in reads)
    true, index, gaps, events = recorded(tmp_path / "r.h5", logger, reads)
    whole = true >= 0  # the row that the buffer cuts may be another one
    assert len(true) >= n_sent - 2
    assert np.count_nonzero(~whole) <= 1
    n_lost = len(logger.samples) - n_sent
    found = [missing for missing, _ in gaps if missing > 1]
    overflows = [event for event in events if event.kind == EventKind.OVERFLOW]
    if n_lost < 25:  # 0.25 s are not told from a late read
        assert not found
        assert not overflows
        return
    assert len(found) == len(overflows) == 1
    assert all(estimated for _, estimated in gaps)
    settled = whole & (true > 100 * (20 + stop + 1))
    assert np.abs(index[settled] - true[settled]).max() <= 4
    before = whole & (true < 2000)
    assert np.array_equal(index[before], true[before])


def test_rows_that_come_with_the_last_stored_ones_are_behind_the_gap(tmp_path: Path) -> None:
    logger = TextLogger(seconds=60.0)
    reads = logger.stopped(20.0, 30.0, 4096)
    begin = next(n for n, (_, now) in enumerate(reads) if now >= 30)
    stored, new = reads[begin], reads[begin + 1 : begin + 11]
    end = stored[0].index(b"\n", 2000) + 1
    together = stored[0][end:] + b"".join(data for data, _ in new), new[-1][1]
    reads[begin : begin + 11] = [(stored[0][:end], stored[1]), together]
    true, index, gaps, _ = recorded(tmp_path / "r.h5", logger, reads)
    n_lost = len(logger.samples) - sum(data.count(b"\n") for data, _ in reads)
    ((missing, is_estimated),) = gaps
    assert is_estimated
    assert abs(missing - n_lost) <= 4
    assert np.count_nonzero(np.abs(index - true)[true >= 0] > 4) <= 8


@pytest.mark.parametrize(("stop", "speed"), [(10.0, 1.3), (2.0, 20.0)])
def test_stored_rows_that_a_server_drains_are_no_gap(
    tmp_path: Path, stop: float, speed: float
) -> None:
    logger = TextLogger(seconds=65.0)
    true, index, gaps, events = recorded(
        tmp_path / "r.h5", logger, logger.drained(15.0, 15.0 + stop, speed)
    )
    assert np.array_equal(true, index)
    assert not gaps
    assert not any(event.kind == EventKind.OVERFLOW for event in events)


@pytest.mark.parametrize("ppm", [-10_000.0, 10_000.0])
def test_a_busy_host_and_an_odd_rate_make_no_gap(tmp_path: Path, ppm: float) -> None:
    rng = np.random.default_rng(3)
    begins = np.arange(20.0, 110.0, 15.0)
    stalls = tuple((t, t + d) for t, d in zip(begins, rng.uniform(0.5, 8, 6), strict=True))
    logger = TextLogger(seconds=120.0, ppm=ppm, jitter=0.1, stalls=stalls)
    true, index, gaps, _ = recorded(tmp_path / "r.h5", logger, logger.rows())
    assert np.array_equal(true, index)
    assert not gaps


def test_two_stops_are_two_gaps_and_the_second_may_end_the_recording(tmp_path: Path) -> None:
    logger = TextLogger(seconds=76.0)
    reads = [read for read in logger.rows() if not 30 <= read[1] < 35 and not 60 <= read[1] < 72]
    reads = [read for read in reads if read[1] < 75]
    true, index, gaps, _ = recorded(tmp_path / "r.h5", logger, reads)
    assert len(gaps) >= 2
    late = true > 7300
    assert np.abs(index[late] - true[late]).max() <= 8


def test_counted_blocks_are_passed_on_at_once() -> None:
    late = LateBlocks(RATE)
    for n in range(100):
        at = arrival(n * (1.0 if n > 50 else 0.1))
        block = Block("A", 10 * n, np.zeros((10, 1), np.int32), at, 10 * n, BlockFlag.NONE)
        assert late.passed(block) == [block]
