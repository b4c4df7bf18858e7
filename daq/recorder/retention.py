"""Removes recordings with their files."""

from __future__ import annotations

from pathlib import Path

from daq.recording.storage.journal import journal_path

RUN_SUFFIXES = (".json", ".csv", ".csv-metadata.json", ".html", ".pdf", ".sig", ".extremes")
"""Suffixes of the other files of a recording, which are also removed."""


def remove_run(path: Path) -> None:
    """Remove the files of a recording, then the recording: after an error it leads to the rest.

    Raises
    ------
    OSError
        If a file cannot be removed.
    """
    for other in (journal_path(path), *(path.with_suffix(suffix) for suffix in RUN_SUFFIXES)):
        other.unlink(missing_ok=True)
    path.unlink(missing_ok=True)
