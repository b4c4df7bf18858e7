"""LabJack T7 and T8 streams: scans of a list of channels, spontaneous or on request.

Theory of operation
-------------------
The device scans a list of addresses at a fixed rate into a buffer. Spontaneous streams push packets
over TCP port 702 (T-series datasheet 3.2.4), big-endian::

    transaction u16, protocol u16 = 0, length u16 = 10 + 2 N, unit u8 = 1, function u8 = 76,
    type u8 = 16, reserved u8, backlog u16 (bytes), status u16, information u16, N samples u16

In command-response mode the host reads register 4500: N u16, backlog, status, information, samples.
Samples cycle through the scan list; a scan may span two packets. N is at most 512.

===== ==================== =====================================================================
2940  auto-recovery         the buffer overflowed; the samples in it are valid
2941  end of auto-recovery  ``information`` scans were skipped; one scan of 0xFFFF, one of these,
                            separates old and new samples
2942  scan overlap          fatal: the rate is too high for the scan list
2943  recovery overflow     fatal: more scans were skipped than the device can count
2944  burst complete        the requested number of scans was taken
2945  buffer full           fatal, without auto-recovery
===== ==================== =====================================================================

If the scan list begins with CORE_TIMER and STREAM_DATA_CAPTURE_16 (its upper half), every scan
holds the 40 MHz timer from which the scan rate is derived. Every step of the timer is checked. Gaps
are counted by the timer, and blocks have it as ``device_counter``, unwrapped (it wraps every 107
s).

A scan of 0xFFFF in every column is a scan that the device did not complete, and a gap. Without the
timer such a scan may also have been clipped. It counts as incomplete if it stands alone and has
several columns.

After a fatal status or on a new connection the stream is restarted: call
:meth:`StreamDecoder.restart`. The timer continues, but scans start again. The number of missing
scans then follows from the timer, to the nearest scan, and the number of its wraps from host time.
If the timer contradicts host time, it was reset as well, and the number is an estimate.

The U3's guide counts the scan of 0xFFFF among the skipped ones; the T-series datasheet does not say
so. Either way, ``information`` scans are missing in its place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from daq.devices.labjack.packets import Packet, PacketFinder
from daq.devices.labjack.registers import CORE_HZ, CORE_TIMER, STREAM_DATA_CAPTURE_16
from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.protocols.errors import several
from daq.protocols.sample_counter import CLOCK_TOLERANCE, SLACK, SampleCounter

AUTO_RECOVER_ACTIVE = 2940
AUTO_RECOVER_END = 2941
SCAN_OVERLAP = 2942
AUTO_RECOVER_OVERFLOW = 2943
BURST_COMPLETE = 2944
BUFFER_FULL = 2945
FATAL = {
    SCAN_OVERLAP: "scan overlap: the scan rate is too high",
    AUTO_RECOVER_OVERFLOW: "the buffer overflowed for too long",
    BUFFER_FULL: "the buffer is full",
}
DUMMY = 0xFFFF
REPEATED = 2
"""Maximum age in s of repeated scans against the last scan; if older, the timer was reset."""
TIMER_ADDRESSES = (CORE_TIMER, STREAM_DATA_CAPTURE_16)
MAX_JITTER, MIN_STEP = 0.4, 0.1
"""Jitter of the timer from scan to scan, and its smallest step, in scans."""
_WRAP = 1 << 32
MAX_UNCERTAINTY = 40.0
"""Largest uncertainty of host time, in s, that still determines the timer's number of wraps."""


