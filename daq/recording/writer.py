"""Writes a recording so that acknowledged data survive kill -9 and power loss.

Theory of operation
-------------------
All groups, datasets and attributes are created under a unique temporary name. Then the file is
switched to SWMR (single writer, multiple readers) and gets its name, which must be free: an
incomplete recording never has the final name, and of two recorders with the same name one fails.
From then on rows are only appended. Samples are written in complete compressed chunks: HDF5 would
rewrite partial chunks elsewhere, and the file would grow. So a sample is buffered for up to the
duration of one chunk.

``commit`` flushes and fsyncs the appended rows; appends them to the journal
(:mod:`daq.recording.storage.journal`) and fsyncs it; writes the numbers of rows to ``/committed``,
for readers; and only then acknowledges. ``/committed`` has a fixed size and position. If a crash
interrupts its writing, some numbers are old and some new; all count safe rows. Readers cut all
datasets of a sensor to the shortest.

``close`` closes the file, fsyncs it, and then removes the journal.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import uuid
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from daq.bench.tables.unattended import Hooks
from daq.errors import DiskError, RecordingError, RemovedError
from daq.recording import file_format
from daq.recording.chunks.chunk_writer import SensorRows, TableBuffer
from daq.recording.chunks.manifest import differences, make_manifest, write_manifest
from daq.recording.description import make_checksums, write_checksums
from daq.recording.extremes import GrowingFile
from daq.recording.storage.journal import Journal
from daq.recording.storage.locking import WriterLock
from daq.recording.storage.names import give_back, publish, remove_leftovers, taken
from daq.recording.storage.refusals import text
from daq.recording.storage.retries import reason_of, repeated
from daq.recording.storage.trial import remember
from daq.whole_file import PRIVATE, RememberingFile, create_private, sync_directory, sync_file

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daq.bench.model import Bench
    from daq.protocols.block import Block, Event, HostTime, Reading
    from daq.recording.file_format import SensorLayout

_LOGGER = logging.getLogger(__name__)
_MIN_CHUNK_ROWS = 64


def write_attributes(
    file: h5py.File,
    bench: Bench | None,
    created: HostTime,
    control: tuple[int, str] | None,
    attributes: dict[str, str | float],
    *,
    sensors: Sequence[SensorLayout],
) -> None:
    """Write the attributes that are known at the start of the run."""
    utc = datetime.fromtimestamp(created.utc_ns / 1e9, tz=UTC)
    try:
        software = f"huddle {version('huddle-bench')}"
    except PackageNotFoundError:
        software = "huddle"
    known: dict[str, Any] = {
        "format": file_format.FORMAT,
        "format_version": max(sensor.format_version for sensor in sensors),
        "run_id": uuid.uuid4().hex,
        "created": utc.isoformat(timespec="microseconds"),
        "created_utc_ns": created.utc_ns,
        "created_monotonic_ns": created.monotonic_ns,
        "software": software,
        "bench": "" if bench is None else recorded_text(bench),
        "operator": "" if bench is None else bench.operator,
        "location": "" if bench is None else bench.location,
    } | attributes
    if control is not None:
        known["control_port"], known["control_token"] = control
    file.attrs.update({name: file_format.fixed(value) for name, value in known.items()})


def recorded_text(bench: Bench) -> str:
    """Return the text of a bench file without the tables that may hold secrets.

    A recording is passed on. Commands and addresses of a service are of no use in it.
    """
    private = bench.metrics, bench.signing, bench.web
    if bench.hooks == Hooks() and private == (None, None, None):
        return bench.text
    from daq.bench.editing import without_tables  # noqa: PLC0415 - tomlkit takes 30 ms to import

    return without_tables(bench.text, *file_format.PRIVATE_TABLES)


def make_datasets(file: h5py.File, sensors: Sequence[SensorLayout], chunk_seconds: float) -> None:
    """Create the empty datasets of all sensors, events, readings, and ``/committed``."""
    groups = file.create_group("sensors")
    for sensor in sensors:
        group = groups.create_group(sensor.name)
        for key in ("model", "serial_number", "driver", "port", "clock", "sampling_rate"):
            group.attrs[key] = file_format.fixed(getattr(sensor, key))
        if sensor.firmware:
            group.attrs["firmware"] = file_format.fixed(sensor.firmware)
        if sensor.temperature is not None:
            group.attrs["temperature"] = float(sensor.temperature)
        n_channels = len(sensor.channels)
        # Reading a chunk takes at least 10 µs, so at low rates a chunk has 2 s.
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
        if sensor.absent is not None and len(sensor.absent):
            samples.attrs["absent"] = sensor.absent
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
        instants.attrs["unit"] = file_format.fixed("ns")
        _make_table(group, "blocks", file_format.BLOCK_DTYPE, file_format.BLOCKS_PER_CHUNK)
        _make_table(group, "gaps", file_format.GAP_DTYPE, file_format.GAPS_PER_CHUNK)
    _make_table(file, "events", file_format.EVENT_DTYPE, file_format.EVENTS_PER_CHUNK)
    _make_table(file, "readings", file_format.READING_DTYPE, file_format.READINGS_PER_CHUNK)
    make_checksums(file, len(sensors))
    committed = file.create_dataset("committed", data=np.zeros((len(sensors) + 1, 3), "<i8"))
    fixed = file_format.fixed
    committed.attrs["sensors"] = fixed([sensor.name for sensor in sensors])
    committed.attrs["columns"] = fixed(["rows", "blocks", "gaps"])
    committed.attrs["last_row"] = fixed(["events", "closed", "readings"])
    make_manifest(file)


def _make_table(group: h5py.Group, name: str, dtype: np.dtype[Any], n_rows: int) -> None:
    group.create_dataset(name, shape=(0,), maxshape=(None,), chunks=(n_rows,), dtype=dtype)


BROKEN: list[RecordingWriter | h5py.File] = []
"""What HDF5 could not write or close. Freeing their objects also fails, prints tracebacks, and
may crash. The recorder therefore ends without freeing them."""

IN_MEMORY = {"driver": "core", "backing_store": False, "libver": file_format.LIBVER}


@dataclass(frozen=True, slots=True)
class SensorCounts:
    """Numbers of rows of one sensor that are safe on disk."""

    rows: int
    blocks: int
    gaps: int


@dataclass(frozen=True, slots=True)
class Committed:
    """An acknowledgment: the numbers of rows that are safe on disk."""

    sensors: dict[str, SensorCounts]
    events: int
    closed: bool = False


class RecordingWriter:
    """Writes one recording; not thread-safe, but may be used from any single thread."""

    def __init__(
        self,
        path: Path,
        file: h5py.File,
        sensors: Sequence[SensorLayout],
        lock: WriterLock,
        *,
        disk: RememberingFile | None = None,
    ) -> None:
        self.path = path
        self._disk = disk
        self._hidden: Path | None = None
        self._journal: Journal | None = None
        self._file = file
        self._lock = lock
        self._sensors = {
            s.name: SensorRows(file["sensors"][s.name], s, packs=disk is not None) for s in sensors
        }
        self._events = TableBuffer(file["events"])
        self._readings = TableBuffer(file["readings"])
        self._committed = file["committed"]
        self._run_id = text(file.attrs, "run_id")
        extremes = {name: each.extremes for name, each in self._sensors.items()}
        self._extremes = GrowingFile(path, self._run_id, extremes)
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
            Keep the temporary name until `close`, to hide an incomplete recording; `abandon` then
            removes the file. Chunks are packed as in `daq.recording.storage.packing`. No write that
            fails is repeated.

        Raises
        ------
        RecordingError
            If the file exists or cannot be written.
        """
        path = Path(path)
        if path.exists():
            raise taken(path)
        renames = hidden or os.name != "nt"  # Windows cannot rename an open file
        with _as_recording_error(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(path)
            temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.new") if renames else path
            create_private(temporary)
            lock, file, writer = WriterLock(temporary), None, None
            disk = RememberingFile(temporary, "r+") if hidden else None
            try:
                with h5py.File(str(temporary), "w", **IN_MEMORY) as new:
                    write_attributes(
                        new, bench, created, control, attributes or {}, sensors=sensors
                    )
                    make_datasets(new, sensors, chunk_seconds)
                    new.flush()
                    # HDF5 can crash when it frees objects that it could not write.
                    temporary.write_bytes(new.id.get_file_image())
                # A small cache suffices: chunks are written completely and not read again.
                file = h5py.File(
                    disk or temporary,
                    "r+",
                    libver=file_format.LIBVER,
                    rdcc_nbytes=64 * 1024,
                    locking=False,
                )
                if not hidden:
                    file.swmr_mode = True
                writer = cls(path, file, sensors, lock, disk=disk)
                writer._sync()
                if hidden:
                    writer._hidden = temporary
                else:
                    if renames:
                        publish(temporary, path)
                    writer._journal = Journal(path, file, PRIVATE)
                sync_directory(path.parent)
            except BaseException:
                with contextlib.suppress(OSError, RuntimeError):
                    if file is not None:
                        BROKEN.append(file)
                        file.close()
                        BROKEN.remove(file)
                    if disk is not None:
                        disk.close()
                lock.release()
                temporary.unlink(missing_ok=True)
                raise
        return writer

    @property
    def run_id(self) -> str:
        """Unique identifier of the recording."""
        return self._run_id

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

    def reading(self, reading: Reading) -> None:
        """Record a reading."""
        row = (
            reading.received.monotonic_ns,
            reading.received.utc_ns,
            _field(reading.sensor, 64),
            _field(reading.quantity, 32),
            reading.value,
        )
        self._readings.add(np.array([row], file_format.READING_DTYPE))

    def commit(self) -> Committed:
        """Make all complete chunks safe on disk, and return the numbers of safe rows.

        Raises
        ------
        RecordingError
            If the file cannot be written (disk full, device removed); rows acknowledged earlier
            remain safe.
        """
        return self._commit(closed=False)

    def close(self) -> Committed:
        """Write and commit all buffered rows, and close the file.

        Raises
        ------
        RecordingError
            If the file cannot be written; it is nevertheless closed.
        """
        try:
            with self._guarded():
                for sensor in self._sensors.values():
                    sensor.finish()
            done = self._commit(closed=True)
            with self._guarded():
                self._close_hdf5()
                sync_file(self._hidden or self.path)
                if self._hidden is not None:
                    self._prove(self._hidden)
                    publish(self._hidden, self.path)
                self._hidden = None
                if self._journal is not None:
                    self._journal.remove()
                sync_directory(self.path.parent)
                remember(self.path)
            return done
        finally:
            self.abandon()

    def discard(self) -> None:
        """Close and remove the file, which must not hold acknowledged rows."""
        self.abandon()
        with contextlib.suppress(OSError):
            self.path.unlink(missing_ok=True)
            self._extremes.path.unlink(missing_ok=True)
            if self._journal is not None:
                self._journal.remove()

    def abandon(self) -> None:
        """Close the file without writing buffered rows."""
        try:
            self._close_file()
        finally:
            if self._hidden is not None:
                self._hidden.unlink(missing_ok=True)
                self._extremes.path.unlink(missing_ok=True)

    def _close_hdf5(self) -> None:
        """Close the file; do not print errors of HDF5 while it frees objects."""
        before = sys.unraisablehook
        sys.unraisablehook = lambda _: None
        self._file.close()
        sys.unraisablehook = before  # not after an error: objects are then freed later
        if self._disk is not None:
            self._disk.close()
            self._disk.check()

    def _prove(self, hidden: Path) -> None:
        """Compare the closed file with the digests of what was in memory."""
        with h5py.File(hidden, "r", locking=False) as file:
            if changed := differences(file):
                raise RecordingError(
                    f"{self.path}: the disk returns other content than was written:"
                    f" {', '.join(changed)}"
                )

    def _close_file(self) -> None:
        try:
            with contextlib.suppress(OSError, RuntimeError):
                self._close_hdf5()
            if self._journal is not None:
                self._journal.close()
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
            self._readings.write()
            counts[-1] = self._events.n_rows, closed, self._readings.n_rows
            self._sync()
            self._check_place()
            for sensor in self._sensors.values():
                sensor.are_safe()
            if self._journal is not None:
                self._journal.commit(self._chunked(), self._new_rows(), counts)
            self._committed[...] = counts
            if closed:
                write_checksums(self._file)
                write_manifest(self._file, contents=self._contents_sha256())
            repeated(self._file.flush)
        blocks = {name: (s.blocks.n_rows, s.of_blocks) for name, s in self._sensors.items()}
        self._extremes.append(self._hidden or self.path, blocks, last=closed)
        return Committed(
            {
                name: SensorCounts(*map(int, row))
                for name, row in zip(self._sensors, counts[:-1], strict=True)
            },
            self._events.n_rows,
            closed,
        )

    def _contents_sha256(self) -> dict[str, bytes]:
        found = {each.name: each.sha256.digest() for each in (self._events, self._readings)}
        for sensor in self._sensors.values():
            found |= sensor.contents_sha256()
        return found

    def _chunked(self) -> dict[str, tuple[h5py.Dataset, ...]]:
        return {
            name: (sensor.samples.dataset, sensor.instants.dataset)
            for name, sensor in self._sensors.items()
        }

    def _new_rows(self) -> dict[str, tuple[bytes, ...]]:
        rows = {
            name: (sensor.blocks.written, sensor.gaps.written)
            for name, sensor in self._sensors.items()
        }
        return {**rows, "": (self._events.written, self._readings.written)}

    def _check_place(self) -> None:
        """Check that the file still has its name; give it back to a file that was renamed.

        Readers, the journal and a service know the file by this name.

        Raises
        ------
        DiskError
            If the name leads to another file, or to a copy of what was removed.
        RemovedError
            If what was removed cannot be copied.
        """
        place, handle = self._hidden or self.path, self._handle
        if self._journal is not None:
            self._journal.keep_name()
        found, is_taken = os.fstat(handle), os.path.lexists(place)
        if place.exists() and os.path.samestat(place.stat(), found):
            return
        what = "was replaced by another file" if is_taken else "lost its name"
        what = f"{place}: {what} while it was recorded"
        if is_taken and found.st_nlink:
            raise DiskError(what)
        try:
            again = give_back(place, handle)
        except (OSError, NotImplementedError) as error:
            kind = DiskError if found.st_nlink else RemovedError
            raise kind(f"{what}, and cannot be written again: {reason_of(error)}") from error
        if not found.st_nlink:
            raise DiskError(f"{what}; what was safe in it is in {again.name}")
        _LOGGER.warning("%s, and has it again", what)

    def _write_again(self) -> None:
        for sensor in self._sensors.values():
            sensor.write_again()

    @property
    def _handle(self) -> int:
        return int(self._file.id.get_vfd_handle() if self._disk is None else self._disk.fileno())

    def _sync(self) -> None:
        repeated(self._file.flush, before=self._write_again)
        if self._disk is not None:
            self._disk.check()
        os.fsync(self._handle)

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
            BROKEN.append(self)
            raise


@contextlib.contextmanager
def _as_recording_error(path: Path) -> Iterator[None]:
    try:
        yield
    except RecordingError:
        raise
    except (OSError, RuntimeError) as error:
        # HDF5 raises RuntimeError for a full disk.
        raise DiskError(f"{path}: cannot be written: {reason_of(error)}") from error


def _field(text: str, n_bytes: int) -> bytes:
    """Return text as UTF-8 of at most ``n_bytes``, not cut within a character."""
    return text.encode()[:n_bytes].decode(errors="ignore").encode()
