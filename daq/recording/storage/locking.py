"""Lock that marks a recording as being written.

HDF5 releases its own lock when a writer switches to SWMR. So the writer holds a shared ``flock``:
huddle's readers take no lock, other readers a shared one, and programs that open the file for
writing, including plain h5py, are refused. The system releases the lock when the process ends.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

if sys.platform != "win32":
    import fcntl

_looking = threading.Lock()
_WAITS = 0.0, 0.0005, 0.002  # s: a fork lasts less, and a loop that asks waits no longer
LOCKS_ARE_VISIBLE: bool = sys.platform != "win32"
"""Whether `is_being_written` works: Windows has only HDF5's own lock."""


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
    """Return whether a running process is writing this recording.

    Who looks holds a lock for a moment, as does a process that forks meanwhile: one who looks at
    the same time looks again.
    """
    if sys.platform == "win32":  # only HDF5's own lock
        return False
    for wait in _WAITS:
        time.sleep(wait)
        with _looking:
            if not _is_locked(path):
                return False
    return True


def _is_locked(path: Path) -> bool:
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False
