"""What opening a file for reading costs."""

from __future__ import annotations

import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.waiting import python

N_TABLES, BYTES, CHUNK = 4, 8_000_000, 16_000
_READ_ALL = """
import sys
from pathlib import Path
from daq.recording.storage.opening import open_file

def resident() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096e-6

with open_file(Path(sys.argv[1])) as file:
    tables = list(file.values())
    tables[0][:2000]
    before = resident()
    for table in tables:
        for first in range(0, len(table), 2000):
            table[first : first + 2000]
    print(resident() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads its memory from /proc")
def test_what_was_read_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "tables.h5"
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        for number in range(N_TABLES):
            values = np.arange(BYTES // 8, dtype=np.int64)
            file.create_dataset(str(number), data=values, chunks=(CHUNK // 8,))
    assert float(python(_READ_ALL, path).stdout) < 8.0  # in MB; of 32 MB
