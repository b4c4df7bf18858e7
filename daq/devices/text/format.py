"""Formats of samples as text: settings, presets, encoders, and separation of messages.

:mod:`daq.devices.text.decoder` describes the messages.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from typing import Any, Literal

import numpy as np

MAX_MESSAGE = 16_384
"""Maximum length of a message in bytes; a longer one is dropped."""
_NS = 1_000_000_000
SINCE_START = {"millis": 1_000_000, "micros": 1000}
"""Units, in ns, of times since the start of the device."""
_EPOCH = datetime.fromtimestamp(0, UTC)
_LATEST_S = 9e9  # in ns it still fits 64 bits


@dataclass(frozen=True, slots=True)
class TextFormat:
    """Format of the samples of a device.

    Attributes
    ----------
    columns : tuple of int
        Field of each channel, counted from 0, including the tag (layout "row").
    channel_names : tuple of str
        Names in the messages, in the order of the channels (the other layouts). In layout "json" a
        name may be a path, such as ``acceleration.0``.
    time_column, time_format : int, str or None, str
        Field of the time, by number or name, and its format: seconds since 1970 (``"epoch"``), a
        format of ``strptime`` in UTC, or ms or µs since the start of the device (``"millis"``,
        ``"micros"``).
    counter_column, counter_modulus : int, str or None, int
        Field of a counter that increases by one per row, modulo ``counter_modulus``.
    decimal_comma : bool
        Whether numbers are written ``1,5``.
    temperature_column, supply_column : int, str or None
        Fields of the device's temperature in °C and of its supply voltage in V (not in layout
        "channel").
    hexadecimal_bits : int or None
        Number of bits of samples in hexadecimal, two's complement; None for decimal samples.
    tag : str
        Required value of the first field; rows with other values are skipped.
    whole : bool
        Whether samples are integers (int32 counts) or not (float64).
    device_time : bool
        Whether the device's time is more accurate than the arrival (NTP, GPS).
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
    temperature_column: int | str | None = None
    supply_column: int | str | None = None

    @classmethod
    def of(cls, settings: Mapping[str, Any], names: Iterable[str]) -> TextFormat:
        """Return the format for settings of a bench file, of channels with these names."""
        given: dict[str, Any] = {
            field.name: tuple(value) if isinstance(value, list) else value
            for field in fields(cls)
            if (value := settings.get(field.name)) is not None
        }
        found = replace(PRESETS[settings.get("preset", "none")], **given)
        if found.layout != "row":
            return replace(found, channel_names=given.get("channel_names") or tuple(names))
        return replace(found, columns=found.columns or tuple(range(len(tuple(names)))))

    @property
    def channel_keys(self) -> tuple[int, ...] | tuple[str, ...]:
        """Field of each channel: a number in layout "row", a name in the others."""
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
"""Its times are from NTP, rounded to 1 ms: precise enough for gaps, too coarse for the clock."""
LILY = TextFormat(
    tag="LILY",
    columns=(2, 3),
    time_column=1,
    time_format="%Y/%m/%d %H:%M:%S",
    terminator="\r\n",
    temperature_column=5,
    supply_column=6,
)
"""Fields: tilt X and Y in µrad; then azimuth, temperature, supply voltage, serial number."""
PRESETS = {"raspberry-shake": RASPBERRY_SHAKE, "lily": LILY, "none": TextFormat()}


def nmea_checksum(text: str) -> int:
    """Return the XOR of all characters."""
    return reduce(xor, text.encode(), 0)


def encode_fields(fields: Sequence[str], format_: TextFormat) -> bytes:
    """Encode one message."""
    body = format_.delimiter.join(fields) + format_.suffix
    if format_.nmea_checksum:
        body += f"*{nmea_checksum(body):02X}"
    return (format_.prefix + body + format_.terminator).encode("ascii")


LABELLED = re.compile(r"([A-Za-z_]\w*)\s*[:=]\s*([^\s,;]+)")
"""A field of layout "labelled": ``X:1`` or ``X = 1``."""


def read_number(text: str) -> float:
    """Parse a decimal number; raise ValueError if it is none."""
    if "_" in text:  # float() accepts underscores
        raise ValueError(text)
    return float(text)


def read_hexadecimal(text: str, n_bits: int) -> float:
    """Parse a hexadecimal number in two's complement; raise ValueError if it is none."""
    value = int(text, 16)
    if "_" in text or not 0 <= value < 1 << n_bits:
        raise ValueError(text)
    return float(value - (value >> (n_bits - 1) << n_bits))


def flatten(value: object, path: str = "") -> dict[str, str]:
    """Return the numbers and texts in a JSON object by path.

    Raises
    ------
    TypeError
        If ``value`` is no object.
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
    """Encode one row of layout "row", "labelled" or "json", from the text of each field."""
    if format_.layout == "row":
        return encode_fields(
            [values.get(n, "0") for n in range(1 + max(k for k in values if isinstance(k, int)))],
            format_,
        )
    pairs = (f'"{k}": {v}' if format_.layout == "json" else f"{k}:{v}" for k, v in values.items())
    text = f"{{{', '.join(pairs)}}}" if format_.layout == "json" else " ".join(pairs)
    return (text + format_.terminator).encode("ascii")


def encode_time(utc_ns: int, format_: TextFormat) -> str:
    """Return a time in this format; ``utc_ns`` is since the start for "millis" and "micros"."""
    if format_.time_format in SINCE_START:
        return str(utc_ns // SINCE_START[format_.time_format] % (1 << 32))
    if format_.time_format == "epoch":
        return f"{utc_ns / _NS:.3f}"
    return (_EPOCH + timedelta(microseconds=utc_ns // 1000)).strftime(format_.time_format)


def decode_time(text: str, format_: TextFormat) -> tuple[int, int]:
    """Parse a time; return the time and its resolution, both in ns.

    Raises
    ------
    ValueError, OverflowError
        If ``text`` is no time.
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
    """Return whether a format of ``strptime`` has the date and the time, at least to the minute."""
    instant = datetime(2026, 11, 21, 13, 14, 15, 161_718, UTC)
    try:
        found = datetime.strptime(instant.strftime(time_format), time_format)  # noqa: DTZ007 -- always UTC
    except ValueError:
        return False
    return found.replace(second=0, microsecond=0, tzinfo=UTC) == instant.replace(
        second=0, microsecond=0
    )


def _instant(text: str, time_format: str) -> datetime:
    try:
        return datetime.strptime(text, time_format)  # noqa: DTZ007 -- the caller knows the zone
    except ValueError:  # second 60, a leap second, is read as the first of the next minute
        minute = datetime.strptime(text, time_format.replace("%S", "60"))  # noqa: DTZ007
        return minute + timedelta(minutes=1)


class MessageFinder:
    """Separates bytes, cut anywhere, into messages."""

    def __init__(self, terminator: bytes) -> None:
        self._terminator = terminator
        self._buffer = bytearray()
        self._too_long = False
        self.n_given_up = 0
        """Number of messages dropped because they exceed ``MAX_MESSAGE`` bytes."""

    def receive(self, received: bytes) -> list[bytes]:
        """Decode bytes; return the completed messages, without white space around them."""
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
