"""Files that are complete, proven and on the disk when they have their names."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import stat
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from daq.archive.spectra_file import Described, Origin, SpectraFile, SpectraWriter
from daq.bench.channel import Channel
from daq.recording.storage.whole_hdf5 import WholeHdf5
from daq.whole_file import RememberingFile, remove, replaced, write_whole, written
from tests.full_disk import files_limited_to

CHANNELS = tuple(("A", Channel(name=name, sensitivity=1.0)) for name in "abcdef")


def names_in(folder: Path) -> list[str]:
    return sorted(each.name for each in folder.iterdir())


def test_a_file_replaces_an_earlier_one_and_keeps_its_permissions(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    write_whole(path, b"one")
    path.chmod(0o666)  # more than the process gives to new files
    link = tmp_path / "link"
    link.symlink_to(path)
    write_whole(link, b"two")
    assert link.is_symlink()
    assert path.read_bytes() == b"two"
    assert stat.S_IMODE(path.stat().st_mode) == 0o666
    assert names_in(tmp_path) == ["link", "r.json"]


def test_a_file_is_synced_before_it_replaces_another_and_its_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, synced, sync = tmp_path / "r.json", [], os.fsync
    write_whole(path, b"one")

    def seen(descriptor: int) -> None:
        synced.append((stat.S_ISDIR(os.fstat(descriptor).st_mode), path.read_bytes()))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", seen)
    write_whole(path, b"two")
    assert synced == [(False, b"one"), (True, b"two")]


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize(
    ("code", "is_refused"), [(errno.EIO, True), (errno.EINVAL, False), (errno.EACCES, False)]
)
def test_a_folder_that_cannot_be_synced_is_an_error_where_the_disk_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, code: int, is_refused: bool, free: bool
) -> None:
    """Not where a file system cannot sync folders; a name that was to be free is free again."""
    sync = os.fsync

    def fails(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(code, "of the test")
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", fails)
    path = tmp_path / "r.json"
    with pytest.raises(OSError, match="of the test") if is_refused else contextlib.nullcontext():
        write_whole(path, b"one", free=free)
    assert names_in(tmp_path) == ([] if is_refused and free else ["r.json"])


def test_a_file_that_the_disk_refuses_leaves_the_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    write_whole(path, b"one")
    with files_limited_to(1000), pytest.raises(OSError, match="File too large") as refused:
        write_whole(path, bytes(100_000))
    assert refused.value.filename == str(path)
    assert path.read_bytes() == b"one"
    assert names_in(tmp_path) == ["r.json"]


def test_a_name_that_must_be_free_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "key"
    write_whole(path, b"one", mode=0o600, free=True)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with pytest.raises(FileExistsError):
        write_whole(path, b"two", free=True)
    assert path.read_bytes() == b"one"

    def refused(*_: Path) -> None:
        raise OSError(errno.EPERM, "no hard links here")

    monkeypatch.setattr(os, "link", refused)
    write_whole(tmp_path / "other", b"two", free=True)
    assert (tmp_path / "other").read_bytes() == b"two"
    with pytest.raises(FileExistsError):
        write_whole(path, b"two", free=True)
    assert path.read_bytes() == b"one"
    assert names_in(tmp_path) == ["key", "other"]


def test_other_bytes_on_the_disk_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"

    def write_changed() -> None:
        with written(path) as write:
            write(bytes(100_000))  # more than is buffered
            with next(tmp_path.glob(".r.csv.*")).open("r+b") as part:
                part.write(b"1")

    with pytest.raises(OSError, match="other content than was written"):
        write_changed()
    assert names_in(tmp_path) == []


def test_leftovers_of_killed_processes_are_removed_after_a_day(tmp_path: Path) -> None:
    old, new = tmp_path / ".r.csv.1.part", tmp_path / ".r.csv.2.part"
    for each in (old, new):
        each.write_bytes(b"")
    os.utime(old, (1.0, 1.0))
    write_whole(tmp_path / "r.csv", b"")
    assert names_in(tmp_path) == [".r.csv.2.part", "r.csv"]


def test_a_folder_into_which_a_thread_still_writes_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zarr's threads go on after one has failed, and left a hidden folder."""
    part, late, rmdir = tmp_path / ".e.zarr.part", ["chunk"], os.rmdir
    part.mkdir()

    def write_late(*args: Any, **names: Any) -> None:  # noqa: ANN401
        while late:
            (part / late.pop()).write_bytes(b"")
        rmdir(*args, **names)

    monkeypatch.setattr(os, "rmdir", write_late)
    remove(part)
    assert not late
    assert not part.exists()


