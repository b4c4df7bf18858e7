"""Names, types and version of the recording format (documented in ``docs/recording-format.md``)."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from daq.bench.channel import Channel
from daq.caveats import Caveat
from estimator.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import DTypeLike, NDArray

    from daq.bench.model import Sensor
    from daq.bench.response import PolesZeros, Response

FORMAT = "huddle-recording"
FORMAT_VERSION = 3
"""Version 2 has a manifest, and strings of fixed length; version 1 is read. Files in which channels
have no samples in some rows are of version 3, all others of version 2: earlier programs would take
what stands there for samples."""
LIBVER = ("v110", "v110")
"""HDF5 file format of recordings."""

SIMULATED = Caveat.SIMULATED.value
"""Origin of a recording made without devices, and the driver of its sensors."""

PRIVATE_TABLES = ("hooks", "metrics", "signing", "web")
"""Tables of the bench file that are not recorded."""

NO_COUNTER = -1
"""``device_counter`` of a block without one."""

_RECEIVED = [("monotonic_ns", "<i8"), ("utc_ns", "<i8")]
_SAID = [*_RECEIVED, ("sensor", "S64")]
BLOCK_DTYPE = np.dtype(
    [
        *((name, "<i8") for name in ("first_sample", "first_row", "n_samples")),
        *_RECEIVED,
        *[("device_counter", "<i8"), ("flags", "<i4"), ("crc32", "<u4")],
    ]
)
GAP_DTYPE = np.dtype(
    [("first_sample", "<i8"), ("missing", "<i8"), ("estimated", "<i4"), ("reason", "S100")]
)
EVENT_DTYPE = np.dtype([*_SAID, ("kind", "S32"), ("text", "S200")])
READING_DTYPE = np.dtype([*_SAID, ("quantity", "S32"), ("value", "<f8")])

# Columns of ``/committed``. The last row has the number of events, whether the file is closed, and
# the number of readings.
ROWS, BLOCKS, GAPS = range(3)
EVENTS, CLOSED, READINGS = range(3)

BLOCKS_PER_CHUNK = 256
GAPS_PER_CHUNK = 32
EVENTS_PER_CHUNK = 64
READINGS_PER_CHUNK = 64


@dataclass(frozen=True, slots=True)
class SensorLayout:
    """One sensor of a recording.

    Attributes
    ----------
    name, model, serial_number, driver, port : str
        As in the bench file, or as reported by the device.
    channels : tuple of Channel
        Columns of ``samples``.
    sampling_rate : float
        In Hz; as reported by the device, otherwise nominal.
    dtype : numpy dtype
        Type of the raw counts.
    clock : str
        Name of the sampling clock; sensors with one clock share the name.
    firmware : str
        As the device reported; empty if it reports none.
    temperature : float or None
        In °C, as the device reported at the start; None if it reports none.
    absent : int64, shape (n, 3), optional
        Rows in which a channel has no sample: its column, the first row, and the one after the
        last.
    """

    name: str
    channels: tuple[Channel, ...]
    sampling_rate: float
    dtype: np.dtype[Any]
    clock: str = ""
    model: str = ""
    serial_number: str = ""
    driver: str = ""
    port: str = ""
    firmware: str = ""
    temperature: float | None = None
    absent: NDArray[np.int64] | None = None

    @property
    def format_version(self) -> int:
        """The first version of the format that can hold it."""
        return FORMAT_VERSION if self.absent is not None and len(self.absent) else 2

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        dtype: DTypeLike,
        clock: str,
        absent: NDArray[np.int64] | None = None,
    ) -> SensorLayout:
        """Return the layout of a sensor of a bench file."""
        return cls(
            name=sensor.name,
            channels=sensor.channels,
            sampling_rate=sensor.sampling_rate,
            dtype=np.dtype(dtype),
            clock=clock,
            model=sensor.model,
            serial_number=sensor.serial_number,
            driver=sensor.driver,
            port=sensor.port,
            absent=absent,
        )


def fixed(value: Any) -> Any:  # noqa: ANN401 - any attribute
    """Return an attribute with its strings, if it has any, as UTF-8 of fixed length.

    HDF5 stores strings of variable length in its global heap, which has no checksum. One changed
    bit there can send every reader around in a circle.
    """
    if isinstance(value, str):
        encoded = value.encode()
        return np.array(encoded, h5py.string_dtype("utf-8", max(1, len(encoded))))
    if isinstance(value, (list, tuple)) and value and all(isinstance(v, str) for v in value):
        several = [v.encode() for v in value]
        return np.array(several, h5py.string_dtype("utf-8", max(1, *map(len, several))))
    return value


def texts(value: Any) -> Any:  # noqa: ANN401 - any attribute
    """Return an attribute as stored by this or an earlier version, with its strings as `str`."""
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray) and value.dtype.kind in "SO":
        return [v.decode() if isinstance(v, bytes) else v for v in value.tolist()]
    return value


def plain(value: Any) -> Any:  # noqa: ANN401 - any attribute
    """Return an attribute as JSON has it."""
    value = texts(value)
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def channel_attributes(channels: Sequence[Channel]) -> dict[str, Any]:
    """Return the attributes of the dataset ``samples`` that describe channels."""
    return {
        "channels": fixed([channel.name for channel in channels]),
        "sensitivity": np.array([channel.sensitivity for channel in channels]),
        "unit": fixed([channel.unit for channel in channels]),
        "direction": fixed([channel.direction or "" for channel in channels]),
        "auxiliary": np.array([channel.auxiliary for channel in channels], dtype=np.int8),
        "response": fixed(
            [
                "" if channel.response is None else _response_text(channel.response)
                for channel in channels
            ]
        ),
    }


def channels_of(attributes: Any) -> tuple[Channel, ...]:  # noqa: ANN401  (h5py is untyped)
    """Return the channels described by :func:`channel_attributes`."""
    columns = zip(
        *(texts(attributes[key]) for key in ("channels", "sensitivity", "unit", "direction")),
        *(texts(attributes[key]) for key in ("auxiliary", "response")),
        strict=True,
    )
    return tuple(
        Channel(
            name=name,
            sensitivity=float(sensitivity),
            unit=unit,
            direction=direction or None,
            auxiliary=bool(auxiliary),
            response=_response(response) if response else None,
        )
        for name, sensitivity, unit, direction, auxiliary, response in columns
    )


def _response_text(response: PolesZeros | Response) -> str:
    from daq.bench.response import response_to_json  # noqa: PLC0415 - few channels have one

    return response_to_json(response)


def _response(text: str) -> PolesZeros | Response:
    from daq.bench.response import response_from_json  # noqa: PLC0415 - few channels have one

    return response_from_json(text)


def block_crc32(row: NDArray[np.void], counts_crc32: int) -> int:
    """Return the checksum of a block: of its counts, continued over its row up to ``crc32``.

    Parameters
    ----------
    row : void, dtype BLOCK_DTYPE
        The block's row; its ``crc32`` is not read.
    counts_crc32 : int
        CRC-32 of the block's counts as little-endian bytes in C order.
    """
    return zlib.crc32(row.tobytes()[: -BLOCK_DTYPE["crc32"].itemsize], counts_crc32)
