"""Blocks stay in the file, and are read where they are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.errors import RecordingError
from daq.protocols.block import BlockFlag
from daq.recording.file_format import BLOCK_DTYPE, BLOCKS_PER_CHUNK
from daq.recording.sensor_record import BlockTable
from tests.traced_memory import peak_of

N_BLOCKS = 100_000
LENGTH = 10
CLIPPED = (*range(100, 110), 50_000)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Iterator[h5py.Dataset]:
    rows = np.zeros(N_BLOCKS, BLOCK_DTYPE)
    rows["first_row"] = LENGTH * np.arange(N_BLOCKS)
    rows["first_sample"] = rows["first_row"] + 7
    rows["n_samples"] = LENGTH
    rows["flags"][list(CLIPPED)] = int(BlockFlag.CLIPPED)
    path: Path = tmp_path_factory.mktemp("blocks") / "blocks.h5"
    with h5py.File(path, "w") as file:
        yield file.create_dataset("blocks", data=rows, chunks=(BLOCKS_PER_CHUNK,))


def test_a_table_is_indexed_like_an_array(dataset: h5py.Dataset) -> None:
    table, rows = BlockTable(dataset), dataset[:]
    table.extend(90_000, LENGTH * N_BLOCKS)
    assert len(table) == 90_000
    rows = rows[:90_000]
    for slices in (slice(17, 20_000), slice(89_999, None), slice(-3, None), slice(5, 2)):
        np.testing.assert_array_equal(table[slices], rows[slices])
    np.testing.assert_array_equal(table["first_row"], rows["first_row"])
    np.testing.assert_array_equal(table[rows["flags"] != 0], rows[rows["flags"] != 0])
    assert table[-1] == rows[-1]
    assert sum(int(row["n_samples"]) for row in table) == table.n_samples == 900_000


def test_only_blocks_with_committed_samples_count(dataset: h5py.Dataset) -> None:
    table = BlockTable(dataset)
    for n_rows, n_samples, whole in ((5, 29, 2), (5, 30, 3), (40_000, 399_999, 39_999)):
        table.extend(n_rows, n_samples)
        assert (len(table), table.n_samples) == (whole, LENGTH * whole)
    with pytest.raises(RecordingError, match="100000 rows where 100001 were committed"):
        table.extend(N_BLOCKS + 1, LENGTH * (N_BLOCKS + 1))


def test_clipped_stretches_are_cached(dataset: h5py.Dataset) -> None:
    table = BlockTable(dataset)
    assert table.clipped.shape == (0, 2)
    for n_rows in (105, N_BLOCKS):
        table.extend(n_rows, LENGTH * n_rows)
    assert table.clipped.tolist() == [[1007, 1057], [1057, 1107], [500_007, 500_017]]


def test_memory_does_not_grow_with_the_blocks(dataset: h5py.Dataset) -> None:
    most = peak_of(lambda: BlockTable(dataset).extend(N_BLOCKS, LENGTH * N_BLOCKS))
    assert most < N_BLOCKS * BLOCK_DTYPE.itemsize / 2
