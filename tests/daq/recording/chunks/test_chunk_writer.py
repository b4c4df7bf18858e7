"""Rows written past h5py are stored as they are meant, whatever their memory looks like."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from daq.recording.chunks.chunk_writer import AppendedRows, ChunkBuffer

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
