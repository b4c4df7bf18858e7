"""The database of runs: one row a run, and the noise that it found.

SQLite in the folder of the recordings, readable by its owner alone. Each change is one transaction
that survives a power cut. A connection lasts for one operation, so that a disk that comes back is
used again.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, fields, replace
from datetime import date, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from daq.bench.end_condition import EndCondition
from daq.caveats import Caveat, Caveats
from daq.errors import HuddleError
from daq.whole_file import create_private, hidden, put_in_place, remove, replaced
from tui.service.records.run_state import (
    NEXT,
    UNFINISHED,
    RecordedNoise,
    Run,
    RunState,
    from_text,
    utc_text,
)

NAME = "runs.sqlite"
VERSION = len(Caveat)
"""A further caveat has a further table, which databases of before receive."""
COPIES = 7
"""Daily copies that are kept."""
EMPTY = "it is empty"
_DAMAGE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_BUSY = 10.0
"""Seconds that a change waits for another program's."""
_STEP = 256
"""Pages of a copy that are read at once."""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS runs (
    key TEXT PRIMARY KEY, bench TEXT NOT NULL, entry TEXT NOT NULL, due TEXT NOT NULL,
    state TEXT NOT NULL, reason TEXT NOT NULL, verdict TEXT NOT NULL, started TEXT, ended TEXT,
    duration REAL NOT NULL, target_cov REAL, queue INTEGER NOT NULL, parts TEXT NOT NULL,
    attempts INTEGER NOT NULL, pinned INTEGER NOT NULL, removed TEXT, untold TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS runs_by_due ON runs (bench, due);
CREATE TABLE IF NOT EXISTS noise (
    run TEXT NOT NULL REFERENCES runs (key), sensor TEXT, model TEXT, serial_number TEXT,
    channel TEXT, unit TEXT, method TEXT, low_hz REAL, high_hz REAL, psd REAL, low REAL, high REAL);
CREATE INDEX IF NOT EXISTS noise_by_run ON noise (run);
CREATE TABLE IF NOT EXISTS identities (
    part TEXT PRIMARY KEY, run TEXT NOT NULL, run_id TEXT NOT NULL, root_sha256 TEXT NOT NULL);
CREATE INDEX IF NOT EXISTS runs_by_time ON runs (due, entry);
CREATE INDEX IF NOT EXISTS runs_by_state ON runs (bench, state, due);
CREATE INDEX IF NOT EXISTS runs_pending ON runs (bench) WHERE untold != '[]';
""" + "".join(f"CREATE TABLE IF NOT EXISTS {each} (run TEXT PRIMARY KEY);" for each in Caveat)
_NOISE = tuple(field.name for field in fields(RecordedNoise))
_CAVEATS = ", ".join(
    f"EXISTS (SELECT 1 FROM {each} WHERE run = runs.key)"  # noqa: S608 - our own words
    for each in Caveat
)
"""The questions whether a run has each caveat."""
_STATES = ", ".join(f"'{state}'" for state in RunState)
_DATES = " OR ".join(
    f"({name} IS NOT NULL AND julianday({name}) IS NULL)"
    for name in ("started", "ended", "removed")
)
_WRONG_ROWS = (
    "SELECT count(*) FROM runs WHERE julianday(due) IS NULL"  # noqa: S608 - our own words
    f" OR {_DATES} OR state NOT IN ({_STATES}) OR NOT json_valid(parts) OR parts LIKE '%/%'"
    " OR NOT json_valid(untold) OR typeof(duration) NOT IN ('real', 'integer')"
)
"""Rows of which SQLite does not know that they are damaged: it has no checksums."""
_MISSING_SAVED = (
    "SELECT value FROM json_each(?) WHERE NOT EXISTS (SELECT 1 FROM runs WHERE key = value)"
)
_MISSING_COPIED = (
    "SELECT key FROM copied.runs AS old WHERE state != ?"
    " AND NOT EXISTS (SELECT 1 FROM main.runs WHERE key = old.key)"
)
_OVER = tuple(state for state in RunState if not NEXT[state])


class StoreError(HuddleError):
    """The database of runs cannot be read or written."""


class RunStore:
    """The runs of all benches that record into one folder.

    Parameters
    ----------
    folder : Path
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self._known: tuple[int, int, bytes] | None = (-1, -1, b"")  # not checked yet
        """State of the file that was checked, with the changes made here since."""
        self._saved: set[str] = set()
        """Keys of the runs that this object has written."""

    def save(self, run: Run) -> None:
        """Write a run in its present state, with the noise that it has found.

        Raises
        ------
        StoreError
            If the database cannot be written; it stays as it was.
        """
        row = _row(run)
        places = ", ".join(f":{name}" for name in _COLUMNS)
        # What a person has pinned meanwhile stays pinned.
        updates = ", ".join(f"{n} = :{n}" for n in _COLUMNS if n not in {"key", "pinned"})
        with self._changed() as database:
            database.execute(
                f"INSERT INTO runs ({', '.join(_COLUMNS)}) VALUES ({places})"  # noqa: S608
                f" ON CONFLICT (key) DO UPDATE SET {updates}",
                row,
            )
            for each in run.caveats:
                database.execute(f"INSERT OR IGNORE INTO {each} VALUES (?)", (run.key,))  # noqa: S608
            if run.noise:
                database.execute("DELETE FROM noise WHERE run = ?", (run.key,))
                database.executemany(
                    f"INSERT INTO noise (run, {', '.join(_NOISE)})"  # noqa: S608
                    f" VALUES (?{', ?' * len(_NOISE)})",
                    [(run.key, *astuple(each)) for each in run.noise],
                )
        self._saved.add(run.key)

    def pin(self, keys: Sequence[str], *, pinned: bool) -> None:
        """Keep these runs whatever the limits of storage, or no longer."""
        self._write("UPDATE runs SET pinned = ? WHERE key = ?", *((int(pinned), k) for k in keys))

    def set_pending_hooks(self, run: Run, events: Sequence[str]) -> None:
        """Write which hooks of a run have still to be carried out."""
        pending = json.dumps(list(events))
        self._write("UPDATE runs SET untold = ? WHERE key = ?", (pending, run.key))

    def set_removed(self, run: Run, when: datetime) -> None:
        """Write that the files of a run were removed."""
        self._write("UPDATE runs SET removed = ? WHERE key = ?", (utc_text(when), run.key))

    def set_identities(self, run: Run, identities: Sequence[tuple[str, str, str]]) -> None:
        """Write file name, run id and root SHA-256 of the recordings of a run."""
        rows = ((part, run.key, run_id, root) for part, run_id, root in identities)
        self._write("INSERT OR REPLACE INTO identities VALUES (?, ?, ?, ?)", *rows)

    def _write(self, statement: str, *rows: tuple[object, ...]) -> None:
        with self._changed() as database:
            database.executemany(statement, rows)

    def identities(self) -> dict[str, tuple[str, str]]:
        """Return run id and root SHA-256 of recordings, by file name."""
        rows = self._rows("SELECT part, run_id, root_sha256 FROM identities")
        return {part: (run_id, root) for part, run_id, root in rows}

    def forget_planned(self, run: Run) -> None:
        """Remove a run that is no longer in the schedule, unless it has begun."""
        self._saved.discard(run.key)
        self._write("DELETE FROM runs WHERE key = ? AND state = ?", (run.key, RunState.DUE))

    def runs(
        self,
        bench: str | None = None,
        *states: RunState,
        last: int | None = None,
        kept: bool = False,
    ) -> list[Run]:
        """Return runs by the time at which they were due, without their noise.

        Parameters
        ----------
        bench : str, optional
            Of one bench; default: of all.
        *states : RunState
            In one of these states; default: in any.
        last : int, optional
            The last ones only.
        kept : bool
            Without those whose files were removed.

        Raises
        ------
        StoreError
            If the database cannot be read.
        """
        return self._found(bench, states, last=last, condition="removed IS NULL" if kept else "")

    def current(self, bench: str) -> list[Run]:
        """Return what a service has to do with: runs not over, or with pending hooks, and the last.

        With noise where hooks are pending: they receive it.
        """
        pending = self._found(bench, _OVER, condition="untold != '[]'")
        found = {
            run.key: run
            for run in (
                *self.runs(bench, *_OVER, last=1),
                *(self.with_noise(run) for run in pending),
                *self.runs(bench, RunState.DUE, *UNFINISHED),
            )
        }
        return sorted(found.values(), key=lambda run: (run.due, run.entry))

    def with_noise(self, run: Run) -> Run:
        """Return a run with the noise that it found."""
        rows = self._rows(
            f"SELECT {', '.join(_NOISE)} FROM noise WHERE run = ? ORDER BY rowid",  # noqa: S608
            run.key,
        )
        return replace(run, noise=tuple(RecordedNoise.of(*row) for row in rows))

    def begun(self, bench: str) -> set[str]:
        """Return the keys of all runs that are no longer due."""
        rows = self._rows(
            "SELECT key FROM runs WHERE bench = ? AND state != ?", bench, RunState.DUE
        )
        return {str(key) for (key,) in rows}

    def parts(self) -> set[str]:
        """Return the file names of the recordings of all runs."""
        return {
            name
            for (stored,) in self._rows("SELECT parts FROM runs WHERE parts != '[]'")
            for name in _safe_names(stored)
        }

    def noise(
        self, bench: str | None = None, since: datetime | None = None
    ) -> Iterator[tuple[str, datetime, RecordedNoise, Caveats]]:
        """Yield the noise of all runs by their time: bench, due time, noise, caveats."""
        conditions, values = [], []
        if bench is not None:
            conditions.append("bench = ?")
            values.append(bench)
        if since is not None:
            conditions.append("due >= ?")
            values.append(str(utc_text(since)))
        where = f" WHERE {' AND '.join(conditions)}" if conditions else ""
        columns = ", ".join(f"noise.{name}" for name in _NOISE)
        rows = self._rows(
            f"SELECT bench, due, {_CAVEATS}, {columns}"  # noqa: S608 - our own words
            " FROM runs CROSS JOIN noise ON noise.run = runs.key"
            f"{where} ORDER BY due, entry, noise.rowid",
            *values,
        )
        moment = lru_cache(maxsize=1)(datetime.fromisoformat)  # of many rows in turn
        for name, due, *row in rows:
            caveats = Caveats.of(dict(zip(Caveat, row, strict=False)))
            yield name, moment(due), RecordedNoise.of(*row[len(Caveat) :]), caveats

    def _found(
        self,
        bench: str | None,
        states: Sequence[RunState],
        *,
        condition: str = "",
        last: int | None = None,
    ) -> list[Run]:
        where, values = [condition] if condition else [], []
        if bench is not None:
            where.append("bench = ?")
            values.append(bench)
        if states:
            where.append(f"state IN ({', '.join('?' * len(states))})")
            values += list(states)
        condition = f" WHERE {' AND '.join(where)}" if where else ""
        order = "due, entry" if last is None else f"due DESC, entry DESC LIMIT {last:d}"
        rows = self._rows(
            f"SELECT {', '.join(_COLUMNS)}, {_CAVEATS}"  # noqa: S608 - our own words
            f" FROM runs{condition} ORDER BY {order}",
            *values,
        )
        if last is not None:
            rows.reverse()
        try:
            columns = (*_COLUMNS, *Caveat)
            return [_run(dict(zip(columns, row, strict=True))) for row in rows]
        except (TypeError, ValueError) as error:
            raise StoreError(
                f"{self.path}: a row cannot be read ({error}); huddle serve restores the database:"
                " recordings are not affected"
            ) from error

    def _rows(self, question: str, *values: str) -> list[tuple[Any, ...]]:
        if not self.path.exists():
            return []
        with self._opened() as database:
            try:
                return database.execute(question, values).fetchall()
            except sqlite3.OperationalError as error:
                if "decode" not in str(error):
                    raise
                # A damaged text must not hide the others; replacing all would take twice as long.
                database.text_factory = lambda text: text.decode(errors="replace")
                return database.execute(question, values).fetchall()

    def damage(self) -> str:
        """Return what is wrong with the database; empty if nothing is, or it cannot be asked now.

        Runs that have begun are never removed: a database without those of its newest copy, or
        without those that this object has written, is damaged.
        """
        newest, state = next(iter(self.copies()), None), self._state()
        try:
            found = _check(self.path) or self._missing(newest)
        except FileNotFoundError:
            found = "" if newest is None else "it is missing"
        except (sqlite3.Error, OSError) as error:
            code = getattr(error, "sqlite_errorcode", 0) & 0xFF
            return str(error) if code in _DAMAGE else ""
        if found == EMPTY and newest is None:
            found = ""
        if not found:
            self._known = state
        return found

    def _missing(self, copy: Path | None) -> str:
        """Return how many runs of its copy, and of those written here, the database has not."""
        saved = json.dumps(list(self._saved))
        missing: set[tuple[str]] = set()
        with contextlib.closing(sqlite3.connect(self.path, timeout=_BUSY)) as database:
            missing.update(database.execute(_MISSING_SAVED, (saved,)))
            missing = {key for key in missing if key[0] in self._saved}  # not forgotten meanwhile
            if copy is not None:
                with contextlib.suppress(sqlite3.Error):  # a damaged copy says nothing
                    database.execute("ATTACH ? AS copied", (f"{copy.absolute()}",))
                    missing.update(database.execute(_MISSING_COPIED, (RunState.DUE,)))
        n = len(missing)
        return f"{n} {'run is' if n == 1 else 'runs are'} missing" if n else ""

    @property
    def is_changed(self) -> bool:
        """Whether anything but this object has changed the file since `damage` was asked."""
        return self._state() != self._known

    def _state(self) -> tuple[int, int, bytes] | None:
        try:
            with self.path.open("rb") as file:
                found, head = os.fstat(file.fileno()), file.read(28)
        except OSError:
            return None
        return found.st_size, found.st_mtime_ns, head[24:]  # SQLite's counter of changes

    def copies(self) -> list[Path]:
        """Return the daily copies, the newest first."""
        return sorted(self._copies.glob("????-??-??.sqlite"), reverse=True)

    def copy(self, day: date) -> None:
        """Make the copy of a day, unless there is one; keep the newest `COPIES`.

        Raises
        ------
        StoreError
            If the disk refuses it.
        """
        target = self._copies / f"{day:%Y-%m-%d}.sqlite"
        if target.exists() or not self.path.exists():
            return
        new = hidden(target)
        try:
            self._copies.mkdir(mode=0o700, exist_ok=True)
            create_private(new)
            with (
                contextlib.closing(sqlite3.connect(self.path, timeout=_BUSY)) as source,
                contextlib.closing(sqlite3.connect(new)) as copied,
            ):
                # In steps, so that other connections write meanwhile.
                source.backup(copied, pages=_STEP, sleep=0.0)
            if _check(new) == "":
                put_in_place(new, target)
            for old in self.copies()[COPIES:]:
                old.unlink()
        except (sqlite3.Error, OSError) as error:
            raise StoreError(f"{target}: the database of runs cannot be copied: {error}") from error
        finally:
            remove(new)

    def restore(self, now: datetime) -> tuple[Path | None, Path | None]:
        """Move a damaged database away, and put its newest good copy in its place.

        Returns
        -------
        moved, copy : Path or None
            Where the damaged file is now, and which copy was taken.

        Raises
        ------
        StoreError
            If the disk refuses it.
        """
        moved = None
        self._saved.clear()
        try:
            if self.path.exists():
                moved = self.path.with_name(f"{NAME}.damaged-{now:%Y%m%dT%H%M%S}")
                for suffix in ("", "-journal"):
                    with contextlib.suppress(FileNotFoundError):
                        self.path.with_name(NAME + suffix).replace(
                            moved.with_name(moved.name + suffix)
                        )
            for copy in self.copies():
                with contextlib.suppress(sqlite3.Error):
                    if _check(copy) == "":
                        with replaced(self.path) as new:
                            shutil.copy(copy, new)
                        return moved, copy
        except OSError as error:
            raise StoreError(f"{self.path}: cannot be restored: {error}") from error
        return moved, None

    @property
    def _copies(self) -> Path:
        return self.path.with_name(".runs-copies")

    @contextlib.contextmanager
    def _changed(self) -> Iterator[sqlite3.Connection]:
        with self._opened() as database:
            database.execute("BEGIN IMMEDIATE")
            before = self._state()
            yield database
            database.execute("COMMIT")
        if before == self._known:
            self._known = self._state()

    @contextlib.contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        try:
            if not self.path.exists():
                self.path.parent.mkdir(parents=True, exist_ok=True)
                with contextlib.suppress(FileExistsError):
                    create_private(self.path)
            # Closing undoes what was not committed.
            with contextlib.closing(
                sqlite3.connect(self.path, timeout=_BUSY, isolation_level=None)
            ) as database:
                database.execute("PRAGMA synchronous = EXTRA")
                self._prepare(database)
                yield database
        except (sqlite3.Error, OSError) as error:
            raise StoreError(
                f"{self.path}: the database of runs cannot be used ({error}); if it is damaged,"
                " huddle serve restores it: recordings are not affected"
            ) from error

    def _prepare(self, database: sqlite3.Connection) -> None:
        version = int(database.execute("PRAGMA user_version").fetchone()[0])
        if version > VERSION:
            raise StoreError(
                f"{self.path}: written by a newer version of huddle (format {version}); this"
                f" version reads formats up to {VERSION}: update huddle"
            )
        if version < VERSION:
            database.executescript(f"BEGIN IMMEDIATE; {_SCHEMA} PRAGMA user_version = {VERSION};")
            database.execute("COMMIT")


def _check(path: Path) -> str:
    """Return what SQLite finds wrong with a database, `EMPTY`, or nothing."""
    if not path.exists():
        raise FileNotFoundError(path)
    with contextlib.closing(sqlite3.connect(path, timeout=_BUSY)) as database:
        # Not quick_check: it takes a third of the time, and sees no damage of indexes.
        found = [str(row[0]) for row in database.execute("PRAGMA integrity_check(1)")]
        if found != ["ok"]:
            return "; ".join(found)
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'runs'").fetchone():
            return EMPTY
        (n_wrong,) = database.execute(_WRONG_ROWS).fetchone()
        if n_wrong:
            return f"{n_wrong} rows cannot be read"
        return "" if database.execute("SELECT 1 FROM runs LIMIT 1").fetchone() else EMPTY


def _same(value: Any) -> Any:  # noqa: ANN401 - of SQLite
    return value


def _end_text(until: EndCondition) -> float | str | None:
    # a number where it is a precision alone: earlier versions read that
    return until.text if until.decided else until.cov


def _end(stored: float | str | None) -> EndCondition:
    return EndCondition.of_text(stored) if isinstance(stored, str) else EndCondition(cov=stored)


def _texts(stored: str) -> tuple[str, ...]:
    return tuple(json.loads(stored))


def _safe_name(name: str) -> str:
    """Return a file name that stays in the folder of the database, whoever wrote it there."""
    if Path(name).name != name or name in {"", ".", ".."}:
        raise StoreError(f"recording {name!r}: expected a file name without a folder")
    return name


def _safe_names(stored: str) -> tuple[str, ...]:
    return tuple(map(_safe_name, json.loads(stored)))


_PLAIN = "bench", "entry", "reason", "verdict", "duration", "attempts"
_FIELDS: dict[str, tuple[str, Callable[[Any], Any], Callable[[Any], Any]]] = {
    **{name: (name, _same, _same) for name in _PLAIN},
    "due": ("due", utc_text, datetime.fromisoformat),
    "state": ("state", str, RunState),
    "started": ("started", utc_text, from_text),
    "ended": ("ended", utc_text, from_text),
    "target_cov": ("until", _end_text, _end),
    "queue": ("queue", int, bool),
    "parts": ("parts", json.dumps, _safe_names),
    "pinned": ("pinned", int, bool),
    "removed": ("removed", utc_text, from_text),
    # Renamed, earlier versions could not open the database.
    "untold": ("pending_hooks", json.dumps, _texts),
}
"""Columns beside the key: which attribute of a run each has, and how it is written and read."""
_COLUMNS = ("key", *_FIELDS)


def _row(run: Run) -> dict[str, Any]:
    stored = {name: write(getattr(run, own)) for name, (own, write, _) in _FIELDS.items()}
    return {"key": run.key} | stored


def _run(row: dict[str, Any]) -> Run:
    found = {own: read(row[name]) for name, (own, _, read) in _FIELDS.items()}
    return Run(**found, caveats=Caveats.of(row))
