"""Recordings made from arrays: complete or not there at all, and which chunks are compressed."""

from __future__ import annotations

import os
import time
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.protocols.block import Block, BlockFlag, EventKind, HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import NO_COUNTER, SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.sensor_record import ChunkedRows
from daq.recording.storage import packing
from daq.recording.writer import RecordingWriter

CREATED = HostTime(5_000_000_000, 1_790_000_000_000_000_000)
RATE = 100.0
LAYOUT = SensorLayout(
    "A", tuple(Channel(name=n, sensitivity=1.0) for n in "XY"), RATE, np.dtype(np.int32)
)
COUNTS = np.random.default_rng(1).integers(-(2**20), 2**20, (1000, 2), dtype=np.int32)


def written(path: Path, *pieces: int, **options: Any) -> NDArray[np.void]:  # noqa: ANN401 - times
    """Write `COUNTS` in pieces of so many samples; check the samples and return the blocks."""
    with ArrayWriter(path, sensors=[LAYOUT], created=CREATED) as writer:
        first = 0
        for n_samples in pieces:
            writer.samples("A", COUNTS[first : first + n_samples], first_sample=first, **options)
            first += n_samples
    report = verify(path)
    assert report.closed
    assert report.intact
    with Recording.open(path) as recording:
        sensor = recording.sensors[0]
        np.testing.assert_array_equal(sensor.counts(), COUNTS)
        return np.array(sensor.blocks)


def test_the_recording_does_not_depend_on_the_length_of_pieces(tmp_path: Path) -> None:
    at_once = written(tmp_path / "1.h5", 1000, block_rows=50)
    in_pieces = written(tmp_path / "2.h5", 50, 400, 550, block_rows=50)
    np.testing.assert_array_equal(at_once, in_pieces)
    assert len(at_once) == 20
    assert written(tmp_path / "3.h5", 1000)["n_samples"].tolist() == [1000]
    assert written(tmp_path / "4.h5", 990, 10, block_rows=300)["n_samples"].tolist() == [
        *(300, 300, 300, 90),
        10,
    ]


def test_blocks_are_received_at_the_nominal_rate_unless_times_are_given(tmp_path: Path) -> None:
    blocks = written(tmp_path / "1.h5", 1000, block_rows=500)
    assert (blocks["utc_ns"] - CREATED.utc_ns).tolist() == [5 * 10**9, 10 * 10**9]
    assert (blocks["monotonic_ns"] - CREATED.monotonic_ns).tolist() == [5 * 10**9, 10 * 10**9]
    assert blocks["flags"].tolist() == [BlockFlag.CLOCK_RESTART, 0]
    assert blocks["device_counter"].tolist() == [NO_COUNTER, NO_COUNTER]
    times = {"received_ns": [7, 8], "utc_ns": np.array([3, 4]), "instants_ns": np.arange(1000)}
    blocks = written(tmp_path / "2.h5", 1000, block_rows=500, restart=False, **times)
    assert (blocks["utc_ns"] - CREATED.utc_ns).tolist() == [7, 8]
    assert (blocks["device_counter"] - CREATED.utc_ns).tolist() == [3, 4]
    assert blocks["flags"].tolist() == [BlockFlag.DEVICE_UTC] * 2
    with Recording.open(tmp_path / "2.h5") as recording:
        instants = recording.sensors[0].instants_ns()
    np.testing.assert_array_equal(instants - CREATED.monotonic_ns, np.arange(1000))


def test_gaps_and_events_are_recorded(tmp_path: Path) -> None:
    with ArrayWriter(tmp_path / "r.h5", sensors=[LAYOUT], created=CREATED) as writer:
        writer.samples("A", COUNTS[:400])
        writer.gap("A", 400, 100, reason="not in the file")
        writer.samples("A", COUNTS[400:], first_sample=500, restart=True)
        writer.event(EventKind.STOPPED, "the end", at_ns=11)
    with Recording.open(tmp_path / "r.h5") as recording:
        (event,) = recording.events
        assert (event.kind, event.text) == (EventKind.STOPPED, "the end")
        assert event.received.utc_ns == CREATED.utc_ns + 11
        (gap,) = recording.sensors[0].gaps
        assert (gap["first_sample"], gap["missing"], gap["reason"]) == (
            400,
            100,
            b"not in the file",
        )
        assert recording.sensors[0].blocks["first_sample"].tolist() == [0, 500]


