"""How a device writes its samples as text: formats, presets, encoders, and the cutting of bytes.

See :mod:`daq.protocols.text.decoder` for what messages are made of.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MAX_MESSAGE = 16_384
"""Bytes without a terminator after which a message is given up."""
_NS = 1_000_000_000
SINCE_START = {"millis": 1_000_000, "micros": 1000}
"""Units, in ns, of times that count since the device was started."""
_EPOCH = datetime.fromtimestamp(0, UTC)
_LATEST_S = 9e9  # in ns it still fits 64 bits


@dataclass(frozen=True, slots=True)
class TextFormat:
    """How a device writes its samples.

    Attributes
    ----------
    columns : tuple of int
        Field of each channel, counted from 0, the tag included (layout "row").
    channel_names : tuple of str
        As in the messages, in the order of the channels (the other layouts). In layout "json" a
        name may be a path, such as ``acceleration.0``.
    time_column, time_format : int, str or None, str
        Field of the time, by its number or its name: seconds since 1970 (``"epoch"``), as
        ``strptime`` has it, in UTC, or ms or µs since the device was started (``"millis"``,
        ``"micros"``).
    counter_column, counter_modulus : int, str or None, int
        Field of a counter that goes up by one a row and starts again at the modulus.
    decimal_comma : bool
        Whether numbers are written ``1,5``.
    hexadecimal_bits : int or None
        Of samples in hexadecimal, two's complement.
    tag : str
        What the first field must be; rows of other tags are skipped.
    whole : bool
        Whether samples are whole numbers (int32 counts) or not (float64).
    device_time : bool
        Whether the device's time is to be trusted more than arrival (NTP, GPS).
    """

    layout: Literal["row", "labelled", "json", "channel"] = "row"
    delimiter: str = ","
    terminator: str = "\n"
    prefix: str = ""
    suffix: str = ""
    tag: str = ""
    columns: tuple[int, ...] = ()
    channel_names: tuple[str, ...] = ()
    time_column: int | str | None = None
    time_format: str = "epoch"
    counter_column: int | str | None = None
    counter_modulus: int = 1 << 16
    nmea_checksum: bool = False
    whole: bool = False
    device_time: bool = False
    decimal_comma: bool = False
    hexadecimal_bits: int | None = None

    @property
    def channel_keys(self) -> tuple[int, ...] | tuple[str, ...]:
        """Field of each channel: its number in layout "row", its name in the others."""
        return self.columns if self.layout == "row" else self.channel_names

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the counts."""
        return np.dtype(np.int32 if self.whole else np.float64)


RASPBERRY_SHAKE = TextFormat(
    layout="channel",
    terminator="}",
    prefix="{",
    channel_names=("EHZ",),
    whole=True,
)
"""Its times are NTP's, rounded to 1 ms: good for gaps, too coarse to be the clock."""
LILY = TextFormat(
    tag="LILY", columns=(2, 3), time_column=1, time_format="%Y/%m/%d %H:%M:%S", terminator="\r\n"
)
"""Tilt X and Y in µrad; then azimuth, temperature, supply, serial number."""


def nmea_checksum(text: str) -> int:
    """Return the XOR of all characters."""
    return reduce(xor, text.encode(), 0)


def encode_fields(fields: Sequence[str], format_: TextFormat) -> bytes:
    """Write one message."""
    body = format_.delimiter.join(fields) + format_.suffix
    if format_.nmea_checksum:
        body += f"*{nmea_checksum(body):02X}"
    return (format_.prefix + body + format_.terminator).encode("ascii")


LABELLED = re.compile(r"([A-Za-z_]\w*)\s*[:=]\s*([^\s,;]+)")
"""A field of layout "labelled": ``X:1`` or ``X = 1``."""


def read_number(text: str) -> float:
    """Read a decimal number; raises ValueError."""
    if "_" in text:  # which Python allows
        raise ValueError(text)
    return float(text)


def read_hexadecimal(text: str, n_bits: int) -> float:
    """Read a hexadecimal number in two's complement; raises ValueError."""
    value = int(text, 16)
    if "_" in text or not 0 <= value < 1 << n_bits:
        raise ValueError(text)
    return float(value - (value >> (n_bits - 1) << n_bits))


