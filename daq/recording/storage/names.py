"""Names and permissions of recordings: taken exclusively, and made to survive a power cut."""

from __future__ import annotations

import contextlib
import errno
import glob
import itertools
import os
import re
import sys
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from daq.errors import RecordingError
from daq.recording.storage.locking import is_being_written

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.protocols.block import HostTime

PRIVATE = 0o600
"""Permissions of a recording: whoever can read one can stop its recorder."""
CONTINUES = "continues"
"""Attribute of a recording that continues another, which the disk refused: the other's run_id."""
_STALE_SECONDS = 60.0
"""Age from which a temporary file that nobody writes is taken for a leftover."""
_NO_HARD_LINKS = {errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK, errno.EINVAL}


def create_private(path: Path) -> None:
    """Create an empty file that only its owner can read.

    Raises
    ------
    FileExistsError
        If there is one.
    """
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, PRIVATE))


def publish(temporary: Path, path: Path) -> None:
    """Give a file its name, which must be free.

    Raises
    ------
    RecordingError
        If a file has that name.
    """
    try:
        _take_name(temporary, path)
    except FileExistsError:
        raise taken(path) from None


def _take_name(temporary: Path, path: Path) -> None:
    try:
        os.link(temporary, path)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        create_private(path)  # takes the name on a file system without hard links
        temporary.replace(path)
    else:
        temporary.unlink()


def taken(path: Path) -> RecordingError:
    """Return the error that a recording has this name already."""
    return RecordingError(f"{path}: exists already; expected a new file")


def continuation_names(path: Path) -> Iterator[Path]:
    """Yield the names that continuations of a recording may have, in their order."""
    return (path.with_stem(f"{path.stem}-{number}") for number in itertools.count(2))


def remove_leftovers(path: Path) -> None:
    """Remove what killed writers of this recording have left under temporary names."""
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.*new"):
        with contextlib.suppress(OSError):
            age = time.time() - leftover.stat().st_mtime
            if age > _STALE_SECONDS and not is_being_written(leftover):
                leftover.unlink()


def sync_file(path: Path) -> None:
    """Make the contents of a closed file survive a power loss."""
    handle = os.open(path, os.O_RDWR)  # Windows syncs only what may be written
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_directory(path: Path) -> None:
    """Make the names in a directory survive a power loss (not possible on Windows)."""
    if sys.platform == "win32":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def recording_path(bench: Bench, at: HostTime) -> Path:
    """Return the default path of a recording that starts at this instant."""
    name = re.sub(r"[^\w.-]+", "-", bench.name).strip("-.") or "recording"
    utc = datetime.fromtimestamp(at.utc_ns / 1e9, tz=UTC)
    return bench.recording_directory / f"{name}-{utc:%Y%m%dT%H%M%SZ}.h5"
