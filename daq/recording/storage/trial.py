"""Opens files first in a child process, so that a damaged one cannot hold up its reader.

Theory of operation
-------------------
HDF5 trusts what a file holds. In a damaged global heap it goes around in a circle for ever; other
damage crashes it. Neither can be caught in the process itself. So a file at rest is opened once by
a child (:mod:`daq.recording.repair`), which is ended if it makes no progress for `LIMIT`
seconds. Only if the child lives does this process open the file; errors are then its own to report.

A file is tried once. An extended attribute has the inode, the size and the time of change with
which it was opened, and a recorder sets it on the recordings that it closes. Copies and changed
files are tried again: who sends a file can send attribute and time with it, but not the inode.
Where a file system has no such attributes, each process tries a file once.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from daq.errors import NotARecordingError
from daq.python_process import python_command

LIMIT = 10.0
"""Seconds without progress after which a child is ended."""
_START = 120.0
"""Seconds that a child may need to start, on a computer with much else to do."""
_MARK = "user.huddle.opened"
_OPENED: set[tuple[int, int, int, int]] = set()
_CHILD = "daq.recording.repair"


def tried(path: Path) -> None:
    """Open a file in a child, unless it was opened before in this state.

    Raises
    ------
    NotARecordingError
        If HDF5 does not come back from the file, or crashes.
    """
    if _state(path) in _OPENED or _marked(path):
        return
    [(_, found)] = trials([path], "open")
    if found.get("fatal"):
        raise NotARecordingError(f"{path}: damaged: {found['fatal']}")
    if found.get("opened"):
        remember(path)


def remember(path: Path) -> None:
    """Note that a file in its present state can be opened: this program has just written it."""
    _OPENED.add(_state(path))
    with contextlib.suppress(OSError, AttributeError):  # read-only, or a system without it
        os.setxattr(path, _MARK, _text(path))


def trials(paths: Sequence[Path], task: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield what children found about each file; one that hangs or crashes has ``fatal``.

    Parameters
    ----------
    paths : sequence of Path
    task : str
        ``open``, ``verify``, or ``close:M:U`` with the host's time in ns, monotonic and UTC. What
        closes a file writes for an unknown time, and is not ended.
    """
    left = list(paths)
    while left:
        for found in _trials(tuple(left), task):
            yield left.pop(0), found


def _trials(paths: Sequence[Path], task: str) -> Iterator[dict[str, Any]]:
    """Yield what one child finds, up to the first file that ends it."""
    import selectors  # noqa: PLC0415 - most files need no child, and these take 10 ms to import
    import subprocess  # noqa: PLC0415

    command = python_command(_CHILD, task, *map(str, paths))
    with (
        subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
        ) as child,
        selectors.DefaultSelector() as ready,
    ):
        try:
            ready.register(child.stdout, selectors.EVENT_READ)  # type: ignore[arg-type]  # a pipe
            is_limited = task in {"open", "verify"}
            wait, buffered, n_found = _START if is_limited else None, b"", 0
            while ready.select(wait):
                wait = LIMIT if is_limited else None
                received = child.stdout.read(1 << 16)  # type: ignore[union-attr]  # a pipe
                if not received:
                    break
                *lines, buffered = (buffered + received).split(b"\n")
                for line in lines:
                    if line.startswith(b"{"):
                        n_found += 1
                        yield json.loads(line)
                if n_found == len(paths):  # how long it takes to end is no matter
                    return
            else:  # silence
                yield {"fatal": f"HDF5 does not come back from it within {LIMIT:g} s"}
                return
            child.wait()
        finally:
            child.kill()
    if n_found < len(paths):
        yield {"fatal": f"HDF5 crashes while it reads the file (exit code {child.returncode})"}


def _state(path: Path) -> tuple[int, int, int, int]:
    found = path.stat()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def _text(path: Path) -> bytes:
    _, *state = _state(path)
    return " ".join(map(str, state)).encode()


def _marked(path: Path) -> bool:
    with contextlib.suppress(OSError, AttributeError):
        return os.getxattr(path, _MARK) == _text(path)
    return False
