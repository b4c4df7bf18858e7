"""Writes a recording so that acknowledged data survive kill -9 and power loss.

Theory of operation
-------------------
All groups, datasets and attributes are made under a temporary name. Then the file is switched to
SWMR (single writer, multiple readers) and renamed, so that an incomplete recording never has the
final name. From then on rows are only appended. Samples are written in whole compressed chunks:
partial chunks would be rewritten elsewhere and inflate the file. So a sample is buffered for up to
the length of one chunk.

``commit`` flushes and fsyncs the appended rows, then writes their numbers to ``/committed``, fsyncs
again, and only then acknowledges. ``/committed`` has a fixed size and place. If a crash interrupts
its writing, some numbers are old and some new; each counts rows that are safe. Readers cut all
datasets of a sensor to the shortest.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import uuid
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from daq.errors import RecordingError
from daq.recording import file_format
from daq.recording.chunk_writer import SensorRows, TableBuffer
from daq.recording.locking import WriterLock, is_being_written

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daq.bench.model import Bench
    from daq.protocols.block import Block, Event, HostTime
    from daq.recording.file_format import SensorLayout

LIBVER = ("v110", "v110")
_MIN_CHUNK_ROWS = 64


@dataclass(frozen=True, slots=True)
class SensorCounts:
    """Numbers of rows of one sensor that are safe on disk."""

    rows: int
    blocks: int
    gaps: int


@dataclass(frozen=True, slots=True)
class Committed:
    """An acknowledgment: what is safe on disk."""

    sensors: dict[str, SensorCounts]
    events: int
    closed: bool = False


class RecordingWriter:
    """Writes one recording; not thread-safe, but may be used from any single thread."""

    def __init__(
        self, path: Path, file: h5py.File, sensors: Sequence[SensorLayout], lock: WriterLock
    ) -> None:
        self.path = path
        self._hidden: Path | None = None
        self._file = file
        self._lock = lock
        self._sensors = {s.name: SensorRows(file["sensors"][s.name], s) for s in sensors}
        self._events = TableBuffer(file["events"])
        self._committed = file["committed"]
        self._failed = False

    @classmethod
    def create(
        cls,
        path: str | Path,
        bench: Bench | None = None,
        *,
        sensors: Sequence[SensorLayout],
        created: HostTime,
        control: tuple[int, str] | None = None,
        attributes: dict[str, str | float] | None = None,
        chunk_seconds: float = 1.0,
        hidden: bool = False,
    ) -> RecordingWriter:
        """Create a recording.

        Parameters
        ----------
        path : path
            Must not exist; its directory is made.
        bench : Bench, optional
            The bench that is recorded.
        sensors : sequence of SensorLayout
            In the order of the bench.
        created : HostTime
            The current time.
        control : (port, token), optional
            Address for commands to the recorder (:mod:`daq.recording.control`).
        attributes : dict, optional
            More attributes of the file, such as its origin.
        chunk_seconds : float
            Length of a chunk. Longer chunks are read faster, but samples are buffered longer.
        hidden : bool
            Keep the temporary name until `close`, for a recording that is not to be seen before it
            is complete; `abandon` then removes it.

        Raises
        ------
        RecordingError
            If the file exists or cannot be written.
        """
        path = Path(path)
        if path.exists():
            raise RecordingError(f"{path}: exists already; expected a new file")
        renames = hidden or os.name != "nt"  # Windows renames no file that is open
        temporary = path.with_name(f".{path.name}.new") if renames else path
        if hidden and temporary.exists() and is_being_written(temporary):
            raise RecordingError(f"{path}: another process is writing it; expected a new file")
        with _as_recording_error(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            # A small cache: chunks are written whole and not read again.
            file = h5py.File(temporary, "w", libver=LIBVER, rdcc_nbytes=64 * 1024, locking=False)
            try:
                _write_attributes(file, bench, created, control, attributes or {})
                _make_datasets(file, sensors, chunk_seconds)
                file.swmr_mode = True
                writer = cls(path, file, sensors, WriterLock(temporary))
                writer._sync()
                if hidden:
                    writer._hidden = temporary
                elif renames:
                    temporary.rename(path)
                sync_directory(path.parent)
            except BaseException:
                with contextlib.suppress(OSError, RuntimeError):
                    file.close()
                temporary.unlink(missing_ok=True)
                raise
        return writer

    @property
    def n_written(self) -> int:
        """Number of rows of samples of all sensors in the file, committed or not."""
        return sum(sensor.samples.n_written for sensor in self._sensors.values())

    def append(self, block: Block) -> None:
        """Add a block; it is safe once a later ``commit`` counts it."""
        with self._guarded():
            self._sensors[block.sensor].append(block)

    def gap(
        self, sensor: str, first_sample: int, missing: int, *, reason: str, estimated: bool = False
    ) -> None:
        """Record that samples from ``first_sample`` on are missing."""
        row = (first_sample, missing, estimated, _field(reason, 100))
        self._sensors[sensor].gaps.add(np.array([row], file_format.GAP_DTYPE))

    def event(self, event: Event) -> None:
        """Record an event."""
        row = (
            event.received.monotonic_ns,
            event.received.utc_ns,
            _field(event.sensor, 64),
            _field(event.kind, 32),
            _field(event.text, 200),
        )
        self._events.add(np.array([row], file_format.EVENT_DTYPE))

    def commit(self) -> Committed:
        """Make all complete chunks safe on disk, and return what is safe.

        Raises
        ------
        RecordingError
            If the file cannot be written (disk full, device removed); what earlier commits
            acknowledged stays.
        """
        return self._commit(closed=False)

    def close(self) -> Committed:
        """Write and commit everything, and close the file.

        Raises
        ------
        RecordingError
            If the file cannot be written; it is closed all the same.
        """
        try:
            with self._guarded():
                for sensor in self._sensors.values():
                    sensor.finish()
            done = self._commit(closed=True)
            if self._hidden is not None:
                with _as_recording_error(self.path):
                    self._file.close()
                    _publish(self._hidden, self.path)
                self._hidden = None
            return done
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file without writing buffered rows."""
        try:
            self._close_file()
        finally:
            if self._hidden is not None:
                self._hidden.unlink(missing_ok=True)

    def _close_file(self) -> None:
        try:
            with contextlib.suppress(OSError, RuntimeError):
                self._file.close()
        finally:
            self._lock.release()

    def _commit(self, *, closed: bool) -> Committed:
        with self._guarded():
            counts = np.zeros(self._committed.shape, np.int64)
            for number, sensor in enumerate(self._sensors.values()):
                sensor.collect()
                sensor.blocks.write()
                sensor.gaps.write()
                counts[number] = sensor.committable_rows, sensor.blocks.n_rows, sensor.gaps.n_rows
            self._events.write()
            counts[-1, : file_format.CLOSED + 1] = self._events.n_rows, closed
            self._sync()
            self._committed[...] = counts
            self._sync()
        return Committed(
            {
                name: SensorCounts(*map(int, row))
                for name, row in zip(self._sensors, counts[:-1], strict=True)
            },
            self._events.n_rows,
            closed,
        )

    def _sync(self) -> None:
        self._file.flush()
        os.fsync(self._file.id.get_vfd_handle())

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Convert errors of HDF5 to RecordingError, and refuse to write after a failure."""
        if self._failed:
            raise RecordingError(f"{self.path}: cannot be written: an earlier write failed")
        try:
            with _as_recording_error(self.path):
                yield
        except RecordingError:
            self._failed = True
            raise


@contextlib.contextmanager
def _as_recording_error(path: Path) -> Iterator[None]:
    try:
        yield
    except RecordingError:
        raise
    except (OSError, RuntimeError) as error:
        # HDF5 raises RuntimeError for a full disk, with the system's message only in its text.
        found = re.search(r"error message = '([^']+)'", str(error))
        reason = found[1] if found else error
        raise RecordingError(f"{path}: cannot be written: {reason}") from error


def _publish(temporary: Path, path: Path) -> None:
    """Give a closed file its name, which nobody must have taken."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise RecordingError(f"{path}: exists already; expected a new file") from None
    except OSError:  # a file system without hard links
        if path.exists():
            raise RecordingError(f"{path}: exists already; expected a new file") from None
        temporary.rename(path)
    else:
        temporary.unlink()
    sync_directory(path.parent)


