"""Single-channel streams, joined by count and time into the samples of a sensor.

Theory of operation
-------------------
Digitizers of seismometers send each component as a stream of its own, in records that state the UTC
of their first sample and may differ in length. :class:`JoinedStreams` aligns the streams of one
sensor and yields the samples that all streams have, one column per stream. GPS or NTP disciplines
the sampling clock and every record states its time (``BlockFlag.DEVICE_UTC``), so no clock model is
fitted.

A record that begins within half a sample of the end of the one before continues its stream, so the
count follows a rate that is a little off. Any other stated time is compared with what arrived:

- the same samples were received for this time: they are repeated, and dropped;
- it is earlier, and a hole is still open there: the record fills it;
- else it is *doubtful*, until the next record arrives. If that one continues from an earlier time,
  or both arrive too early for samples to be missing (:mod:`daq.protocols.pace`), the clock of the
  device was set: no sample is dropped, and the block says so (``BlockFlag.CLOCK_RESTART``). If both
  arrive late enough, or the numbers of packets show a loss, samples are missing. An earlier record
  that nothing continues came after its hole had become a gap; it is dropped.

A hole stays open while a late record may still fill it (``awaiting``). Then it becomes a gap, of
exact length because records state their time; if arrivals are too unsteady to show that anything is
missing, the length is an estimate.

A step of the clock is found in one stream, and then expected in the others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.protocols.pace import Pace

_NS = 1_000_000_000
_RATE_OFF = 5e-4  # share by which the rate may be off that a record states
_BASELINE_NS = 60 * _NS  # from which on stated times show the rate
_NEAR = 10.0  # seconds between the records of several streams behind one gap
MAX_SEEN = 1 << 17
"""Samples of a stream that are kept to tell repeated ones."""
MAX_PENDING = 64
"""Default for the number of records that a stream may be ahead of the others."""


class StreamRecord(Protocol):
    """Contiguous samples of one stream."""

    @property
    def stream_id(self) -> str:
        """ID of the stream."""

    @property
    def start_ns(self) -> int:
        """UTC of the first sample, in ns since 1970."""

    @property
    def sampling_rate(self) -> Fraction:
        """In Hz."""

    @property
    def counts(self) -> NDArray[Any]:
        """Samples, shape (n_samples,)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """Samples of one stream from index ``first`` on, taken from ``start_ns`` on as stated."""

    first: int
    counts: NDArray[Any]
    start_ns: int
    flags: BlockFlag = BlockFlag.NONE
    """Of the block that begins with them."""

    @property
    def end(self) -> int:
        return self.first + len(self.counts)

    def since(self, index: int, rate: Fraction) -> _Piece:
        """Return the samples from ``index`` on."""
        n = max(0, index - self.first)
        if not n:
            return self
        return _Piece(self.first + n, self.counts[n:], self.start_ns + round(n * _NS / rate))


@dataclass(frozen=True, slots=True)
class _Step:
    """A step of the device's clock, in ns, before the sample of this index."""

    index: int
    size_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Doubtful:
    """A record of which the next one shows whether samples are missing, or the clock was set."""

    record: StreamRecord
    came: HostTime
    in_turn: bool | None


