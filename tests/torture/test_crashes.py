"""A part of the torture by kills and by errors of the disk."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.torture.crashes import CALLS, disk_faults, kill_faults
from tests.torture.power_cuts import shim

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals and a preloaded library")


@pytest.mark.long
def test_nothing_acknowledged_is_lost_in_a_kill(tmp_path: Path) -> None:
    assert kill_faults(tmp_path, 3, seed=5) == []


@pytest.mark.long
def test_nothing_acknowledged_is_lost_in_an_error_of_the_disk(tmp_path: Path) -> None:
    library = shim(tmp_path)
    if library is None:
        pytest.skip("no C compiler")
    assert disk_faults(library, tmp_path, len(CALLS), seed=5) == []
