"""What `verify` calls intact is readable by any program, here where HDF5's own headers change."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.recording.file_format import SensorLayout
from daq.recording.repair import verify
from tests.torture.damaged_files import make_recording, plain_h5py_reads

_HEADER = re.compile(rb"(?:BTHD|BTLF|FRHP|FHDB|EAHD|FSHD|FSSE)\x00")
"""Of indexes, heaps and lists of free space, which our own reader may not need."""


@pytest.mark.parametrize(("rows", "version"), [([], 2), ([[0, 3, 5]], 3)])
def test_only_recordings_that_lack_rows_of_channels_need_a_later_program(
    rows: list[list[int]], version: int
) -> None:
    """Programs of before refuse version 3, and read version 2."""
    channels = (Channel(name="x", sensitivity=1.0),)
    absent = np.array(rows, np.int64).reshape(-1, 3)
    layout = SensorLayout("a", channels, 100.0, np.dtype("i4"), absent=absent)
    assert layout.format_version == version


@pytest.mark.parametrize("offset", [5, 12, 20, 30])
def test_a_damaged_header_is_damage(tmp_path: Path, offset: int) -> None:
    path = tmp_path / "r.h5"
    make_recording(path)
    content = path.read_bytes()
    headers = [match.start() for match in _HEADER.finditer(content)]
    n_unreadable = 0
    for start in headers:
        changed = bytearray(content)
        changed[start + offset] ^= 0x80
        path.write_bytes(changed)
        if plain_h5py_reads(path):
            continue
        n_unreadable += 1
        try:
            report = verify(path, tried=True)
        except RecordingError:
            continue
        assert not report.intact, content[start : start + 4]
    assert n_unreadable > 0
