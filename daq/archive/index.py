"""What the files of recordings say, in a database, so that an answer need not open them all."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from daq.archive.documents import Documents
from daq.archive.rollup import month_of
from daq.archive.spectra_file import Described, SpectraFile
from daq.bench.channel import Channel
from daq.recording.file_format import channel_attributes, channels_of, plain

FILE = "index.sqlite"
ROLLUP = "rollup-"
"""Names of files of years begin with this (`daq.archive.answers`)."""
_OWN = ("start_utc_ns", "n_segments", "months", "daily", "single")
"""Attributes of an entry beside what describes its file."""


@dataclass(frozen=True, slots=True)
class IndexEntry:
    """One recording of an archive: its file, and what that says."""

    path: Path
    described: Described
    start_utc_ns: int | None
    """Of its first stretch; None without one."""
    n_segments: int
    months: Mapping[str, str]
    """Months of UTC with stretches, each with the hash of what the recording gives to it."""
    daily: bool
    """Whether its matrices have become those of days."""
    single: bool
    """Whether these are in single precision."""

    @property
    def order(self) -> tuple[bool, int, str]:
        """Sort key: by time, then by run; without a stretch first."""
        start = self.start_utc_ns
        return start is not None, start or 0, self.described.origin.run_id

    @classmethod
    def of(cls, file: SpectraFile) -> Self:
        """Return what a file says."""
        starts = file.stretches["start_utc_ns"].tolist()
        months: Mapping[str, str] = file.months
        if starts and not months:  # format version 1
            about = file.path.stat()
            months = {month_of(s): f"{about.st_size} {about.st_mtime_ns}" for s in starts}
        n_segments = int(file.stretches["n_segments"].sum())
        start = starts[0] if starts else None
        return cls(
            file.path, file.described, start, n_segments, months, file.is_daily, file.is_single
        )


class Index:
    """The database of an archive (`daq.archive.documents`); a context manager.

    Parameters
    ----------
    folder : Path
        Of the archive.
    """

    def __init__(self, folder: Path) -> None:
        self._prefix = f"{folder}{os.sep}"
        self._documents = Documents(folder / FILE)
        self._channels: dict[str, tuple[tuple[str, Channel], ...]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._documents.save()

    def get(self, path: Path) -> IndexEntry | None:
        """Return a file's entry; None if it is not known, or has changed."""
        try:
            about = path.stat()
            state = about.st_size, about.st_mtime_ns
            found: dict[str, Any] | None = self._documents.get(self._name(path), state)
            if found is None:
                return None
            described = Described.of(found, self._channels_of(found["channels"]))
            return IndexEntry(path, described, **{name: found[name] for name in _OWN})
        except (OSError, AttributeError, KeyError, ValueError, TypeError):
            return None

    def put(self, entry: IndexEntry) -> None:
        """Keep an entry."""
        described, about = entry.described, entry.path.stat()
        channels = [
            (sensor, {k: plain(v) for k, v in channel_attributes([channel]).items()})
            for sensor, channel in described.channels
        ]
        key = hashlib.sha256(json.dumps(channels).encode()).hexdigest()
        self._documents.put(key, channels)
        own = {name: getattr(entry, name) for name in _OWN}
        document = described.document | own | {"channels": key}
        state = about.st_size, about.st_mtime_ns
        self._documents.put(self._name(entry.path), document, state)

    def _channels_of(self, key: str) -> tuple[tuple[str, Channel], ...]:
        """Return channels, which most recordings have in common."""
        if key not in self._channels:
            found = self._documents.get(key)
            self._channels[key] = tuple((str(s), channels_of(channel)[0]) for s, channel in found)
        return self._channels[key]

    def _name(self, path: Path) -> str:
        """Return the key of a file: its path in the folder."""
        return str(path).removeprefix(self._prefix)
