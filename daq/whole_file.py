"""Files that are complete, proven and on the disk when they have their names.

Results, archives, exports, reports and certificates are written under a hidden name in the folder
of the file. What the disk then has is compared with what was in memory, file and folder are synced,
and the file gets its name. If any of it fails, an earlier file of this name stays, and the error
names the file.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import io
import os
import shutil
import stat
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

PRIVATE = 0o600
"""Permissions of what only its owner may read, such as recordings and keys."""
_PUBLIC = 0o666
_SUFFIX = ".part"
_REMOVALS, _PAUSE = 10, 0.05  # times that a folder is emptied, and seconds between
_STALE_SECONDS = 86400.0
"""Age in s from which a hidden file is a leftover of a process that was killed."""
_NO_HARD_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EINVAL}
_NO_FOLDER_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM}
"""Errors of file systems that cannot sync folders, and of folders that cannot be read."""


def hidden(path: Path) -> Path:
    """Return an unused hidden name beside a file."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}{_SUFFIX}")


def put_in_place(part: Path, path: Path, *, free: bool = False) -> None:
    """Give a complete file or folder its name, durably; it takes the permissions of a former one.

    Raises
    ------
    FileExistsError
        If the name must be `free` and is not.
    OSError
        If it cannot be synced or renamed.
    """
    if path.is_file():
        shutil.copymode(path, part)
    for each in part.rglob("*") if part.is_dir() else (part,):
        if each.is_file():
            sync_file(each)
        else:
            sync_directory(each)
    if not free:
        part.replace(path)
        sync_directory(path.parent)
        return
    take_name(part, path)
    try:
        sync_directory(path.parent)
    except OSError:
        remove(path)  # or the name would be taken when this is tried again
        raise


def take_name(part: Path, path: Path) -> None:
    """Rename a file to a name that must be free.

    Raises
    ------
    FileExistsError
        If a file has this name.
    """
    try:
        os.link(part, path)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        create_private(path)  # takes the name on a file system without hard links
        part.replace(path)
    else:
        part.unlink()


def remove(part: Path) -> None:
    """Remove what is left of a hidden file or folder, if it can be removed.

    Threads of Zarr go on writing into a folder after one has failed: it is emptied again.
    """
    for _ in range(_REMOVALS if part.is_dir() else 0):
        shutil.rmtree(part, ignore_errors=True)
        if not part.exists():
            return
        time.sleep(_PAUSE)
    with contextlib.suppress(OSError):
        part.unlink()


def remove_parts(folder: Path, name: str, *, age: float = 0.0) -> None:
    """Remove hidden files of killed processes, of this age in s, whose names begin with `name`."""
    for leftover in folder.glob(f".{glob.escape(name)}.*{_SUFFIX}"):
        with contextlib.suppress(OSError):
            if time.time() - leftover.stat().st_mtime >= age:
                remove(leftover)


@contextlib.contextmanager
def replaced(path: Path, *, free: bool = False) -> Iterator[Path]:
    """Yield a hidden name; the file or folder that is written there then takes the name `path`.

    A link stays a link: the file to which it leads is replaced.

    Raises
    ------
    FileExistsError
        If the name must be `free` and is not.
    OSError
        With the name of the file. The earlier file is as it was, unless only the folder's fsync
        failed.
    """
    path = path.resolve()
    part = hidden(path)
    remove_parts(path.parent, path.name, age=_STALE_SECONDS)
    try:
        yield part
        put_in_place(part, path, free=free)
    except OSError as error:
        if error.errno is not None and error.filename in {None, part, str(part)}:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        remove(part)


