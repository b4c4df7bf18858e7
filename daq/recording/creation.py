"""Creates the contents of a new recording: attributes, and datasets that grow."""

from __future__ import annotations

import uuid
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.tables.unattended import Hooks
from daq.recording import file_format
from daq.recording.chunks.manifest import make_manifest
from daq.recording.description import make_checksums

if TYPE_CHECKING:
    from collections.abc import Sequence

    import h5py

    from daq.bench.model import Bench
    from daq.protocols.block import HostTime
    from daq.recording.file_format import SensorLayout

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
