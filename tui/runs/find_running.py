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
    """Return the newest recording of this bench whose recorder answers."""
    folder = bench.recording_directory
    if not folder.is_dir():
        return None
    files = sorted(folder.glob("*.h5"), key=lambda path: path.stat().st_mtime, reverse=True)
    return next((path for path in files[:LATEST] if _runs(path, bench.name)), None)


def _runs(path: Path, name: str) -> bool:
    try:
        with Recording.open(path) as recording:
            if recording.closed or recording.bench is None or recording.bench.name != name:
                return False
        ask(path, "status")
    except HuddleError:
        return False
    return True
