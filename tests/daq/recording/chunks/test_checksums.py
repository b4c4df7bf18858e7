"""Damaged blocks are found in any company, left out, and counted."""

from __future__ import annotations

import zlib
from pathlib import Path
from unittest.mock import patch

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.errors import RecordingError
from daq.recording.chunks.checksums import intact_blocks
from daq.recording.file_format import BLOCK_DTYPE, block_crc32
from daq.recording.reader import Recording
from daq.recording.repair import verify, write_results
from daq.recording.storage.packing import deflate
from tests.torture.damaged_files import make_recording


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
