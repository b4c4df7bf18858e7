"""Sensors made of GCF streams: the streams of a sensor joined by time, whatever they came by.

Theory of operation
-------------------
A Güralp digitizer sends each component as a stream of its own (``DEMOZ2``, ``DEMON2``, ``DEMOE2``),
in blocks that start on UTC and need not be equally long. :class:`Streams` lines up the streams of
each sensor on the grid that the block times define and yields what is there in all of them, one
column a stream. The sampling clock is disciplined by GPS and stated in every block
(``BlockFlag.DEVICE_UTC``), so no clock is fitted.

A hole in a stream is left open while the link may still recover it (``awaiting``), then becomes a
gap, exact because blocks carry their time. Blocks seen twice are dropped. A device whose time jumps
by more than an hour has had its clock set: its grid starts anew (``BlockFlag.CLOCK_RESTART``).

A sensor whose streams are still to be found has none at first. Blocks of streams that are nobody's
are then kept, until :meth:`Streams.found` says whose they are.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.protocols.guralp.gcf import SampleBlock, StatusBlock, serial_number

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from fractions import Fraction

    from numpy.typing import NDArray

_NS = 1_000_000_000
_HOUR_NS = 3600 * _NS
MAX_PENDING = 64
"""Blocks a stream may be ahead of the others."""
MOST_KEPT = 1024
"""Blocks kept while it is not known whose they are."""
FULL_SCALE_COUNTS = (1 << 23) - 1
"""Of a 24-bit digitizer."""


@dataclass(slots=True)
class _Stream:
    """What of one stream waits for the others: (index of its first sample, samples), in order."""

    pending: deque[tuple[int, NDArray[np.int32]]] = field(default_factory=deque)

    def add(self, start: int, counts: NDArray[np.int32], *, taken_to: int | None) -> None:
        """Put samples in their place; those already there or taken are dropped."""
        if self.pending and start >= self.pending[-1][0]:  # nearly always
            tail = self.pending[-1]
            fresh = counts[max(0, tail[0] + len(tail[1]) - start) :]
            if len(fresh):
                self.pending.append((start + len(counts) - len(fresh), fresh))
            return
        in_order = sorted((*self.pending, (start, counts)), key=lambda entry: entry[0])
        self.pending.clear()
        end = in_order[0][0] if taken_to is None else taken_to
        for first, samples in in_order:
            fresh = samples[max(0, end - first) :]
            if len(fresh):
                end = first + len(samples)
                self.pending.append((end - len(fresh), fresh))

    def skip_to(self, index: int) -> None:
        """Forget what lies before ``index``."""
        while self.pending and self.pending[0][0] < index:
            first, samples = self.pending.popleft()
            if first + len(samples) > index:
                self.pending.appendleft((index, samples[index - first :]))


class _Sensor:
    """The streams of one sensor, on one grid."""

    def __init__(self, name: str, stream_ids: tuple[str, ...]) -> None:
        self._name = name
        self._streams = {stream_id: _Stream() for stream_id in stream_ids}
        self._rate: Fraction | None = None
        self.system = ""
        self._origin_ns = 0  # UTC of sample 0
        self._taken_to: int | None = None  # None until the first block is complete
        self._flags = BlockFlag.CLOCK_RESTART
        self._latest: tuple[int, HostTime] | None = None  # index and arrival of the latest block

    @property
    def sampling_rate(self) -> Fraction | None:
        """As the first block said."""
        return self._rate

    @property
    def silent(self) -> tuple[str, ...]:
        """The streams of which nothing has come."""
        if self._taken_to is not None:
            return ()
        return tuple(name for name, stream in self._streams.items() if not stream.pending)

    def add(self, block: SampleBlock, at: HostTime) -> Iterator[Event]:
        """Take a block of one of the streams."""
        if self._rate is None:
            self._rate, self._origin_ns = block.sampling_rate, block.start_ns
            self.system = block.system.text
        if block.sampling_rate != self._rate:
            text = f"{block.stream_id} came at {block.sampling_rate} Hz; expected {self._rate} Hz"
            yield Event(self._name, EventKind.REFUSED, text, at)
            return
        index = round((block.start_ns - self._origin_ns) * self._rate / _NS)
        jumped = self._jump(index, at)
        if jumped:
            text = f"the time of {block.stream_id} jumped by {float(jumped / self._rate):.0f} s"
            yield Event(self._name, EventKind.RESET, text, at)
            index -= jumped
            self._origin_ns = block.start_ns - round(index * _NS / self._rate)
            self._flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
            for stream in self._streams.values():
                stream.pending.clear()
        self._latest = (max(index, self._latest[0]) if self._latest else index, at)
        stream = self._streams[block.stream_id]
        stream.add(index, block.counts, taken_to=self._taken_to)
        if len(stream.pending) > MAX_PENDING:
            text = f"dropped a block of {block.stream_id}: another stream does not come"
            yield Event(self._name, EventKind.OVERFLOW, text, at)
            stream.pending.popleft()

    def _jump(self, index: int, at: HostTime) -> int:
        """Return by how many samples the device's time has been set, 0 within an hour."""
        if self._rate is None or self._latest is None:
            return 0
        waited = round((at.monotonic_ns - self._latest[1].monotonic_ns) * self._rate / _NS)
        hour = round(_HOUR_NS * self._rate / _NS)
        if -hour <= index - self._latest[0] <= hour + waited:
            return 0
        ends = (
            s.pending[-1][0] + len(s.pending[-1][1]) for s in self._streams.values() if s.pending
        )
        return index - max(self._latest[0] + waited, self._taken_to or 0, *ends)

    def take(self, at: HostTime, *, awaiting: bool, reason: str) -> Iterator[Block]:
        """Yield what all streams have; across a hole only if nothing is awaited."""
        streams = self._streams.values()
        while streams and all(stream.pending for stream in streams):
            start = max(stream.pending[0][0] for stream in streams)
            if awaiting and self._taken_to is not None and start > self._taken_to:
                return
            for stream in streams:
                stream.skip_to(start)
            if not all(stream.pending and stream.pending[0][0] == start for stream in streams):
                continue
            end = min(start + len(stream.pending[0][1]) for stream in streams)
            counts = np.column_stack([stream.pending[0][1][: end - start] for stream in streams])
            for stream in streams:
                stream.skip_to(end)
            yield self._block(start, counts, at, reason)

    def _block(self, start: int, counts: NDArray[np.int32], at: HostTime, reason: str) -> Block:
        if self._taken_to is None:  # the first sample of the first block is sample 0
            self._origin_ns = self._utc_ns(start)
            for stream in self._streams.values():
                stream.pending = deque((first - start, kept) for first, kept in stream.pending)
            if self._latest is not None:
                self._latest = (self._latest[0] - start, self._latest[1])
            start = self._taken_to = 0
        flags, self._flags = self._flags | BlockFlag.DEVICE_UTC, BlockFlag.NONE
        if counts.max() >= FULL_SCALE_COUNTS or counts.min() <= -FULL_SCALE_COUNTS:
            flags |= BlockFlag.CLIPPED
        missing = start > self._taken_to
        self._taken_to = start + len(counts)
        return Block(
            self._name,
            start,
            counts,
            at,
            device_counter=self._utc_ns(start),
            flags=flags,
            reason=reason if missing else "",
        )

    def _utc_ns(self, index: int) -> int:
        return self._origin_ns + (round(index * _NS / self._rate) if self._rate else 0)


