"""Reads recordings: growing, left open by a killed recorder, or closed.

A recording consists of the rows counted in ``/committed``; later rows were never acknowledged.
"""

from __future__ import annotations

import contextlib
import json
import logging
import sys
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import h5py
import numpy as np

from daq.bench.end_condition import EndCondition
from daq.bench.outline import BenchOutline
from daq.caveats import Caveat, Caveats
from daq.errors import BenchFileError, NotARecordingError
from daq.protocols.block import Event, EventKind, HostTime, Quantity, Reading
from daq.recording import file_format
from daq.recording.description import damaged_tables, result_crc32
from daq.recording.file_format import SIMULATED
from daq.recording.sensor_record import CommittedRows, SensorRecord
from daq.recording.storage import trial
from daq.recording.storage.locking import is_being_written
from daq.recording.storage.names import CONTINUES
from daq.recording.storage.opening import open_file, refresh, source_of
from daq.recording.storage.refusals import (
    check_counts,
    damage_named,
    dataset,
    member,
    number,
    text,
)
from daq.recording.storage.superblock import Superblock

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.bench.model import Bench

__all__ = ["Recording", "SensorRecord", "check_format", "control_address"]
_NAMED: set[str] = set()
"""Run ids of recordings with private tables that this process has named."""
_LOGGER = logging.getLogger(__name__)


