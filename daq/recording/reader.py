"""Reads recordings: growing ones, those of a killed recorder, and closed ones, by the same code.

A file is opened as a SWMR reader, which works in all three cases. A recording has the rows that
``/committed`` counts; rows beyond these were never acknowledged.
"""

from __future__ import annotations

import contextlib
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import h5py
import numpy as np

from daq.bench.loading import parse
from daq.errors import BenchFileError, NotARecordingError, RecordingError
from daq.protocols.block import Event, EventKind, HostTime
from daq.recording import file_format
from daq.recording.block_table import BlockTable
from daq.recording.chunk_reader import ChunkedRows
from daq.recording.locking import is_being_written
from daq.recording.superblock import ClearedFile, Superblock

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray

    from daq.bench.model import Bench, Channel


class _CommittedRows:
    """The committed rows of a table; each is read once."""

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._parts: list[NDArray[np.void]] = []
        self.n_rows = 0

    def extend(self, n_rows: int) -> None:
        """Read further rows, up to ``n_rows`` in all."""
        if n_rows > self.n_rows:
            self._dataset.refresh()
            part = self._dataset[self.n_rows : n_rows]
            if len(part) < n_rows - self.n_rows:
                raise OSError(
                    f"{self._dataset.name} has {self.n_rows + len(part)} rows where {n_rows} were"
                    " committed"
                )
            self._parts.append(part)
            self.n_rows = n_rows

    def rows(self) -> NDArray[np.void]:
        """Return all rows."""
        if not self._parts:
            return np.zeros(0, self._dataset.dtype)
        if len(self._parts) > 1:
            self._parts = [np.concatenate(self._parts)]
        return self._parts[0]


class SensorRecord:
    """The committed data of one sensor; grows when its recording is refreshed."""

    def __init__(self, group: h5py.Group) -> None:
        attributes = group.attrs
        self.name: str = group.name.rpartition("/")[2]
        self.model: str = attributes["model"]
        self.serial_number: str = attributes["serial_number"]
        self.driver: str = attributes["driver"]
        self.port: str = attributes["port"]
        self.clock: str = attributes["clock"]
        """Sensors with the same name here are sampled by one clock."""
        self.sampling_rate = float(attributes["sampling_rate"])
        """In Hz, as reported by the device; otherwise nominal."""
        self._samples: h5py.Dataset = group["samples"]
        self._instants: h5py.Dataset = group["instants"]
        self.channels: tuple[Channel, ...] = file_format.channels_of(self._samples.attrs)
        self.dtype: np.dtype[Any] = self._samples.dtype
        self._sample_rows = ChunkedRows(self._samples)
        self._instant_rows = ChunkedRows(self._instants)
        self.blocks = BlockTable(group["blocks"])
        self._gaps = _CommittedRows(group["gaps"])
        self.n_samples = 0
        """Number of committed rows of samples."""

    @property
    def polled(self) -> bool:
        """Whether the time of every sample is recorded; False as long as there are no samples."""
        return bool(self.n_samples > 0 and self._instants.shape[0] >= self.n_samples)

    @property
    def n_written(self) -> int:
        """Number of rows of samples in the file, including those never committed."""
        return int(self._samples.shape[0])

    @property
    def gaps(self) -> NDArray[np.void]:
        """Committed gaps, dtype :data:`daq.recording.file_format.GAP_DTYPE`."""
        return self._gaps.rows()

    def counts(self, first_row: int = 0, last_row: int | None = None) -> NDArray[Any]:
        """Return raw counts.

        Parameters
        ----------
        first_row, last_row : int
            Rows, without ``last_row``; up to ``n_samples`` if not given.

        Returns
        -------
        ndarray, shape (last_row - first_row, n_channels)

        Raises
        ------
        IndexError
            If these rows are not committed.
        RecordingError
            If the file is damaged there.
        """
        return self._read(self._sample_rows, first_row, last_row)

    def instants_ns(self, first_row: int = 0, last_row: int | None = None) -> NDArray[np.int64]:
        """Return the host monotonic time of each sample of a polled sensor, in ns.

        Raises
        ------
        IndexError
            If these rows are not committed.
        RecordingError
            If the sensor is not polled, or the file damaged.
        """
        if not self.polled:
            raise RecordingError(f"sensor {self.name!r} has no sample times")
        return self._read(self._instant_rows, first_row, last_row)

    def _read(self, rows: ChunkedRows, first_row: int, last_row: int | None) -> NDArray[Any]:
        last_row = self.n_samples if last_row is None else last_row
        if not 0 <= first_row <= last_row <= self.n_samples:
            raise IndexError(
                f"rows {first_row} to {last_row} of sensor {self.name!r}: {self.n_samples} are"
                " committed"
            )
        try:
            return rows.read(first_row, last_row)
        except (OSError, RuntimeError) as error:
            raise RecordingError(
                f"{self._samples.file.filename}: sensor {self.name!r} is damaged between rows"
                f" {first_row} and {last_row}: {error}"
            ) from error

    def extend(self, counts: NDArray[np.int64]) -> bool:
        """Add what a row of ``/committed`` counts; return whether anything is new."""
        before = self.n_samples, self._gaps.n_rows
        self.blocks.extend(int(counts[file_format.BLOCKS]), int(counts[file_format.ROWS]))
        self._gaps.extend(int(counts[file_format.GAPS]))
        if self.blocks.n_samples > self.n_samples:
            self._samples.refresh()
            self._instants.refresh()
            self.n_samples = self.blocks.n_samples
        return before != (self.n_samples, self._gaps.n_rows)