class Streams:
    """Sorts GCF blocks by sensor and joins the streams of each.

    Parameters
    ----------
    sensors : mapping of str to sequence of str
        For each sensor the stream ID of each channel, in the order of its channels; none where they
        are still to be found.
    """

    def __init__(self, sensors: Mapping[str, Iterable[str]]) -> None:
        ids = {name: tuple(stream_ids) for name, stream_ids in sensors.items()}
        self._sensors = {name: _Sensor(name, stream_ids) for name, stream_ids in ids.items()}
        self._owner = {stream: name for name, streams in ids.items() for stream in streams}
        self._unknown: Counter[str] = Counter()
        self._kept: deque[tuple[SampleBlock, HostTime]] = deque(maxlen=MOST_KEPT)
        self._searching = not all(ids.values())
        self._name = only(ids)
        self._lost = "block missing"

    @property
    def silent(self) -> tuple[str, ...]:
        """IDs of the streams of which nothing has come yet."""
        return tuple(stream for sensor in self._sensors.values() for stream in sensor.silent)

    @property
    def unknown(self) -> frozenset[str]:
        """Stream IDs that came and belong to no sensor."""
        return frozenset(self._unknown)

    @property
    def repeated(self) -> bool:
        """Whether one of these has come twice, and so all of them once, if equally long."""
        return max(self._unknown.values(), default=0) > 1

    def sampling_rate(self, sensor: str) -> float | None:
        """Return the sampling rate of a sensor in Hz, once a block has said it."""
        rate = self._sensors[sensor].sampling_rate
        return None if rate is None else float(rate)

    def stream_ids(self, sensor: str) -> tuple[str, ...]:
        """Return the stream IDs of a sensor's channels."""
        return tuple(stream for stream, owner in self._owner.items() if owner == sensor)

    def system(self, sensor: str) -> str:
        """Return the system ID a sensor's first block carried."""
        return self._sensors[sensor].system

    def lost(self, reason: str) -> None:
        """Note why samples may be missing from now on."""
        self._lost = reason

    def receive(
        self, block: SampleBlock | StatusBlock, at: HostTime, *, awaiting: bool = False
    ) -> Iterator[Block | Event]:
        """Take one block; yield what it completes."""
        if isinstance(block, StatusBlock):
            yield from self._status(block, at)
        elif block.stream_id in self._owner:
            yield from self._sensors[self._owner[block.stream_id]].add(block, at)
        elif block.stream_id in self._unknown or len(self._unknown) < MAX_PENDING:
            self._unknown[block.stream_id] += 1
            if self._searching:
                self._kept.append((block, at))
            elif self._unknown[block.stream_id] == 1:
                yield self._nobodys(block.stream_id, at)
        for sensor in self._sensors.values():
            yield from sensor.take(at, awaiting=awaiting, reason=self._lost)

    def found(self, sensor: str, stream_ids: Iterable[str]) -> Iterator[Block | Event]:
        """Give a sensor its streams; yield what has come of them, up to a hole."""
        ids = tuple(stream_ids)
        own = self._sensors[sensor] = _Sensor(sensor, ids)
        self._owner |= dict.fromkeys(ids, sensor)
        kept, self._searching = list(self._kept), False
        self._kept.clear()
        for block, at in kept:
            if block.stream_id in ids:
                self._unknown.pop(block.stream_id, None)
                yield from own.add(block, at)
                yield from own.take(at, awaiting=True, reason=self._lost)
        for stream_id in sorted(self._unknown):
            yield self._nobodys(stream_id, kept[-1][1])

    def _nobodys(self, stream_id: str, at: HostTime) -> Event:
        return Event(self._name, EventKind.REFUSED, f"stream {stream_id} is of no sensor here", at)

    def _status(self, block: StatusBlock, at: HostTime) -> Iterator[Event]:
        serial = serial_number(block.stream_id)
        owners = {n for stream, n in self._owner.items() if serial_number(stream) == serial} or {""}
        for line in block.text.splitlines():
            text = "".join(c if c.isprintable() else "?" for c in line).strip()
            if text:
                for name in sorted(owners):
                    yield Event(name, EventKind.STATUS, cut(text), at)


def cut(text: str) -> str:
    """Return as much of a text as an event holds."""
    return text.encode()[:200].decode(errors="ignore")


def only(names: Iterable[str]) -> str:
    """Return the one name of events that concern the port; none if several sensors share it."""
    first, *others = (*names, "")
    return first if len(others) <= 1 else ""
