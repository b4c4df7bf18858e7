"""Decoders of GCF over a serial line with block recovery, and from Scream servers.

Both pass blocks to :class:`Streams`, and whether missing blocks may still arrive. It joins GCF
streams into sensors by time, for every kind of link.

Theory of operation
-------------------
A Güralp digitizer sends each component as a stream of its own (``DEMOZ2``, ``DEMON2``, ``DEMOE2``).
:class:`Streams` gives each block to its sensor, where streams are joined by time
(:mod:`daq.protocols.joined_streams`).

A sensor whose streams are not yet known starts without streams. Meanwhile, blocks of streams that
belong to no sensor are kept until :meth:`Streams.assign` assigns their streams.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping

from daq.devices.guralp.brp import (
    MAX_SIZE,
    Damaged,
    Frame,
    Lost,
    NumberingRestarted,
    Receiver,
    Skipped,
)
from daq.devices.guralp.gcf import SampleBlock, StatusBlock, decode_block, serial_number
from daq.devices.guralp.scream import ACKNOWLEDGED, NO_SERVER, Packet, PacketFinder, decode_packet
from daq.protocols.block import Block, DeviceItem, Event, EventKind, HostTime, Quantity, Reading
from daq.protocols.errors import RemoteProtocolError, several, shortened
from daq.protocols.joined_streams import MAX_PENDING, JoinedStreams

MAX_KEPT = 1024
"""Maximum number of blocks kept for streams that are not assigned yet."""
_STATED = {
    Quantity.SUPPLY: re.compile(r"\bsupply\s*[:=]?\s*(\d{1,3}(?:\.\d{1,4})?)\s*V\b", re.IGNORECASE),
    Quantity.TEMPERATURE: re.compile(
        r"\btemp(?:erature)?\s*[:=]?\s*([-+]?\d{1,3}(?:\.\d{1,4})?)\s*['°]?\s*C\b", re.IGNORECASE
    ),
}
"""As in ``External supply : 13.0V Temperature 24.68'C`` (Güralp MAN-D24-0004, 7.1.1)."""
FULL_SCALE_COUNTS = (1 << 23) - 1
"""Full scale of a 24-bit digitizer, peak."""


