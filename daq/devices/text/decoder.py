"""Decoder of delimited text: one line per sample, or packets of many samples of one channel.

Theory of operation
-------------------
The terminator separates *messages*; white space around a message is removed. A message is
``prefix``, fields separated by the delimiter, ``suffix``, and optionally a checksum ``*hh``: the
XOR, in hexadecimal, of all characters between the prefix and the asterisk (NMEA 0183). Fields may
be padded with spaces or quoted. Four layouts:

row
    ``LILY,2013/06/24 23:22:00,-236.026,  25.666,194.25, 26.01,11.96,N9655``
    One sample of every channel, in the fields ``columns``. A row may have a time, or a counter that
    increases by one.
labelled
    ``t:1200 X:-12 Y:40 Z:16384``: like a row, but each field has a name.
json
    ``{"t": 1200, "acc": [-12, 40, 16384]}``: like a row; names are ``t``, ``acc.0`` and so on.
channel
    ``{'EHZ', 1582315130.292, 14168, 14927, …}``
    The channel, the time of the first sample in seconds since 1970, then samples. Packets with
    the same time belong together (Raspberry Shake datacast over UDP: packets are lost, repeated and
    reordered; see below).

A counter gives the exact index of a sample (:mod:`daq.protocols.sample_counter`), and so does a
time of sufficient resolution (:mod:`daq.protocols.sample_times`): repeated rows are dropped and
counted, missing rows become a gap. With neither, an unreadable message after the first
readable one counts as one missing sample, and lost bytes are not detected.

Single-channel packets are grouped by their time, in order of time.
Datagrams are lost, repeated and reordered. A group of packets with the same time is yielded as soon
as it is complete and next in time. A group that is incomplete, or follows a hole, waits until
``PATIENCE`` later groups are complete: then the missing packets count as lost.
"""

from __future__ import annotations

import contextlib
import json
from bisect import bisect_left, insort
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.devices.text.format import (
    LABELLED,
    MAX_MESSAGE,
    MessageFinder,
    TextFormat,
    decode_time,
    flatten,
    nmea_checksum,
    read_hexadecimal,
)
from daq.protocols.block import (
    Block,
    BlockFlag,
    DeviceItem,
    Event,
    EventKind,
    HostTime,
    Quantity,
    Reading,
    ReadingTimes,
)
from daq.protocols.errors import RemoteProtocolError, shortened
from daq.protocols.sample_counter import SampleCounter
from daq.protocols.sample_times import LATE_NS, SamplePlace, SampleTimes

PATIENCE = 2
MAX_WAITING = 64
"""Maximum number of waiting groups."""


@dataclass(frozen=True, slots=True, eq=False)
class Group:
    """Samples of all channels with one time; ``counts`` has shape (n_samples, n_channels)."""

    time_ns: int
    counts: NDArray[Any]
    received: HostTime
    resolution_ns: int


@dataclass(slots=True)
class _Waiting:
    """An incomplete or early group: packets with one time."""

    time_ns: int
    resolution_ns: int
    received: HostTime
    packets: dict[str, NDArray[Any]]


_TIME = attrgetter("time_ns")


