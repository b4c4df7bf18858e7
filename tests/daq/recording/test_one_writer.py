"""A recording has one writer, and is safe when it says that it is closed."""

from __future__ import annotations

import errno
import os
import stat
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import h5py
import numpy as np
import pytest

from daq.bench.channel import Channel
from daq.errors import DiskError, RecordingError, RemovedError
from daq.estimation.follow import _RemoteRecorder
from daq.protocols.block import Block, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import repair, verify
from daq.recording.storage.journal import journal_path
from daq.recording.storage.locking import is_being_written
from daq.recording.storage.retries import PAUSES, repeated
from daq.recording.storage.superblock import Superblock, lookup3
from daq.recording.writer import RecordingWriter, make_datasets

NOW = HostTime(1_000_000_000, 1_790_000_000_000_000_000)
SENSOR = SensorLayout("a", (Channel(name="x", sensitivity=1.0),), 100.0, np.dtype("i4"))
COUNTS = np.arange(200, dtype=np.int32)[:, None]


def create(path: Path) -> RecordingWriter:
    return RecordingWriter.create(path, sensors=[SENSOR], created=NOW)


def record(path: Path) -> bytes:
    writer = create(path)
    writer.append(Block("a", 0, COUNTS, NOW))
    writer.close()
    return path.read_bytes()