class StreamDecoder:
    """Decoder of scans into blocks of the sensors that share the digitizer.

    Parameters
    ----------
    sensors : mapping of str to sequence of int
        Address of each channel, by sensor; all are in ``scan_list``.
    scan_list : sequence of int
        The addresses that the device scans. If the list begins with CORE_TIMER and
        STREAM_DATA_CAPTURE_16, blocks have the timer as ``device_counter``.
    scan_rate : float
        Actual scan rate, read from the device, in Hz.
    """

    def __init__(
        self, sensors: Mapping[str, Sequence[int]], *, scan_list: Sequence[int], scan_rate: float
    ) -> None:
        self._columns = {
            name: np.array([list(scan_list).index(address) for address in addresses])
            for name, addresses in sensors.items()
        }
        self._name = next(iter(sensors)) if len(sensors) == 1 else ""  # for events of the port
        self._n_columns = len(scan_list)
        self._timed = tuple(scan_list[:2]) == TIMER_ADDRESSES
        self._rate = scan_rate
        self._ticks = CORE_HZ / scan_rate  # an integer for a T7
        self._finder = PacketFinder()
        self._next_row = self._end_row = 0  # expected index; index after the last scan
        self._flags = BlockFlag.CLOCK_RESTART
        self._reason = ""
        self._timer: int | None = None  # of the last timed scan, unwrapped
        self._timer_row = 0  # index of that scan
        self._latest: HostTime | None = None
        self._is_untimed = False  # whether the last scans had no timer, although they should
        self._begin()

    def _begin(self) -> None:
        self._carry = np.empty(0, np.uint16)  # the incomplete last scan
        self._offset = 0  # samples to drop before the next scan begins
        self._transactions: SampleCounter | None = None
        self._packet_size = 0
        self.recovers = False
        """Whether the last packet reported auto-recovery: the buffer overflowed."""
        self._newest: int | None = None  # timer of the last received scan
        self._newest_ns = 0  # host time of its arrival
        self.fatal: int | None = None
        """The status that ended the stream, or None."""
        self.complete = False
        """Whether the burst is complete."""

    @property
    def can_resume(self) -> bool:
        """Whether the scans of a restarted stream can be placed by the timer."""
        return self._timer is not None

    def restart(self) -> None:
        """Expect a restarted stream, on this connection or another."""
        reason = FATAL.get(self.fatal or 0, "stream restarted")
        self._finder = PacketFinder()
        self._begin()
        self._flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
        self._reason = reason

    def receive(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Decode bytes of port 702, cut anywhere."""
        found: list[Block | Event] = []
        rows: list[NDArray[np.uint16]] = []
        for item in self._finder.receive(data):
            if isinstance(item, Packet):
                found += self._packet(item, rows, at)
            else:
                text = f"skipped {several(item, 'byte')}"
                found.append(Event(self._name, EventKind.RESYNCHRONISED, text, at))
        return found + self._blocks(rows, at)

    def receive_response(self, packet: Packet, at: HostTime) -> list[Block | Event]:
        """Decode the content of register 4500."""
        rows: list[NDArray[np.uint16]] = []
        found = self._packet(packet, rows, at)
        return found + self._blocks(rows, at)

    def _packet(
        self, packet: Packet, rows: list[NDArray[np.uint16]], at: HostTime
    ) -> list[Block | Event]:
        """Append the scans of a packet to ``rows``; return the blocks and events before them."""
        found: list[Block | Event] = []
        if self.fatal is not None or self.complete:
            return found
        lost = self._lost_packets(packet, at)
        if lost is None:
            found.append(Event(self._name, EventKind.RESYNCHRONISED, "received a packet twice", at))
            return found
        if lost:
            found += self._blocks(rows, at)
            text = several(lost, "packet", "lost")
            found.append(Event(self._name, EventKind.RESYNCHRONISED, text, at))
            self._skip_samples(lost * self._packet_size)
        self._packet_size = max(len(packet.samples), self._packet_size)
        if packet.status == AUTO_RECOVER_ACTIVE and not self.recovers:
            text = "the device's buffer overflowed (2940)"
            found.append(Event(self._name, EventKind.OVERFLOW, text, at))
        self.recovers = packet.status == AUTO_RECOVER_ACTIVE
        scans = self._scans(packet.samples)
        if packet.status != AUTO_RECOVER_END:  # such a packet may begin with a scan of 0xFFFF
            scans = scans[self._n_repeated(scans, at) :]
        if packet.status == AUTO_RECOVER_END:
            before, scans = self._around_dummy(scans)
            rows.append(before)
            found += self._blocks(rows, at)
            text = f"the device skipped {several(packet.information, 'scan')} (2941)"
            found.append(Event(self._name, EventKind.OVERFLOW, text, at))
            self._next_row += packet.information
            self._reason = "buffer overflow"
        elif packet.status in FATAL:
            self.fatal = packet.status
            text = f"{FATAL[packet.status]} ({packet.status})"
            found.append(Event(self._name, EventKind.OVERFLOW, text, at))
            if DUMMY in scans[-1:]:  # incomplete when the stream ended
                scans = scans[:-1]
        elif packet.status == BURST_COMPLETE:
            self.complete = True
        elif packet.status not in (0, AUTO_RECOVER_ACTIVE):
            found.append(Event(self._name, EventKind.STATUS, f"stream status {packet.status}", at))
        rows.append(scans)
        return found

    def _lost_packets(self, packet: Packet, at: HostTime) -> int | None:
        """Return the number of packets missing before this one; None if it is a repetition."""
        if packet.transaction is None:
            return 0
        if self._transactions is None:
            if packet.status == AUTO_RECOVER_ACTIVE:  # it may not be full, so the rate is unknown
                return 0
            packet_rate = self._rate * self._n_columns / max(1, len(packet.samples))
            self._transactions = SampleCounter(65536, packet_rate)
        runs, n_repeated = self._transactions.place(np.array([packet.transaction]), at)
        if n_repeated:
            return None
        # A number that contradicts host time is invalid.
        return 0 if runs[0].restarted else runs[0].missing

    def _skip_samples(self, n_samples: int) -> None:
        position = len(self._carry) + n_samples
        self._next_row += -(-position // self._n_columns)
        self._offset = -position % self._n_columns
        self._carry = self._carry[:0]
        self._reason = "lost packet"

    def _scans(self, samples: NDArray[np.uint16]) -> NDArray[np.uint16]:
        dropped = min(self._offset, len(samples))
        self._offset -= dropped
        samples = np.concatenate((self._carry, samples[dropped:]))
        n_whole = len(samples) // self._n_columns * self._n_columns
        self._carry = samples[n_whole:]
        return samples[:n_whole].reshape(-1, self._n_columns)

    @staticmethod
    def _around_dummy(scans: NDArray[np.uint16]) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        is_dummy = (scans == DUMMY).all(axis=1)
        if not is_dummy.any():
            return scans[:0], scans
        at = int(is_dummy.argmax())
        return scans[:at], scans[at + 1 :]

    def _blocks(self, rows: list[NDArray[np.uint16]], at: HostTime) -> list[Block | Event]:
        """Return the scans in ``rows`` as blocks, one per sensor and run; clear ``rows``."""
        scans = np.concatenate(rows) if rows else np.empty((0, self._n_columns), np.uint16)
        rows.clear()
        found: list[Block | Event] = []
        if not len(scans):
            return found
        is_dummy = self._is_dummy(scans)
        jumps = self._jumps(scans, is_dummy, at)
        if jumps is None and not self._is_untimed:
            text = "the core timer does not fit the scan rate: it is not used"
            found.append(Event(self._name, EventKind.RESYNCHRONISED, text, at))
        self._is_untimed = jumps is None
        cuts = np.flatnonzero(np.diff(is_dummy)) + 1
        if jumps is not None:
            cuts = np.union1d(cuts, jumps)
        for run in np.split(np.arange(len(scans)), cuts):
            if is_dummy[run[0]]:
                self._next_row += len(run)  # without a timer, each stands for itself
                self._reason = "the device did not complete a scan (0xFFFF)"
                continue
            if jumps is not None and run[0] in jumps and not self._reason:
                self._reason = "scans are missing by the core timer"
            found += self._run(scans[run], at)
        return found

    def _is_dummy(self, scans: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Return which scans are incomplete."""
        dummy: NDArray[np.bool_] = (scans == DUMMY).all(axis=1)
        if self._timed:
            return dummy
        if self._n_columns == 1:
            return np.zeros_like(dummy)
        around = np.concatenate(([False], dummy, [False]))
        return dummy & ~around[:-2] & ~around[2:]

    def _jumps(
        self, scans: NDArray[np.uint16], is_dummy: NDArray[np.bool_], at: HostTime
    ) -> NDArray[np.int64] | None:
        """Return the rows before which the timer skips scans; None if it is not a timer."""
        rows = np.flatnonzero(~is_dummy)
        if not self._timed or len(rows) < 2:
            return np.empty(0, np.int64)
        timers = scans[rows, 0].astype(np.int64) | scans[rows, 1].astype(np.int64) << 16
        steps = np.diff(timers) % _WRAP / self._ticks
        missing = np.floor(steps + MAX_JITTER) - 1
        elapsed = SLACK
        if self._latest is not None:
            elapsed += (at.monotonic_ns - self._latest.monotonic_ns) * 1e-9
        is_timer = (steps > MIN_STEP) & (missing <= elapsed * self._rate)
        if not is_timer.all():
            return None
        return np.asarray(rows[1:][missing > 0], np.int64)

    def _run(self, scans: NDArray[np.uint16], at: HostTime) -> list[Block | Event]:
        """Return one block per sensor with scans that follow one another."""
        counter = self._place(scans, at)
        first, self._next_row = self._next_row, self._next_row + len(scans)
        self._end_row = self._next_row
        flags, self._flags = self._flags, BlockFlag.NONE
        reason, self._reason = self._reason, ""
        self._latest = at
        blocks: list[Block | Event] = []
        for name, columns in self._columns.items():
            counts = scans[:, columns]
            clipped = counts.max() == DUMMY or counts.min() == 0
            own = flags | BlockFlag.CLIPPED if clipped else flags
            blocks.append(Block(name, first, counts, at, counter, own, reason))
        return blocks

    def _n_repeated(self, scans: NDArray[np.uint16], at: HostTime) -> int:
        """Return the number of leading scans that repeat earlier ones, by the timer."""
        if not self._timed or not len(scans):
            return 0
        first, last = _timer(scans[0]), _timer(scans[-1])
        before, before_ns, n_repeated = self._newest, self._newest_ns, 0
        # The timer jitters by less than half a scan; otherwise these are not timer values.
        if abs((last - first) % _WRAP - (len(scans) - 1) * self._ticks) < self._ticks / 2:
            self._newest, self._newest_ns = last, at.monotonic_ns
        if before is not None and (at.monotonic_ns - before_ns) * 1e-9 < MAX_UNCERTAINTY:
            behind = (before - first) % _WRAP
            if behind < REPEATED * CORE_HZ:
                n_repeated = min(round(behind / self._ticks) + 1, len(scans))
                if n_repeated == len(scans):
                    self._newest, self._newest_ns = before, before_ns
        return n_repeated

    def _place(self, scans: NDArray[np.uint16], at: HostTime) -> int | None:
        """Set the index of the scans by timer or host time; return the timer of the first."""
        n_scans = len(scans)
        doubt = 0.0  # uncertainty of host time in s; 0 if host time is not used
        if self._flags & BlockFlag.MISSING_ESTIMATED and self._latest is not None:
            elapsed = (at.monotonic_ns - self._latest.monotonic_ns) * 1e-9
            self._next_row += max(0, round(elapsed * self._rate) - n_scans)
            doubt = SLACK + CLOCK_TOLERANCE * elapsed
        if not self._timed:
            return None
        first, last = _timer(scans[0]), _timer(scans[-1])
        if abs((last - first) % _WRAP - (n_scans - 1) * self._ticks) > n_scans * self._ticks / 2:
            return None  # samples were lost: these columns are not the timer
        counter = first
        if self._timer is not None:
            # The expected index gives the number of wraps; the timer gives the exact index.
            expected = self._timer + (self._next_row - self._timer_row) * self._ticks
            counter += _WRAP * round((expected - first) / _WRAP)
            if not doubt or abs(counter - expected) <= doubt * CORE_HZ <= MAX_UNCERTAINTY * CORE_HZ:
                steps = round((counter - self._timer) / self._ticks)
                self._next_row = max(self._timer_row + steps, self._end_row)
                self._flags &= ~BlockFlag.MISSING_ESTIMATED
        self._timer = counter + (last - first) % _WRAP
        self._timer_row = self._next_row + n_scans - 1
        return counter


def _timer(scan: NDArray[np.uint16]) -> int:
    return int(scan[0]) | int(scan[1]) << 16