class _Stream:
    """One stream: its pending samples in order, and what tells a repetition from a step."""

    def __init__(self, rate: Fraction) -> None:
        self.rate = rate
        self.pending: deque[_Piece] = deque()
        self.end: int | None = None
        """Index after the latest sample; None before the first."""
        self.end_ns = 0
        """When this sample is expected, by the times that records state."""
        self.n_steps = 0
        """Steps of the device's clock that this stream has had."""
        self.doubtful: _Doubtful | None = None
        self.pace = Pace(float(rate))
        self._shifted = 0
        self._seen: deque[StreamRecord] = deque()
        self._n_seen = 0
        self._base = (0, 0)  # index and time from which on the rate is measured

    def ahead(self, record: StreamRecord) -> float:
        """Return by how many samples a record begins after the end."""
        return float((record.start_ns - self.end_ns) * self.rate / _NS)

    def continues(self, record: StreamRecord) -> bool:
        """Return whether a record begins where the stream ends, but for the drift of its clock."""
        return self.end is not None and abs(self.ahead(record)) < self.tolerance(record)

    def follows(self, record: StreamRecord, before: StreamRecord) -> bool:
        """Return whether a record begins where another one ends."""
        ahead = (record.start_ns - before.start_ns) * self.rate / _NS - len(before.counts)
        return abs(float(ahead)) < self.tolerance(record)

    def tolerance(self, record: StreamRecord) -> float:
        """Return by how many samples the stated time of a record may differ from the count."""
        return max(0.5, _RATE_OFF * len(record.counts))

    def repeats(self, record: StreamRecord) -> bool | None:
        """Return whether the samples received for the times of a record are equal to its own.

        None if none were received for these times.
        """
        found = None
        for seen in self._seen:
            first = round((record.start_ns - seen.start_ns) * self.rate / _NS)
            low, high = max(0, first), min(len(seen.counts), first + len(record.counts))
            if low < high:
                mine = record.counts[low - first : high - first]
                if not np.array_equal(seen.counts[low:high], mine):
                    return False
                found = True
        return found

    def keep(
        self, record: StreamRecord, index: int, *, taken_to: int | None, flags: BlockFlag
    ) -> None:
        """Add a record at an index; discard samples already pending or before ``taken_to``."""
        self._seen.append(record)
        self._n_seen += len(record.counts)
        while self._n_seen > MAX_SEEN:
            self._n_seen -= len(self._seen.popleft().counts)
        piece = _Piece(index, record.counts, record.start_ns, flags)
        if self.end is None or index >= self.end:
            if index != self.end or flags:
                self._base = index, record.start_ns
            self.end = piece.end
            self.end_ns = record.start_ns + round(len(record.counts) * _NS / self.rate)
            elapsed_ns = record.start_ns - self._base[1]
            if elapsed_ns >= _BASELINE_NS:
                self.rate = Fraction((index - self._base[0]) * _NS, elapsed_ns)
        if self.pending and piece.first >= self.pending[-1].end:  # fast path
            self.pending.append(piece)
            return
        in_order = sorted((*self.pending, piece), key=lambda each: each.first)
        self.pending.clear()
        end = in_order[0].first if taken_to is None else taken_to
        for each in in_order:
            if each.end > end:
                self.pending.append(each.since(end, self.rate))
                end = each.end

    def skip_to(self, index: int) -> None:
        """Discard samples before ``index``."""
        while self.pending and self.pending[0].first < index:
            piece = self.pending.popleft()
            if piece.end > index:
                self.pending.appendleft(piece.since(index, self.rate))

    def shift(self, n: int) -> None:
        """Count from another sample."""
        self.pending = deque(replace(each, first=each.first - n) for each in self.pending)
        if self.end is not None:
            self.end -= n
        self._base = self._base[0] - n, self._base[1]
        self._shifted += n

    def arrived(self, at: HostTime) -> None:
        """Take the arrival of the latest sample."""
        self.pace.take((self.end or 0) - 1 + self._shifted, at)

    def late(self, n: int, at: HostTime) -> float:
        """Return by how many s samples that end n after the end are late, if none is missing."""
        return self.pace.late((self.end or 0) - 1 + n + self._shifted, at)