@contextlib.contextmanager
def written(
    path: Path, *, mode: int = _PUBLIC, free: bool = False
) -> Iterator[Callable[[bytes], object]]:
    """Yield what adds bytes to a file, which then replaces an earlier one.

    Errors of the disk are raised at the end: some libraries lose those of single writes.

    Parameters
    ----------
    path : Path
    mode : int
        Permissions of a new file, less those that the process withholds.
    free : bool
        Whether no file may have the name.

    Raises
    ------
    OSError
        If it cannot be written, or the disk has other bytes than were written.
    """
    import hashlib  # noqa: PLC0415 - takes 3 ms, and most commands write no file

    if path.is_file():
        mode = stat.S_IMODE(path.stat().st_mode)
    with replaced(path, free=free) as part:
        digest = hashlib.sha256()
        file = RememberingFile(part, "x", mode)
        with io.BufferedWriter(file) as buffered:

            def write(content: bytes) -> None:
                digest.update(content)
                buffered.write(content)

            yield write
        file.check()
        with part.open("rb") as disk:
            if hashlib.file_digest(disk, "sha256").digest() != digest.digest():
                raise wrong_content(path)


def write_whole(path: Path, content: bytes, *, mode: int = _PUBLIC, free: bool = False) -> None:
    """Write a file as `written` does."""
    with written(path, mode=mode, free=free) as write:
        write(content)


def wrong_content(path: Path) -> OSError:
    """Return the error for a disk that returns something else than was written."""
    return OSError(errno.EIO, "the disk returns other content than was written", str(path))


class RememberingFile(io.FileIO):
    """A file for HDF5, whose first failed write is remembered and not reported.

    HDF5 writes some chunks when it frees objects, where nothing can be raised, and can crash after
    a write that failed. So after a failure all writes appear to succeed; `check` raises it. What is
    written then is kept in memory: HDF5 can go around in a circle in what it did not write.
    """

    def __init__(self, path: Path, mode: str, permissions: int = _PUBLIC) -> None:
        super().__init__(path, mode, opener=lambda name, flags: os.open(name, flags, permissions))
        self._failure: OSError | None = None
        self._kept: list[tuple[int, bytes]] = []

    def write(self, content: Any, /) -> int:  # noqa: ANN401 - any buffer
        """Write all of the content."""
        view = memoryview(content).cast("B")
        at = self.tell()
        done = 0
        while done < len(view) and self._failure is None:
            with self._remembered():
                done += super().write(view[done:]) or 0
        if self._failure is not None:
            self._kept.append((at, bytes(view)))
            self.seek(at + len(view))
        return len(view)

    def readinto(self, buffer: Any, /) -> int:  # noqa: ANN401 - any buffer
        """Read what was written, whether the disk has it or not."""
        if self._failure is None:
            return super().readinto(buffer) or 0
        view = memoryview(buffer).cast("B")
        at, n_read = self.tell(), super().readinto(view) or 0
        view[n_read:] = bytes(len(view) - n_read)
        for begin, content in self._kept:
            first, last = max(at, begin), min(at + len(view), begin + len(content))
            if first < last:
                view[first - at : last - at] = content[first - begin : last - begin]
        self.seek(at + len(view))
        return len(view)

    def seek(self, offset: int, whence: int = 0, /) -> int:
        """Go to a place; the end is behind all that was written."""
        if whence == io.SEEK_END and self._kept:
            end = max(begin + len(content) for begin, content in self._kept)
            return super().seek(max(end, super().seek(0, io.SEEK_END)) + offset)
        return super().seek(offset, whence)

    def truncate(self, size: int | None = None) -> int:
        """Set the size of the file."""
        if self._failure is None:
            with self._remembered():
                return super().truncate(size)
        return self.tell() if size is None else size

    def check(self) -> None:
        """Raise the first failure, if there was one."""
        if self._failure is not None:
            raise self._failure

    @contextlib.contextmanager
    def _remembered(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._failure = error


def create_private(path: Path) -> None:
    """Create an empty file that only its owner can read.

    Raises
    ------
    FileExistsError
        If the file exists.
    """
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, PRIVATE))


def sync_file(path: Path) -> None:
    """Make the contents of a closed file durable over a power loss."""
    # Windows syncs only files open for writing; elsewhere a file may be read-only
    _sync(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)


def sync_directory(path: Path) -> None:
    """Make the names in a directory durable over a power loss (not possible on Windows)."""
    if sys.platform == "win32":
        return
    try:
        _sync(path, os.O_RDONLY)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise


def _sync(path: Path, flags: int) -> None:
    handle = os.open(path, flags)
    try:
        os.fsync(handle)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error  # which it lacks
    finally:
        os.close(handle)
