"""Chunks on disk: which are compressed, and who can read them."""

from __future__ import annotations

import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.protocols.block import Block, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.sensor_record import ChunkedRows
from daq.recording.storage import packing
from daq.recording.writer import RecordingWriter

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
