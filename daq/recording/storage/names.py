"""Names and permissions of recordings: exclusive, and durable over power cuts."""

from __future__ import annotations

import contextlib
import glob
import itertools
import os
import re
import shutil
import stat
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from daq.errors import RecordingError
from daq.recording.storage.locking import is_being_written
from daq.whole_file import create_private, replaced, take_name

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.protocols.block import HostTime

CONTINUES = "continues"
"""Attribute of a recording that continues another after a disk error: the run_id of the other."""
_STALE_SECONDS = 10.0
"""Age in s from which a temporary file without a lock is a leftover. A writer locks its file within
a millisecond; ten seconds allow for a computer that is suspended or overloaded in between."""


def publish(temporary: Path, path: Path) -> None:
    """Rename a file to its final name, which must be free.

    Raises
    ------
    RecordingError
        If a file with this name exists.
    """
    try:
        take_name(temporary, path)
    except FileExistsError:
        raise taken(path) from None


def give_back(path: Path, handle: int) -> Path:
    """Give an open file the name that it had: it, or its folder, was renamed or removed (Linux).

    Another name stays. What a file without any name has is copied, and the open file stays
    nameless; where another file has the name, the copy gets that of a continuation. Return the
    name.

    Raises
    ------
    OSError, NotImplementedError
        If the system or the disk cannot.
    """
    source, found = f"/proc/self/fd/{handle}", os.fstat(handle)
    path.parent.mkdir(parents=True, exist_ok=True)
    if found.st_nlink:  # the link is followed to the open file only with a folder's descriptor
        os.link(source, path, src_dir_fd=handle, follow_symlinks=True)
        return path
    if os.path.lexists(path):
        path = next(each for each in continuation_names(path) if not os.path.lexists(each))
    with replaced(path, free=True) as part:
        create_private(part)
        shutil.copyfile(source, part)
        part.chmod(stat.S_IMODE(found.st_mode))
    return path


def taken(path: Path) -> RecordingError:
    """Return the error for a name that is not free."""
    return RecordingError(f"{path}: exists already; expected a new file")


def continuation_names(path: Path) -> Iterator[Path]:
    """Yield the possible names of continuations of a recording, in order."""
    return (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))


def continuations(path: Path) -> list[Path]:
    """Return the files that have names of continuations of a recording, in any order."""
    named = path.parent.glob(f"{glob.escape(path.stem)}-*{glob.escape(path.suffix)}")
    return [each for each in named if continued_name(each) == path]


def continued_name(path: Path) -> Path | None:
    """Return the name of which `continuation_names` yields this one, or None if of no name."""
    stem, _, number = path.stem.rpartition("-")
    is_continuation = stem and re.fullmatch("[1-9][0-9]*", number) and int(number) > 1
    return path.with_stem(stem) if is_continuation else None


def remove_leftovers(path: Path) -> None:
    """Remove temporary files left by killed writers of this recording."""
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.*new"):
        with contextlib.suppress(OSError):
            age = time.time() - leftover.stat().st_mtime
            if age > _STALE_SECONDS and not is_being_written(leftover):
                leftover.unlink()


def recording_path(bench: Bench, at: HostTime) -> Path:
    """Return the default path of a recording that starts at this instant."""
    name = re.sub(r"[^\w.-]+", "-", bench.name).strip("-.") or "recording"
    utc = datetime.fromtimestamp(at.utc_ns / 1e9, tz=UTC)
    return bench.recording_directory / f"{name}-{utc:%Y%m%dT%H%M%SZ}.h5"