class Recording:
    """A recording that is open for reading."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self._file = file
        attributes = file.attrs
        self.run_id = text(attributes, "run_id")
        self.created = datetime.fromisoformat(text(attributes, "created"))
        """UTC."""
        self.created_at = HostTime(
            int(number(attributes, "created_monotonic_ns")),
            int(number(attributes, "created_utc_ns")),
        )
        self.software = text(attributes, "software")
        self.operator = text(attributes, "operator")
        self.location = text(attributes, "location")
        self.bench_text = text(attributes, "bench")
        self.duration = float(number(attributes, "duration")) if "duration" in attributes else None
        """Planned duration in s; None without a planned end."""
        self.until = EndCondition.of_text(
            text(attributes, "until") if "until" in attributes else ""
        )
        """What of the live estimate ends the run; the process that records obeys it."""
        self._estimate = text(attributes, "estimate") if "estimate" in attributes else ""
        self._marked = Caveats.of(attributes)
        self._origin = text(attributes, "origin") if "origin" in attributes else ""
        self.continues = text(attributes, CONTINUES) if CONTINUES in attributes else ""
        """The ``run_id`` of the recording that this one continues; empty for most."""
        self._committed = dataset(file, "committed", np.dtype("<i8"))
        names = [str(name) for name in file_format.texts(self._committed.attrs["sensors"])]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"sensors {names}; expected different names")
        groups = member(file, "sensors")
        self.sensors = tuple(SensorRecord(member(groups, name)) for name in names)
        """In the order of the bench."""
        self._events = CommittedRows(dataset(file, "events", file_format.EVENT_DTYPE))
        self._readings = (  # not in recordings of earlier versions
            CommittedRows(dataset(file, "readings", file_format.READING_DTYPE))
            if "readings" in file
            else None
        )
        self.closed = False
        """Whether the recording was closed properly and is complete."""
        self.refresh()
        gaps = {sensor.name: sensor.gap_rows for sensor in self.sensors}
        of_run = [self._events] + ([] if self._readings is None else [self._readings])
        self.damaged_tables = tuple(damaged_tables(path, file, gaps, of_run))
        """Tables of gaps, events or readings with a wrong checksum."""
        for name in self.damaged_tables:
            _LOGGER.warning("%s: damaged: wrong checksum of the %s", path, name)
        if self.warning and self.run_id not in _NAMED:
            _NAMED.add(self.run_id)
            _LOGGER.warning("%s: %s", path, self.warning)

    @property
    def opened(self) -> Path:
        """Path of the open file: on Linux also where its name is gone, or leads to another."""
        if sys.platform != "linux":
            return self.path
        return Path(f"/proc/self/fd/{self._file.id.get_vfd_handle()}")

    @classmethod
    def open(cls, path: str | Path, *, tried: bool = False) -> Recording:
        """Open a recording: growing, closed, or left open by a killed recorder.

        Parameters
        ----------
        path : path
        tried : bool
            Whether the file is known to be harmless, or this process may hang.

        Raises
        ------
        NotARecordingError
            If the file is something else, truncated, or of a newer format.
        RecordingError
            If the file cannot be read.
        """
        path = Path(path)
        try:
            file = open_file(path, tried=tried)
            try:
                with damage_named(path):
                    check_format(path, file)
                    return cls(path, file)
            except BaseException:
                file.close()
                raise
        except NotARecordingError as error:
            from daq.recording.storage.journal import journal_path  # noqa: PLC0415 - seldom needed

            if not journal_path(path).exists():
                raise
            raise NotARecordingError(
                f"{error}; its journal has what was acknowledged: huddle repair {path}"
            ) from error

    @cached_property
    def caveats(self) -> Caveats:
        """What must be read before its numbers; also of recordings older than the attribute."""
        origins = {self._origin, *(sensor.driver for sensor in self.sensors)}
        is_model = self.outline is not None and self.outline.is_simulated
        found = {SIMULATED} & origins or is_model
        return Caveats.joined([self._marked, [Caveat.SIMULATED] if found else []])

    @cached_property
    def warning(self) -> str:
        """Names the tables of the bench that may hold secrets; older versions recorded them."""
        private = file_format.PRIVATE_TABLES
        if not any(name in self.bench_text for name in private):
            return ""
        import tomllib  # noqa: PLC0415 - few recordings have such a word

        with contextlib.suppress(tomllib.TOMLDecodeError):
            found = tomllib.loads(self.bench_text)
            names = ", ".join(f"[{name}]" for name in private if name in found)
            if names:
                return f"holds {names} of its bench file, which may have secrets; do not pass it on"
        return ""

    @cached_property
    def outline(self) -> BenchOutline | None:
        """The recorded bench in outline; None for recordings without a bench."""
        return BenchOutline.of_text(self.bench_text, self._estimate)

    @cached_property
    def bench(self) -> Bench | None:
        """The recorded bench; None for imported recordings."""
        if not self.bench_text:
            return None
        from daq.bench.loading import parse  # noqa: PLC0415 - pydantic, as long as all of HDF5
        from daq.bench.model import estimate_settings  # noqa: PLC0415

        with contextlib.suppress(BenchFileError):
            bench = parse(self.bench_text, str(self.path))
            if self._estimate:
                table = estimate_settings(json.loads(self._estimate))
                bench = bench.model_copy(update={"estimate": table})
            return bench
        return None

    @property
    def events(self) -> tuple[Event, ...]:
        """All events so far."""
        return self.events_from(0)

    def events_from(self, first: int) -> tuple[Event, ...]:
        """Return all events from index ``first`` on."""
        return tuple(
            Event(
                sensor=row["sensor"].decode(errors="replace"),
                kind=EventKind.of(row["kind"].decode(errors="replace")),
                text=row["text"].decode(errors="replace"),
                received=HostTime(int(row["monotonic_ns"]), int(row["utc_ns"])),
            )
            for row in self._events.rows()[first:]
        )

    @property
    def readings(self) -> tuple[Reading, ...]:
        """What devices and the host stated of themselves so far; none in older recordings."""
        rows = () if self._readings is None else self._readings.rows()
        return tuple(
            Reading(
                sensor=row["sensor"].decode(errors="replace"),
                quantity=Quantity.of(row["quantity"].decode(errors="replace")),
                value=float(row["value"]),
                received=HostTime(int(row["monotonic_ns"]), int(row["utc_ns"])),
            )
            for row in rows
        )

    def sensor(self, name: str) -> SensorRecord:
        """Return the sensor with this name."""
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise KeyError(name)

    def results(self) -> dict[str, tuple[dict[str, NDArray[Any]], dict[str, Any]]]:
        """Return the stored results: arrays and attributes by method."""
        with damage_named(self.path):
            if "results" not in self._file:
                return {}
            group = member(self._file, "results")
            entries = {method: member(group, method) for method in group}
            return {method: self._result(method, entry) for method, entry in entries.items()}

    def about_results(self) -> dict[str, Any]:
        """Return the attributes of all results together; the service writes which run they are."""
        with damage_named(self.path):
            return _attributes(member(self._file, "results")) if "results" in self._file else {}

    def result_attributes(self) -> dict[str, dict[str, Any]]:
        """Return the attributes of the stored results by method, without reading their arrays.

        Their checksum is not verified, because it also covers the arrays.
        """
        with damage_named(self.path):
            if "results" not in self._file:
                return {}
            group = member(self._file, "results")
            return {method: _attributes(member(group, method)) for method in group}

    def _result(
        self, method: str, entry: h5py.Group
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        arrays = {key: dataset(entry, key)[...] for key in entry}
        attributes = _attributes(entry)
        stored = attributes.pop("crc32", None)
        if stored is not None and stored != result_crc32(arrays, attributes):
            raise NotARecordingError(
                f"{self.path}: damaged: the result of method {method!r} has a wrong checksum;"
                f" make it again: huddle estimate {self.path}"
            )
        return arrays, attributes

    def refresh(self) -> bool:
        """Read newly committed rows; return whether there were any.

        Raises
        ------
        RecordingError
            If the file is damaged.
        """
        if self.closed:
            return False
        with damage_named(self.path):
            refresh(self._committed)
            counts: NDArray[np.int64] = self._committed[...]
            check_counts(counts, len(self.sensors))
            closed = bool(counts[-1, file_format.CLOSED])
            is_new = [
                sensor.extend(row, closed=closed)
                for sensor, row in zip(self.sensors, counts[:-1], strict=True)
            ]
            n_events = self._events.n_rows
            self._events.extend(int(counts[-1, file_format.EVENTS]))
            if self._readings is not None:
                self._readings.extend(int(counts[-1, file_format.READINGS]))
        self.closed = closed
        return any(is_new) or self._events.n_rows > n_events or self.closed

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _attributes(group: h5py.Group) -> dict[str, Any]:
    return {name: file_format.texts(value) for name, value in group.attrs.items()}


def check_format(path: Path, file: h5py.File) -> None:
    """Raise NotARecordingError for other HDF5 files, and for newer formats."""
    found = file_format.texts(file.attrs.get("format"))
    if found != file_format.FORMAT:
        what = "it has no attribute format" if found is None else f"its format is {found!r}"
        raise NotARecordingError(
            f"{path}: an HDF5 file but not a huddle recording: {what};"
            f" expected {file_format.FORMAT!r}; for arrays of other programs: huddle import --help"
        )
    version = file.attrs.get("format_version")
    if not isinstance(version, (int, np.integer)) or version < 1:
        raise NotARecordingError(f"{path}: format_version {version!r}; expected 1")
    if version > file_format.FORMAT_VERSION:
        raise NotARecordingError(
            f"{path}: written by a newer version of huddle (format {version}); this version reads"
            f" formats up to {file_format.FORMAT_VERSION}: update huddle"
        )


def control_address(path: str | Path) -> tuple[int, str] | None:
    """Return port and token of the recorder that writes a recording; None if it is closed.

    Unlike a second ``Recording``, this is safe while a reader in the same process follows the file.
    HDF5 would share cached metadata between both, and the first reader would fail or read zeros.
    This function reads without that cache, and only parts of the file that never move.

    Raises
    ------
    NotARecordingError, RecordingError
        As :meth:`Recording.open` does.
    """
    path = Path(path)
    superblock = Superblock.of(path)
    if not is_being_written(path):
        trial.tried(path)
    with damage_named(path), h5py.File(source_of(path, superblock), "r") as file:
        check_format(path, file)
        committed = dataset(file, "committed", np.dtype("<i8"))
        if committed[-1, file_format.CLOSED] or "control_port" not in file.attrs:
            return None
        return int(number(file.attrs, "control_port")), text(file.attrs, "control_token")