class Packets:
    """Packets waiting for the others of their group.

    Parameters
    ----------
    names : sequence of str
        Names of the channels, in the order of the columns.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._waiting: list[_Waiting] = []  # in order of time
        self._last: HostTime | None = None  # arrival of the last yielded group

    def add(
        self, name: str, values: NDArray[Any], time_ns: int, at: HostTime, resolution_ns: int
    ) -> int:
        """Add a packet; return 1 if it is a repetition, else 0."""
        index = bisect_left(self._waiting, time_ns, key=_TIME)
        if index < len(self._waiting) and self._waiting[index].time_ns == time_ns:
            one = self._waiting[index]
            if name in one.packets:
                return 1
            one.packets[name] = values
            one.received = at
            return 0
        insort(self._waiting, _Waiting(time_ns, resolution_ns, at, {name: values}), key=_TIME)
        return 0

    def ready(self, times: SampleTimes, *, patience: int = PATIENCE) -> Iterator[Group]:
        """Yield the groups that need not wait; all that are complete, without patience.

        The caller must place each group with ``times`` before it requests the next one.
        """
        while self._waiting:
            first = self._waiting[0]
            in_turn = self._is_whole(first) and not times.missing(first.time_ns)
            if not in_turn and sum(map(self._is_whole, self._waiting[1:])) < patience:
                return
            del self._waiting[0]
            if self._is_whole(first):
                yield self._group(first)

    def dropped(self, at: HostTime) -> list[str]:
        """Drop groups that wait too long; return a text for each.

        This happens if a channel never arrives, or if a wrong time is never next.
        """
        texts = []
        if len(self._waiting) > MAX_WAITING:
            silent = set(self._names) - set(self._waiting.pop(0).packets)
            texts.append(f"packets dropped: no packets of {', '.join(sorted(silent))}")
        last = self._last
        if last is not None and last.monotonic_ns == at.monotonic_ns:  # others still arrive
            stale = [
                w for w in self._waiting if at.monotonic_ns - w.received.monotonic_ns > LATE_NS
            ]
            for one in stale:
                self._waiting.remove(one)
                n_packets = len(one.packets)
                texts.append(f"{n_packets} packets dropped: their time contradicts the others")
        return texts

    def _is_whole(self, one: _Waiting) -> bool:
        return len(one.packets) == len(self._names)

    def _group(self, one: _Waiting) -> Group:
        if self._last is None or one.received.monotonic_ns > self._last.monotonic_ns:
            self._last = one.received
        n_samples = min(len(values) for values in one.packets.values())
        counts = np.column_stack([one.packets[name][:n_samples] for name in self._names])
        return Group(one.time_ns, counts, self._last, one.resolution_ns)


_FIRST_ROWS = 5


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """A decoded row."""

    counts: NDArray[Any]
    message: bytes
    counter: int
    time_ns: int
    resolution_ns: int


class TextDecoder:
    """Decoder of messages into blocks of one sensor.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    format_ : TextFormat
        Format of the messages.
    sampling_rate : float
        In Hz.
    joins : bool
        Whether the device may already be sending, so that the first message may lack its start.
    """

    def __init__(
        self, sensor: str, format_: TextFormat, *, sampling_rate: float, joins: bool = False
    ) -> None:
        self._sensor = sensor
        self._format = format_
        self._joins = joins
        self._finder = MessageFinder(format_.terminator.encode())
        self._next = 0
        self._flags = BlockFlag.CLOCK_RESTART
        self._reason = ""
        self._counter = SampleCounter(format_.counter_modulus, sampling_rate)
        self._times = SampleTimes(sampling_rate)
        self._packets = Packets(format_.channel_names)
        self._doubtful: Group | None = None
        self._sampling_rate = sampling_rate
        self._latest_ns: int | None = None  # time of the last row
        self._n_known = self._n_unreadable = self._n_given_up = 0
        self._n_explained = 0  # of the unreadable messages: those before the last gap
        self._finest_ns: int | None = None  # resolution of the times
        self._delimiter = format_.delimiter.strip() or None  # None: any white space
        if "\t" in format_.delimiter:
            self._delimiter = "\t"
        self.first_rows: list[bytes] = []
        """The first messages, while none of them was readable."""
        self._has_read = False
        keys = {
            Quantity.TEMPERATURE: format_.temperature_column,
            Quantity.SUPPLY: format_.supply_column,
        }
        self._stated_keys = {quantity: key for quantity, key in keys.items() if key is not None}
        self._reading_times = ReadingTimes()

    def receive(self, data: bytes, at: HostTime) -> list[DeviceItem]:
        """Decode bytes of a line or connection, cut anywhere."""
        messages = self._finder.receive(data)
        if self._joins and messages:
            messages, self._joins = messages[1:], False
        return [*self._given_up(self._finder, at), *self._messages(messages, at)]

    def receive_datagram(self, data: bytes, at: HostTime) -> list[DeviceItem]:
        """Decode one datagram: complete messages, the last with or without a terminator."""
        finder = MessageFinder(self._format.terminator.encode())
        messages = finder.receive(data + self._format.terminator.encode())
        return [*self._given_up(finder, at), *self._messages(messages, at)]

    def flush(self) -> Iterator[Block | Event]:
        """Yield the samples that wait for others: nothing follows them."""
        for group in self._packets.ready(self._times, patience=0):
            yield from self._timed([group])
        place, doubtful = self._times.settle(), self._doubtful
        if place is not None and doubtful is not None:
            self._flags |= BlockFlag.MISSING_ESTIMATED
            yield from self._decided(place, doubtful.received)

    def _given_up(self, finder: MessageFinder, at: HostTime) -> Iterator[Event]:
        n, finder.n_given_up = finder.n_given_up, 0
        for _ in range(n):
            self._n_given_up += 1
            self._unreadable()
            text = (
                f"{MAX_MESSAGE} bytes without the terminator {self._format.terminator!r}: dropped"
                f" ({self._n_given_up} so far); check settings.terminator"
            )
            yield Event(self._sensor, EventKind.RESYNCHRONISED, shortened(text), at)

    def _messages(self, messages: list[bytes], at: HostTime) -> list[DeviceItem]:
        found: list[DeviceItem] = []
        rows: list[_Row] = []
        n_known = self._n_known
        for message in messages:
            try:
                fields = self._split(message)
                if fields is None:
                    continue
                if self._format.layout == "channel":
                    found += self._packet(fields, at)
                else:
                    rows.append(self._row(fields, message))
                self._has_read = True
                self.first_rows.clear()
            except RemoteProtocolError as error:
                found += self._rows(rows, at)
                rows = []
                self._n_unreadable += 1
                if not self._has_read and len(self.first_rows) < _FIRST_ROWS:
                    self.first_rows.append(message)
                text = f"{shortened(str(error), 160)} ({self._n_unreadable} unreadable so far)"
                found.append(Event(self._sensor, EventKind.CHECKSUM, shortened(text), at))
                self._unreadable()
        found += self._rows(rows, at)
        if rows and self._stated_keys and self._reading_times.is_due(at):
            found += self._readings(rows[-1], at)
        if self._n_known > n_known:
            what = "packets" if self._format.layout == "channel" else "rows"
            text = f"dropped {self._n_known - n_known} {what} that were repeated or too late"
            found.append(
                Event(self._sensor, EventKind.STATUS, f"{text} ({self._n_known} so far)", at)
            )
        return found

    def _split(self, message: bytes) -> list[str] | None:
        """Return the fields of a message, or None if it has another tag."""
        format_ = self._format
        text = message.decode("ascii", "replace")
        if format_.layout in {"labelled", "json"}:
            return [text]
        if not text.startswith(format_.prefix):
            raise RemoteProtocolError(f"no {format_.prefix!r} at the start of {text[:80]!r}")
        text = text[len(format_.prefix) :]
        if format_.nmea_checksum:
            text, star, checksum = text.rpartition("*")
            if not star or f"{nmea_checksum(text):02X}" != checksum.strip().upper():
                raise RemoteProtocolError(f"checksum {checksum[:8]!r} of {text[:80]!r} is wrong")
        if not text.endswith(format_.suffix):
            raise RemoteProtocolError(f"no {format_.suffix!r} at the end of {text[-80:]!r}")
        fields = text.removesuffix(format_.suffix).split(self._delimiter)
        fields = [field.strip() for field in fields] or [""]
        if format_.tag and fields[0] != format_.tag:
            return None
        return fields

    # --- rows --------------------------------------------------------------------------------

    def _row(self, fields: list[str], message: bytes) -> _Row:
        """Return samples, time and counter of a row."""
        format_ = self._format
        time_ns = resolution_ns = counter = 0
        try:
            by_key = _by_key(fields, format_)
            values = _numbers([by_key[key] for key in format_.channel_keys], format_)
            if format_.time_column is not None:
                time_ns, resolution_ns = self._time(by_key[format_.time_column])
            if format_.counter_column is not None:
                counter = int(by_key[format_.counter_column]) % format_.counter_modulus
        except (ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
            text = format_.delimiter.join(fields)[:80]
            raise RemoteProtocolError(f"not a row of this format: {text!r}") from error
        return _Row(values, message, counter, time_ns, resolution_ns)

    def _readings(self, row: _Row, at: HostTime) -> Iterator[Reading]:
        """Yield what a row states of the device; a field that is no number states nothing."""
        by_key = _by_key(self._split(row.message) or [], self._format)
        for quantity, key in self._stated_keys.items():
            with contextlib.suppress(ValueError, LookupError):
                (value,) = _numbers([by_key[key]], replace(self._format, whole=False))
                yield Reading(self._sensor, quantity, float(value), at)

    def _time(self, text: str) -> tuple[int, int]:
        """Return a time and the resolution of the times: trailing zeros may be omitted."""
        time_ns, resolution_ns = decode_time(text, self._format)
        self._finest_ns = min(resolution_ns, self._finest_ns or resolution_ns)
        return time_ns, self._finest_ns

    def _rows(self, rows: list[_Row], at: HostTime) -> Iterator[Block | Event]:
        if not rows:
            return
        if self._format.counter_column is not None:
            yield from self._counted(rows, at)
        elif self._format.time_column is not None:
            yield from self._timed([group for row in rows if (group := self._new(row, at))])
        else:
            yield self._block(np.stack([row.counts for row in rows]), None, at)

    def _counted(self, rows: list[_Row], at: HostTime) -> Iterator[Block | Event]:
        counts = np.stack([row.counts for row in rows])
        counters = np.array([row.counter for row in rows], np.int64)
        runs, n_repeated = self._counter.place(counters, at)
        self._n_known += n_repeated
        for run in runs:
            if run.missing:
                self._reason = "counter"
            if run.restarted:
                self._flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
                yield Event(self._sensor, EventKind.RESET, "the counter restarted", at)
            self._next = run.first_sample
            device = rows[run.start].time_ns if self._format.device_time else run.counter
            yield self._block(counts[run.start : run.stop], device, at)

    def _new(self, row: _Row, at: HostTime) -> Group | None:
        """Return a row as a group; None if it is repeated or too late."""
        width = row.resolution_ns * 1e-9 * self._sampling_rate
        is_next = width > 1 and row.time_ns == self._latest_ns  # rows of one time may be equal
        self._latest_ns = row.time_ns
        if not is_next and self._times.is_known(row.time_ns, hash(row.message)):
            self._n_known += 1
            return None
        return Group(row.time_ns, row.counts[None], at, row.resolution_ns)

    def _unreadable(self) -> None:
        """Count an unreadable message as missing, if neither a counter nor a time shows this.

        Before the first sample nothing can be missing: other hosts send to a UDP port, too.
        """
        format_ = self._format
        is_shown = format_.counter_column is not None or format_.time_column is not None
        if self._has_read and format_.layout != "channel" and not is_shown:
            self._skip(1, "unreadable row", is_exact=False)

    # --- packets -----------------------------------------------------------------------------

    def _packet(self, fields: list[str], at: HostTime) -> Iterator[Block | Event]:
        name = fields[0].strip("'\"")
        try:
            time_ns, resolution_ns = self._time(fields[1])
            values = _numbers(fields[2:], self._format)
        except (ValueError, IndexError, OverflowError) as error:
            text = self._format.delimiter.join(fields)[:80]
            raise RemoteProtocolError(f"not a packet of this format: {text!r}") from error
        if name not in self._format.channel_names or not len(values):
            return
        if self._times.is_known(time_ns, hash((name, time_ns, values.tobytes()))):
            self._n_known += 1
            return
        self._n_known += self._packets.add(name, values, time_ns, at, resolution_ns)
        for group in self._packets.ready(self._times):
            yield from self._timed([group])
        for text in self._packets.dropped(at):
            yield Event(self._sensor, EventKind.OVERFLOW, shortened(text), at)

    # --- positions by time -------------------------------------------------------------------

    def _timed(self, groups: Sequence[Group]) -> Iterator[Block | Event]:
        """Yield blocks of contiguous groups, which arrived together."""
        together: list[Group] = []
        n_behind = sum(len(group.counts) for group in groups)
        for group in groups:
            n_behind -= len(group.counts)
            while (place := self._place(group, n_behind)).kind in {"before", "damaged"}:
                yield from self._joined(together)
                together = []
                yield from self._decided(place, group.received)
            if place.kind == "next":
                together.append(group)
            else:
                self._doubtful = group
        yield from self._joined(together)
        if groups and self._doubtful is None:
            self._times.arrived(groups[-1].received)

    def _place(self, group: Group, n_behind: int) -> SamplePlace:
        is_damaged, width = self._n_unreadable > self._n_explained, group.resolution_ns
        placed = group.time_ns, len(group.counts), group.received
        return self._times.place(
            *placed, resolution_ns=width, n_behind=n_behind, is_damaged=is_damaged
        )

    def _decided(self, place: SamplePlace, at: HostTime) -> Iterator[Block | Event]:
        """Yield the doubtful group, or an event if it was damaged."""
        group, self._doubtful = self._doubtful, None
        if group is None:
            return
        if place.kind == "damaged":  # the next message shows it
            yield self._out_of_time(group, at)
            return
        if place.is_reset:
            yield Event(self._sensor, EventKind.RESET, "the device's clock was set", at)
            self._flags |= BlockFlag.CLOCK_RESTART
        reason = "clock set" if place.is_reset else "time step"
        self._skip(place.missing, reason, is_exact=place.is_exact)
        self._n_explained = self._n_unreadable
        yield from self._joined([group])

    def _joined(self, groups: list[Group]) -> Iterator[Block]:
        if groups:
            counts = np.concatenate([group.counts for group in groups])
            yield self._block(counts, groups[0].time_ns, groups[-1].received)

    def _out_of_time(self, group: Group, at: HostTime) -> Event:
        self._n_unreadable += 1
        text = (
            f"dropped {len(group.counts)} samples whose time contradicts those of the others"
            f" ({self._n_unreadable} unreadable so far)"
        )
        return Event(self._sensor, EventKind.CHECKSUM, text, at)

    def _skip(self, missing: int, reason: str, *, is_exact: bool) -> None:
        if missing:
            self._next += missing
            self._reason = reason
            if not is_exact:
                self._flags |= BlockFlag.MISSING_ESTIMATED

    def _block(self, counts: NDArray[Any], device: int | None, at: HostTime) -> Block:
        first, self._next = self._next, self._next + len(counts)
        flags, self._flags = self._flags, BlockFlag.NONE
        reason, self._reason = self._reason, ""
        if self._format.device_time and device is not None:
            flags |= BlockFlag.DEVICE_UTC
        return Block(self._sensor, first, counts, at, device, flags, reason)


def _by_key(fields: list[str], format_: TextFormat) -> dict[int | str, str]:
    """Return the fields of a row by number or name."""
    if format_.layout == "labelled":
        return {name: value for name, value in LABELLED.findall(fields[0])}  # noqa: C416 -- keys of either type
    if format_.layout == "json":
        return {path: value for path, value in flatten(json.loads(fields[0])).items()}  # noqa: C416
    return {n: field for n, field in enumerate(fields)}  # noqa: C416


def _numbers(fields: list[str], format_: TextFormat) -> NDArray[Any]:
    if format_.hexadecimal_bits is not None:
        n_bits = format_.hexadecimal_bits
        values = np.array([read_hexadecimal(field, n_bits) for field in fields], np.float64)
    else:
        if format_.decimal_comma:
            fields = [field.replace(",", ".") for field in fields]
        values = np.array(fields, dtype=np.float64) if fields else np.empty(0)
    if not np.isfinite(values).all():
        raise ValueError(fields)
    if not format_.whole:
        return values
    whole = np.rint(values).clip(-(1 << 31), (1 << 31) - 1)
    if (whole != values).any():
        raise ValueError(fields)
    return whole.astype(np.int32)
