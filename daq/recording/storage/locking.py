"""Marks a recording as being written.

HDF5 releases its own lock when a writer switches to SWMR. So the writer holds a shared ``flock``:
our readers take no lock, other readers a shared one, and programs that open the file for writing,
plain h5py included, are refused. The lock ends with the process, however the process ends.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if sys.platform != "win32":
    import fcntl

if TYPE_CHECKING:
    from pathlib import Path


IS_SEEN: bool = sys.platform != "win32"
"""Whether `is_being_written` can tell: on Windows there is no lock beyond HDF5's own."""


class WriterLock:
    """A shared lock on a file, held until released."""

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_RDONLY)
        if sys.platform != "win32":
            fcntl.flock(self._handle, fcntl.LOCK_SH)

    def release(self) -> None:
        """Release the lock; may be called again."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


def is_being_written(path: Path) -> bool:
    """Return whether a living process is writing this recording."""
    if sys.platform == "win32":  # no protection beyond HDF5's own
        return False
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False