class Streams:
    """Sorts GCF blocks by sensor and joins the streams of each.

    Parameters
    ----------
    sensors : mapping of str to sequence of str
        Stream ID of each channel, by sensor, in the order of the channels; empty if not yet known.
    """

    def __init__(self, sensors: Mapping[str, Iterable[str]]) -> None:
        ids = {name: tuple(stream_ids) for name, stream_ids in sensors.items()}
        self._sensors = {name: _joined(name, stream_ids) for name, stream_ids in ids.items()}
        self._systems: dict[str, str] = {}
        self._owner = {stream: name for name, streams in ids.items() for stream in streams}
        self._unknown: Counter[str] = Counter()
        self._kept: deque[tuple[SampleBlock, HostTime]] = deque(maxlen=MAX_KEPT)
        self._searching = not all(ids.values())
        self._name = only(ids)
        self._lost = "block missing"
        self._incomplete: set[str] = set()  # streams whose next block may follow a lost one
        self._at: HostTime | None = None  # of the last block

    @property
    def silent(self) -> tuple[str, ...]:
        """IDs of the streams without any block yet."""
        return tuple(stream for sensor in self._sensors.values() for stream in sensor.silent)

    @property
    def unknown(self) -> frozenset[str]:
        """IDs of received streams that belong to no sensor."""
        return frozenset(self._unknown)

    @property
    def repeated(self) -> bool:
        """Whether one of the `unknown` streams sent two blocks: probably each has sent one."""
        return max(self._unknown.values(), default=0) > 1

    def sampling_rate(self, sensor: str) -> float | None:
        """Return the sampling rate of a sensor in Hz, or None before its first block."""
        rate = self._sensors[sensor].sampling_rate
        return None if rate is None else float(rate)

    def stream_ids(self, sensor: str) -> tuple[str, ...]:
        """Return the stream IDs of a sensor's channels."""
        return tuple(stream for stream, owner in self._owner.items() if owner == sensor)

    def system(self, sensor: str) -> str:
        """Return the system ID in a sensor's first block."""
        return self._systems.get(sensor, "")

    def lost(self, reason: str) -> None:
        """Set the reason for gaps from now on: block numbers show that some were lost."""
        self._lost = reason
        self._incomplete = set(self._owner)

    def receive(
        self, block: SampleBlock | StatusBlock, at: HostTime, *, awaiting: bool = False
    ) -> Iterator[DeviceItem]:
        """Add one block; yield the completed blocks and events.

        ``awaiting`` is whether missing blocks may still arrive.
        """
        self._at = at
        if isinstance(block, StatusBlock):
            yield from self._status(block, at)
        elif block.stream_id in self._owner:
            owner = self._owner[block.stream_id]
            self._systems.setdefault(owner, block.system.text)
            in_turn = False if awaiting or block.stream_id in self._incomplete else None
            self._incomplete.discard(block.stream_id)
            yield from self._sensors[owner].add(block, at, in_turn=in_turn)
        elif block.stream_id in self._unknown or len(self._unknown) < MAX_PENDING:
            self._unknown[block.stream_id] += 1
            if self._searching:
                self._kept.append((block, at))
            elif self._unknown[block.stream_id] == 1:
                yield self._nobodys(block.stream_id, at)
        for sensor in self._sensors.values():
            yield from sensor.take(at, awaiting=awaiting, reason=self._lost)

    def release(self) -> Iterator[Block | Event]:
        """Yield the blocks that wait for missing ones: the connection ended, nothing comes."""
        if self._at is not None:
            for sensor in self._sensors.values():
                yield from sensor.settle(self._at)
                yield from sensor.take(self._at, awaiting=False, reason=self._lost)

    def assign(self, sensor: str, stream_ids: Iterable[str]) -> Iterator[DeviceItem]:
        """Assign streams to a sensor; yield the blocks received of them, up to the first hole."""
        ids = tuple(stream_ids)
        own = self._sensors[sensor] = _joined(sensor, ids)
        self._owner |= dict.fromkeys(ids, sensor)
        kept, self._searching = list(self._kept), False
        self._kept.clear()
        for block, at in kept:
            if block.stream_id in ids:
                self._unknown.pop(block.stream_id, None)
                self._systems.setdefault(sensor, block.system.text)
                yield from own.add(block, at)
                yield from own.take(at, awaiting=True, reason=self._lost)
        for stream_id in sorted(self._unknown):
            yield self._nobodys(stream_id, kept[-1][1])

    def _nobodys(self, stream_id: str, at: HostTime) -> Event:
        text = f"stream {stream_id} belongs to no sensor of this port"
        return Event(self._name, EventKind.REFUSED, text, at)

    def _status(self, block: StatusBlock, at: HostTime) -> Iterator[Event | Reading]:
        serial = serial_number(block.stream_id)
        owners = {n for stream, n in self._owner.items() if serial_number(stream) == serial} or {""}
        for line in block.text.splitlines():
            text = "".join(c if c.isprintable() else "?" for c in line).strip()
            if text:
                stated = [
                    (quantity, float(found[1]))
                    for quantity, pattern in _STATED.items()
                    if (found := pattern.search(text))
                ]
                for name in sorted(owners):
                    yield Event(name, EventKind.STATUS, shortened(text), at)
                    for quantity, value in stated if name else ():
                        yield Reading(name, quantity, value, at)


def _joined(sensor: str, stream_ids: tuple[str, ...]) -> JoinedStreams:
    return JoinedStreams(sensor, stream_ids, full_scale=FULL_SCALE_COUNTS)


def only(names: Iterable[str]) -> str:
    """Return the sensor name for events of the port; empty if several sensors share the port."""
    first, *others = (*names, "")
    return first if len(others) <= 1 else ""


MAX_JUMP = 1024
"""Largest jump of the packet number; a larger one means that the server restarted."""


class SerialDecoder:
    """GCF over a serial line with block recovery; see :mod:`daq.devices.guralp.brp`.

    Parameters
    ----------
    sensors : mapping of str to sequence of str
        Stream ID of each channel, by sensor.
    replies : bool
        Whether the host acknowledges blocks and requests lost ones again.
    """

    def __init__(self, sensors: Mapping[str, Iterable[str]], *, replies: bool = True) -> None:
        self.streams = Streams(sensors)
        self._name = only(sensors)
        self._receiver = Receiver(replies=replies)

    def receive(self, data: bytes, at: HostTime) -> list[DeviceItem]:
        """Decode bytes of the line, cut anywhere. Then send :meth:`take_replies`."""
        found: list[DeviceItem] = []
        for item in self._receiver.receive(data):
            match item:
                case Frame(_, block):
                    found += self._frame(block, at)
                case Damaged(sequence):
                    text = f"block {sequence} was damaged"
                    found.append(Event(self._name, EventKind.CHECKSUM, text, at))
                    self.streams.lost("damaged block")
                case Lost(sequence, n_frames):
                    text = f"lost {several(n_frames, 'block')} from number {sequence} on"
                    found.append(Event(self._name, EventKind.RESYNCHRONISED, text, at))
                    self.streams.lost("lost block")
                case NumberingRestarted(sequence, due):
                    text = f"the digitizer restarted: block {sequence}, expected {due}"
                    found.append(Event(self._name, EventKind.RESET, text, at))
                    self.streams.lost("digitizer restarted")
                case Skipped(n_bytes, start):
                    text = _skipped_text(n_bytes, start)
                    found.append(Event(self._name, EventKind.STATUS, text, at))
        return found

    def take_replies(self) -> bytes:
        """Return and remove the bytes to send to the digitizer."""
        return self._receiver.take_replies()

    def _frame(self, data: bytes, at: HostTime) -> Iterator[DeviceItem]:
        try:
            block = decode_block(data)
        except RemoteProtocolError as error:
            yield Event(self._name, EventKind.CHECKSUM, shortened(str(error)), at)
            return
        yield from self.streams.receive(block, at, awaiting=self._receiver.awaiting)


