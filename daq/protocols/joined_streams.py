"""Single-channel streams, joined by time into the samples of a sensor.

Theory of operation
-------------------
Digitizers of seismometers send each component as a stream of its own, in records that state the UTC
of their first sample and may differ in length. :class:`JoinedStreams` aligns the streams of one
sensor on the grid that these times define and yields the samples that all streams have, one column
per stream. GPS or NTP disciplines the sampling clock and every record states its time
(``BlockFlag.DEVICE_UTC``), so no clock model is fitted.

A hole in a stream stays open while a late record may still fill it (``awaiting``). Then it becomes
a gap, of exact length because records state their time. Repeated samples are discarded. A jump of
the device's time by more than an hour means that its clock was set: the grid restarts
(``BlockFlag.CLOCK_RESTART``).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime

if TYPE_CHECKING:
    from collections.abc import Iterator
    from fractions import Fraction

    from numpy.typing import NDArray

_NS = 1_000_000_000
_HOUR_NS = 3600 * _NS
MAX_PENDING = 64
"""Default for the number of records that a stream may be ahead of the others."""


class Record(Protocol):
    """Contiguous samples of one stream."""

    @property
    def stream_id(self) -> str:
        """ID of the stream."""
        ...

    @property
    def start_ns(self) -> int:
        """UTC of the first sample, in ns since 1970."""
        ...

    @property
    def sampling_rate(self) -> Fraction:
        """In Hz."""
        ...

    @property
    def counts(self) -> NDArray[Any]:
        """Samples, shape (n_samples,)."""
        ...


@dataclass(slots=True)
class _Stream:
    """Pending samples of one stream: (index of the first sample, samples), in order."""

    pending: deque[tuple[int, NDArray[Any]]] = field(default_factory=deque)

    def add(self, start: int, counts: NDArray[Any], *, taken_to: int | None) -> None:
        """Add samples; discard those already pending or before index ``taken_to``."""
        if self.pending and start >= self.pending[-1][0]:  # fast path
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
        """Discard samples before ``index``."""
        while self.pending and self.pending[0][0] < index:
            first, samples = self.pending.popleft()
            if first + len(samples) > index:
                self.pending.appendleft((index, samples[index - first :]))


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
        self._streams = {stream_id: _Stream() for stream_id in stream_ids}
        self._rate: Fraction | None = None
        self._origin_ns = 0  # UTC of sample 0
        self._taken_to: int | None = None  # None until the first block is complete
        self._flags = BlockFlag.CLOCK_RESTART
        self._latest: tuple[int, HostTime] | None = None  # index and arrival of the latest block

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
        return max(stream.pending[0][0] for stream in streams) > self._taken_to

    @property
    def is_crowded(self) -> bool:
        """Whether a stream has half of ``max_pending`` records: holes must then become gaps."""
        streams = self._streams.values()
        return any(len(stream.pending) > self._max_pending // 2 for stream in streams)

    def add(self, block: Record, at: HostTime) -> Iterator[Event]:
        """Add a record of one of the streams."""
        if self._rate is None:
            self._rate, self._origin_ns = block.sampling_rate, block.start_ns
        if block.sampling_rate != self._rate:
            text = f"{block.stream_id} has {block.sampling_rate} Hz; expected {self._rate} Hz"
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
        if len(stream.pending) > self._max_pending:
            text = f"dropped a block of {block.stream_id}: another stream sends nothing"
            yield Event(self._name, EventKind.OVERFLOW, text, at)
            stream.pending.popleft()

    def _jump(self, index: int, at: HostTime) -> int:
        """Return the jump of the device's time in samples; 0 if below an hour."""
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
        """Yield the samples that all streams have; beyond a hole only if not ``awaiting``."""
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

    def _block(self, start: int, counts: NDArray[Any], at: HostTime, reason: str) -> Block:
        if self._taken_to is None:  # the first sample of the first block is sample 0
            self._origin_ns = self._utc_ns(start)
            for stream in self._streams.values():
                stream.pending = deque((first - start, kept) for first, kept in stream.pending)
            if self._latest is not None:
                self._latest = (self._latest[0] - start, self._latest[1])
            start = self._taken_to = 0
        flags, self._flags = self._flags | BlockFlag.DEVICE_UTC, BlockFlag.NONE
        full_scale = self._full_scale
        if full_scale and (counts.max() >= full_scale or counts.min() <= -full_scale):
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
