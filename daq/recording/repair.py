"""Verifies recordings, closes those that a killed recorder left open, and stores results.

Theory of operation
-------------------
A recording is never changed in place. A copy beside it is changed, fsynced and renamed over the
original, so that there is always one intact file under the name.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from daq.errors import RecordingError
from daq.host_clock import SystemClock
from daq.protocols.block import EventKind
from daq.recording import file_format
from daq.recording.locking import is_being_written
from daq.recording.reader import Recording, SensorRecord
from daq.recording.superblock import Superblock
from daq.recording.writer import LIBVER, sync_directory

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from daq.protocols.block import HostTime

_ROWS_PER_READ = 1 << 18


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
        Rows that were written and never acknowledged; they are not part of the recording.
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

    @property
    def intact(self) -> bool:
        """Whether all committed blocks have their checksums."""
        return not any(sensor.bad_blocks for sensor in self.sensors)


def verify(path: str | Path) -> Verification:
    """Check the checksums of all committed blocks.

    Raises
    ------
    NotARecordingError, RecordingError
        If the file is no recording, or cannot be read at all.
    """
    path = Path(path)
    being_written = is_being_written(path) if path.is_file() else False
    with Recording.open(path, isolated=True) as recording:
        sensors = tuple(_verify_sensor(sensor) for sensor in recording.sensors)
        return Verification(path, recording.closed, being_written, sensors, len(recording.events))


def repair(path: str | Path, *, now: HostTime | None = None) -> Verification:
    """Close a recording that a killed recorder left open; uncommitted rows are removed.

    A closed recording is not changed.

    Raises
    ------
    NotARecordingError
        If the file is no recording.
    RecordingError
        If a recorder is writing the file, or the copy cannot be written.
    """
    path = Path(path)
    report = verify(path)
    if report.closed:
        return report
    if report.being_written:
        raise RecordingError(
            f"{path}: another program is writing it or has it open; stop that program first"
        )
    now = SystemClock().now() if now is None else now
    with _replaced(path) as copy:
        with copy.open("r+b") as raw:
            raw.write(Superblock.of(path).cleared())
        with h5py.File(copy, "r+", libver=LIBVER) as file:
            _cut_to_committed(file, report)
            _add_last_events(file, report, now)
    return verify(path)


def write_results(
    path: str | Path,
    results: Mapping[str, tuple[Mapping[str, NDArray[Any]], Mapping[str, Any]]],
) -> None:
    """Write the results of an estimate to ``/results``, replacing earlier ones.

    All results are written in one pass; a crash leaves either all of them or none. A recording that
    its recorder left open is closed first.

    Parameters
    ----------
    path : path
    results : mapping
        Arrays and attributes by name of the method, as `Recording.results` returns them.

    Raises
    ------
    RecordingError
        If a recorder is writing the file, or it cannot be written.
    """
    path = Path(path)
    with Recording.open(path, isolated=True) as recording:
        closed = recording.closed
    if not closed:
        repair(path)
    with _replaced(path) as copy, h5py.File(copy, "r+", libver=LIBVER) as file:
        if "results" in file:
            del file["results"]
        for method, (arrays, attributes) in results.items():
            group = file.create_group(f"results/{method}")
            for name, values in arrays.items():
                group.create_dataset(name, data=values)
            group.attrs.update(attributes)


def _verify_sensor(sensor: SensorRecord) -> SensorVerification:
    blocks = sensor.blocks
    bad = [number for number, row in enumerate(blocks) if not _is_intact(sensor, row)]
    return SensorVerification(
        name=sensor.name,
        n_samples=sensor.n_samples,
        n_blocks=len(blocks),
        n_gaps=len(sensor.gaps),
        bad_blocks=tuple(bad),
        n_uncommitted=sensor.n_written - sensor.n_samples,
    )


def _is_intact(sensor: SensorRecord, row: NDArray[np.void]) -> bool:
    crc32 = 0
    first, end = int(row["first_row"]), int(row["first_row"] + row["n_samples"])
    try:
        for start in range(first, end, _ROWS_PER_READ):
            counts = sensor.counts(start, min(start + _ROWS_PER_READ, end))
            crc32 = zlib.crc32(np.ascontiguousarray(counts).data, crc32)
    except (RecordingError, IndexError):
        return False
    return bool(file_format.block_crc32(row, crc32) == row["crc32"])


def _cut_to_committed(file: h5py.File, report: Verification) -> None:
    for sensor in report.sensors:
        group = file["sensors"][sensor.name]
        group["samples"].resize(sensor.n_samples, axis=0)
        instants = group["instants"]
        instants.resize(min(sensor.n_samples, len(instants)), axis=0)
        group["blocks"].resize(sensor.n_blocks, axis=0)
        group["gaps"].resize(sensor.n_gaps, axis=0)


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
    file["committed"][...] = [*counts, [n_events, 1, 0]]


@contextlib.contextmanager
def _replaced(path: Path) -> Iterator[Path]:
    """Yield a copy to be changed; it replaces the original if no error occurs."""
    copy = path.with_name(f".{path.name}.copy")
    try:
        shutil.copyfile(path, copy)
        yield copy
        with copy.open("r+b") as written:  # Windows syncs only what may be written
            os.fsync(written)
        copy.replace(path)
        sync_directory(path.parent)
    except RecordingError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise RecordingError(
            f"{path}: cannot be rewritten ({error}); it was not changed"
        ) from error
    finally:
        copy.unlink(missing_ok=True)
