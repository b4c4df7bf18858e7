"""Checksums of attributes, gaps, events, readings, and ``/committed``, for which HDF5 has none.

``/checksums`` has the same rows as ``/committed``. A sensor's row has the CRC-32 of its description
(attributes), of its gaps, and of its row of ``/committed``; the last row has those of the file's
attributes, of the events and readings, and of the last row of ``/committed``. It is written when
the recording is closed; zeros mean that it was not closed. Older recordings have no such dataset.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from daq.caveats import Caveat
from daq.errors import NotARecordingError
from daq.recording.file_format import fixed, plain, texts
from daq.recording.sensor_record import CommittedRows
from daq.recording.storage.refusals import dataset

CHECKSUMS = "checksums"
_DESCRIPTION, _TABLE, _COUNTS = range(3)
_FILE = (
    *("format", "format_version", "run_id", "created", "created_utc_ns", "created_monotonic_ns"),
    *("software", "bench", "operator", "location", "duration", "until", "estimate", "origin"),
    *Caveat,
)
_SENSOR = ("model", "serial_number", "driver", "port", "clock", "sampling_rate", "temperature")
"""Not the firmware, which came later: programs that do not know it would see damage. It is in the
manifest."""
_SAMPLES = ("channels", "sensitivity", "unit", "direction", "auxiliary", "response", "absent")


def write_checksums(file: h5py.File) -> None:
    """Write ``/checksums`` of a complete recording."""
    if CHECKSUMS in file:
        names = texts(file["committed"].attrs["sensors"])
        tables = [file["sensors"][name]["gaps"][...].tobytes() for name in names]
        of_run = [file[name][...].tobytes() for name in ("events", "readings") if name in file]
        file[CHECKSUMS][...] = _checksums(file, [*tables, b"".join(of_run)])


def damaged_tables(
    path: Path, file: h5py.File, gaps: dict[str, CommittedRows], of_run: Sequence[CommittedRows]
) -> Iterator[str]:
    """Yield the names of tables with wrong checksums.

    Parameters
    ----------
    path : Path
    file : h5py.File
        The recording.
    gaps : dict
        Gaps by name of the sensor.
    of_run : sequence of CommittedRows
        Events, and readings if the file has them.

    Raises
    ------
    NotARecordingError
        If a description or ``/committed`` is damaged: the data then have no meaning.
    """
    if CHECKSUMS not in file:
        return
    stored = dataset(file, CHECKSUMS, np.dtype("<u4"))[...]
    if not stored.any():
        return
    tables = [rows.rows().tobytes() for rows in gaps.values()]
    tables.append(b"".join(rows.rows().tobytes() for rows in of_run))
    found = _checksums(file, tables)
    if found.shape != stored.shape:
        raise NotARecordingError(f"{path}: damaged: /{CHECKSUMS} of shape {stored.shape}")
    names = [*(f"sensor {name!r}" for name in gaps), "the file"]
    for name, own, expected in zip(names, found, stored, strict=True):
        for column, what in ((_DESCRIPTION, "description"), (_COUNTS, "row of /committed")):
            if own[column] != expected[column]:
                raise NotARecordingError(
                    f"{path}: damaged: the {what} of {name} has a wrong checksum"
                )
        if own[_TABLE] != expected[_TABLE]:
            yield "events and readings" if name == names[-1] else f"gaps of {name}"


def result_crc32(arrays: Mapping[str, Any], attributes: Mapping[str, Any]) -> int:
    """Return the checksum of a stored result."""
    about = [[name, plain(attributes[name])] for name in sorted(attributes)]
    crc32 = zlib.crc32(json.dumps(about).encode())
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        crc32 = zlib.crc32(values.tobytes(), zlib.crc32(f"{name}{values.shape}".encode(), crc32))
    return crc32


def _checksums(file: h5py.File, tables: list[bytes]) -> np.ndarray[Any, np.dtype[np.uint32]]:
    committed = file["committed"]
    names = list(texts(committed.attrs["sensors"]))
    groups = [file["sensors"][name] for name in names]
    described = [_described_sensor(group) for group in groups]
    described.append(_text(file.attrs, _FILE) + json.dumps(names))
    rows = zip(described, tables, committed[...].astype("<i8"), strict=True)
    return np.array(
        [[zlib.crc32(a.encode()), zlib.crc32(b), zlib.crc32(c.tobytes())] for a, b, c in rows],
        np.uint32,
    )


def _described_sensor(group: h5py.Group) -> str:
    samples = group["samples"]
    of_group, of_samples = _text(group.attrs, _SENSOR), _text(samples.attrs, _SAMPLES)
    return f"{of_group}{of_samples}{samples.dtype.str}"


def _text(attributes: h5py.AttributeManager, names: tuple[str, ...]) -> str:
    return json.dumps([[name, plain(attributes[name])] for name in names if name in attributes])


def make_checksums(file: h5py.File, n_sensors: int) -> None:
    """Create ``/checksums`` of a new recording."""
    file.create_dataset(CHECKSUMS, data=np.zeros((n_sensors + 1, 3), "<u4"))
    file[CHECKSUMS].attrs["columns"] = fixed(["description", "gaps or events", "committed"])
