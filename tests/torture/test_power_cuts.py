"""A part of the torture by power cuts, and what the journal is for."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.protocols.block import Block, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import repair
from daq.recording.storage.journal import journal_path
from daq.recording.writer import RecordingWriter
from tests.torture.power_cuts import MODELS, Operation, faults, recorded, replay, shim


@pytest.fixture(scope="module")
def operations(tmp_path_factory: pytest.TempPathFactory) -> list[Operation]:
    folder = tmp_path_factory.mktemp("power")
    library = shim(folder)
    if library is None:
        pytest.skip("no C compiler, or not Linux")
    return recorded(library, folder, 12)


@pytest.mark.parametrize(
    "model",
    [m if m == "sectors" else pytest.param(m, marks=pytest.mark.long) for m in MODELS],
)
def test_nothing_acknowledged_is_lost(
    operations: list[Operation], model: str, tmp_path: Path
) -> None:
    assert faults(operations, model, 6, tmp_path, seed=7) == []


@pytest.mark.long
def test_without_its_journal_a_torn_recording_is_lost(
    operations: list[Operation], tmp_path: Path
) -> None:
    """Shows that the cuts above tear recordings at all; one may end the HDF5 library, too."""
    lost = 0
    for number in range(20):
        disk = tmp_path / str(number)
        disk.mkdir()
        rng = np.random.default_rng(number)
        n = int(rng.integers(len(operations) // 3, len(operations)))
        replay(operations, n, "sectors", rng, disk)
        journal_path(disk / "r.h5").unlink(missing_ok=True)
        command = [sys.executable, "-P", "-m", "tui", "repair", str(disk / "r.h5")]
        lost += bool(subprocess.run(command, check=False, capture_output=True).returncode)
    assert lost > 0


def test_a_journal_of_another_recording_is_not_used(
    operations: list[Operation], tmp_path: Path
) -> None:
    """It lies there when a recording was replaced by another file of its name."""
    path = tmp_path / "r.h5"
    replay(operations, len(operations) * 2 // 3, "prefix", np.random.default_rng(1), tmp_path)
    sensor = SensorLayout("a", (Channel(name="x", sensitivity=1.0),), 100.0, np.dtype("i4"))
    at = HostTime(10**9, 10**18)
    other = RecordingWriter.create(tmp_path / "other.h5", sensors=[sensor], created=at)
    other.append(Block("a", 0, np.ones((200, 1), np.int32), at))
    other.commit()
    other.abandon()
    shutil.copyfile(other.path, path)
    run_id = other.run_id
    journal = journal_path(path).read_bytes()
    assert repair(path).closed
    with Recording.open(path) as recording:
        assert recording.run_id == run_id
    assert journal_path(path).read_bytes() == journal


def test_a_torn_recording_names_its_remedy(operations: list[Operation], tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    replay(operations, len(operations) // 2, "prefix", np.random.default_rng(1), tmp_path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(RecordingError, match=f"its journal has .*: huddle repair {path}"):
        Recording.open(path)
