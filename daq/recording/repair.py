"""Verifies recordings, closes those that a killed recorder left open, and stores results.

Theory of operation
-------------------
A recording is never changed in place. A copy in the same folder is changed, fsynced and renamed to
the original, so that the name always refers to an intact file.

``python -m daq.recording.repair TASK FILE…`` is the child of :mod:`daq.recording.storage.trial`.
Its task is ``open``, ``verify`` or ``close``. For each file it prints a line of JSON; before it, a
line with a point for each part that was read. It may hang or be killed at any file.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from daq.errors import HuddleError, NotARecordingError, RecordingError
from daq.host_clock import SystemClock
from daq.protocols.block import EventKind, HostTime
from daq.recording import file_format
from daq.recording.chunks.manifest import (
    RESULTS,
    RESULTS_MANIFEST,
    differences,
    items,
    root_sha256,
    write_manifest,
)
from daq.recording.description import result_crc32, write_checksums
from daq.recording.file_format import LIBVER, fixed
from daq.recording.reader import Recording
from daq.recording.sensor_record import SensorRecord
from daq.recording.storage.journal import JournalContents, journal_path, read_journal, rebuild
from daq.recording.storage.locking import is_being_written
from daq.recording.storage.opening import open_file
from daq.recording.storage.refusals import damage_named, text
from daq.recording.storage.superblock import Superblock
from daq.recording.storage.trial import remember, trials
from daq.recording.storage.whole_hdf5 import WholeHdf5
from daq.whole_file import create_private, replaced

_ROWS_PER_READ = 1 << 17
_CLOSE = "close"
_SUPERBLOCK = "the superblock: the recorder was killed while it closed the file"


@dataclass(frozen=True, slots=True)
class SensorVerification:
    """The data of one sensor in a recording.

    Attributes
    ----------
    name : str
    n_samples, n_blocks, n_gaps : int
        Committed.
    bad_blocks : tuple of int
        Indices of committed blocks that have a wrong checksum or cannot be read.
    n_uncommitted : int
        Rows written but never acknowledged; they are not part of the recording.
    """

    name: str
    n_samples: int
    n_blocks: int
    n_gaps: int
    bad_blocks: tuple[int, ...]
    n_uncommitted: int


@dataclass(frozen=True, slots=True)
class Verification:
    """The data in a recording, and whether they are intact."""

    path: Path
    closed: bool
    being_written: bool
    sensors: tuple[SensorVerification, ...]
    n_events: int
    n_readings: int = 0
    damaged_tables: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    """Datasets and attributes of a closed recording that differ from its manifest."""
    root_sha256: str = ""
    """SHA-256 of the manifest; empty if there is none."""
    run_id: str = ""
    warning: str = ""
    """Of what is no damage, and must be known before the recording is passed on."""

    @property
    def intact(self) -> bool:
        """Whether all committed rows, and everything in the manifest, are as they were written."""
        damaged = self.damaged_tables or self.changed
        return not damaged and not any(s.bad_blocks for s in self.sensors)


def verify(
    path: str | Path, *, progress: Callable[[], object] = lambda: None, tried: bool = False
) -> Verification:
    """Check the checksums of all committed blocks, and every object of a closed recording.

    Parameters
    ----------
    path : path
    progress : callable
        Called after each part of the file.
    tried : bool
        As for `Recording.open`.

    Raises
    ------
    NotARecordingError, RecordingError
        If the file is no recording, or cannot be read at all.
    """
    path = Path(path)
    being_written = is_being_written(path) if path.is_file() else False
    with Recording.open(path, tried=tried) as recording:
        sensors = tuple(_verify_sensor(sensor, progress) for sensor in recording.sensors)
        report = Verification(
            path,
            recording.closed,
            being_written,
            sensors,
            len(recording.events),
            len(recording.readings),
            recording.damaged_tables,
            run_id=recording.run_id,
            warning=recording.warning,
        )
    if not report.closed or being_written:
        return report
    if Superblock.of(path).is_open:  # killed between its last commit and the end of closing
        return replace(report, changed=(_SUPERBLOCK,))
    # As other programs open it: a wrong superblock, for example, stops those.
    with damage_named(path), h5py.File(path, "r", locking=False) as file:
        changed = tuple(differences(file, progress=progress))
        return replace(report, changed=changed, root_sha256=root_sha256(file))


def repair(
    path: str | Path,
    *,
    now: HostTime | None = None,
    progress: Callable[[], object] = lambda: None,
) -> Verification:
    """Close a recording that a killed recorder or a power cut left open.

    The recording is rebuilt from its journal, if there is one, with all acknowledged rows.
    Uncommitted rows are removed. A closed recording is not changed.

    Raises
    ------
    NotARecordingError
        If the file is no recording, or damaged and without a journal.
    RecordingError
        If a recorder is writing the file, or the copy cannot be written.
    """
    path = Path(path)
    if path.is_file() and is_being_written(path):
        raise RecordingError(
            f"{path}: another program is writing it or has it open; stop that program first"
        )
    journal = _own_journal(path)
    now = SystemClock().now() if now is None else now
    if journal is None:
        if not Superblock.of(path).is_open:
            report = verify(path, progress=progress)
            if report.closed:
                _remove_useless_journal(path)
                return report
        with _replaced(path) as copy:
            _close_in_child(path, copy, now)
    elif (whole := _whole(path, journal, progress)) is not None:
        journal_path(path).unlink()
        return whole
    else:
        with _replaced(path, copied=False) as copy:
            rebuild(path, journal, copy)
            _close(copy, verify(copy, progress=progress), now, progress)
        journal_path(path).unlink(missing_ok=True)
    _remove_useless_journal(path)
    return verify(path, progress=progress)


def _close_in_child(path: Path, copy: Path, now: HostTime) -> None:
    """Close the copy of a recording without a journal: HDF5 may crash in what a power cut tore."""
    for task in ("open", f"{_CLOSE}:{now.monotonic_ns}:{now.utc_ns}"):
        [(_, found)] = trials([copy], task)
        if reason := found.get("fatal") or found.get("error"):
            reason = reason.removeprefix(f"{copy}: ").removeprefix("the recording is ")
            reason = f"damaged: {reason.removeprefix('damaged: ')}"
            raise NotARecordingError(
                f"{path}: {reason}. It was not changed. Put {journal_path(path).name} beside it "
                "and repair it again, or restore a copy of both"
            )


def _close(copy: Path, report: Verification, now: HostTime, progress: Callable[[], object]) -> None:
    """Close a copy with the rows of a report, and refuse it if it then has others."""
    with WholeHdf5(copy, libver=LIBVER) as hdf5:
        if not report.closed:
            _cut_to_committed(hdf5.file, report)
            _add_last_events(hdf5.file, report, now)
        write_checksums(hdf5.file)
        write_manifest(hdf5.file)
        if RESULTS in hdf5.file:
            write_manifest(hdf5.file, RESULTS_MANIFEST)
    found = verify(copy, progress=progress, tried=True)
    if not found.closed or found.changed or found.sensors != _closed(report.sensors):
        raise RecordingError(f"{copy}: the repaired copy differs from what was saved")


def _closed(sensors: Sequence[SensorVerification]) -> tuple[SensorVerification, ...]:
    return tuple(replace(sensor, n_uncommitted=0) for sensor in sensors)


def _is_left_open(path: Path, report: Verification | Recording) -> bool:
    """Return whether a file was not closed, or not completely."""
    return not report.closed or Superblock.of(path).is_open


def _remove_useless_journal(path: Path) -> None:
    """Remove a journal that is incomplete because of a power cut before the first commit."""
    if read_journal(path) is None:
        journal_path(path).unlink(missing_ok=True)


def _own_journal(path: Path) -> JournalContents | None:
    """Return the journal of a recording; None if there is none, or that of another recording."""
    contents = read_journal(path)
    if contents is None or not path.is_file():
        return None
    with h5py.File(io.BytesIO(contents.created), "r") as created:
        run_id = text(created.attrs, "run_id")
    with path.open("rb") as file:  # the attributes, written once, survive most damage
        return contents if run_id.encode() in file.read(len(contents.created)) else None


def _whole(
    path: Path, journal: JournalContents, progress: Callable[[], object]
) -> Verification | None:
    """Return the report on a closed file with all rows of its journal; else None."""
    try:
        report = verify(path, progress=progress)
        is_whole = report.intact and not _is_left_open(path, report)
    except RecordingError:
        return None
    if journal.counts is None:
        return None
    counts = [[s.n_samples, s.n_blocks, s.n_gaps] for s in report.sensors]
    return report if is_whole and counts == journal.counts[:-1].tolist() else None


def write_results(
    path: str | Path,
    results: Mapping[str, tuple[Mapping[str, NDArray[Any]], Mapping[str, Any]]],
    about: Mapping[str, str] | None = None,
) -> None:
    """Write the results of an estimate to ``/results``, replacing earlier ones.

    All results are written in one pass; a crash leaves either all or none. A recording left open by
    its recorder is closed first.

    Parameters
    ----------
    path : path
    results : mapping
        Arrays and attributes by name of the method, as from `Recording.results`.
    about : mapping, optional
        Attributes of ``/results`` itself.

    Raises
    ------
    RecordingError
        If a recorder is writing the file, or it cannot be written.
    """
    path = Path(path)
    left_open = journal_path(path).exists()
    if not left_open:
        with Recording.open(path) as recording:
            left_open = _is_left_open(path, recording)
    if left_open:
        repair(path)
    with _replaced(path) as copy, WholeHdf5(copy, libver=LIBVER) as hdf5:
        file = hdf5.file
        if RESULTS in file:
            del file[RESULTS]
        for method, (arrays, attributes) in results.items():
            group = f"{RESULTS}/{method}"
            for name, values in arrays.items():
                hdf5.create(f"{group}/{name}", values)
            described = file[group].attrs
            described.update({name: fixed(value) for name, value in attributes.items()})
            described["crc32"] = result_crc32(arrays, attributes)
        for name, value in (about or {}).items():
            file.require_group(RESULTS).attrs[name] = fixed(value)
        write_manifest(file, RESULTS_MANIFEST, hdf5.contents)
    remember(path)


def _verify_sensor(sensor: SensorRecord, progress: Callable[[], object]) -> SensorVerification:
    for first in range(0, sensor.n_samples, _ROWS_PER_READ):
        sensor.intact_counts(first, min(first + _ROWS_PER_READ, sensor.n_samples))
        progress()
    first_rows = sensor.blocks["first_row"]
    return SensorVerification(
        name=sensor.name,
        n_samples=sensor.n_samples,
        n_blocks=len(first_rows),
        n_gaps=len(sensor.gaps),
        bad_blocks=tuple(np.flatnonzero(np.isin(first_rows, sensor.damaged_rows)).tolist()),
        n_uncommitted=sensor.n_written - sensor.n_samples,
    )


def _cut_to_committed(file: h5py.File, report: Verification) -> None:
    for sensor in report.sensors:
        group = file["sensors"][sensor.name]
        group["samples"].resize(sensor.n_samples, axis=0)
        instants = group["instants"]
        instants.resize(min(sensor.n_samples, len(instants)), axis=0)
        group["blocks"].resize(sensor.n_blocks, axis=0)
        group["gaps"].resize(sensor.n_gaps, axis=0)
    if "readings" in file:
        file["readings"].resize(report.n_readings, axis=0)


def _add_last_events(file: h5py.File, report: Verification, now: HostTime) -> None:
    """Record the repair as events, and mark the file as closed."""
    lines = [("", EventKind.STOPPED, "the recorder was killed; the recording was repaired")]
    lines += [
        (
            sensor.name,
            EventKind.CHECKSUM,
            f"{len(sensor.bad_blocks)} damaged blocks, first at row {row}",
        )
        for sensor in report.sensors
        for row in sensor.bad_blocks[:1]
    ]
    rows = [
        (now.monotonic_ns, now.utc_ns, name.encode(), kind.encode(), text.encode())
        for name, kind, text in lines
    ]
    n_events = report.n_events + len(rows)
    events = file["events"]
    events.resize(n_events, axis=0)
    events[report.n_events :] = np.array(rows, file_format.EVENT_DTYPE)
    counts = [[s.n_samples, s.n_blocks, s.n_gaps] for s in report.sensors]
    file["committed"][...] = [*counts, [n_events, 1, report.n_readings]]


@contextlib.contextmanager
def _replaced(path: Path, *, copied: bool = True) -> Iterator[Path]:
    """Yield a copy, or an empty file; it replaces the original if no error occurs."""
    try:
        with replaced(path) as copy:
            create_private(copy)
            if copied:
                shutil.copyfile(path, copy)
            yield copy
    except RecordingError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise RecordingError(
            f"{path}: cannot be rewritten ({error}); it was not changed"
        ) from error


def main() -> None:
    """Carry out a task on files, each of which may hold this process up."""
    logging.disable()
    task, *paths = sys.argv[1:]
    _print_progress()
    for path in map(Path, paths):
        print(json.dumps(found_in(path, task)), flush=True)


def found_in(path: Path, task: str) -> dict[str, Any]:
    """Return what a task finds in a file that may hold this process up."""
    try:
        if task.startswith(_CLOSE):
            return _closed_by(path, HostTime(*map(int, task.split(":")[1:])))
        return _opened(path) if task == "open" else _verified(path)
    except (HuddleError, OSError) as error:
        return {"error": str(error)}


def _opened(path: Path) -> dict[str, Any]:
    """Read all that a reader reads before the samples."""
    with Recording.open(path, tried=True) as recording:
        recording.results()
    with open_file(path) as file, damage_named(path):
        for _ in chain(items(file), items(file, RESULTS_MANIFEST)):
            _print_progress()
    return {"opened": True}


def _closed_by(path: Path, now: HostTime) -> dict[str, Any]:
    """Close a recording in its place."""
    report = verify(path, progress=_print_progress, tried=True)
    with path.open("r+b") as raw:
        raw.write(Superblock.of(path).cleared())
    with damage_named(path):
        _close(path, report, now, _print_progress)
    return {"closed": True}


def _verified(path: Path) -> dict[str, Any]:
    report = verify(path, progress=_print_progress, tried=True)
    damaged = [sensor.name for sensor in report.sensors if sensor.bad_blocks]
    return {
        "intact": report.intact,
        "closed": report.closed,
        "being_written": report.being_written,
        "damaged": [*damaged, *report.damaged_tables, *report.changed],
        "root_sha256": report.root_sha256,
        "run_id": report.run_id,
        "warning": report.warning,
    }


def _print_progress() -> None:
    print(".", flush=True)


if __name__ == "__main__":
    main()
