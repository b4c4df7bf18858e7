"""Chunks that are read and written past HDF5 give the same rows; damage never gives others."""

from __future__ import annotations

import os
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from daq.recording import sensor_record
from daq.recording.chunks.chunk_writer import AppendedRows, ChunkBuffer
from daq.recording.sensor_record import ChunkedRows, LocatedChunks
from daq.recording.storage import packing

LENGTH, N_ROWS = 10, 257


@pytest.fixture(autouse=True, params=["isal", "zlib"])
def inflater(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decompress by either library: the extra "fast" may be missing."""
    if request.param == "zlib":
        monkeypatch.setattr("daq.recording.storage.packing.deflate", zlib)
    else:
        pytest.importorskip("isal")


def write(path: Path, rows: np.ndarray[Any, Any], **options: Any) -> None:  # noqa: ANN401
    filters = {"shuffle": True, "compression": "gzip", "compression_opts": 1, "fletcher32": True}
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        file.create_dataset(
            "rows",
            data=rows,
            chunks=(LENGTH, *rows.shape[1:]),
            maxshape=(None, *rows.shape[1:]),
            **(filters | options),
        )


def ramp(dtype: str, n_columns: int | None) -> np.ndarray[Any, Any]:
    shape = (N_ROWS,) if n_columns is None else (N_ROWS, n_columns)
    return np.arange(np.prod(shape)).reshape(shape).astype(dtype) * 100


@pytest.mark.parametrize(
    ("dtype", "n_columns"), [("<i4", 3), ("<i2", 6), ("<f8", 1), ("<i8", None)]
)
def test_rows_equal_those_read_by_hdf5(tmp_path: Path, dtype: str, n_columns: int | None) -> None:
    rows = ramp(dtype, n_columns)
    write(tmp_path / "f.h5", rows)
    with h5py.File(tmp_path / "f.h5", "r") as file:
        reader = ChunkedRows(file["rows"])
        for first, last in [(0, 257), (0, 80), (9, 91), (10, 250), (173, 257), (256, 257), (5, 5)]:
            found = reader.read(first, last, N_ROWS)
            assert found.dtype == rows.dtype
            np.testing.assert_array_equal(found, rows[first:last])


@pytest.mark.parametrize("options", [{"shuffle": False}, {"compression_opts": 9}, {"shape": None}])
def test_datasets_with_other_filters_are_read(tmp_path: Path, options: dict[str, Any]) -> None:
    rows = ramp("<i4", 3)
    if "shape" in options:  # cannot be compressed: HDF5 leaves gzip out, chunk by chunk
        rows[100:] = np.random.default_rng(0).integers(-(2**31), 2**31, (157, 3))
        options = {}
    write(tmp_path / "f.h5", rows, **options)
    with h5py.File(tmp_path / "f.h5", "r") as file:
        np.testing.assert_array_equal(ChunkedRows(file["rows"]).read(3, 250, N_ROWS), rows[3:250])


def test_a_damaged_byte_is_always_detected(tmp_path: Path) -> None:
    path = tmp_path / "f.h5"
    rows = ramp("<i4", 3)
    write(path, rows)
    with h5py.File(path, "r") as file:
        chunk = file["rows"].id.get_chunk_info(4)
    whole = path.read_bytes()
    refused = 0
    for place in range(chunk.byte_offset, chunk.byte_offset + chunk.size):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        path.write_bytes(damaged)
        with h5py.File(path, "r") as file:
            try:
                found = ChunkedRows(file["rows"]).read(0, N_ROWS, N_ROWS)
            except OSError:
                refused += 1
            else:
                np.testing.assert_array_equal(found, rows)
    # The four bytes of Fletcher-32 are not looked at where all before them is right.
    assert refused == chunk.size - 4


def test_repeated_reads_use_a_bounded_cache(tmp_path: Path) -> None:
    rows = ramp("<i4", 3)
    write(tmp_path / "f.h5", rows[:135])  # ends within a chunk, and grows
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        reader = ChunkedRows(file["rows"])
        first = reader.read(12, 135, 135)
        again = reader.read(20, 130, 135)
        assert np.shares_memory(first, again)
        np.testing.assert_array_equal(again, rows[20:130])
        assert not again.flags.writeable
        file["rows"].resize((N_ROWS, 3))
        file["rows"][135:] = rows[135:]
        np.testing.assert_array_equal(reader.read(20, 139, N_ROWS), rows[20:139])
        np.testing.assert_array_equal(reader.read(0, N_ROWS, N_ROWS), rows)


def count_of_inflated(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """Return a list to which every chunk is added when it is inflated."""
    found: list[bytes] = []
    library: Any = packing.__dict__["deflate"]

    class Counted:
        def __init__(self) -> None:
            self._one = library.decompressobj()

        def decompress(self, content: bytes, n_bytes: int) -> bytes:
            found.append(content)
            inflated: bytes = self._one.decompress(content, n_bytes)
            return inflated

        @property
        def eof(self) -> bool:
            return bool(self._one.eof)

    counted = SimpleNamespace(decompressobj=Counted, error=library.error)
    monkeypatch.setattr(packing, "deflate", counted)
    return found


@pytest.mark.parametrize("kept_bytes", [1 << 20, 1 << 10])
@pytest.mark.parametrize(("length", "overlap"), [(90, 0), (90, 7), (90, 50), (41, 20)])
def test_overlapping_reads_inflate_each_chunk_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, length: int, overlap: int, kept_bytes: int
) -> None:
    rows = ramp("<i4", 3)
    write(tmp_path / "f.h5", rows)
    inflated = count_of_inflated(monkeypatch)
    monkeypatch.setattr(sensor_record, "_KEPT_BYTES", kept_bytes)
    with h5py.File(tmp_path / "f.h5", "r") as file:
        reader = ChunkedRows(file["rows"])
        for first in range(0, N_ROWS - overlap, length - overlap):
            last = min(first + length, N_ROWS)
            np.testing.assert_array_equal(reader.read(first, last, N_ROWS), rows[first:last])
    assert len(inflated) == -(-N_ROWS // LENGTH)


def test_threads_that_read_neighbours_inflate_each_chunk_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = ramp("<i4", 3)
    write(tmp_path / "f.h5", rows)
    inflated = count_of_inflated(monkeypatch)
    with h5py.File(tmp_path / "f.h5", "r") as file, ThreadPoolExecutor(2) as pool:
        reader = ChunkedRows(file["rows"])
        reader.read(0, 60, N_ROWS)
        two = [pool.submit(reader.read, 50, 130, N_ROWS) for _ in range(2)]
        for each in two:
            np.testing.assert_array_equal(each.result(), rows[50:130])
    assert len(inflated) == -(-130 // LENGTH)


@pytest.mark.parametrize("later", [136, 180, 250])
def test_rows_after_those_that_are_final_are_read_again(tmp_path: Path, later: int) -> None:
    rows = ramp("<i4", 3)
    write(tmp_path / "f.h5", np.concatenate([rows[:135], -rows[135:]]))
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        reader = ChunkedRows(file["rows"])
        reader.read(0, 130, 135)  # rows of its last chunk are still to be written
        file["rows"][135:] = rows[135:]
        np.testing.assert_array_equal(reader.read(120, later, N_ROWS), rows[120:later])


def write_raw(path: Path, rows: np.ndarray[Any, Any]) -> None:
    """Write chunks that went through no filter, every third one compressed, between others."""
    write(path, np.zeros_like(rows))
    with h5py.File(path, "r+") as file:
        file.create_dataset("others", rows.shape, "<i4", chunks=(LENGTH, *rows.shape[1:]))
        for first in range(0, N_ROWS, LENGTH):
            chunk = np.zeros((LENGTH, *rows.shape[1:]), rows.dtype)
            chunk[: N_ROWS - first] = rows[first : first + LENGTH]
            content, mask = chunk.tobytes(), packing.RAW
            if first // LENGTH % 3 == 2:
                mask = 0b100
                content = zlib.compress(chunk.reshape(-1).view("u1").reshape(-1, 4).T.tobytes())
            file["rows"].id.write_direct_chunk((first, 0), content, mask)
            if first // LENGTH % 4 == 3:
                file["others"].id.write_direct_chunk((first, 0), chunk.tobytes())


def test_raw_chunks_of_a_closed_file_are_read_from_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = ramp("<i4", 3)
    write_raw(tmp_path / "f.h5", rows)
    n_read: list[int] = []

    def unpacked(stored: list[Any], into: np.ndarray[Any, Any]) -> bool:
        n_read.append(len(stored))
        return packing.unpacked(stored, into)

    monkeypatch.setattr(sensor_record, "unpacked", unpacked)
    with h5py.File(tmp_path / "f.h5", "r") as file:
        reader = ChunkedRows(file["rows"])
        np.testing.assert_array_equal(reader.read(0, 20, N_ROWS), rows[:20])
        assert n_read == [2]
        reader.is_closed = True
        for first in range(0, N_ROWS - 20, 20):
            np.testing.assert_array_equal(reader.read(first, first + 20, N_ROWS), rows[first:][:20])
        assert sum(n_read) < 20  # of 26
        np.testing.assert_array_equal(reader.read(0, N_ROWS, N_ROWS), rows)


def test_a_raw_chunk_that_is_cut_off_is_left_to_hdf5(tmp_path: Path) -> None:
    rows = np.random.default_rng(0).integers(-(2**31), 2**31, (N_ROWS, 3)).astype("<i4")
    write_raw(tmp_path / "f.h5", rows)
    with h5py.File(tmp_path / "f.h5", "r") as file:
        raw = LocatedChunks(file["rows"])
        into = np.empty((LENGTH, 3), "<i4")
        assert raw.read(0, into)
        np.testing.assert_array_equal(into, rows[:LENGTH])
        assert not raw.read(2, into)  # compressed
        assert not raw.read(25, np.empty((2 * LENGTH, 3), "<i4"))  # beyond the last
        at = file["rows"].id.get_chunk_info(24).byte_offset
        os.truncate(tmp_path / "f.h5", at + 5)
        assert not raw.read(24, into)


@pytest.mark.parametrize("sparse", [0.0, 4.0])
def test_chunks_of_any_kind_are_taken_from_the_file_as_hdf5_gives_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sparse: float
) -> None:
    monkeypatch.setattr(sensor_record, "_SPARSE", sparse)  # each alone, or all with what is between
    write_raw(tmp_path / "f.h5", ramp("<i4", 3))
    n_chunks = -(-N_ROWS // LENGTH)
    with h5py.File(tmp_path / "f.h5", "r") as file:
        located, fetch = LocatedChunks(file["rows"]), file["rows"].id.read_direct_chunk
        found = located.stored(0, n_chunks)
        assert found is not None
        expected = [fetch((LENGTH * number, 0)) for number in range(n_chunks)]
        assert [(mask, bytes(content)) for mask, content in found] == expected
        assert located.stored(n_chunks - 1, 2) is None  # beyond the last
        at = file["rows"].id.get_chunk_info(2).byte_offset
        os.truncate(tmp_path / "f.h5", at + 5)
        assert located.stored(2, 1) is None


def test_a_chunk_far_larger_than_its_rows_is_left_to_hdf5(tmp_path: Path) -> None:
    rows = ramp("<i4", 3)
    write(tmp_path / "f.h5", rows)
    with h5py.File(tmp_path / "f.h5", "r+") as file:
        file["rows"].id.write_direct_chunk((0, 0), bytes(3 * LENGTH * 12), 0b100)
    with h5py.File(tmp_path / "f.h5", "r") as file:
        located = LocatedChunks(file["rows"])
        assert located.stored(0, 1) is None
        assert located.stored(1, 1) is not None


# --- rows written past h5py ------------------------------------------------------------------


ROWS = np.arange(12).reshape(4, 3)
LAYOUTS = {
    "another type": ROWS.astype("i4"),
    "the other byte order": ROWS.astype(">i8"),
    "columns first": np.asfortranarray(ROWS),
    "every other row": np.repeat(ROWS, 2, axis=0)[::2],
    "floating point": ROWS.astype("f8"),
}


@pytest.mark.parametrize("rows", LAYOUTS.values(), ids=LAYOUTS)
def test_rows_of_another_layout_are_converted(tmp_path: Path, rows: np.ndarray[Any, Any]) -> None:
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        dataset = file.create_dataset("rows", (0, 3), "i8", maxshape=(None, 3), chunks=(4, 3))
        appended = AppendedRows(dataset)
        appended.extend(len(rows))
        appended.write(0, rows)
        assert np.array_equal(dataset[()], ROWS)


@pytest.mark.parametrize("size", [1, 3, 4, 5, 11])
def test_blocks_of_any_size_fill_chunks(tmp_path: Path, size: int) -> None:
    rows = np.arange(66, dtype="i4").reshape(22, 3)
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        dataset = file.create_dataset("rows", (0, 3), "i4", maxshape=(None, 3), chunks=(4, 3))
        buffer = ChunkBuffer(dataset)
        for first in range(0, len(rows), size):
            buffer.add(rows[first : first + size])
            assert buffer.n_written == min(first + size, len(rows)) // 4 * 4
        buffer.finish()
        assert np.array_equal(dataset[()], rows)
