"""The recordings of a folder, each with what a list of them shows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from daq.caveats import NO_CAVEATS, Caveats
from daq.errors import HuddleError, RecordingError
from daq.recorder.retention import remove_run
from daq.recording.reader import Recording
from daq.recording.storage.locking import is_being_written
from daq.results.store import stored_verdict
from estimator.decision.verdict import Verdict


@dataclass(frozen=True, slots=True)
class Entry:
    """One recording.

    Attributes
    ----------
    path : Path
    size : int
        In bytes.
    modified_ns : int
        When the file was written last.
    created : datetime or None
        UTC; None of a file that cannot be read.
    bench : str
        Name of the bench; empty for an imported recording.
    operator : str
    caveats : Caveats
    length : float
        Of the longest sensor, in seconds.
    is_growing : bool
        Whether a recorder writes it.
    is_closed : bool
        Whether it was closed properly.
    has_limits : bool
        Whether its bench has limits.
    has_result : bool
        Whether it holds the result of an estimate.
    verdict : Verdict or None
        Of the stored result; None where none is stored.
    problem : str
        Why the file cannot be read.
    run_id, continues : str
        Of the recording, and of the one that it continues because the disk refused that.
    part_of, goes_on_in : str
        Names of the files before and after it, where a recording is in parts.
    """

    path: Path
    size: int
    modified_ns: int
    created: datetime | None = None
    bench: str = ""
    operator: str = ""
    caveats: Caveats = NO_CAVEATS
    length: float = 0.0
    is_growing: bool = False
    is_closed: bool = False
    has_limits: bool = False
    has_result: bool = False
    verdict: Verdict | None = None
    problem: str = ""
    run_id: str = ""
    continues: str = ""
    part_of: str = ""
    goes_on_in: str = ""

    @property
    def place(self) -> str:
        """The bench, and its caveats."""
        return self.caveats.after(self.bench)


def catalogue(
    folder: Path,
    known: Mapping[Path, Entry],
    *,
    besides: Path | None = None,
    cancelled: Callable[[], bool] = lambda: False,
) -> list[Entry]:
    """Return the recordings of a folder, the newest first.

    Parameters
    ----------
    folder : Path
    known : mapping
        Entries of an earlier call, by path: files that have not changed are not read again.
    besides : Path, optional
        A recording that this process reads already: it is not opened a second time while it grows,
        for HDF5 shares what it knows of a file. Its entry says that it is growing.
    cancelled : callable
        Asked before each file; a cancelled call returns what it has.
    """
    found = []
    for path in folder.glob("*.h5"):
        if cancelled():
            break
        try:
            about = path.stat()
        except OSError:  # removed meanwhile
            continue
        before = known.get(path)
        now = about.st_size, about.st_mtime_ns
        if before is not None and (before.size, before.modified_ns) == now:
            if not before.is_growing or is_being_written(path):
                found.append(before)
                continue
        elif path == besides and is_being_written(path):
            found.append(Entry(path, *now, is_growing=True))
            continue
        found.append(_entry(path, *now))
    return sorted(
        _in_parts(found), key=lambda entry: (_start(entry), entry.path.name), reverse=True
    )


def _in_parts(entries: Sequence[Entry]) -> Iterator[Entry]:
    """Yield recordings with the names of the files that they continue, and that continue them."""
    named = {entry.run_id: entry.path.name for entry in entries if entry.run_id}
    following = {entry.continues: entry.path.name for entry in entries if entry.continues}
    for entry in entries:
        part_of, goes_on_in = named.get(entry.continues, ""), following.get(entry.run_id, "")
        yield replace(entry, part_of=part_of, goes_on_in=goes_on_in)


def delete_recording(path: Path) -> None:
    """Delete a recording with its journal, results and reports.

    Raises
    ------
    RecordingError
        If a recorder is writing it, or a file cannot be removed.
    """
    if is_being_written(path):
        raise RecordingError(f"{path}: is being recorded; stop the recording first")
    try:
        remove_run(path)
    except OSError as error:
        raise RecordingError(
            f"{error.filename or path}: cannot be deleted: {error.strerror}"
        ) from error


def _start(entry: Entry) -> float:
    return entry.modified_ns * 1e-9 if entry.created is None else entry.created.timestamp()


def _entry(path: Path, size: int, modified_ns: int) -> Entry:
    try:
        with Recording.open(path) as recording:
            bench = recording.bench
            lengths = [sensor.n_samples / sensor.sampling_rate for sensor in recording.sensors]
            has_result, verdict = stored_verdict(recording)
            return Entry(
                path=path,
                size=size,
                modified_ns=modified_ns,
                created=recording.created,
                bench="" if bench is None else bench.name,
                operator=recording.operator,
                caveats=recording.caveats,
                length=max(lengths),
                is_growing=not recording.closed and is_being_written(path),
                is_closed=recording.closed,
                has_limits=bench is not None and bench.has_limits,
                has_result=has_result,
                verdict=verdict,
                run_id=recording.run_id,
                continues=recording.continues,
            )
    except (HuddleError, OSError) as error:
        return Entry(path, size, modified_ns, problem=str(error))
