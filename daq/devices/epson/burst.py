"""Decode the stream of bursts of an Epson accelerometer; see :mod:`daq.devices.epson.commands`.

Theory of operation
-------------------
Each read is decoded in one pass. Length, header, delimiter and checksum together identify frames,
COUNT gives the sample index of each frame, and consecutive frames become one block. Bytes outside
frames are skipped, counted, and reported as an event at most once a second; the samples lost with
them appear as a gap in COUNT. The first block of a session starts at index 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from daq.devices.epson.commands import (
    BURST_HEADER,
    DELIMITER,
    FLAG_ERROR,
    BurstFormat,
    are_sums_right,
    temperature,
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
from daq.protocols.errors import several
from daq.protocols.sample_counter import FrameRun, SampleCounter

OctetArray: TypeAlias = NDArray[np.uint8]
BoolArray: TypeAlias = NDArray[np.bool_]

_WINDOWS_AT_ONCE = 1 << 14
"""Bounds the memory that a search of garbage takes."""


def find_frames(
    octets: OctetArray, size: int, valid: Callable[[OctetArray], BoolArray]
) -> tuple[list[tuple[int, int]], int]:
    """Return the frames that a scan from the first byte finds.

    At each position the scan takes a valid frame if there is one, else advances by one byte. Each
    decision uses only the next ``size`` bytes, so the result does not depend on how the stream was
    cut into reads.

    Parameters
    ----------
    octets : uint8, shape (n_bytes,)
        All bytes received and not yet consumed.
    size : int
        Length of a frame in bytes.
    valid : callable
        Maps windows, shape (n, size), to whether each is a frame, shape (n,).

    Returns
    -------
    runs : list of (offset, n_frames)
        Runs of adjacent frames.
    consumed : int
        Number of decided bytes; fewer than ``size`` bytes remain after them.
    """
    n_frames = octets.size // size
    good = valid(octets[: n_frames * size].reshape(n_frames, size))
    n_good = n_frames if good.all() else int(good.argmin())
    runs = [(0, n_good)] if n_good else []
    position = n_good * size
    if n_good == n_frames:
        return runs, position
    windows = sliding_window_view(octets, size)
    pieces = range(0, len(windows), _WINDOWS_AT_ONCE)
    at_any = np.concatenate([valid(windows[at : at + _WINDOWS_AT_ONCE]) for at in pieces])
    starts = np.flatnonzero(at_any)
    while (following := int(np.searchsorted(starts, position))) < starts.size:
        start = int(starts[following])
        chain = at_any[start::size]
        length = chain.size if chain.all() else int(chain.argmin())
        runs.append((start, length))
        position = start + length * size
    return runs, max(position, octets.size - size + 1)


COUNT_MODULUS = 65536
MIN_CONSECUTIVE = 3
"""Consecutive bursts needed to recognise a stream on a new connection."""
REPORT_INTERVAL_NS = 1_000_000_000
"""Minimum host time between two events of one kind."""
_REPORTS = {
    "checksum": (EventKind.CHECKSUM, "frame", "with a wrong checksum"),
    "skipped": (EventKind.RESYNCHRONISED, "byte", "skipped between frames"),
    "repeated": (EventKind.RESYNCHRONISED, "frame", "received twice"),
}
"""Counted faults, and the event that reports each."""


class BurstDecoder:
    """Bytes in, blocks out.

    Parameters
    ----------
    sensor : str
        Name for the blocks and events.
    burst : BurstFormat
        Format of the bursts that the device is configured to send.
    fields : sequence of str
        Fields that become channels, in order: any of x, y, z, temperature.
    sampling_rate : float
        In Hz.
    full_scale_counts : int
        Samples of x, y, z at or beyond this magnitude are clipped.
    """

    def __init__(
        self,
        sensor: str,
        burst: BurstFormat,
        *,
        fields: Sequence[str],
        sampling_rate: float,
        full_scale_counts: int,
    ) -> None:
        self._sensor = sensor
        self._burst = burst
        self._dtype = burst.dtype
        self._size = burst.size
        self._fields = tuple(fields)
        self._has_checksum, self._has_flag = "checksum" in burst, "flag" in burst
        self._has_temperature, self._reading_times = "temperature" in burst, ReadingTimes()
        self._axes = [column for column, field in enumerate(fields) if field != "temperature"]
        self._full_scale = full_scale_counts
        self._counter = SampleCounter(COUNT_MODULUS, sampling_rate)
        self._left = b""
        self._started = False
        self._lost_frames = 0  # without COUNT: estimated invalid frames since the last valid one
        self._next = 0  # without COUNT: index of the next frame
        self._error = False
        self._counts = dict.fromkeys(_REPORTS, 0)
        self._reported = dict.fromkeys(self._counts, -REPORT_INTERVAL_NS)

    @property
    def n_pending(self) -> int:
        """Number of bytes of the incomplete last frame."""
        return len(self._left)

    def continues(self, data: bytes, at: HostTime) -> bool:
        """Whether ``data``, received on a new connection, continues the stream of the old one.

        This holds if ``data`` has ``MIN_CONSECUTIVE`` consecutive bursts of the same format and
        COUNT agrees with host time. The data are not consumed: call :meth:`resume`, then
        :meth:`receive`.
        """
        if not self._started or "count" not in self._burst:
            return False
        runs, _ = find_frames(np.frombuffer(data, np.uint8), self._size, self._valid)
        for offset, length in runs[::-1]:
            if length >= MIN_CONSECUTIVE:
                frames = np.frombuffer(data, self._dtype, count=length, offset=offset)
                counters = frames["count"][-MIN_CONSECUTIVE:].astype(np.int64)
                in_order = bool((np.diff(counters) % COUNT_MODULUS == 1).all())
                return in_order and self._counter.expects(int(counters[-1]), at)
        return False

    def resume(self) -> None:
        """Continue the stream on a new connection."""
        self._left = b""
        self._counter.resume()

    def receive(self, data: bytes, at: HostTime) -> list[DeviceItem]:
        """Return the items of all frames completed by ``data``."""
        data = self._left + data
        octets = np.frombuffer(data, np.uint8)
        runs, consumed = find_frames(octets, self._size, self._valid)
        self._left = data[consumed:]
        skipped = consumed - sum(length for _, length in runs) * self._size
        if skipped:
            self._note_skipped(octets, runs, skipped)
        frames = [
            np.frombuffer(data, self._dtype, count=length, offset=offset) for offset, length in runs
        ]
        found: list[DeviceItem] = []
        if frames:
            together = frames[0] if len(frames) == 1 else np.concatenate(frames)
            found += self._blocks(together, at)
            found += self._error_flag(together, at)
            found += self._temperature(together, at)
        return found + self._report(at)

    def _valid(self, windows: OctetArray) -> BoolArray:
        good: BoolArray = (windows[:, 0] == BURST_HEADER) & (windows[:, -1] == DELIMITER)
        return good & are_sums_right(windows[:, 1:-1]) if self._has_checksum else good

    def _note_skipped(self, octets: OctetArray, runs: list[tuple[int, int]], skipped: int) -> None:
        # A frame where one is due, with header and delimiter but a wrong checksum, was corrupted.
        ends = np.array([0] + [start + length * self._size for start, length in runs])
        ends = ends[ends + self._size <= octets.size]
        looks = (octets[ends] == BURST_HEADER) & (octets[ends + self._size - 1] == DELIMITER)
        starts = {start for start, _ in runs}
        bad = sum(1 for end in ends[looks].tolist() if end not in starts)
        self._counts["checksum"] += bad
        self._counts["skipped"] += max(0, skipped - bad * self._size)
        self._lost_frames += max(1, round(skipped / self._size))

    def _blocks(self, frames: NDArray[np.void], at: HostTime) -> list[Block | Event]:
        if "count" in self._burst:
            runs, repeated = self._counter.place(frames["count"], at)
            self._counts["repeated"] += repeated
        else:  # without COUNT, the skipped bytes are the only estimate of the missing frames
            lost = self._lost_frames
            runs = [FrameRun(0, frames.size, self._next + lost, missing=lost)]
            self._next, self._lost_frames = runs[0].first_sample + frames.size, 0
        counts = np.empty((frames.size, len(self._fields)), np.int32)
        for column, field in enumerate(self._fields):
            counts[:, column] = frames[field]
        found: list[Block | Event] = []
        for run in runs:
            if run.restarted:
                text = f"COUNT restarted; about {several(run.missing, 'sample')} missing"
                found.append(Event(self._sensor, EventKind.RESET, text, at))
            found.append(self._block(run, counts[run.start : run.stop], at))
        return found

    def _block(self, run: FrameRun, counts: NDArray[np.int32], at: HostTime) -> Block:
        flags, reason = BlockFlag.NONE, ""
        if run.restarted or not self._started:
            flags |= BlockFlag.CLOCK_RESTART
        if run.missing:
            reason = several(run.missing, "sample", "not received")
            if run.restarted:
                reason = "the device was reset"
            if run.restarted or "count" not in self._burst:
                flags |= BlockFlag.MISSING_ESTIMATED
        # np.abs would overflow at the most negative count
        axes = counts if len(self._axes) == len(self._fields) else counts[:, self._axes]
        if axes.size and (axes.max() >= self._full_scale or axes.min() <= -self._full_scale):
            flags |= BlockFlag.CLIPPED
        self._started = True
        return Block(self._sensor, run.first_sample, counts, at, run.counter, flags, reason)

    def _error_flag(self, frames: NDArray[np.void], at: HostTime) -> list[Event]:
        if not self._has_flag:
            return []
        error = bool(np.bitwise_or.reduce(frames["flag"]) & FLAG_ERROR)
        changed, self._error = error != self._error, error
        if not changed:
            return []
        text = "the device reports an error" if error else "the device no longer reports an error"
        return [Event(self._sensor, EventKind.STATUS, text, at)]

    def _temperature(self, frames: NDArray[np.void], at: HostTime) -> list[Reading]:
        """Return the temperature once a minute."""
        if not self._has_temperature:
            return []
        count = int(frames["temperature"][-1])
        if not count or not self._reading_times.is_due(at):  # 0: not measured yet
            return []
        return [Reading(self._sensor, Quantity.TEMPERATURE, temperature(count), at)]

    def _report(self, at: HostTime) -> list[Event]:
        events: list[Event] = []
        if not any(self._counts.values()):
            return events
        for name, (kind, noun, what) in _REPORTS.items():
            n = self._counts[name]
            if n and at.monotonic_ns - self._reported[name] >= REPORT_INTERVAL_NS:
                self._counts[name], self._reported[name] = 0, at.monotonic_ns
                events.append(Event(self._sensor, kind, several(n, noun, what), at))
        return events