def test_the_later_of_two_recorders_with_one_name_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one records and closes after this one has found the name free."""
    path = tmp_path / "r.h5"
    closed: list[bytes] = []

    def make_later(file: h5py.File, sensors: list[SensorLayout], chunk_seconds: float) -> None:
        if not closed:
            closed.append(b"")
            closed[0] = record(path)
        make_datasets(file, sensors, chunk_seconds)

    monkeypatch.setattr("daq.recording.writer.make_datasets", make_later)
    with pytest.raises(RecordingError, match="exists already; expected a new file"):
        create(path)
    assert path.read_bytes() == closed[0]
    assert verify(path).closed
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.h5"]


@pytest.mark.skipif(sys.platform != "linux", reason="an open file gets a name by /proc")
def test_what_was_safe_in_a_replaced_recording_has_another_name(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "r.h5"
    writer = create(path)
    writer.append(Block("a", 0, COUNTS, NOW))
    writer.commit()
    path.chmod(0o640)
    record(tmp_path / "other.h5")
    (tmp_path / "other.h5").replace(path)
    with (
        Recording.open(path.parent / "r.h5"),
        pytest.raises(
            DiskError,
            match=r"was replaced by another file while .*; what was safe in it is in r-2\.h5",
        ),
    ):
        writer.commit()
    with pytest.raises(RecordingError):
        writer.close()
    assert verify(path).closed
    other = path.with_name("r-2.h5")
    assert stat.S_IMODE(other.stat().st_mode) == 0o640
    with Recording.open(other) as recording:
        np.testing.assert_array_equal(recording.sensor("a").counts(), COUNTS)


@pytest.mark.skipif(sys.platform != "linux", reason="an open file gets a name by /proc")
def test_a_removed_recording_that_cannot_be_copied_is_said_to_be_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(source: str, _part: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source)

    monkeypatch.setattr("daq.recording.storage.names.shutil.copyfile", full)
    path = tmp_path / "r.h5"
    writer = create(path)
    path.unlink()
    with pytest.raises(RemovedError, match="cannot be written again: No space left on device"):
        writer.commit()
    writer.abandon()
    assert not path.exists()


@pytest.mark.skipif(sys.platform != "linux", reason="an open file gets a name by /proc")
@pytest.mark.parametrize("with_journal", [True, False])
def test_what_was_safe_in_a_removed_recording_stays(tmp_path: Path, *, with_journal: bool) -> None:
    """It was moved to another disk, and the copy there lacks what came meanwhile."""
    path = tmp_path / "folder" / "r.h5"
    writer = create(path)
    writer.append(Block("a", 0, COUNTS[:100], NOW))
    writer.commit()
    recording = Recording.open(path)
    path.unlink()
    if with_journal:
        journal_path(path).unlink()
    writer.append(Block("a", 100, COUNTS[100:], NOW))
    with pytest.raises(DiskError, match=r"lost its name .*; .* is in r\.h5"):
        writer.commit()
    remote = _RemoteRecorder(recording, Event(), 1.0)
    before = remote.ended  # when the recorder has not gone on in another file yet
    writer.abandon()
    assert (before, remote.ended) == (False, True)
    recording.close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with path.open("r+b") as torn:  # by a power cut: the journal is needed
        torn.write(bytes(48))
    repair(path)
    with Recording.open(path) as recording:
        assert recording.sensor("a").n_samples == 100
        np.testing.assert_array_equal(recording.sensor("a").counts(), COUNTS[:100])


@pytest.mark.skipif(sys.platform != "linux", reason="an open file gets a name by /proc")
def test_a_recording_that_is_renamed_loses_nothing(tmp_path: Path) -> None:
    path, other = tmp_path / "folder" / "r.h5", tmp_path / "other.h5"
    writer = create(path)
    writer.append(Block("a", 0, COUNTS[:100], NOW))
    writer.commit()
    path.rename(other)
    writer.append(Block("a", 100, COUNTS[100:], NOW))
    with ThreadPoolExecutor(1) as follower, Recording.open(other) as recording:
        recording.path = path
        has_ended = follower.submit(lambda: _RemoteRecorder(recording, Event(), 1.0).ended)
        writer.commit()
        assert not has_ended.result()
    assert is_being_written(path)
    assert path.samefile(other)
    path.parent.rename(tmp_path / "moved")  # with its journal
    writer.commit()
    assert journal_path(path).exists()
    path.rename(tmp_path / "again.h5")
    writer.close()
    assert not journal_path(path).exists()
    for name in (path, other):
        assert verify(name).closed
        with Recording.open(name) as recording:
            np.testing.assert_array_equal(recording.sensor("a").counts(), COUNTS)


def test_a_recording_is_readable_only_by_its_owner(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    writer = create(path)
    writer.append(Block("a", 0, COUNTS, NOW))
    writer.commit()
    for file in (path, journal_path(path)):
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
    writer.abandon()
    repair(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    path.chmod(0o640)
    assert not journal_path(path).exists()


def test_a_file_marked_closed_that_does_not_open_is_repaired(tmp_path: Path) -> None:
    """The power failed between the last commit and the end of the close."""
    path = tmp_path / "r.h5"
    record(path)
    head = bytearray(Superblock.of(path).head)
    head[11] = 5  # open for SWMR writing
    head[44:48] = lookup3(bytes(head[:44])).to_bytes(4, "little")
    with path.open("r+b") as raw:
        raw.write(head)
    with pytest.raises(OSError, match="already open"):
        h5py.File(path, "r", locking=False)
    with Recording.open(path) as recording:
        assert recording.closed
    assert repair(path).intact
    with h5py.File(path, "r") as file:
        np.testing.assert_array_equal(file["sensors/a/samples"][:], COUNTS)


def test_a_closed_recording_leaves_no_journal(tmp_path: Path) -> None:
    record(tmp_path / "r.h5")
    assert [entry.name for entry in tmp_path.iterdir()] == ["r.h5"]


def test_many_who_look_at_once_see_no_writer(tmp_path: Path) -> None:
    path = tmp_path / "closed.h5"
    path.touch()
    with ThreadPoolExecutor(16) as some:
        assert not any(some.map(is_being_written, [path] * 2000))


# --- a disk that refuses ---------------------------------------------------------------------


@pytest.mark.parametrize("n_failures", [0, 1, len(PAUSES)])
def test_a_write_is_repeated_until_it_succeeds(
    n_failures: int, caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[str] = []

    def write() -> None:
        calls.append("write")
        if calls.count("write") <= n_failures:
            raise OSError(28, "No space left on device")

    slept: list[float] = []
    repeated(write, before=lambda: calls.append("before"), sleep=slept.append)
    assert calls == ["write"] + ["before", "write"] * n_failures
    assert slept == list(PAUSES[:n_failures])
    said = "a write to the recording failed and is repeated: No space left on device"
    assert caplog.messages == [said] * n_failures


def test_a_persistent_error_is_raised() -> None:
    def write() -> None:
        raise OSError(5, "Input/output error")

    with pytest.raises(OSError, match="Input/output error"):
        repeated(write, sleep=lambda _: None)
