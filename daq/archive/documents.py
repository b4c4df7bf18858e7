"""What files say, kept in a database, so that they need not be read again.

Text and numbers only: nothing of it is executed. The database can be deleted at any time.
"""

from __future__ import annotations

import contextlib
import json
import sqlite3
from pathlib import Path
from typing import Any

_SCHEMA = """
CREATE TABLE IF NOT EXISTS files
    (name TEXT PRIMARY KEY, n_bytes INTEGER, modified_ns INTEGER, document TEXT);
"""
_BUSY_SECONDS = 10.0


class Documents:
    """Documents by name, each of one state of a file: its size, and when it changed.

    A damaged database is made again. Where the folder cannot be written, nothing is kept.

    Parameters
    ----------
    path : Path
        Of the database.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[str, tuple[tuple[int, int], str]] = {}
        self._new: dict[str, tuple[int, int, str]] = {}
        if path.exists():
            with contextlib.suppress(sqlite3.Error, ValueError), self._open() as database:
                rows = database.execute("SELECT name, n_bytes, modified_ns, document FROM files")
                self._known = {name: ((n, ns), text) for name, n, ns, text in rows}

    def get(self, name: str, state: tuple[int, int] = (0, 0)) -> Any:  # noqa: ANN401 - of JSON
        """Return a document that was kept earlier; None if none is of this state.

        Raises
        ------
        ValueError, TypeError
            It is damaged.
        """
        known, text = self._known.get(name, (None, ""))
        return json.loads(text) if known == state else None

    def put(self, name: str, document: object, state: tuple[int, int] = (0, 0)) -> None:
        """Take a document, which `save` keeps."""
        self._new[name] = (*state, json.dumps(document))

    def save(self) -> None:
        """Keep what is new."""
        if not self._new:
            return
        try:
            self._write()
        except sqlite3.OperationalError:
            return  # a folder that cannot be written, or another command writes
        except sqlite3.DatabaseError:
            with contextlib.suppress(OSError, sqlite3.Error):
                self._path.unlink(missing_ok=True)
                self._write()

    def _write(self) -> None:
        rows = ((name, *row) for name, row in self._new.items())
        with self._open() as database, database:
            database.executescript(_SCHEMA)
            database.executemany("REPLACE INTO files VALUES (?, ?, ?, ?)", rows)

    def _open(self) -> contextlib.closing[sqlite3.Connection]:
        return contextlib.closing(sqlite3.connect(self._path, timeout=_BUSY_SECONDS))
