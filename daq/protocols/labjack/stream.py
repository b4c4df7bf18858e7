"""LabJack T7 and T8 streams: scans of a list of channels, spontaneous or asked for.

Theory of operation
-------------------
The device scans a list of addresses at a fixed rate into a buffer. Spontaneous streams push packets
over TCP port 702 (T-series datasheet 3.2.4), big-endian::

    transaction u16, protocol u16 = 0, length u16 = 10 + 2 N, unit u8 = 1, function u8 = 76,
    type u8 = 16, reserved u8, backlog u16 (bytes), status u16, information u16, N samples u16

In command-response mode register 4500 is read: N u16, backlog, status, information, samples.
Samples go round the scan list without regard to packets; N is at most 512.

===== ==================== =====================================================================
2940  auto-recovery         the buffer overflowed; what comes is what was in it, valid
2941  end of auto-recovery  ``information`` scans were skipped; one scan of 0xFFFF, one of these,
                            stands between old and new samples
2942  scan overlap          fatal: the rate is too high for the scan list
2943  recovery overflow     fatal: more scans were skipped than can be counted
2944  burst complete        the wanted number of scans was made
2945  buffer full           fatal, without auto-recovery
===== ==================== =====================================================================

With CORE_TIMER and STREAM_DATA_CAPTURE_16 (its upper half) leading the scan list every scan carries
the 40 MHz clock that makes the scan rate: gaps are then counted by it, and blocks carry it as
``device_counter``, unwrapped (it wraps every 107 s). Where the stream is started anew, after a
fatal status or on another connection, :meth:`StreamDecoder.restart` is to be called: the clock runs
on, the scans begin anew. The clock then tells how many are missing, to the nearest scan, and host
time how often it wrapped; one that is not where host time says it should be began anew too, and
what is missing is estimated.

That the scan of 0xFFFF counts among the skipped is what the U3's guide says; the T-series datasheet
does not. Either way ``information`` scans are missing in its place.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.labjack.registers import CORE_HZ, CORE_TIMER, FEEDBACK, STREAM_DATA_CAPTURE_16
from daq.protocols.plural import several
from daq.protocols.sample_counter import CLOCK_TOLERANCE, SLACK, SampleCounter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

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
"""How far behind the last scan repeated scans may be, s; beyond, the timer was set anew."""
MAX_SAMPLES = 512
MAX_CR_SAMPLES = 251
TIMER_ADDRESSES = (CORE_TIMER, STREAM_DATA_CAPTURE_16)
_HEADER = struct.Struct(">HHHBBBBHHH")
_CR_HEADER = struct.Struct(">HHHH")
_MARK = bytes((FEEDBACK, 16))
_WRAP = 1 << 32
MOST_DOUBT = 40.0
"""Of host time beyond which it does not tell the wraps of the timer any more, s."""


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """What one packet or one read of register 4500 holds; ``samples`` is uint16."""

    samples: NDArray[np.uint16]
    backlog: int = 0
    status: int = 0
    information: int = 0
    transaction: int | None = None


def encode_packet(packet: Packet) -> bytes:
    """Write a spontaneous packet."""
    n_samples = len(packet.samples)
    if n_samples > MAX_SAMPLES:
        raise ValueError(f"{n_samples} samples; a packet holds {MAX_SAMPLES}")
    transaction = (packet.transaction or 0) % 65536
    backlog = min(packet.backlog, 65535)
    return (
        _HEADER.pack(
            transaction, 0, 10 + 2 * n_samples, 1, FEEDBACK, 16, 0, backlog, packet.status,
            min(packet.information, 65535),
        )
        + packet.samples.astype(">u2").tobytes()
    )  # fmt: skip


def encode_response(packet: Packet, *, n_registers: int) -> bytes:
    """Write what register 4500 reads as, zeros after the samples."""
    n_samples = len(packet.samples)
    if n_samples + 4 > n_registers:
        raise ValueError(f"{n_samples} samples in {n_registers} registers; four are the header")
    head = _CR_HEADER.pack(
        n_samples, min(packet.backlog, 65535), packet.status, min(packet.information, 65535)
    )
    return (head + packet.samples.astype(">u2").tobytes()).ljust(2 * n_registers, b"\0")


def decode_response(values: bytes) -> Packet:
    """Read what register 4500 holds.

    Raises
    ------
    RemoteProtocolError
        More samples are announced than there are.
    """
    if len(values) < _CR_HEADER.size:
        raise RemoteProtocolError(f"{len(values)} bytes of stream; expected 8 or more")
    n_samples, backlog, status, information = _CR_HEADER.unpack_from(values)
    if _CR_HEADER.size + 2 * n_samples > len(values):
        raise RemoteProtocolError(f"{n_samples} samples announced in {len(values)} bytes")
    samples = np.frombuffer(values, ">u2", n_samples, _CR_HEADER.size).astype(np.uint16)
    return Packet(samples, backlog, status, information)


class PacketFinder:
    """Finds packets in the bytes of port 702, wherever they are cut."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._skipped = 0

    def receive(self, data: bytes) -> list[Packet | int]:
        """Return packets, and before one that follows garbage how many bytes were skipped."""
        self._buffer += data
        buffer = bytes(self._buffer)
        found: list[Packet | int] = []
        here = 0
        while len(buffer) - here >= _HEADER.size:
            if not self._header_at(buffer, here):
                at = buffer.find(_MARK, here + 8)
                following = at - 7 if at >= 0 else len(buffer) - _HEADER.size + 1
                self._skipped += following - here
                here = following
                continue
            head = _HEADER.unpack_from(buffer, here)
            n_samples = (head[2] - 10) // 2
            end = here + _HEADER.size + 2 * n_samples
            if end > len(buffer):
                break
            if self._skipped:
                found.append(self._skipped)
                self._skipped = 0
            samples = np.frombuffer(buffer, ">u2", n_samples, here + _HEADER.size)
            backlog, status, information = head[7:]
            found.append(Packet(samples.astype(np.uint16), backlog, status, information, head[0]))
            here = end
        del self._buffer[:here]
        return found

    @staticmethod
    def _header_at(buffer: bytes, at: int) -> bool:
        _, protocol, length, unit, function, type_, *_ = _HEADER.unpack_from(buffer, at)
        return (
            (protocol, unit, function, type_) == (0, 1, FEEDBACK, 16)
            and 10 <= length <= 10 + 2 * MAX_SAMPLES
            and not length % 2
        )


