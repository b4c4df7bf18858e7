"""Delimited text: a line a sample, or a packet of many samples of one channel.

Theory of operation
-------------------
Bytes are cut at the terminator, and each piece, without white space at its ends, is one *message*:
``prefix``, fields with the delimiter between, ``suffix``, and with a checksum ``*hh``, the XOR of
all characters between the prefix and the asterisk in hexadecimal (NMEA 0183). Fields may be padded
with spaces or quoted. Two layouts:

row
    ``LILY,2013/06/24 23:22:00,-236.026,  25.666,194.25, 26.01,11.96,N9655``
    One sample of every channel; ``columns`` says in which fields. A row may carry a time, or a
    counter that goes up by one.
channel
    ``{'EHZ', 1582315130.292, 14168, 14927, …}``
    The channel, the time of the first sample in seconds since 1970, then samples. Packets of one
    time belong together (Raspberry Shake datacast; UDP, so packets get lost).

A counter makes gaps exact. With a time, a step longer than 1.5 times the nominal is a gap of as
many samples as fit. With neither, a message that cannot be read is known to be one that is missing,
and bytes that were lost altogether are not noticed.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.protocols.counting import SampleCounter
from daq.protocols.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MAX_MESSAGE = 16_384
"""Bytes without a terminator after which a message is given up."""
MAX_WAITING = 64
"""Packets of a channel that may wait for those of the others."""
GAP = 1.5
"""Time step, in nominal ones, from which on samples are missing."""
_NS = 1_000_000_000
_HOUR_S = 3600
_LATEST_S = 9e9  # in ns it still fits 64 bits
_ANNOUNCED = 200


@dataclass(frozen=True, slots=True)
class TextFormat:
    """How a device writes its samples.

    Attributes
    ----------
    columns : tuple of int
        Field of each channel, counted from 0 after the tag included (layout "row").
    channel_names : tuple of str
        As in the messages, in the order of the channels (layout "channel").
    time_column, time_format : int or None, str
        Field of the time: seconds since 1970 (``"epoch"``), or as ``strptime`` has it, in UTC.
    counter_column, counter_modulus : int or None, int
        Field of a counter that goes up by one a row and starts anew at the modulus.
    tag : str
        What the first field must be; rows of other tags are skipped.
    whole : bool
        Whether samples are whole numbers (int32 counts) or not (float64).
    device_time : bool
        Whether the device's time is to be trusted more than arrival (NTP, GPS).
    """

    layout: Literal["row", "channel"] = "row"
    delimiter: str = ","
    terminator: str = "\n"
    prefix: str = ""
    suffix: str = ""
    tag: str = ""
    columns: tuple[int, ...] = ()
    channel_names: tuple[str, ...] = ()
    time_column: int | None = None
    time_format: str = "epoch"
    counter_column: int | None = None
    counter_modulus: int = 1 << 16
    nmea_checksum: bool = False
    whole: bool = False
    device_time: bool = False

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


def encode_time(utc_ns: int, format_: TextFormat) -> str:
    """Write a time as the format has it."""
    if format_.time_format == "epoch":
        return f"{utc_ns / _NS:.3f}"
    return datetime.fromtimestamp(utc_ns // _NS, UTC).strftime(format_.time_format)


def _decode_time(text: str, format_: TextFormat) -> int:
    if format_.time_format == "epoch":
        seconds = float(text)
    else:
        seconds = datetime.strptime(text, format_.time_format).replace(tzinfo=UTC).timestamp()
    if not 0 <= seconds < _LATEST_S:
        raise ValueError(text)
    return round(seconds * 1e6) * 1000


class MessageFinder:
    """Cuts bytes into messages, wherever they come apart."""

    def __init__(self, terminator: bytes) -> None:
        self._terminator = terminator
        self._buffer = bytearray()
        self._too_long = False

    def receive(self, received: bytes) -> list[bytes]:
        """Take bytes; return whole messages, without white space around them."""
        self._buffer += received
        *pieces, rest = bytes(self._buffer).split(self._terminator)
        if self._too_long and pieces:
            pieces = [b"?", *pieces[1:]]
            self._too_long = False
        if len(rest) > MAX_MESSAGE:
            self._too_long = True
            rest = rest[-len(self._terminator) :]
        self._buffer = bytearray(rest)
        stripped = (piece.strip() for piece in pieces)
        return [piece if len(piece) <= MAX_MESSAGE else b"?" for piece in stripped if piece]


class TextDecoder:
    """Messages into blocks of one sensor.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    format_ : TextFormat
        How the device writes.
    sampling_rate : float
        In Hz.
    joins : bool
        Whether the device may be sending already, so that the first message may lack its start.
    """

    def __init__(
        self, sensor: str, format_: TextFormat, *, sampling_rate: float, joins: bool = False
    ) -> None:
        self._sensor = sensor
        self._format = format_
        self._rate = sampling_rate
        self._joins = joins
        self._finder = MessageFinder(format_.terminator.encode())
        self._next = 0
        self._flags = BlockFlag.CLOCK_RESTART
        self._reason = ""
        self._latest: tuple[int, HostTime] | None = None  # device time and arrival of the last
        self._n_latest = 1  # samples that time stood for
        self._counter = SampleCounter(format_.counter_modulus, sampling_rate)
        self._waiting: deque[tuple[int, dict[str, NDArray[Any]]]] = deque()
        delimiter = format_.delimiter.strip()
        self._between = re.compile(rf"\s*{re.escape(delimiter)}\s*" if delimiter else r"\s+")

    def receive(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Take bytes of a line or connection, cut anywhere."""
        messages = self._finder.receive(data)
        if self._joins and messages:
            messages, self._joins = messages[1:], False
        return self._messages(messages, at)

    def receive_datagram(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Take one datagram: whole messages, with or without a terminator at the end."""
        finder = MessageFinder(self._format.terminator.encode())
        return self._messages(finder.receive(data + self._format.terminator.encode()), at)

    def _messages(self, messages: list[bytes], at: HostTime) -> list[Block | Event]:
        found: list[Block | Event] = []
        rows: list[tuple[NDArray[Any], int | None, int | None]] = []
        for message in messages:
            try:
                fields = self._split(message)
                if fields is None:
                    continue
                if self._format.layout == "channel":
                    found += self._packet(fields, at)
                else:
                    rows.append(self._row(fields))
            except RemoteProtocolError as error:
                found += self._rows(rows, at)
                rows = []
                found.append(Event(self._sensor, "checksum", _cut(str(error)), at))
                self._unreadable()
        return found + self._rows(rows, at)

    def _split(self, message: bytes) -> list[str] | None:
        """Return the fields of a message, None if it is another kind."""
        format_ = self._format
        text = message.decode("ascii", "replace")
        if not text.startswith(format_.prefix):
            raise RemoteProtocolError(f"no {format_.prefix!r} at the start of {text[:80]!r}")
        text = text[len(format_.prefix) :]
        if format_.nmea_checksum:
            text, star, checksum = text.rpartition("*")
            if not star or f"{nmea_checksum(text):02X}" != checksum.strip().upper():
                raise RemoteProtocolError(f"checksum {checksum[:8]!r} of {text[:80]!r} is wrong")
        if not text.endswith(format_.suffix):
            raise RemoteProtocolError(f"no {format_.suffix!r} at the end of {text[-80:]!r}")
        fields = self._between.split(text.removesuffix(format_.suffix).strip())
        if format_.tag and fields[0] != format_.tag:
            return None
        return fields

    # --- rows --------------------------------------------------------------------------------

    def _row(self, fields: list[str]) -> tuple[NDArray[Any], int | None, int | None]:
        """Return samples, time and counter of a row."""
        format_ = self._format
        try:
            values = _numbers([fields[i] for i in format_.columns], format_)
            time_ns = counter = None
            if format_.time_column is not None:
                time_ns = _decode_time(fields[format_.time_column], format_)
            if format_.counter_column is not None:
                counter = int(fields[format_.counter_column]) % format_.counter_modulus
        except (ValueError, IndexError, OverflowError) as error:
            text = format_.delimiter.join(fields)[:80]
            raise RemoteProtocolError(f"not a row of this format: {text!r}") from error
        return values, time_ns, counter

    def _rows(
        self, rows: list[tuple[NDArray[Any], int | None, int | None]], at: HostTime
    ) -> list[Block | Event]:
        if not rows:
            return []
        counts = np.stack([values for values, _, _ in rows])
        times = [time for _, time, _ in rows]
        if self._format.counter_column is not None:
            counters = np.array([counter for _, _, counter in rows], np.int64)
            return self._counted(counts, counters, times, at)
        found: list[Block | Event] = []
        begin = 0
        for i, time_ns in enumerate(times):
            missing, events = self._step(time_ns, 1, at)
            if missing or events:
                found += [self._block(counts[begin:i], times[begin], at)] if i > begin else []
                found += events
                begin = i
                self._skip(missing)
        found.append(self._block(counts[begin:], times[begin], at))
        return found

    def _counted(
        self,
        counts: NDArray[Any],
        counters: NDArray[np.int64],
        times: list[int | None],
        at: HostTime,
    ) -> list[Block | Event]:
        found: list[Block | Event] = []
        runs, n_repeated = self._counter.place(counters, at)
        if n_repeated:
            found.append(Event(self._sensor, "status", f"{n_repeated} rows repeated", at))
        for run in runs:
            if run.missing:
                self._reason = "counter"
            if run.restarted:
                self._flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
                found.append(Event(self._sensor, "reset", "the counter began anew", at))
            self._next = run.first_sample
            device = times[run.start] if self._format.device_time else run.counter
            found.append(self._block(counts[run.start : run.stop], device, at))
        return found

    def _step(self, time_ns: int | None, n_samples: int, at: HostTime) -> tuple[int, list[Event]]:
        """Return how many samples are missing before those of this time, and what to tell."""
        if time_ns is None:
            return 0, []
        latest, self._latest = self._latest, (time_ns, at)
        n_latest, self._n_latest = self._n_latest, n_samples
        if latest is None:
            return 0, []
        step_s = (time_ns - latest[0]) / _NS
        waited_s = (at.monotonic_ns - latest[1].monotonic_ns) / _NS
        if -_HOUR_S <= step_s <= _HOUR_S + waited_s:
            n_steps = step_s * self._rate
            return (round(n_steps) - n_latest if n_steps > GAP * n_latest else 0), []
        self._flags |= BlockFlag.CLOCK_RESTART
        text = f"the device's time jumped by {step_s:.0f} s"
        missing = max(0, round(waited_s * self._rate) - n_samples)
        return missing, [Event(self._sensor, "reset", text, at)]

    def _skip(self, missing: int, reason: str = "time step") -> None:
        if missing:
            self._next += missing
            self._flags |= BlockFlag.MISSING_ESTIMATED
            self._reason = reason

    def _unreadable(self) -> None:
        """Count a message that could not be read, where nothing else tells that it is missing."""
        format_ = self._format
        if format_.layout == "row" and format_.counter_column is format_.time_column is None:
            self._skip(1, "unreadable row")

    # --- packets -----------------------------------------------------------------------------

    def _packet(self, fields: list[str], at: HostTime) -> list[Block | Event]:
        name = fields[0].strip("'\"")
        try:
            time_ns = _decode_time(fields[1], self._format)
            values = _numbers(fields[2:], self._format)
        except (ValueError, IndexError, OverflowError) as error:
            text = self._format.delimiter.join(fields)[:80]
            raise RemoteProtocolError(f"not a packet of this format: {text!r}") from error
        if name not in self._format.channel_names or not len(values):
            return []
        together = next((group for when, group in self._waiting if when == time_ns), None)
        if together is None:
            together = {}
            self._waiting.append((time_ns, together))
        together[name] = values
        found: list[Block | Event] = []
        while self._waiting and (self._complete(0) or self._later_is_complete()):
            when, group = self._waiting.popleft()
            if len(group) == len(self._format.channel_names):
                found += self._grouped(when, group, at)
        if len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            silent = set(self._format.channel_names) - set(together)
            text = f"packets dropped: nothing comes of {', '.join(sorted(silent))}"
            found.append(Event(self._sensor, "overflow", text, at))
        return found

    def _complete(self, index: int) -> bool:
        return len(self._waiting[index][1]) == len(self._format.channel_names)

    def _later_is_complete(self) -> bool:
        """Whether two later groups are whole: what is missing before them was lost on the way."""
        return sum(self._complete(i) for i in range(1, len(self._waiting))) >= 2

    def _grouped(
        self, time_ns: int, group: dict[str, NDArray[Any]], at: HostTime
    ) -> list[Block | Event]:
        n_samples = min(len(values) for values in group.values())
        counts = np.column_stack([group[n][:n_samples] for n in self._format.channel_names])
        if self._latest is not None and -_HOUR_S * _NS < time_ns - self._latest[0] <= 0:
            text = "a packet was dropped: its time had passed"
            return [Event(self._sensor, "status", text, at)]
        missing, events = self._step(time_ns, n_samples, at)
        self._skip(missing)
        return [*events, self._block(counts, time_ns, at)]

    def _block(self, counts: NDArray[Any], device: int | None, at: HostTime) -> Block:
        first, self._next = self._next, self._next + len(counts)
        flags, self._flags = self._flags, BlockFlag.NONE
        reason, self._reason = self._reason, ""
        if self._format.device_time and device is not None:
            flags |= BlockFlag.DEVICE_UTC
        return Block(self._sensor, first, counts, at, device, flags, reason)


def _numbers(fields: list[str], format_: TextFormat) -> NDArray[Any]:
    values = np.array(fields, dtype=np.float64) if fields else np.empty(0)
    if not np.isfinite(values).all():
        raise ValueError(fields)
    if not format_.whole:
        return values
    whole = values.astype(np.int64)
    if (whole != values).any() or np.abs(values).max(initial=0) >= 1 << 31:
        raise ValueError(fields)
    return whole.astype(np.int32)


def _cut(text: str) -> str:
    return text.encode()[:_ANNOUNCED].decode(errors="ignore")
