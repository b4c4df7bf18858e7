"""The ledger of a laboratory's certificates: numbers are given once, and no entry is changed.

Theory of operation
-------------------
A folder of certificates has one ledger, an SQLite file. Each row is a record as JSON and the
SHA-256 of the record before and of itself, so that a changed or removed row breaks the chain;
triggers refuse changes through SQL. SQLite counts the rows ever added, so that rows removed from
the end are missed, too; and every certificate prints the hash of its own row.

All of this shows accidents and careless hands. Who can write the file can also write another chain,
and another count. Where certificates are signed, the row that is last then, the head, is signed
with the same key: all rows up to a signed head are those that the owner of the key had.

To issue is: add ``allotted``, make the file under a hidden name, add ``issued`` with the SHA-256 of
the file, and give the file its name. All of it holds a lock that the system releases when the
process ends. Whoever takes the lock next finds what a killed process left: a number without a
certificate becomes ``void``; a certificate that lacks only its name gets it.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
import sqlite3
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

from daq.bench.tables.certificate import CertificateTable
from daq.errors import HuddleError
from daq.whole_file import PRIVATE, create_private, put_in_place, write_whole

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from daq.bench.model import Bench

NAME, LOCK = "ledger.sqlite", "ledger.lock"
PATIENCE = 600.0
"""Seconds to wait for another process that issues."""
State: TypeAlias = Literal["issued", "replaced", "void", "being issued", "file missing"]
_TABLE = """
CREATE TABLE IF NOT EXISTS entries (
    row INTEGER PRIMARY KEY AUTOINCREMENT, record TEXT NOT NULL, hash TEXT NOT NULL UNIQUE);
CREATE TRIGGER IF NOT EXISTS no_change BEFORE UPDATE ON entries
    BEGIN SELECT RAISE(ABORT, 'the ledger is append-only'); END;
CREATE TRIGGER IF NOT EXISTS no_removal BEFORE DELETE ON entries
    BEGIN SELECT RAISE(ABORT, 'the ledger is append-only'); END;
CREATE TABLE IF NOT EXISTS heads (
    row INTEGER PRIMARY KEY, hash TEXT NOT NULL, key TEXT NOT NULL, signature TEXT NOT NULL);
CREATE TRIGGER IF NOT EXISTS no_change_of_heads BEFORE UPDATE ON heads
    BEGIN SELECT RAISE(ABORT, 'the ledger is append-only'); END;
CREATE TRIGGER IF NOT EXISTS no_removal_of_heads BEFORE DELETE ON heads
    BEGIN SELECT RAISE(ABORT, 'the ledger is append-only'); END;