def _field(text: str, n_bytes: int) -> bytes:
    """Return text as UTF-8 of at most ``n_bytes``, not cut within a character."""
    return text.encode()[:n_bytes].decode(errors="ignore").encode()


def _write_attributes(
    file: h5py.File,
    bench: Bench | None,
    created: HostTime,
    control: tuple[int, str] | None,
    attributes: dict[str, str | float],
) -> None:
    utc = datetime.fromtimestamp(created.utc_ns / 1e9, tz=UTC)
    try:
        software = f"huddle {version('huddle-bench')}"
    except PackageNotFoundError:
        software = "huddle"
    file.attrs.update(
        {
            "format": file_format.FORMAT,
            "format_version": file_format.FORMAT_VERSION,
            "run_id": uuid.uuid4().hex,
            "created": utc.isoformat(timespec="microseconds"),
            "created_utc_ns": created.utc_ns,
            "created_monotonic_ns": created.monotonic_ns,
            "software": software,
            "bench": "" if bench is None else bench.text,
            "operator": "" if bench is None else bench.operator,
            "location": "" if bench is None else bench.location,
        }
        | attributes
    )
    if control is not None:
        file.attrs["control_port"], file.attrs["control_token"] = control


def _make_datasets(file: h5py.File, sensors: Sequence[SensorLayout], chunk_seconds: float) -> None:
    groups = file.create_group("sensors")
    for sensor in sensors:
        group = groups.create_group(sensor.name)
        for key in ("model", "serial_number", "driver", "port", "clock", "sampling_rate"):
            group.attrs[key] = getattr(sensor, key)
        n_channels = len(sensor.channels)
        # Reading a chunk takes at least 10 µs, so at low rates a chunk has two seconds.
        min_rows = min(_MIN_CHUNK_ROWS, round(2 * sensor.sampling_rate))
        n_rows = max(4, min_rows, round(sensor.sampling_rate * chunk_seconds))
        filters = {"shuffle": True, "compression": "gzip", "compression_opts": 1}
        samples = group.create_dataset(
            "samples",
            shape=(0, n_channels),
            maxshape=(None, n_channels),
            chunks=(n_rows, n_channels),
            dtype=sensor.dtype.newbyteorder("<"),
            fletcher32=True,
            **filters,
        )
        samples.attrs.update(file_format.channel_attributes(sensor.channels))
        # Remains empty unless the sensor is polled.
        instants = group.create_dataset(
            "instants",
            shape=(0,),
            maxshape=(None,),
            chunks=(n_rows,),
            dtype="<i8",
            fletcher32=True,
            **filters,
        )
        instants.attrs["unit"] = "ns"
        _make_table(group, "blocks", file_format.BLOCK_DTYPE, file_format.BLOCKS_PER_CHUNK)
        _make_table(group, "gaps", file_format.GAP_DTYPE, file_format.GAPS_PER_CHUNK)
    _make_table(file, "events", file_format.EVENT_DTYPE, file_format.EVENTS_PER_CHUNK)
    committed = file.create_dataset("committed", data=np.zeros((len(sensors) + 1, 3), "<i8"))
    committed.attrs["sensors"] = [sensor.name for sensor in sensors]
    committed.attrs["columns"] = ["rows", "blocks", "gaps"]
    committed.attrs["last_row"] = ["events", "closed", "unused"]


def _make_table(group: h5py.Group, name: str, dtype: np.dtype[Any], n_rows: int) -> None:
    group.create_dataset(name, shape=(0,), maxshape=(None,), chunks=(n_rows,), dtype=dtype)


def sync_directory(path: Path) -> None:
    """Make the names in a directory survive a power loss (not possible on Windows)."""
    if sys.platform == "win32":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
