"""Scream: GCF blocks over UDP and TCP, as Güralp's servers send them.

Theory of operation
-------------------
A client sends requests to a server (UDP, port 1567) as text in one packet, ended by NUL:
``GCFPING``, ``GCFSEND:B`` (send, big-endian; the server stops unless the client repeats it),
``GCFSTOP``. The server replies ``GCFACKN``, and sends ``GCFNOSV`` when it shuts down. Over TCP, on
the same port, the client sends single bytes: 0xF9 (send over this connection from now on), 0xFC
(identify: length, text), 0xFE (oldest sequence number: u16), 0xFF and a u16 (repeat that block;
FF FF FF FF if it is no longer available).

Every packet holds one block of 1024 bytes and a tail (DM24 operator's guide, section 8.2)::

    version 31: u8 31, u8 length, 32 bytes of source, u16 sequence, u8 byte order, 2  1063 bytes
    version 40: u8 40, u8 byte order, u16 sequence, u8 length, 48 bytes of source     1077 bytes
    version 45: as 40, 60 bytes of source                                             1089 bytes

byte order 1 = big-endian, 2 = little-endian, for block and sequence. Assumed:

- two bytes of padding in version 31, as in Güralp's sources; the guide omits them;
- the layout of version 45, of which only the length (Güralp's and SeedLink's sources) and the
  position of the sequence number are published;
- in a little-endian block, each field and each difference is reversed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from daq.devices.guralp import gcf
from daq.protocols.errors import RemoteProtocolError

SEND = b"GCFSEND:B\0"
STOP = b"GCFSTOP\0"
ACKNOWLEDGED = b"GCFACKN\0"
NO_SERVER = b"GCFNOSV\0"
TCP_SEND = b"\xf9"
TCP_IDENTIFY = b"\xfc"
TCP_OLDEST = b"\xfe"
TCP_AGAIN = b"\xff"
NOT_AVAILABLE = b"\xff\xff\xff\xff"

_SOURCE_SIZE = {31: 32, 40: 48, 45: 60}
_PADDING = b"\0\0"  # in version 31
SIZES = {31: 1063, 40: 1077, 45: 1089}
"""Size of a packet in bytes, by version."""


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """One packet from a server."""

    sequence: int
    source: str
    block: gcf.SampleBlock | gcf.StatusBlock


def encode_packet(packet: Packet, *, version: int = 40, width: gcf.Width | None = None) -> bytes:
    """Encode a big-endian packet; ``width`` as in :func:`daq.devices.guralp.gcf.encode_block`."""
    block = packet.block
    if isinstance(block, gcf.SampleBlock):
        if width == 24:  # only the length distinguishes 24 from 32 bits; here it is always 1024
            raise ValueError("no differences of 24 bits over a network")
        body = gcf.encode_block(block, width=width)
    else:
        body = gcf.encode_status(block)
    source = packet.source.encode("ascii")[: _SOURCE_SIZE[version]]
    padded = source.ljust(_SOURCE_SIZE[version], b"\0")
    sequence = packet.sequence % 65536
    if version == 31:
        tail = struct.pack(">BB32sHB", version, len(source), padded, sequence, 1) + _PADDING
    else:
        tail = struct.pack(">BBHB", version, 1, sequence, len(source)) + padded
    return body.ljust(gcf.BLOCK_SIZE, b"\0") + tail


def decode_packet(data: bytes) -> Packet:
    """Decode one packet.

    Raises
    ------
    RemoteProtocolError
        If its version, length or byte order is unknown, or its block is damaged.
    """
    version = data[gcf.BLOCK_SIZE] if len(data) > gcf.BLOCK_SIZE else 0
    if len(data) != SIZES.get(version):
        raise RemoteProtocolError(f"a Scream packet of version {version} has {len(data)} bytes")
    tail = data[gcf.BLOCK_SIZE + 1 :]
    if version == 31:
        length, order, raw_sequence, text = tail[0], tail[35], tail[33:35], tail[1:33]
    else:
        order, raw_sequence, length, text = tail[0], tail[1:3], tail[3], tail[4:]
    if order not in (1, 2) or length > len(text):
        raise RemoteProtocolError(f"a Scream packet with byte order {order}, source of {length}")
    block = data[: gcf.BLOCK_SIZE] if order == 1 else swapped(data[: gcf.BLOCK_SIZE])
    sequence = int.from_bytes(raw_sequence, "big" if order == 1 else "little")
    return Packet(sequence, text[:length].decode("ascii", "replace"), gcf.decode_block(block))


def swapped(block: bytes) -> bytes:
    """Return a block of 1024 bytes in the other byte order."""
    out = np.frombuffer(block, np.uint8).copy()
    out[:12] = out[:12].reshape(3, 4)[:, ::-1].reshape(-1)
    sps, compression, records = (int(value) for value in out[13:16])
    if sps:
        end = min(20 + 4 * records, gcf.BLOCK_SIZE - 4)
        size = {1: 4, 2: 2}.get(compression & 7, 1)
        for first, last, step in ((16, 20, 4), (20, end, size), (end, end + 4, 4)):
            out[first:last] = out[first:last].reshape(-1, step)[:, ::-1].reshape(-1)
    return out.tobytes()


class PacketFinder:
    """Finds packets in the bytes of a TCP connection, cut anywhere."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._skipped = 0

    def receive(self, data: bytes) -> Iterator[Packet | int]:
        """Yield packets, and before a packet after garbage the number of skipped bytes."""
        self._buffer += data
        buffer = bytes(self._buffer)
        tails = np.frombuffer(buffer, np.uint8)[gcf.BLOCK_SIZE :]
        starts = np.flatnonzero(np.isin(tails, tuple(SIZES)))
        here = 0
        undecided = max(0, len(buffer) - gcf.BLOCK_SIZE)  # tails of later packets have not arrived
        for start in starts.tolist():
            if start < here:
                continue
            end = start + SIZES[buffer[start + gcf.BLOCK_SIZE]]
            if end > len(buffer):
                if _plausible(buffer, start):
                    undecided = start
                    break
                continue
            if not _plausible(buffer, start):
                continue
            try:
                packet = decode_packet(buffer[start:end])
            except RemoteProtocolError:
                continue
            self._skipped += start - here
            if self._skipped:
                yield self._skipped
                self._skipped = 0
            yield packet
            here = end
        drop = max(here, undecided)
        self._skipped += drop - here
        del self._buffer[:drop]


def _plausible(buffer: bytes, start: int) -> bool:
    """Return whether a packet may begin at ``start``, from a quick test; decoding decides."""
    compression = buffer[start + 14] & 7
    return compression in (1, 2, 4) and compression * buffer[start + 15] <= 1000
