"""Blocks are read where they are asked for; damaged ones are found, left out, and counted."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.errors import RecordingError
from daq.protocols.block import BlockFlag
from daq.recording.chunks.checksums import intact_blocks
from daq.recording.file_format import BLOCK_DTYPE, BLOCKS_PER_CHUNK, block_crc32
from daq.recording.reader import Recording
from daq.recording.repair import verify, write_results
from daq.recording.sensor_record import BlockTable
from daq.recording.storage.packing import deflate
from tests.torture.damaged_files import make_recording
from tests.traced_memory import peak_of


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(1, 9) | st.integers(700, 702), min_size=1, max_size=40),
    st.lists(st.integers(0, 10**6), max_size=3),
    st.integers(0, 2**32 - 1),
)
def test_damaged_blocks_are_identified(lengths: list[int], flipped: list[int], seed: int) -> None:
    """Those of a length that are intact take one call together, if they are short."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(-(2**31), 2**31, (sum(lengths), 3)).astype("<i4")
    blocks = np.zeros(len(lengths), BLOCK_DTYPE)
    blocks["n_samples"] = lengths
    blocks["first_row"] = 700 + np.append(0, np.cumsum(lengths)[:-1])
    blocks["utc_ns"] = rng.integers(0, 2**62, len(lengths))
    ends = np.cumsum(lengths)
    for number, (end, n) in enumerate(zip(ends, lengths, strict=True)):
        crc32 = zlib.crc32(counts[end - n : end].tobytes())
        blocks["crc32"][number] = block_crc32(blocks[number : number + 1], crc32)
    whole = counts.copy()
    for each in set(flipped):  # two may name one bit, which is then as it was
        counts[each % len(counts), each % 3] ^= 1 << (each % 31)
    expected = np.ones(len(lengths), bool)
    rows = np.flatnonzero((counts != whole).any(axis=1))
    expected[np.searchsorted(ends, rows, side="right")] = False
    with patch.object(deflate, "crc32", wraps=deflate.crc32) as crc32:
        assert intact_blocks(blocks, counts).tolist() == expected.tolist()
    if expected.all():
        n_long = sum(n >= 700 for n in lengths)
        assert crc32.call_count == len({n for n in lengths if n < 700}) + 2 * n_long


def test_a_damaged_chunk_loses_only_its_blocks(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    with Recording.open(path) as recording:
        whole = recording.sensor("a").counts()
    with h5py.File(path) as file:
        samples = file["sensors/a/samples"]
        chunk, length = samples.id.get_chunk_info(2), samples.chunks[0]
    with path.open("r+b") as raw:
        raw.seek(chunk.byte_offset + 30)
        raw.write(b"\xff\xff\xff")
    with Recording.open(path) as recording:
        sensor = recording.sensor("a")
        counts, damaged = sensor.intact_counts(0, sensor.n_samples)
        n_damaged = sensor.n_damaged
        with pytest.raises(RecordingError, match="damaged between rows"):
            sensor.counts()
    lost = np.zeros(len(whole), bool)
    for first, last in damaged:
        lost[first:last] = True
    chunk_rows = slice(2 * length, 3 * length)
    assert lost[chunk_rows].all()
    assert lost.sum() < 2 * length
    np.testing.assert_array_equal(counts, np.where(lost[:, None], 0, whole))
    assert len(verify(path).sensors[0].bad_blocks) == n_damaged == len(damaged)


def test_damaged_gaps_and_events_are_reported_and_the_rest_is_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    with h5py.File(path, "r+") as file:
        row = file["sensors/b/gaps"][0]
        row["missing"] += 1
        file["sensors/b/gaps"][0] = row
    report = verify(path)
    assert not report.intact
    assert report.damaged_tables == ("gaps of sensor 'b'",)
    assert "wrong checksum of the gaps of sensor 'b'" in caplog.text


@pytest.mark.parametrize("place", ["sensors/a/samples", "/"])
def test_a_changed_description_is_refused(tmp_path: Path, place: str) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    with h5py.File(path, "r+") as file:
        if place == "/":
            file.attrs["created_utc_ns"] += 1
        else:
            file[place].attrs["sensitivity"] = np.array([1e6, 2e6, 1e6])
        file.attrs["remark of another program"] = "not ours, and no damage"
    with pytest.raises(RecordingError, match=r"the description of .* has a wrong checksum"):
        Recording.open(path)


def test_a_changed_result_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    write_results(path, {"m": ({"x": np.arange(3.0)}, {"unit": "m/s²", "names": ["a", "b"]})})
    with Recording.open(path) as recording:
        assert recording.results()["m"][1]["unit"] == "m/s²"
    with h5py.File(path, "r+") as file:
        file["results/m/x"][1] = 7.0
    with (
        Recording.open(path) as recording,
        pytest.raises(RecordingError, match="result of method 'm' has a wrong checksum"),
    ):
        recording.results()


# --- blocks stay in the file -----------------------------------------------------------------


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
