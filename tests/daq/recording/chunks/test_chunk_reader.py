"""Chunks that are read past HDF5 give the same rows, and damage never gives others."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import pytest

from daq.recording.chunks.chunk_reader import ChunkedRows

if TYPE_CHECKING:
    from pathlib import Path

LENGTH, N_ROWS = 10, 257


@pytest.fixture(autouse=True, params=["isal", "zlib"])
def inflater(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decompress by either library: the extra "fast" may be missing."""
    if request.param == "zlib":
        monkeypatch.setattr("daq.recording.chunks.chunk_reader.inflater", zlib)
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
            found = reader.read(first, last)
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
        np.testing.assert_array_equal(ChunkedRows(file["rows"]).read(3, 250), rows[3:250])


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
                found = ChunkedRows(file["rows"]).read(0, N_ROWS)
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
        first = reader.read(12, 135)
        again = reader.read(20, 130)
        assert np.shares_memory(first, again)
        np.testing.assert_array_equal(again, rows[20:130])
        assert not again.flags.writeable
        file["rows"].resize((N_ROWS, 3))
        file["rows"][135:] = rows[135:]
        np.testing.assert_array_equal(reader.read(20, 139), rows[20:139])
        np.testing.assert_array_equal(reader.read(0, N_ROWS), rows)