class Recording:
    """A recording that is open for reading."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self._file = file
        attributes = file.attrs
        self.run_id: str = attributes["run_id"]
        self.created = datetime.fromisoformat(attributes["created"])
        """UTC."""
        self.created_at = HostTime(
            int(attributes["created_monotonic_ns"]), int(attributes["created_utc_ns"])
        )
        self.software: str = attributes["software"]
        self.operator: str = attributes["operator"]
        self.location: str = attributes["location"]
        self.bench_text: str = attributes["bench"]
        duration = attributes.get("duration")
        self.duration = None if duration is None else float(duration)
        """Planned length in seconds; None where it was to last until stopped."""
        self._committed: h5py.Dataset = file["committed"]
        self.sensors = tuple(
            SensorRecord(file["sensors"][name]) for name in self._committed.attrs["sensors"]
        )
        """In the order of the bench."""
        self._events = _CommittedRows(file["events"])
        self.closed = False
        """Whether the recording was closed properly, and so is complete."""
        self.refresh()

    @classmethod
    def open(cls, path: str | Path, *, isolated: bool = False) -> Recording:
        """Open a recording: growing, closed, or left open by a killed recorder.

        Parameters
        ----------
        isolated : bool
            Share no cached metadata with other readers in this process, if no process is writing
            the file. HDF5 shares it among all readers of a file: beside a reader that has not been
            refreshed, a second one may read zeros in place of samples.

        Raises
        ------
        NotARecordingError
            If the file is something else, truncated, or of a newer format.
        RecordingError
            If the file cannot be read.
        """
        path = Path(path)
        file = _open_file(path, isolated=isolated)
        try:
            check_format(path, file)
            return cls(path, file)
        except (KeyError, OSError, RuntimeError, ValueError) as error:
            file.close()
            if isinstance(error, RecordingError):
                raise
            raise NotARecordingError(f"{path}: the recording is damaged: {error}") from error

    @property
    def bench(self) -> Bench | None:
        """The bench that was recorded; None for recordings from elsewhere."""
        if not self.bench_text:
            return None
        with contextlib.suppress(BenchFileError):
            return parse(self.bench_text, str(self.path))
        return None

    @property
    def events(self) -> tuple[Event, ...]:
        """All events so far."""
        return self.events_from(0)

    def events_from(self, first: int) -> tuple[Event, ...]:
        """Return all events but the first ``first`` ones."""
        return tuple(
            Event(
                sensor=row["sensor"].decode(),
                kind=EventKind.of(row["kind"].decode()),
                text=row["text"].decode(),
                received=HostTime(int(row["monotonic_ns"]), int(row["utc_ns"])),
            )
            for row in self._events.rows()[first:]
        )

    def sensor(self, name: str) -> SensorRecord:
        """Return the sensor of this name."""
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise KeyError(name)

    def results(self) -> dict[str, tuple[dict[str, NDArray[Any]], dict[str, Any]]]:
        """Return the stored results: arrays and attributes by method."""
        group = self._file.get("results", {})
        return {
            method: ({key: entry[key][...] for key in entry}, dict(entry.attrs))
            for method, entry in group.items()
        }

    def refresh(self) -> bool:
        """Read what has been committed since the last call; return whether there was anything.

        Raises
        ------
        RecordingError
            If the file is damaged.
        """
        if self.closed:
            return False
        try:
            self._committed.refresh()
            counts: NDArray[np.int64] = self._committed[...]
            is_new = [s.extend(row) for s, row in zip(self.sensors, counts[:-1], strict=True)]
            n_events = self._events.n_rows
            self._events.extend(int(counts[-1, file_format.EVENTS]))
        except RecordingError:
            raise
        except (OSError, RuntimeError) as error:
            raise RecordingError(f"{self.path}: the recording is damaged: {error}") from error
        self.closed = bool(counts[-1, file_format.CLOSED])
        return any(is_new) or self._events.n_rows > n_events or self.closed

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _open_file(path: Path, *, isolated: bool) -> h5py.File:
    superblock = Superblock.of(path)
    at_rest = not is_being_written(path)
    is_truncated = superblock.end > superblock.n_bytes and at_rest
    if is_truncated and not superblock.is_open:
        raise NotARecordingError(
            f"{path}: truncated: {superblock.n_bytes} of {superblock.end} bytes; copy the file"
            " again"
        )
    try:
        if is_truncated or (isolated and at_rest and superblock.version == 3):
            # Where a killed recorder's file lost its end, a SWMR reader would retry for long, in
            # case a writer is about to complete it.
            return h5py.File(ClearedFile(path, superblock), "r")
        return h5py.File(path, "r", libver="latest", swmr=True, locking=False)
    except (OSError, RuntimeError) as error:
        raise NotARecordingError(f"{path}: cannot be opened as HDF5: {error}") from error


def check_format(path: Path, file: h5py.File) -> None:
    """Raise NotARecordingError for other HDF5 files, and for formats newer than this program."""
    found = file.attrs.get("format")
    if found != file_format.FORMAT:
        what = "it has no attribute format" if found is None else f"its format is {found!r}"
        raise NotARecordingError(
            f"{path}: an HDF5 file but not a huddle recording: {what};"
            f" expected {file_format.FORMAT!r}"
        )
    number = file.attrs.get("format_version")
    if not isinstance(number, (int, np.integer)) or number < 1:
        raise NotARecordingError(f"{path}: format_version {number!r}; expected 1")
    if number > file_format.FORMAT_VERSION:
        raise NotARecordingError(
            f"{path}: written by a newer version of huddle (format {number}); this version reads"
            f" formats up to {file_format.FORMAT_VERSION}: update huddle"
        )


def control_address(path: str | Path) -> tuple[int, str] | None:
    """Return port and token of the recorder that writes a recording; None if it is closed.

    Safe beside a reader that follows the file in the same process, unlike a second ``Recording``:
    HDF5 would share the metadata of the growing file, and the first reader would fail or read
    zeros. This function reads the file without that cache, and only parts that never move.

    Raises
    ------
    NotARecordingError, RecordingError
        As :meth:`Recording.open` does.
    """
    path = Path(path)
    superblock = Superblock.of(path)
    source = ClearedFile(path, superblock) if superblock.version == 3 else path
    try:
        with h5py.File(source, "r") as file:
            check_format(path, file)
            if file["committed"][-1, file_format.CLOSED] or "control_port" not in file.attrs:
                return None
            return int(file.attrs["control_port"]), file.attrs["control_token"]
    except (KeyError, OSError, RuntimeError, ValueError) as error:
        if isinstance(error, RecordingError):
            raise
        raise NotARecordingError(f"{path}: the recording is damaged: {error}") from error