def test_a_write_that_fails_once_is_remembered(tmp_path: Path) -> None:
    """HDF5 goes on with what it has written, as if the disk had it."""
    with RememberingFile(tmp_path / "f", "x+") as file:
        file.truncate(70)
        file.write(b"a" * 60)
        assert os.fstat(file.fileno()).st_size == 70
        with files_limited_to(100):
            assert file.write(b"b" * 1000) == 1000
        assert file.tell() == 1060
        assert file.truncate(5) == 5
        file.write(b"later")
        assert file.seek(0, io.SEEK_END) == 1065
        for at, expected in (
            (1055, b"b" * 5 + b"later" + bytes(10)), (55, b"a" * 5 + b"b" * 5), (50, b"a" * 10)
        ):  # fmt: skip
            buffer = bytearray(len(expected))
            file.seek(at - 1065, io.SEEK_END)
            assert file.readinto(buffer) == len(expected)
            assert buffer == expected
            assert file.tell() == at + len(expected)
        with pytest.raises(OSError, match="File too large"):
            file.check()
    assert (tmp_path / "f").stat().st_size <= 100


@pytest.mark.parametrize("limit", [100, 3000, 20_000, 60_000])
def test_hdf5_that_the_disk_refuses_raises_one_error(tmp_path: Path, limit: int) -> None:
    """Also where only closing writes; HDF5's own driver then prints, or crashes."""
    path = tmp_path / "r.h5"
    values = np.random.default_rng(1).normal(size=(10, 1000))

    def fill() -> None:
        with replaced(path) as part, WholeHdf5(part) as hdf5:
            for name in "abc":
                hdf5.create(name, values, chunks=(1, 1000), fletcher32=True)

    with files_limited_to(limit), pytest.raises(OSError, match="File too large") as refused:
        fill()
    assert (refused.value.errno, refused.value.filename) == (errno.EFBIG, str(path))
    assert names_in(tmp_path) == []
    fill()
    with h5py.File(path) as file:
        assert np.array_equal(file["c"], values)


@pytest.mark.parametrize("limit", [100, 10_000, 100_000, 200_000])
def test_spectra_that_the_disk_refuses_are_not_kept(tmp_path: Path, limit: int) -> None:
    path = tmp_path / "r.h5"
    csm = np.full((51, 6, 6), 1.0 + 0j)

    def fill() -> None:
        with SpectraWriter(path, n_freqs=51, n_channels=6) as writer:
            for row in range(16):
                writer.append(row, 1, csm)
            writer.commit(
                Described(Origin("r", "r.h5", 1, 1, 1, closed=True), CHANNELS, 1.0, 1.0), ()
            )

    with files_limited_to(limit), pytest.raises(OSError, match="File too large") as refused:
        fill()
    assert refused.value.filename == str(path)
    assert names_in(tmp_path) == []
    fill()
    with SpectraFile(path) as file:
        assert len(file.stretches) == 16


@pytest.mark.parametrize("lost", ["a chunk", "a row", "all of it"])
def test_hdf5_with_other_contents_than_in_memory_is_refused(tmp_path: Path, lost: str) -> None:
    path = tmp_path / "r.h5"
    values = np.ones((4, 100))

    def fill() -> None:
        with replaced(path) as part, WholeHdf5(part) as hdf5:
            made = hdf5.create("a", values, chunks=(1, 100))
            if lost == "a chunk":
                made[2] = 0.0
            elif lost == "a row":
                made.resize(3, axis=0)
            else:
                del hdf5.file["a"]

    with pytest.raises(OSError, match="other content than was written"):
        fill()
    assert names_in(tmp_path) == []
