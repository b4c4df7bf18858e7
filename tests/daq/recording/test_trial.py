"""A file that holds HDF5 up for ever, or crashes it, is damaged, and others are read."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest

from daq.errors import NotARecordingError
from daq.recording.reader import Recording, control_address
from daq.recording.repair import repair, verify
from daq.recording.storage import trial
from tests.daq.recording.version_1 import with_heap_loop
from tests.torture.damaged_files import make_recording, write_recording
from tests.waiting import limit

pytestmark = pytest.mark.trial


@pytest.fixture
def loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a recording at which HDF5 hangs; the limit is shorter than in life."""
    monkeypatch.setattr(trial, "LIMIT", limit(0.5))
    path = tmp_path / "loop.h5"
    make_recording(path)
    with_heap_loop(path)
    return path


@pytest.mark.parametrize("read", [Recording.open, verify, repair, control_address])
def test_a_loop_in_the_heap_is_damage(loop: Path, read: object) -> None:
    with pytest.raises(NotARecordingError, match="damaged: HDF5 does not come back from it"):
        read(loop)  # type: ignore[operator]  # of several types


def test_the_files_after_one_that_hangs_are_verified(loop: Path, tmp_path: Path) -> None:
    good, lost = tmp_path / "good.h5", tmp_path / "lost.h5"
    make_recording(good)
    found = dict(trial.trials([loop, good, lost], "verify"))
    assert list(found) == [loop, good, lost]
    assert "does not come back" in found[loop]["fatal"]
    assert found[good]["intact"]
    assert found[good]["root_sha256"] == verify(good).root_sha256
    assert "cannot be read" in found[lost]["error"]


def test_a_child_that_is_slow_to_end_says_nothing_of_further_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = "import signal; print('{}', flush=True); signal.pause()"
    monkeypatch.setattr(trial, "LIMIT", limit(0.1))
    monkeypatch.setattr(trial, "python_command", lambda *_: [sys.executable, "-S", "-c", program])
    assert list(trial.trials([tmp_path / "a.h5"], "open")) == [(tmp_path / "a.h5", {})]


def test_a_file_that_crashes_the_child_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [tmp_path / "a.h5", tmp_path / "b.h5"]
    for path in files:
        make_recording(path)
    monkeypatch.setattr(trial, "_CHILD", "no.such.module")  # ends with exit code 1
    found = dict(trial.trials(files, "open"))
    assert all("crashes" in each["fatal"] for each in found.values())
    assert len(found) == 2


def test_a_torn_recording_without_its_journal_that_crashes_hdf5_stays_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "torn.h5"
    write_recording(path)
    before = bytearray(path.read_bytes())
    before[11] = 5  # the superblock's flags of a writer
    path.write_bytes(before)
    monkeypatch.setattr(trial, "_CHILD", "no.such.module")
    with pytest.raises(NotARecordingError, match=r"HDF5 crashes .*Put torn.h5.journal"):
        repair(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_is_tried_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, copy = tmp_path / "a.h5", tmp_path / "b.h5"
    write_recording(path)
    shutil.copyfile(path, copy)
    Recording.open(copy).close()
    monkeypatch.setattr(trial, "_CHILD", "no.such.module")
    Recording.open(path).close()  # written by this program
    Recording.open(copy).close()  # opened before
    os.utime(copy, ns=(1, 1))
    with pytest.raises(NotARecordingError, match="crashes"):
        Recording.open(copy)


@pytest.mark.skipif(not hasattr(os, "setxattr"), reason="no extended attributes")
def test_a_mark_that_came_with_a_file_is_not_believed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marks: dict[Path, bytes] = {}
    monkeypatch.setattr(os, "setxattr", lambda path, _, text: marks.update({path: text}))
    monkeypatch.setattr(os, "getxattr", lambda path, _: marks[path])
    path, copy = tmp_path / "a.h5", tmp_path / "b.h5"
    write_recording(path)
    trial.remember(path)
    shutil.copy2(path, copy)
    marks[copy] = marks[path]
    monkeypatch.setattr(trial, "_OPENED", set())
    monkeypatch.setattr(trial, "_CHILD", "no.such.module")
    Recording.open(path).close()
    with pytest.raises(NotARecordingError, match="crashes"):
        Recording.open(copy)


@pytest.mark.skipif(not hasattr(os, "setxattr"), reason="no extended attributes")
def test_another_process_knows_that_a_file_was_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.h5"
    make_recording(path)
    if not os.listxattr(path):
        pytest.skip("this file system has no extended attributes")
    monkeypatch.setattr(trial, "_OPENED", set())  # as in another process
    monkeypatch.setattr(trial, "_CHILD", "no.such.module")
    Recording.open(path).close()