def flatten(value: object, path: str = "") -> dict[str, str]:
    """Return the numbers and texts in a JSON object by their path.

    Raises
    ------
    TypeError
        It is no object.
    """
    if isinstance(value, dict):
        inner = value.items()
    elif isinstance(value, list) and path:
        inner = dict(enumerate(value)).items()
    elif path:
        return {path: value if isinstance(value, str) else json.dumps(value)}
    else:
        raise TypeError(value)
    found: dict[str, str] = {}
    for key, below in inner:
        found |= flatten(below, f"{path}.{key}" if path else str(key))
    return found


def encode_row(values: Mapping[int | str, str], format_: TextFormat) -> bytes:
    """Write one row of layout "row", "labelled" or "json", from the text of each field."""
    if format_.layout == "row":
        return encode_fields(
            [values.get(n, "0") for n in range(1 + max(k for k in values if isinstance(k, int)))],
            format_,
        )
    pairs = (f'"{k}": {v}' if format_.layout == "json" else f"{k}:{v}" for k, v in values.items())
    text = f"{{{', '.join(pairs)}}}" if format_.layout == "json" else " ".join(pairs)
    return (text + format_.terminator).encode("ascii")


def encode_time(utc_ns: int, format_: TextFormat) -> str:
    """Write a time as the format has it; ``utc_ns`` since the start for those that count it."""
    if format_.time_format in SINCE_START:
        return str(utc_ns // SINCE_START[format_.time_format] % (1 << 32))
    if format_.time_format == "epoch":
        return f"{utc_ns / _NS:.3f}"
    return (_EPOCH + timedelta(microseconds=utc_ns // 1000)).strftime(format_.time_format)


def decode_time(text: str, format_: TextFormat) -> tuple[int, int]:
    """Read a time; return it and how finely it is written, both in ns.

    Raises
    ------
    ValueError, OverflowError
        It is none.
    """
    if format_.time_format in SINCE_START:
        resolution_ns = SINCE_START[format_.time_format]
        return int(text) * resolution_ns, resolution_ns
    if format_.time_format == "epoch":
        seconds = float(text)
        resolution_ns = 10 ** max(0, 9 - len(text.partition(".")[2]))
    else:
        seconds = _instant(text, format_.time_format).replace(tzinfo=UTC).timestamp()
        resolution_ns = 1000 if "%f" in format_.time_format else _NS
    if not 0 <= seconds < _LATEST_S:
        raise ValueError(text)
    return round(seconds * 1e6) * 1000, resolution_ns


def is_readable(time_format: str) -> bool:
    """Whether a format, as ``strptime`` has it, gives date and time to the minute at least."""
    instant = datetime(2026, 11, 21, 13, 14, 15, 161_718, UTC)
    try:
        found = datetime.strptime(instant.strftime(time_format), time_format)  # noqa: DTZ007 -- UTC by now
    except ValueError:
        return False
    return found.replace(second=0, microsecond=0, tzinfo=UTC) == instant.replace(
        second=0, microsecond=0
    )


def _instant(text: str, time_format: str) -> datetime:
    try:
        return datetime.strptime(text, time_format)  # noqa: DTZ007 -- the caller knows the zone
    except ValueError:  # a leap second has a second 60, which here is the next minute's first
        minute = datetime.strptime(text, time_format.replace("%S", "60"))  # noqa: DTZ007
        return minute + timedelta(minutes=1)


class MessageFinder:
    """Cuts bytes into messages, wherever they come apart."""

    def __init__(self, terminator: bytes) -> None:
        self._terminator = terminator
        self._buffer = bytearray()
        self._too_long = False
        self.n_given_up = 0
        """Messages that went on for more than ``MAX_MESSAGE`` bytes."""

    def receive(self, received: bytes) -> list[bytes]:
        """Take bytes; return whole messages, without white space around them.

        Of one that was given up nothing is returned.
        """
        self._buffer += received
        *pieces, rest = bytes(self._buffer).split(self._terminator)
        if self._too_long and pieces:
            del pieces[0]
            self._too_long = False
        if len(rest) > MAX_MESSAGE:
            self.n_given_up += not self._too_long
            self._too_long = True
            rest = rest[-len(self._terminator) :]
        self._buffer = bytearray(rest)
        stripped = [piece.strip() for piece in pieces]
        self.n_given_up += sum(len(piece) > MAX_MESSAGE for piece in stripped)
        return [piece for piece in stripped if 0 < len(piece) <= MAX_MESSAGE]