def test_an_incomplete_recording_does_not_have_its_name(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    with ArrayWriter(path, sensors=[LAYOUT], created=CREATED) as writer:
        writer.samples("A", COUNTS)
        assert not path.exists()
        other = ArrayWriter(path, sensors=[LAYOUT], created=CREATED)
    first = path.read_bytes()
    with pytest.raises(RecordingError, match="exists already"), other:
        pass
    assert path.read_bytes() == first
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.h5"]


def test_an_error_leaves_nothing_behind(tmp_path: Path) -> None:
    def fail() -> None:
        with ArrayWriter(tmp_path / "r.h5", sensors=[LAYOUT], created=CREATED) as writer:
            writer.samples("A", COUNTS)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not list(tmp_path.iterdir())


def test_a_file_of_that_name_is_never_replaced(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"

    def write() -> None:
        with ArrayWriter(path, sensors=[LAYOUT], created=CREATED) as writer:
            writer.samples("A", COUNTS)
            path.write_bytes(b"made meanwhile")

    with pytest.raises(RecordingError, match="exists already"):
        write()
    assert path.read_bytes() == b"made meanwhile"
    with pytest.raises(RecordingError, match="exists already"):
        ArrayWriter(path, sensors=[LAYOUT], created=CREATED)
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.h5"]


def test_files_of_a_killed_process_do_not_block_a_new_recording(tmp_path: Path) -> None:
    leftover = tmp_path / ".r.h5.0123.new"
    leftover.write_bytes(b"half of it")
    alive = RecordingWriter.create(
        tmp_path / "r.h5", sensors=[LAYOUT], created=CREATED, hidden=True
    )
    (kept,) = set(tmp_path.iterdir()) - {leftover}
    for path in (leftover, kept):
        os.utime(path, (time.time() - 20, time.time() - 20))
    written(tmp_path / "r.h5", 1000)
    assert {entry.name for entry in tmp_path.iterdir()} == {"r.h5", kept.name}
    alive.abandon()
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.h5"]


# --- chunks on disk --------------------------------------------------------------------------


NOW = HostTime(10**9, 1_790_000_000 * 10**9)
N_ROWS = 1050
RNG = np.random.default_rng(12)
NOISE = RNG.integers(-(2**30), 2**30, (N_ROWS, 3), dtype=np.int32)
DRIFT = np.cumsum(RNG.integers(-3, 4, (N_ROWS, 3)), axis=0).astype(np.int32)


@pytest.fixture(params=["isal", "zlib"])
def deflate(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "zlib":  # the extra "fast" is not installed
        monkeypatch.setattr(packing, "deflate", zlib)


def recorded(path: Path, counts: NDArray[np.int32]) -> Path:
    channels = tuple(Channel(name=name, sensitivity=1.0) for name in "xyz")
    layout = SensorLayout("a", channels, 100.0, np.dtype(np.int32), clock="a")
    writer = RecordingWriter.create(path, sensors=[layout], created=NOW, hidden=True)
    for first in range(0, len(counts), 70):
        at = HostTime(NOW.monotonic_ns + first * 10**7, NOW.utc_ns + first * 10**7)
        writer.append(Block("a", first, counts[first : first + 70], at))
        writer.commit()
    writer.close()
    return path


@pytest.mark.usefixtures("deflate")
@pytest.mark.parametrize(("counts", "mask"), [(NOISE, 0b111), (DRIFT, 0b100)])
def test_noise_is_raw_and_the_rest_deflated_and_both_are_read_by_any_program(
    counts: NDArray[np.int32], mask: int, tmp_path: Path
) -> None:
    path = recorded(tmp_path / "r.h5", counts)
    with h5py.File(path, "r") as file:
        rows = file["sensors/a/samples"]
        np.testing.assert_array_equal(rows[...], counts)
        found = [rows.id.get_chunk_info(n) for n in range(rows.id.get_num_chunks())]
        assert len(found) == -(-N_ROWS // 100)
        assert {chunk.filter_mask for chunk in found[:-1]} == {mask}
        if mask == 0b100:
            assert sum(chunk.size for chunk in found) < counts.nbytes / 2
    with Recording.open(path) as recording:
        np.testing.assert_array_equal(recording.sensor("a").counts(), counts)
        read, damaged = recording.sensor("a").intact_counts(130, 990)
        np.testing.assert_array_equal(read, counts[130:990])
        assert not damaged


def test_raw_and_deflated_chunks_are_read_together(tmp_path: Path) -> None:
    mixed = np.concatenate([NOISE[:300], DRIFT[:250], NOISE[:150]])
    with Recording.open(recorded(tmp_path / "r.h5", mixed)) as recording:
        np.testing.assert_array_equal(recording.sensor("a").counts(), mixed)


def test_a_flipped_bit_in_a_raw_chunk_is_found(tmp_path: Path) -> None:
    path = recorded(tmp_path / "r.h5", NOISE)
    with h5py.File(path, "r") as file:
        place = file["sensors/a/samples"].id.get_chunk_info(2).byte_offset
    content = bytearray(path.read_bytes())
    content[place + 40] ^= 16
    path.write_bytes(content)
    with Recording.open(path) as recording:
        read, damaged = recording.sensor("a").intact_counts(0, N_ROWS)
        (bad,) = damaged
        assert bad[0] <= 203 < bad[1]
        assert bad[1] - bad[0] <= 70
        good = np.r_[0 : bad[0], bad[1] : N_ROWS]
        np.testing.assert_array_equal(read[good], NOISE[good])


def test_chunks_that_hdf5_compressed_are_read(tmp_path: Path) -> None:
    """As earlier versions wrote them, with Fletcher-32."""
    with h5py.File(tmp_path / "old.h5", "w") as file:
        options = {"shuffle": True, "compression": "gzip", "fletcher32": True}
        rows = file.create_dataset("rows", data=DRIFT, chunks=(100, 3), **options)
        assert rows.id.get_chunk_info(0).filter_mask == 0
        found = ChunkedRows(rows).read(0, 1000, N_ROWS)
        np.testing.assert_array_equal(found, DRIFT[:1000])


def test_a_stream_that_is_not_intact_is_not_unpacked() -> None:
    content, mask = packing.packed(DRIFT[:100])
    rows = np.empty_like(DRIFT[:100])
    assert packing.unpacked([(mask, content)], rows)
    np.testing.assert_array_equal(rows, DRIFT[:100])
    assert not packing.unpacked([(mask, content[:-1] + bytes([content[-1] ^ 1]))], rows)
    assert not packing.unpacked([(mask, content[:50])], rows)
    assert not packing.unpacked([(0b001, content)], rows)  # deflated, not shuffled
    assert not packing.unpacked([(packing.RAW, bytes(100))], rows)
