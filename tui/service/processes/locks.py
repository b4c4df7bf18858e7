"""Locks that end with the processes that hold them, however these end.

A lock is an ``flock`` on an empty file. A child that inherits its descriptor holds it as well, so
after a crash of the service the lock tells whether a recorder of the service still runs.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from pathlib import Path

from daq.whole_file import PRIVATE

if sys.platform != "win32":
    import fcntl


class Lock:
    """A lock that this process holds, and those that inherit `descriptor`, until all have ended."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path, self.descriptor = path, descriptor

    @classmethod
    def take(cls, path: Path) -> Lock | None:
        """Take the lock; return None if somebody holds it.

        Raises
        ------
        OSError
            If the file cannot be made.
        """
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, PRIVATE)
        try:
            if sys.platform != "win32":
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except BaseException:
            os.close(descriptor)
            raise
        return cls(path, descriptor)

    def name(self, pid: int) -> None:
        """Write down the process that holds the lock from now on."""
        os.ftruncate(self.descriptor, 0)
        os.pwrite(self.descriptor, str(pid).encode(), 0)

    def release(self, *, remove: bool = False) -> None:
        """Close our descriptor, and remove the file on request; may be called again."""
        if remove:
            with contextlib.suppress(OSError):
                self.path.unlink(missing_ok=True)
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


def is_held(path: Path) -> bool:
    """Return whether a process holds a lock."""
    if not path.exists():
        return False
    lock = Lock.take(path)
    if lock is None:
        return True
    lock.release()
    return False


def kill_holder(path: Path) -> None:
    """Kill the process that is written down in a lock, if the lock is held."""
    with contextlib.suppress(OSError, ValueError):
        pid = int(path.read_bytes() or b"0")
        if pid > 1 and is_held(path):
            os.kill(pid, signal.SIGKILL if sys.platform != "win32" else signal.SIGTERM)
