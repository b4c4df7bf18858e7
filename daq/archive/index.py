"""What the files of recordings say, in a database, so that an answer need not open them all.

Text and numbers only: nothing of it is executed. The database can be deleted at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sqlite3
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np

from daq.archive.rollup import month_of
from daq.archive.spectra_file import Described, Origin, SpectraFile
from daq.bench.channel import Channel
from daq.caveats import Caveat, Caveats
from daq.recording.file_format import channel_attributes, channels_of, texts
from estimator.checks.count_limits import CountLimits
from estimator.spectra.segment_rejection import Reason

FILE = "index.sqlite"
ROLLUP = "rollup-"
"""Names of files of years begin with this (`daq.archive.answers`)."""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS recordings
    (name TEXT PRIMARY KEY, n_bytes INTEGER, modified_ns INTEGER, document TEXT);
CREATE TABLE IF NOT EXISTS channels (key TEXT PRIMARY KEY, document TEXT);
"""
_BUSY_SECONDS = 10.0
PLAIN = ("usable", "elapsed", "residual", "rounded")
"""Fields of `Described` that a document has as they are."""


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
    """The database of an archive; a context manager.

    A damaged one is made again. Where the folder cannot be written, nothing is kept.

    Parameters
    ----------
    folder : Path
        Of the archive.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._prefix = f"{folder}{os.sep}"
        self._known: dict[str, tuple[int, int, str]] = {}
        self._channels: dict[str, tuple[tuple[str, Channel], ...]] = {}
        self._new: list[tuple[str, int, int, str]] = []
        self._texts: dict[str, str] = {}

    def __enter__(self) -> Self:
        damage = (sqlite3.Error, ValueError, TypeError, KeyError, AttributeError)
        with contextlib.suppress(*damage), self._open() as database:
            for key, text in database.execute("SELECT key, document FROM channels"):
                self._channels[key] = tuple(
                    (str(sensor), channels_of(channel)[0]) for sensor, channel in json.loads(text)
                )
            rows = database.execute("SELECT name, n_bytes, modified_ns, document FROM recordings")
            self._known = {name: (n, ns, text) for name, n, ns, text in rows}
        return self

    def __exit__(self, *_: object) -> None:
        if not self._new:
            return
        try:
            self._write()
        except sqlite3.OperationalError:
            return  # a folder that cannot be written, or another command writes
        except sqlite3.DatabaseError:
            with contextlib.suppress(OSError, sqlite3.Error):
                (self._folder / FILE).unlink(missing_ok=True)
                self._write()

    def get(self, path: Path) -> IndexEntry | None:
        """Return a file's entry; None if it is not known, or has changed."""
        try:
            about = path.stat()
            n_bytes, modified_ns, text = self._known[self._name(path)]
            if (n_bytes, modified_ns) != (about.st_size, about.st_mtime_ns):
                return None
            found: dict[str, Any] = json.loads(text)
            described = Described(
                origin=Origin(**found.pop("origin")),
                channels=self._channels[found.pop("channels")],
                left_out={Reason(k): v for k, v in found.pop("left_out").items()},
                counts=CountLimits.from_tables(found.pop("counts")),
                stood_still={int(k): v for k, v in found.pop("stood_still").items()},
                lacking={int(k): v for k, v in found.pop("lacking").items()},
                shortened={k: (v[0], v[1]) for k, v in found.pop("shortened").items()},
                not_understood=tuple(found.pop("not_understood")),
                caveats=Caveats(map(Caveat, found.pop("caveats"))),
                **{name: found.pop(name) for name in PLAIN},
            )
            return IndexEntry(path, described, **found)
        except (OSError, AttributeError, KeyError, ValueError, TypeError):
            return None

    def put(self, entry: IndexEntry) -> None:
        """Keep an entry."""
        described, about = entry.described, entry.path.stat()
        channels = json.dumps(
            [
                (sensor, {k: _plain(v) for k, v in channel_attributes([channel]).items()})
                for sensor, channel in described.channels
            ]
        )
        key = hashlib.sha256(channels.encode()).hexdigest()
        self._texts[key] = channels
        document = {each.name: getattr(described, each.name) for each in fields(described)} | {
            "origin": asdict(described.origin),
            "counts": asdict(described.counts),
            "channels": key,
            "start_utc_ns": entry.start_utc_ns,
            "n_segments": entry.n_segments,
            "months": dict(entry.months),
            "daily": entry.daily,
            "single": entry.single,
        }
        name = self._name(entry.path)
        self._new.append((name, about.st_size, about.st_mtime_ns, json.dumps(document)))

    def _name(self, path: Path) -> str:
        """Return the key of a file: its path in the folder."""
        return str(path).removeprefix(self._prefix)

    def _write(self) -> None:
        with self._open() as database, database:
            database.executescript(_SCHEMA)
            database.executemany("REPLACE INTO channels VALUES (?, ?)", self._texts.items())
            database.executemany("REPLACE INTO recordings VALUES (?, ?, ?, ?)", self._new)

    def _open(self) -> contextlib.closing[sqlite3.Connection]:
        path = self._folder / FILE
        return contextlib.closing(sqlite3.connect(path, timeout=_BUSY_SECONDS))


def _plain(value: object) -> list[Any]:
    found = texts(value)
    return found if isinstance(found, list) else list(np.asarray(found).tolist())