def _skipped_text(n_bytes: int, start: bytes) -> str:
    if sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in start) > 0.9 * len(start):
        return shortened("terminal: " + " ".join(start.decode("ascii", "replace").split()))
    if start[:1] == b"G" and len(start) >= 4 and int.from_bytes(start[2:4], "big") > MAX_SIZE:
        size = int.from_bytes(start[2:4], "big")
        return f"skipped {n_bytes} bytes: a block of {size} bytes; expected at most {MAX_SIZE}"
    return f"skipped {n_bytes} bytes that are no block"


class ScreamDecoder:
    """GCF from a Scream server: ``receive`` for TCP, ``receive_datagram`` for UDP.

    Packets may arrive out of order, or again after a request by number (``missing``). A missing
    packet is awaited until ``patience`` others have arrived. Meanwhile no blocks are returned; the
    stall detector must allow for this. An earlier number with a block later than all others means
    that the server restarted.
    """

    MAX_MISSING = 32

    def __init__(self, sensors: Mapping[str, Iterable[str]], *, patience: int = 2) -> None:
        self.streams = Streams(sensors)
        self._patience = patience
        self._name = only(sensors)
        self._finder = PacketFinder()
        self._next: int | None = None
        self._latest_ns = 0  # latest start of a block
        self._missing: dict[int, int] = {}  # sequence number: number of packets since

    @property
    def missing(self) -> tuple[int, ...]:
        """Sequence numbers of missing packets that may still arrive."""
        return tuple(self._missing)

    def receive(self, data: bytes, at: HostTime) -> list[DeviceItem]:
        """Decode bytes of the TCP connection, cut anywhere."""
        found: list[DeviceItem] = []
        for item in self._finder.receive(data):
            if isinstance(item, Packet):
                found += self._packet(item, at)
            else:
                text = f"skipped {several(item, 'byte')}"
                found.append(Event(self._name, EventKind.RESYNCHRONISED, text, at))
        return found

    def receive_datagram(self, data: bytes, at: HostTime) -> list[DeviceItem]:
        """Decode one UDP packet."""
        text = data[:16].rstrip(b"\0") + b"\0"
        if text == ACKNOWLEDGED:
            return []
        if text == NO_SERVER:
            return [Event(self._name, EventKind.STOPPED, "the Scream server shuts down", at)]
        try:
            return list(self._packet(decode_packet(data), at))
        except RemoteProtocolError as error:
            return [Event(self._name, EventKind.RESYNCHRONISED, shortened(str(error)), at)]

    def not_available(self, sequence: int) -> None:
        """Stop waiting for a packet that the server no longer has."""
        self._missing.pop(sequence, None)

    def _packet(self, packet: Packet, at: HostTime) -> Iterator[DeviceItem]:
        sequence = packet.sequence
        due = sequence if self._next is None else self._next
        ahead = (sequence - due) % 65536
        start_ns = packet.block.start_ns
        known = sequence in self._missing or start_ns <= self._latest_ns
        self._latest_ns = max(self._latest_ns, start_ns)
        if min(ahead, 65536 - ahead) > MAX_JUMP or (ahead >= 32768 and not known):
            self._missing.clear()
            self._next = (sequence + 1) % 65536
            self.streams.lost("server restarted")
            text = f"the server restarted: packet {sequence}, expected {due}"
            yield Event(self._name, EventKind.RESET, text, at)
        elif ahead < 32768:
            yield from self._advance(due, ahead, at)
            self._next = (sequence + 1) % 65536
        self._missing.pop(sequence, None)
        yield from self.streams.receive(packet.block, at, awaiting=bool(self._missing))

    def _advance(self, due: int, ahead: int, at: HostTime) -> Iterator[Event]:
        if ahead:
            self.streams.lost("lost packet")
            yield Event(
                self._name, EventKind.RESYNCHRONISED, several(ahead, "packet", "missing"), at
            )
        aged = {number: since + 1 for number, since in self._missing.items()}
        if ahead <= self.MAX_MISSING:  # packets are not reordered by more
            aged |= {(due + i) % 65536: 0 for i in range(ahead)}
        self._missing = {n: since for n, since in aged.items() if since < self._patience}