class StreamDecoder:
    """Scans into blocks of the sensors that share the digitizer.

    Parameters
    ----------
    sensors : mapping of str to sequence of int
        For each sensor the address of each channel, as they stand in ``scan_list``.
    scan_list : sequence of int
        The addresses the device scans. If it begins with CORE_TIMER and STREAM_DATA_CAPTURE_16,
        blocks carry the device's clock.
    scan_rate : float
        As read back from the device, in Hz.
    """

    def __init__(
        self, sensors: Mapping[str, Sequence[int]], *, scan_list: Sequence[int], scan_rate: float
    ) -> None:
        self._columns = {
            name: np.array([list(scan_list).index(address) for address in addresses])
            for name, addresses in sensors.items()
        }
        self._name = next(iter(sensors)) if len(sensors) == 1 else ""  # of events of the port
        self._n_columns = len(scan_list)
        self._timed = tuple(scan_list[:2]) == TIMER_ADDRESSES
        self._rate = scan_rate
        self._ticks = CORE_HZ / scan_rate  # a whole number of a T7
        self._finder = PacketFinder()
        self._next_row = self._end_row = 0  # expected, as far as is known; after the last scan
        self._flags = BlockFlag.CLOCK_RESTART
        self._reason = ""
        self._timer: int | None = None  # unwrapped, of the last scan
        self._timer_row = 0  # its row
        self._latest: HostTime | None = None
        self._begin()

    def _begin(self) -> None:
        self._carry = np.empty(0, np.uint16)  # of a scan that goes on in the next packet
        self._offset = 0  # samples to drop until a scan begins
        self._transactions: SampleCounter | None = None
        self._packet_size = 0
        self.recovers = False
        """Whether the device said last that its buffer has overflowed, and that it will go on."""
        self._newest: int | None = None  # timer of the last scan that came
        self._newest_ns = 0  # when it did
        self.fatal: int | None = None
        """The status that ended the stream, if one did."""
        self.complete = False
        """Whether a burst has come to its end."""

    @property
    def can_go_on(self) -> bool:
        """Whether there is a timer by which scans of another stream can be placed after these."""
        return self._timer is not None

    def restart(self) -> None:
        """Note that the stream was started anew, on this connection or another."""
        reason = FATAL.get(self.fatal or 0, "stream restarted")
        self._finder = PacketFinder()
        self._begin()
        self._flags |= BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
        self._reason = reason

    def receive(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Take bytes of port 702, cut anywhere."""
        found: list[Block | Event] = []
        rows: list[NDArray[np.uint16]] = []
        for item in self._finder.receive(data):
            if isinstance(item, Packet):
                found += self._packet(item, rows, at)
            else:
                found.append(
                    Event(
                        self._name, EventKind.RESYNCHRONISED, f"skipped {several(item, 'byte')}", at
                    )
                )
        return found + self._blocks(rows, at)

    def receive_response(self, packet: Packet, at: HostTime) -> list[Block | Event]:
        """Take what register 4500 held."""
        rows: list[NDArray[np.uint16]] = []
        found = self._packet(packet, rows, at)
        return found + self._blocks(rows, at)

    def _packet(
        self, packet: Packet, rows: list[NDArray[np.uint16]], at: HostTime
    ) -> list[Block | Event]:
        """Add the scans of a packet to ``rows``; return what had to be said before them."""
        found: list[Block | Event] = []
        if self.fatal is not None or self.complete:
            return found
        lost = self._lost_packets(packet, at)
        if lost is None:
            found.append(Event(self._name, EventKind.RESYNCHRONISED, "a packet came twice", at))
            return found
        if lost:
            found += self._blocks(rows, at)
            found.append(
                Event(self._name, EventKind.RESYNCHRONISED, several(lost, "packet", "lost"), at)
            )
            self._skip_samples(lost * self._packet_size)
        self._packet_size = max(len(packet.samples), self._packet_size)
        if packet.status == AUTO_RECOVER_ACTIVE and not self.recovers:
            found.append(
                Event(self._name, EventKind.OVERFLOW, "the device's buffer overflowed (2940)", at)
            )
        self.recovers = packet.status == AUTO_RECOVER_ACTIVE
        scans = self._scans(packet.samples)
        if packet.status != AUTO_RECOVER_END:  # which may begin with a scan of 0xFFFF
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
            if DUMMY in scans[-1:]:  # incomplete when the stream broke off
                scans = scans[:-1]
        elif packet.status == BURST_COMPLETE:
            self.complete = True
        elif packet.status not in (0, AUTO_RECOVER_ACTIVE):
            found.append(Event(self._name, EventKind.STATUS, f"stream status {packet.status}", at))
        rows.append(scans)
        return found

    def _lost_packets(self, packet: Packet, at: HostTime) -> int | None:
        """Return how many packets are missing before this one; None if it came before."""
        if packet.transaction is None:
            return 0
        if self._transactions is None:
            if packet.status == AUTO_RECOVER_ACTIVE:  # it may not be full
                return 0
            packet_rate = self._rate * self._n_columns / max(1, len(packet.samples))
            self._transactions = SampleCounter(65536, packet_rate)
        runs, n_repeated = self._transactions.place(np.array([packet.transaction]), at)
        if n_repeated:
            return None
        # a number that host time does not allow is none that was counted to
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
        """Make the scans gathered so far into a block for each sensor."""
        scans = np.concatenate(rows) if rows else np.empty((0, self._n_columns), np.uint16)
        rows.clear()
        if not len(scans):
            return []
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
        """Return how many scans lead that the timer says came before, when their packet did."""
        if not self._timed or not len(scans):
            return 0
        first, last = _timer(scans[0]), _timer(scans[-1])
        before, before_ns, n_repeated = self._newest, self._newest_ns, 0
        # The timer may jitter; what is off by more is no timer.
        if abs((last - first) % _WRAP - (len(scans) - 1) * self._ticks) < self._ticks / 2:
            self._newest, self._newest_ns = last, at.monotonic_ns
        if before is not None and (at.monotonic_ns - before_ns) * 1e-9 < MOST_DOUBT:
            behind = (before - first) % _WRAP
            if behind < REPEATED * CORE_HZ:
                n_repeated = min(round(behind / self._ticks) + 1, len(scans))
                if n_repeated == len(scans):
                    self._newest, self._newest_ns = before, before_ns
        return n_repeated

    def _place(self, scans: NDArray[np.uint16], at: HostTime) -> int | None:
        """Put the scans in their place by timer or host time; return the timer of the first."""
        n_scans = len(scans)
        doubt = 0.0  # of host time, s; none, where it is not asked
        if self._flags & BlockFlag.MISSING_ESTIMATED and self._latest is not None:
            elapsed = (at.monotonic_ns - self._latest.monotonic_ns) * 1e-9
            self._next_row += max(0, round(elapsed * self._rate) - n_scans)
            doubt = SLACK + CLOCK_TOLERANCE * elapsed
        if not self._timed:
            return None
        first, last = _timer(scans[0]), _timer(scans[-1])
        if abs((last - first) % _WRAP - (n_scans - 1) * self._ticks) > n_scans * self._ticks / 2:
            return None  # samples were lost on the way: what stands there is no timer
        counter = first
        if self._timer is not None:
            # What is known to be missing tells the number of wraps, the timer then the rest.
            expected = self._timer + (self._next_row - self._timer_row) * self._ticks
            counter += _WRAP * round((expected - first) / _WRAP)
            if not doubt or abs(counter - expected) <= doubt * CORE_HZ <= MOST_DOUBT * CORE_HZ:
                steps = round((counter - self._timer) / self._ticks)
                self._next_row = max(self._timer_row + steps, self._end_row)
                self._flags &= ~BlockFlag.MISSING_ESTIMATED
        self._timer = counter + (last - first) % _WRAP
        self._timer_row = self._next_row + n_scans - 1
        return counter


def _timer(scan: NDArray[np.uint16]) -> int:
    return int(scan[0]) | int(scan[1]) << 16