class JoinedStreams:
    """The streams of one sensor, on one grid.

    Parameters
    ----------
    name : str
        Name of the sensor.
    stream_ids : tuple of str
        Stream of each channel, in the order of the channels.
    full_scale : int or None
        Magnitude in counts from which samples are clipped; None disables the test.
    max_pending : int
        Maximum number of records that a stream may be ahead of the others.
    """

    def __init__(
        self,
        name: str,
        stream_ids: tuple[str, ...],
        *,
        full_scale: int | None = None,
        max_pending: int = MAX_PENDING,
    ) -> None:
        self._name = name
        self._max_pending = max_pending
        self._full_scale = full_scale
        self._rate: Fraction | None = None
        self._streams = {stream_id: _Stream(Fraction(1)) for stream_id in stream_ids}
        self._taken_to: int | None = None  # None until the first block is complete
        self._steps: list[_Step] = []
        self._gap = (0, 0.0)  # where a stream lacks samples last, and how many
        self._flags = BlockFlag.CLOCK_RESTART

    @property
    def sampling_rate(self) -> Fraction | None:
        """Sampling rate in Hz of the first block."""
        return self._rate

    @property
    def silent(self) -> tuple[str, ...]:
        """The streams without any record yet."""
        if self._taken_to is not None:
            return ()
        return tuple(name for name, stream in self._streams.items() if not stream.pending)

    @property
    def has_hole(self) -> bool:
        """Whether all streams have samples, but only after missing ones."""
        streams = self._streams.values()
        if self._taken_to is None or not all(stream.pending for stream in streams):
            return False
        return max(stream.pending[0].first for stream in streams) > self._taken_to

    @property
    def is_crowded(self) -> bool:
        """Whether a stream has half of ``max_pending`` records: holes must then become gaps."""
        streams = self._streams.values()
        return any(len(stream.pending) > self._max_pending // 2 for stream in streams)

    def add(
        self, record: StreamRecord, at: HostTime, *, in_turn: bool | None = None
    ) -> Iterator[Event]:
        """Add a record of one of the streams.

        `in_turn`: whether the number of its packet follows the one before; None without numbers.
        """
        if self._rate is None:
            self._rate = record.sampling_rate
            self._streams = {name: _Stream(self._rate) for name in self._streams}
        if record.sampling_rate != self._rate:
            text = f"{record.stream_id} has {record.sampling_rate} Hz; expected {self._rate} Hz"
            yield Event(self._name, EventKind.REFUSED, text, at)
            return
        stream = self._streams[record.stream_id]
        yield from self._place(stream, record, at, in_turn=in_turn)
        if len(stream.pending) > self._max_pending:
            text = f"dropped a block of {record.stream_id}: another stream sends nothing"
            yield Event(self._name, EventKind.OVERFLOW, text, at)
            stream.pending.popleft()

    def settle(self, at: HostTime) -> Iterator[Event]:
        """Place the doubtful records: nothing follows them."""
        for stream in self._streams.values():
            if stream.doubtful is not None:
                doubtful, stream.doubtful = stream.doubtful, None
                yield from self._decide(stream, doubtful, doubtful.record, at)

    def _place(
        self, stream: _Stream, record: StreamRecord, at: HostTime, *, in_turn: bool | None
    ) -> Iterator[Event]:
        doubtful = stream.doubtful
        if doubtful is not None:
            fills = stream.ahead(doubtful.record) > 0 and record.start_ns < doubtful.record.start_ns
            if not fills:
                stream.doubtful = None
                yield from self._decide(stream, doubtful, record, at)
        if stream.end is None or stream.continues(record):
            index = self._by_others(stream, record) if stream.end is None else stream.end
            self._keep(stream, record, index, at)
        elif (missing := self._at_known_step(stream, record)) is not None:
            self._keep(stream, record, stream.end + missing, at, BlockFlag.CLOCK_RESTART)
        elif (ahead := stream.ahead(record)) > 0:
            if in_turn is False or stream.doubtful is not None or self._is_known_gap(stream, ahead):
                self._keep(stream, record, self._by_others(stream, record), at)
            else:
                stream.doubtful = _Doubtful(record, at, in_turn)
        else:
            index, repeats = stream.end + round(ahead), stream.repeats(record)
            fills = repeats is None and (self._taken_to is None or index >= self._taken_to)
            if repeats or fills:
                flags = BlockFlag.NONE
                stream.keep(record, index, taken_to=self._taken_to, flags=flags)
            else:
                stream.doubtful = _Doubtful(record, at, in_turn)
        doubtful = stream.doubtful
        if doubtful is not None and stream.continues(doubtful.record):
            stream.doubtful = None
            self._keep(stream, doubtful.record, stream.end or 0, doubtful.came)

    def _decide(
        self, stream: _Stream, doubtful: _Doubtful, record: StreamRecord, at: HostTime
    ) -> Iterator[Event]:
        """Place the doubtful record, or drop it, by the next one."""
        before, end, pace = doubtful.record, stream.end or 0, stream.pace
        missing = self._at_known_step(stream, before)
        if missing is not None:
            self._keep(stream, before, end + missing, doubtful.came, BlockFlag.CLOCK_RESTART)
            return
        n, ahead = len(before.counts), stream.ahead(before)
        late = stream.late(n, doubtful.came)
        is_last, follows = record is before, stream.follows(record, before)
        after = late if is_last or not follows else stream.late(n + len(record.counts), at)
        seconds, late = ahead / float(stream.rate), min(late, after)
        if ahead < 0:
            # Samples that arrive faster than they are taken are old ones, sent again.
            is_old = after < -len(record.counts) / 2 / float(stream.rate) and pace.is_sure(after)
            if not is_last and (is_old or not follows):
                text = f"dropped {n} samples of {before.stream_id} that came after their gap"
                yield Event(self._name, EventKind.RESYNCHRONISED, text, at)
                return
        elif not pace.is_early(late, seconds) and (
            pace.is_sure(seconds) or not doubtful.in_turn or ahead >= n
        ):
            shown = pace.shows(late, seconds)
            flags = BlockFlag.NONE if shown else BlockFlag.MISSING_ESTIMATED
            self._gap = end, ahead
            self._keep(stream, before, self._by_others(stream, before), doubtful.came, flags)
            return
        missing = pace.lost(late)
        yield self._stepped(stream, before, missing, at)
        flags = BlockFlag.CLOCK_RESTART
        flags |= BlockFlag.MISSING_ESTIMATED if missing else BlockFlag.NONE
        self._keep(stream, before, end + missing, doubtful.came, flags)

    def _is_known_gap(self, stream: _Stream, ahead: float) -> bool:
        """Return whether another stream lacks as many samples about here."""
        index, n_missing = self._gap
        near = abs((stream.end or 0) - index) < _NEAR * float(stream.rate)
        return near and abs(ahead - n_missing) < 1.5

    def _keep(
        self,
        stream: _Stream,
        record: StreamRecord,
        index: int,
        at: HostTime,
        flags: BlockFlag = BlockFlag.NONE,
    ) -> None:
        stream.keep(record, index, taken_to=self._taken_to, flags=flags)
        stream.arrived(at)

    def _by_others(self, stream: _Stream, record: StreamRecord) -> int:
        """Return the index of a record after missing ones.

        Long after the end of its own stream, those of the others know it better.
        """
        own = 0 if stream.end is None else stream.end + round(stream.ahead(record))
        if stream.end is not None and record.start_ns < stream.end_ns + _BASELINE_NS:
            return own
        others = [
            each
            for each in self._streams.values()
            if each.end is not None and (stream.end is None or each.n_steps == stream.n_steps)
        ]
        if not others:
            return own
        nearest = min(others, key=lambda each: abs(record.start_ns - each.end_ns))
        stream.n_steps = nearest.n_steps
        return (nearest.end or 0) + round(nearest.ahead(record))

    def _at_known_step(self, stream: _Stream, record: StreamRecord) -> int | None:
        """Return how many samples are missing before a record behind a step of another stream.

        None if it is before the step, or there is none.
        """
        if stream.n_steps == len(self._steps):
            return None
        step = self._steps[stream.n_steps]
        rest = stream.ahead(record) - float(step.size_ns * stream.rate / _NS)
        later = rest > 0 and (stream.end or 0) + rest >= step.index
        if not later and abs(rest) >= stream.tolerance(record):
            return None
        stream.n_steps += 1
        return max(0, round(rest))

    def _stepped(self, stream: _Stream, record: StreamRecord, missing: int, at: HostTime) -> Event:
        """Take a step of the device's clock, seen in one stream."""
        size_ns = record.start_ns - stream.end_ns - round(missing * _NS / stream.rate)
        self._steps.append(_Step(stream.end or 0, size_ns))
        stream.n_steps = len(self._steps)
        text = f"the time of {record.stream_id} stepped by {size_ns / _NS:+.4g} s"
        return Event(self._name, EventKind.RESET, f"{text}; its samples are counted on", at)

    def take(self, at: HostTime, *, awaiting: bool, reason: str) -> Iterator[Block]:
        """Yield the samples that all streams have; beyond a hole only if not ``awaiting``."""
        streams = self._streams.values()
        while streams and all(stream.pending for stream in streams):
            start = max(stream.pending[0].first for stream in streams)
            if awaiting and self._taken_to is not None and start > self._taken_to:
                return
            for stream in streams:
                stream.skip_to(start)
            if not all(stream.pending and stream.pending[0].first == start for stream in streams):
                continue
            end = min(stream.pending[0].end for stream in streams)
            pieces = [stream.pending[0] for stream in streams]
            for stream in streams:
                stream.skip_to(end)
            yield self._block(pieces, end, at, reason)

    def _block(self, pieces: list[_Piece], end: int, at: HostTime, reason: str) -> Block:
        """Return a block; it states the times of the first stream."""
        start = pieces[0].first
        counts = np.column_stack([piece.counts[: end - start] for piece in pieces])
        if self._taken_to is None:  # the first sample of the first block is sample 0
            for stream in self._streams.values():
                stream.shift(start)
            self._steps = [_Step(each.index - start, each.size_ns) for each in self._steps]
            end, start = end - start, 0
            self._taken_to = 0
        missing = start > self._taken_to
        flags, self._flags = self._flags | BlockFlag.DEVICE_UTC, BlockFlag.NONE
        flags |= pieces[0].flags
        if missing:
            flags |= max(piece.flags & BlockFlag.MISSING_ESTIMATED for piece in pieces)
        full_scale = self._full_scale
        if full_scale and (counts.max() >= full_scale or counts.min() <= -full_scale):
            flags |= BlockFlag.CLIPPED
        self._taken_to = end
        reason = reason if missing else ""
        return Block(self._name, start, counts, at, pieces[0].start_ns, flags, reason)