"""


class HeadSigner(Protocol):
    """The key of a laboratory."""

    key_id: str
    public_key: str
    """In PEM."""

    def sign(self, message: bytes) -> bytes:
        """Return the signature of a message."""


class LedgerError(HuddleError, OSError):
    """The ledger cannot be used: changed by hand, busy, or not there."""


@dataclass(frozen=True, slots=True)
class LedgerEntry:
    """One certificate or void number, as the ledger knows it now.

    Attributes
    ----------
    number : str
    revision : int
    at : datetime
        UTC.
    by : str
    recordings : tuple of (file, run_id, sha256)
    roots : mapping
        Root SHA-256 of the manifest of each recording, by run id.
    signer : str
        Id of the key that signs the certificate; empty: not signed.
    settings : mapping
        Those of the estimate that differ from the defaults.
    reason : str
        Of a revision.
    hash : str
        Of the row that allotted the number.
    state : State
    file, sha256 : str
        Of the certificate; empty for a void number.
    row : int
        Of the ledger, in which the certificate was issued.
    """

    number: str
    revision: int
    at: datetime
    by: str
    recordings: tuple[tuple[str, str, str], ...]
    settings: Mapping[str, Any]
    reason: str
    hash: str
    state: State
    file: str = ""
    sha256: str = ""
    roots: Mapping[str, str] = field(default_factory=dict)
    signer: str = ""
    row: int = 0

    @property
    def name(self) -> str:
        """Number and revision."""
        return f"{self.number}, revision {self.revision}"

    @property
    def runs(self) -> frozenset[str]:
        """The runs certified."""
        return frozenset(run_id for _, run_id, _ in self.recordings)


class Ledger:
    """The ledger of one folder; every method opens the file anew.

    Parameters
    ----------
    folder : Path
        Of the certificates.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / NAME

    @property
    def exists(self) -> bool:
        """Whether there is a ledger: an empty file is of a disk that refused it."""
        return self._path.is_file() and self._path.stat().st_size > 0

    @contextmanager
    def held(self, *, patience: float = PATIENCE) -> Iterator[None]:
        """Hold the ledger for one certificate; first clear up what a killed process left.

        Raises
        ------
        LedgerError
            If another process holds it for longer, or the ledger was changed.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._locked(patience):
            _private(self._path)
            with self._open() as rows:
                rows.executescript(_TABLE)
            self._clear_up()
            yield

    def entries(self) -> tuple[LedgerEntry, ...]:
        """Return all certificates and void numbers, in the order in which they were allotted.

        Raises
        ------
        LedgerError
            If a row was changed or removed.
        """
        found: dict[tuple[str, int], LedgerEntry] = {}
        busy = self._is_busy()
        for row, (record, own) in enumerate(self._records(), start=1):
            key = record["number"], record["revision"]
            if record["kind"] == "allotted":
                state: State = "being issued" if busy else "void"
                found[key] = _entry(record, own, state)
            elif record["kind"] == "issued":
                here = (self.folder / record["file"]).exists()
                state = "issued" if here or busy else "file missing"
                about = {"file": record["file"], "sha256": record["sha256"]}
                found[key] = replace(found[key], state=state, row=row, **about)
            else:
                found[key] = replace(found[key], state="void")
        last = {e.number: e.revision for e in found.values() if e.state != "void"}
        return tuple(
            replace(e, state="replaced")
            if e.state == "issued" and e.revision < last[e.number]
            else e
            for e in found.values()
        )

    def allot(
        self,
        prefix: str,
        *,
        at: datetime,
        recordings: Sequence[tuple[str, str, str]],
        **about: Any,  # noqa: ANN401 - by their names, and in JSON
    ) -> LedgerEntry:
        """Give the next number; a further certificate of the same runs is a revision of theirs.

        The row has all else that is said about it, by the names of `LedgerEntry`.
        """
        entries = self.entries()
        before = self.last_of(frozenset(run_id for _, run_id, _ in recordings), entries)
        if before is not None:
            number = before.number
            revision = 1 + max(e.revision for e in entries if e.number == number)
        else:
            start = f"{prefix}-{at:%Y}-"
            taken = [e.number.removeprefix(start) for e in entries if e.number.startswith(start)]
            number, revision = f"{start}{1 + max(map(int, taken), default=0):04d}", 0
        record = {
            "kind": "allotted",
            "number": number,
            "revision": revision,
            "at": at.isoformat(),
            "recordings": recordings,
            **about,
        }
        return _entry(record, self._add(record), "being issued")

    def last_of(
        self, runs: frozenset[str], entries: Sequence[LedgerEntry] | None = None
    ) -> LedgerEntry | None:
        """Return the last certificate of the same runs that is not void."""
        known = self.entries() if entries is None else entries
        found = [each for each in known if each.runs == runs and each.state != "void"]
        return found[-1] if found else None

    def certified(self, path: Path, run_id: str, root: str) -> tuple[LedgerEntry | None, str]:
        """Return the last certificate of a recording, and how the recording contradicts one.

        Parameters
        ----------
        path : Path
        run_id, root : str
            Its run, and the root SHA-256 of its manifest.

        Returns
        -------
        entry : Entry or None
        problem : str
            Empty if nothing is wrong.
        """
        last = None
        for entry in self.entries():
            if entry.state == "void":
                continue
            if run_id in entry.runs:
                last = entry
                known = entry.roots.get(run_id, "")
                sha256 = next(each for _, run, each in entry.recordings if run == run_id)
                if root != known if known else _sha256(path) != sha256:
                    return last, f"changed since certificate {entry.name} was issued"
            elif path.name in {file for file, _, _ in entry.recordings}:
                return None, f"exchanged: certificate {entry.name} is of another run of this name"
        return last, ""

    def publish(
        self, entry: LedgerEntry, suffix: str, content: bytes, signer: HeadSigner | None = None
    ) -> Path:
        """Add a certificate to the ledger and to the folder, in which it replaces nothing.

        A signer signs the ledger as far as this certificate.

        Raises
        ------
        LedgerError
            If a file has the name already.
        """
        path = self.folder / f"{entry.number}-r{entry.revision}{suffix}"
        if path.exists():
            raise LedgerError(f"{path}: exists, and is not in the ledger; move it away")
        part = _part(path)
        write_whole(part, content, mode=PRIVATE)
        sha256 = hashlib.sha256(content).hexdigest()
        self._note("issued", entry, signer, file=path.name, sha256=sha256)
        _name(part, path)
        return path

    def void(self, entry: LedgerEntry, why: str) -> None:
        """Mark a number without a certificate, unless it has one that lacks only its name."""
        key = "issued", entry.number, entry.revision
        if any(key == (r["kind"], r["number"], r["revision"]) for r, _ in self._records()):
            return
        _part(self.folder / f"{entry.number}-r{entry.revision}.pdf").unlink(missing_ok=True)
        self._note("void", entry, why=why)

    def _note(
        self, kind: str, entry: LedgerEntry, signer: HeadSigner | None = None, **more: str
    ) -> None:
        """Add what became of a number."""
        own = {"kind": kind, "number": entry.number, "revision": entry.revision}
        self._add({**own, "at": datetime.now(UTC).isoformat(), **more}, signer)

    def signed_rows(self) -> dict[str, int]:
        """Return how many rows each key has signed, by its id.

        Raises
        ------
        LedgerError
            If a signature is not that of its row.
        """
        from tui.certificate.keys import is_genuine, key_id, loaded  # noqa: PLC0415 - an extra

        hashes = [own for _, own in self._records()]
        with self._open() as rows:
            if not rows.execute("SELECT 1 FROM sqlite_master WHERE name = 'heads'").fetchone():
                return {}
            heads = rows.execute("SELECT row, hash, key, signature FROM heads").fetchall()
        found: dict[str, int] = {}
        for row, own, pem, signature in heads:
            try:
                key = loaded(pem)
                is_own = is_genuine(key, _head(row, own), base64.b64decode(signature))
            except ValueError:
                is_own = False
            if not is_own or row > len(hashes) or hashes[row - 1] != own:
                raise LedgerError(
                    f"{self._path}: changed by hand: row {row} is not the one that was signed"
                )
            found[key_id(key)] = max(row, found.get(key_id(key), 0))
        return found

    def _clear_up(self) -> None:
        """Finish what a killed process left; the lock is held."""
        open_entries: dict[tuple[str, int], LedgerEntry] = {}
        for record, own in self._records():
            key = record["number"], record["revision"]
            if record["kind"] == "allotted":
                open_entries[key] = _entry(record, own, "void")
                continue
            open_entries.pop(key, None)
            if record["kind"] == "issued":
                path = self.folder / record["file"]
                part = _part(path)
                if not path.exists() and part.exists() and _sha256(part) == record["sha256"]:
                    _name(part, path)
                part.unlink(missing_ok=True)
        for entry in open_entries.values():
            self.void(entry, "the process that issued it was ended")
            for part in self.folder.glob(f".{entry.number}-r{entry.revision}.*.part"):
                part.unlink()

    def _add(self, record: dict[str, Any], signer: HeadSigner | None = None) -> str:
        with self._open() as rows:
            rows.execute("BEGIN IMMEDIATE")
            last = rows.execute("SELECT hash FROM entries ORDER BY row DESC LIMIT 1").fetchone()
            text = json.dumps(
                record | {"previous": last[0] if last else ""}, ensure_ascii=False, sort_keys=True
            )
            own = hashlib.sha256(text.encode()).hexdigest()
            added = rows.execute(
                "INSERT INTO entries (record, hash) VALUES (?, ?) RETURNING row", (text, own)
            ).fetchone()
            if signer is not None:
                signature = base64.b64encode(signer.sign(_head(added[0], own))).decode()
                rows.execute(
                    "INSERT INTO heads VALUES (?, ?, ?, ?)",
                    (added[0], own, signer.public_key, signature),
                )
            rows.execute("COMMIT")
        return own

    def _records(self) -> list[tuple[dict[str, Any], str]]:
        """Return all records with their hashes, after walking the chain."""
        if not self.exists:
            raise LedgerError(f"{self._path}: there is no ledger; huddle issue makes one")
        with self._open() as rows:
            found = rows.execute("SELECT row, record, hash FROM entries ORDER BY row").fetchall()
            counted = rows.execute(
                "SELECT seq FROM sqlite_sequence WHERE name = 'entries'"
            ).fetchone()
        previous, records = "", []
        for number, (row, text, own) in enumerate(found, start=1):
            record = _record(text, own)
            if row != number or record.get("previous") != previous:
                raise LedgerError(f"{self._path}: changed by hand: row {number} breaks the chain")
            if not _is_plain(record):
                raise LedgerError(
                    f"{self._path}: row {number} is no row of a ledger; expected a record of a"
                    " certificate, whose file is its number and revision, in this folder"
                )
            records.append((record, own))
            previous = own
        written = counted[0] if counted else 0
        if written != len(found):
            raise LedgerError(
                f"{self._path}: changed by hand: {written} rows were written,"
                f" {len(found)} are there"
            )
        return records

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        try:
            with contextlib.closing(
                sqlite3.connect(self._path, timeout=60, isolation_level=None)
            ) as rows:
                rows.execute("PRAGMA synchronous = EXTRA")
                yield rows
        except sqlite3.Error as error:
            raise LedgerError(f"{self._path}: {error}") from error

    @contextmanager
    def _locked(self, patience: float) -> Iterator[None]:
        """Hold the lock: a transaction of a file of its own, which ends with the process."""
        path = self.folder / LOCK
        _private(path)
        with contextlib.closing(
            sqlite3.connect(path, timeout=patience, isolation_level=None)
        ) as lock:
            try:
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.OperationalError as error:
                raise LedgerError(f"{path}: another process is issuing ({error})") from error
            yield

    def _is_busy(self) -> bool:
        if not (self.folder / LOCK).exists():
            return False
        try:
            with self._locked(0.0):
                return False
        except LedgerError:
            return True


def _record(text: object, own: object) -> dict[str, Any]:
    """Return the record of a row; empty if its hash is not that of the text."""
    if not isinstance(text, str) or hashlib.sha256(text.encode()).hexdigest() != own:
        return {}
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _is_plain(record: Mapping[str, Any]) -> bool:
    """Whether a record has what is read of it, and names no file but its own certificate.

    A ledger may come from elsewhere: its files are read, and shown in the pages.
    """
    number, kind = record.get("number"), record.get("kind")
    if not isinstance(number, str) or not isinstance(record.get("revision"), int):
        return False
    if kind == "allotted":
        return isinstance(record.get("recordings"), list) and isinstance(record.get("at"), str)
    if kind != "issued":
        return kind == "void"
    own = re.escape(f"{number}-r{record['revision']}")
    is_file = re.fullmatch(rf"{own}\.[a-z]+", str(record.get("file"))) is not None
    return is_file and not set(number) & set("/\\\0") and isinstance(record.get("sha256"), str)


def _entry(record: Mapping[str, Any], own: str, state: State) -> LedgerEntry:
    return LedgerEntry(
        number=record["number"],
        revision=record["revision"],
        at=datetime.fromisoformat(record["at"]),
        by=record["by"],
        recordings=tuple((file, run_id, sha256) for file, run_id, sha256 in record["recordings"]),
        settings=record["settings"],
        reason=record["reason"],
        roots=record.get("roots", {}),
        signer=record.get("signer", ""),
        hash=own,
        state=state,
    )


def _head(row: int, own: str) -> bytes:
    """Return what is signed of a row."""
    return f"huddle ledger 1\n{row}\n{own}\n".encode()


def _private(path: Path) -> None:
    """Create a file that only its owner can read, if there is none."""
    with contextlib.suppress(FileExistsError):
        create_private(path)


def _part(path: Path) -> Path:
    return path.with_name(f".{path.name}.part")


def _name(part: Path, path: Path) -> None:
    """Give a complete file its name, which must be free."""
    try:
        put_in_place(part, path, free=True)
    except FileExistsError:
        raise LedgerError(f"{path}: exists, and is not in the ledger; move it away") from None


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def ledger_of(recording: Path, about: Bench | None) -> Ledger:
    """Return the ledger for a recording: in the folder that the bench file names."""
    table = CertificateTable() if about is None else about.certificate
    return Ledger(recording.resolve().parent / table.folder.expanduser())


def unknown_beside(folder: Path, entries: Sequence[LedgerEntry]) -> list[str]:
    """Return which certificates of a folder a ledger of the same numbers lacks, a line each.

    No file of a certificate is older than its row: such a ledger is an older copy, or cut short.
    """
    known = {f"{each.number}-r{each.revision}" for each in entries}
    series = {each.number.rpartition("-")[0] for each in entries}
    named = (re.fullmatch(r"(.+)-\d+-r\d+", path.stem) for path in folder.glob("*.pdf"))
    found = sorted(each[0] for each in named if each and each[1] in series)
    return [
        f"the ledger lacks {each} of the folder: it is an older copy, or was cut short"
        for each in found
        if each not in known
    ]


def ledgers_of(recording: Path, folders: Iterable[Path]) -> list[Ledger]:
    """Return the ledgers that may have a recording.

    That of its own bench file, that in the usual folder, and those in other folders.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    """
    from daq.recording.reader import Recording  # noqa: PLC0415 - not where it only writes

    with Recording.open(recording, tried=True) as opened:
        own = ledger_of(recording, opened.bench)
    others = (Ledger(recording.resolve().parent / each.expanduser()) for each in folders)
    every = (own, ledger_of(recording, None), *others)
    found = {each.folder.resolve(): each for each in every if each.exists}
    return [found[folder] for folder in sorted(found)]
