"""Decoders of GCF over a serial line with block recovery, and from Scream servers.

Both pass blocks to :class:`~daq.devices.guralp.streams.Streams`, and whether missing blocks may
still arrive.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.devices.guralp.brp import (
    MAX_SIZE,
    Damaged,
    Frame,
    Lost,
    NumberingRestarted,
    Receiver,
    Skipped,
)
from daq.devices.guralp.gcf import decode_block
from daq.devices.guralp.scream import (
    ACKNOWLEDGED,
    NO_SERVER,
    Packet,
    PacketFinder,
    decode_packet,
)
from daq.devices.guralp.streams import Streams, cut, only
from daq.protocols.block import DeviceItem, Event, EventKind, HostTime
from daq.protocols.errors import RemoteProtocolError, several

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

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
                    found.append(
                        Event(self._name, EventKind.CHECKSUM, f"block {sequence} was damaged", at)
                    )
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
            yield Event(self._name, EventKind.CHECKSUM, cut(str(error)), at)
            return
        yield from self.streams.receive(block, at, awaiting=self._receiver.awaiting)


def _skipped_text(n_bytes: int, start: bytes) -> str:
    if sum(32 <= byte < 127 or byte in b"\r\n\t" for byte in start) > 0.9 * len(start):
        return cut("terminal: " + " ".join(start.decode("ascii", "replace").split()))
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
                found.append(
                    Event(
                        self._name, EventKind.RESYNCHRONISED, f"skipped {several(item, 'byte')}", at
                    )
                )
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
            return [Event(self._name, EventKind.RESYNCHRONISED, cut(str(error)), at)]

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
