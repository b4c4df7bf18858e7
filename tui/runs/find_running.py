"""Finds the recording that a running recorder of a bench is writing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.recording.control import ask
from daq.recording.reader import Recording

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
    """Return the recording that this one continues after a disk error; itself, if it does not."""
    with Recording.open(path) as recording:
        first = path.with_stem(path.stem.rpartition("-")[0])  # as in `continuation_names`
        return first if recording.continues and first.exists() else path


def _runs(path: Path, name: str) -> bool:
    try:
        with Recording.open(path) as recording:
            if recording.closed or recording.bench is None or recording.bench.name != name:
                return False
        ask(path, "status")
    except HuddleError:
        return False
    return True
