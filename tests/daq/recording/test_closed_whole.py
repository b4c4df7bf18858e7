"""In a closed recording blocks, rows and ``/committed`` agree; what is lost is named."""

from __future__ import annotations

import contextlib
import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from daq.errors import NotARecordingError
from daq.recording.reader import Recording
from daq.recording.repair import repair, verify
from tests.torture.damaged_files import make_recording


@pytest.fixture
def closed(tmp_path: Path) -> Path:
    path = tmp_path / "closed.h5"
    make_recording(path)
    return path


def change_block(path: Path, row: int, field: str, bit: int) -> None:
    """Flip one bit of a row of the block table, as a damaged disk does."""
    with h5py.File(path, "r+") as file:
        table = file["sensors/a/blocks"]
        rows = table[...]
        rows[field][row] ^= np.int64(1) << bit
        table[...] = rows


@pytest.mark.parametrize("field", ["first_row", "n_samples"])
@pytest.mark.parametrize(("bit", "row"), [(0, 17), (7, 0), (11, 59), (40, 17), (62, 0)])
def test_no_block_of_a_closed_recording_is_left_out_unseen(
    closed: Path, field: str, bit: int, row: int
) -> None:
    change_block(closed, row, field, bit)
    certain = 50 * max(0, row - 1)  # the damaged block, and in doubt the one before
    for read in (Recording.open, verify, repair):
        with pytest.raises(NotARecordingError, match="damaged") as said:
            read(closed)
        lost = re.search(r"sensor 'a': (\d+) of 3000 samples are lost", str(said.value))
        assert lost is not None
        assert 50 <= int(lost[1]) <= 3000 - certain


@pytest.mark.parametrize("name", ["samples", "blocks", "instants"])
def test_a_closed_recording_has_the_lengths_that_were_committed(closed: Path, name: str) -> None:
    with h5py.File(closed, "r+") as file:
        rows = file["sensors/b"][name]
        rows.resize(len(rows) + 50, axis=0)
    expected = "110 rows; expected 60" if name == "blocks" else "3050 rows; expected 3000"
    with pytest.raises(NotARecordingError, match=expected):
        verify(closed)


def test_a_recording_left_open_is_cut_to_its_whole_blocks(tmp_path: Path) -> None:
    path = tmp_path / "open.h5"
    make_recording(path)
    with h5py.File(path, "r+") as file:
        del file["checksums"]
        file["committed"][-1, 1] = 0
        file["committed"][0, 0] = 2960  # older than the row of the table
    with Recording.open(path) as recording:
        assert recording.sensor("a").n_samples == 2950


def test_a_changed_byte_of_the_superblock_is_damage(closed: Path) -> None:
    content = closed.read_bytes()
    for at in range(48):
        changed = bytearray(content)
        changed[at] ^= 0x80  # an offset becomes one that no file can have
        closed.write_bytes(changed)
        with contextlib.suppress(NotARecordingError):
            assert not verify(closed, tried=True).intact
