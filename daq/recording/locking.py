"""Says to others that a recording is being written.

HDF5's own lock goes when a writer turns to SWMR, so the writer holds a shared ``flock`` of its own:
our readers take none, and other readers a shared one; but whoever opens the file for writing,
plain h5py included, is refused. The lock goes with the process, however that ends.
"""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

if sys.platform != "win32":
    import fcntl

if TYPE_CHECKING:
    from pathlib import Path


class WriterLock:
    """A shared lock on a file, held until released."""

    def __init__(self, path: Path) -> None:
        self._handle = os.open(path, os.O_RDONLY)
        if sys.platform != "win32":
            fcntl.flock(self._handle, fcntl.LOCK_SH)

    def release(self) -> None:
        """Let go; more than once is fine."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


def is_being_written(path: Path) -> bool:
    """Return whether a living process is writing this recording."""
    if sys.platform == "win32":  # No protection beyond HDF5's own.
        return False
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False
