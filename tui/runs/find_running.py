"""Finds the recording that a running recorder of a bench is writing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.errors import HuddleError, RecordingError
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.recording.storage.names import continuations, continued_name

if TYPE_CHECKING:
    from pathlib import Path

    from daq.bench.model import Bench

LATEST = 3
"""How many of the newest recordings are looked at."""


def running_recording(bench: Bench) -> Path | None:
    """Return the newest recording of this bench whose recorder answers: the first of its parts."""
    folder = bench.recording_directory
    if not folder.is_dir():
        return None
    files = sorted(folder.glob("*.h5"), key=lambda path: path.stat().st_mtime, reverse=True)
    return next((first_part(path) for path in files[:LATEST] if _runs(path, bench.name)), None)


def first_part(path: Path) -> Path:
    """Return the first of the recordings that this one continues after disk errors.

    Itself, if it continues none, or if the one that it continues is no longer in its folder.
    """
    with Recording.open(path) as recording:
        continues = recording.continues
    start = continued_name(path)
    if not continues or start is None:
        return path
    parts = dict(_part(name) for name in (start, *continuations(start)) if name != path)
    first = path
    while continues in parts:
        first, continues = parts.pop(continues)
    return first


def _part(path: Path) -> tuple[str, tuple[Path, str]]:
    """Return the run_id of a recording, with its path and the run_id that it continues."""
    try:
        with Recording.open(path) as recording:
            return recording.run_id, (path, recording.continues)
    except RecordingError:  # there is none, or another file has such a name
        return "", (path, "")


def _runs(path: Path, name: str) -> bool:
    try:
        with Recording.open(path) as recording:
            if recording.closed or recording.bench is None or recording.bench.name != name:
                return False
        ask(path, "status")
    except HuddleError:
        return False
    return True
