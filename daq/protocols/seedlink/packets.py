"""SeedLink commands and packets, both ends of the connection.

Theory of operation
-------------------
A client sends commands, lines that end in CR LF, over TCP (port 18000, usually). ``HELLO`` is
answered by two lines, the first with the versions that the server speaks; then for each station
``STATION``, ``SELECT`` and ``DATA`` are each answered by ``OK`` or ``ERROR``. After ``END`` packets
flow until the connection is closed. Version 3 (SeisComP, "SeedLink" 2 to 3.3)::

    SL  sequence, 6 hexadecimal digits  miniSEED 2 record of 512 bytes
    SLINFO  * or blank                  the same, with what INFO asked for

Version 4 (FDSN, 2023), little-endian::

    SE  format u8  subformat u8  payload length u32  sequence u64  id length u8  station id  payload

Sequence numbers count the packets of a station. ``DATA n`` begins with packet n, or with the oldest
that the server still has: a client that asks for the one after the last that it got loses nothing
for as long as the server keeps its packets. In version 3 they have 24 bits. ``DATA n time``
gives the time of packet n - 1 as well: a server that has restarted and counts from 1 again (as
ringserver does after a crash) goes on from that time.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, TypeAlias

from daq.protocols.errors import RemoteProtocolError

Version: TypeAlias = Literal[3, 4]
WRAP = 1 << 24
"""Of sequence numbers in version 3."""
RECORD_SIZE = 512
MAX_PAYLOAD = 1 << 20
"""Bytes of a payload, beyond which what came is no packet."""
LINE_END = b"\r\n"
_HEADER_3 = 8
_HEADER_4 = struct.Struct("<2sBBIQB")
_SEQUENCE = re.compile(rb"SL([0-9A-Fa-f]{6})")
_VERSIONS = re.compile(r"SLPROTO:(\d+)\.(\d+)")


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet.

    Attributes
    ----------
    sequence : int or None
        None of an answer to INFO.
    payload : bytes
        A miniSEED record.
    station : str
        ``NET_STA`` in version 4; empty in version 3, where the record says it.
    is_miniseed : bool
        Whether the payload is a miniSEED record.
    """

    sequence: int | None
    payload: bytes
    station: str = ""
    is_miniseed: bool = True


def speaks_version_4(hello: str) -> bool:
    """Whether the first line of the answer to HELLO offers version 4."""
    return any(major == "4" for major, _ in _VERSIONS.findall(hello))


def station_command(version: Version, network: str, station: str) -> str:
    """Return the command that chooses a station."""
    return f"STATION {network}_{station}" if version == 4 else f"STATION {station} {network}"


def select_command(version: Version, location: str, channel: str) -> str:
    """Return the command that selects channels; ``?`` stands for any character.

    ``location`` is ``*`` for any.
    """
    if version == 4:
        codes = "_".join(channel) if len(channel) == 3 else channel
        return f"SELECT {'' if location == '--' else location}_{codes}"
    return f"SELECT {'' if location == '*' else location}{channel}"


def data_command(version: Version, last: tuple[int, int] | None) -> str:
    """Return the command that asks for the packets after one, or for those to come.

    Parameters
    ----------
    last : (int, int) or None
        Sequence number of the last packet that came, and UTC of its first sample in ns. A server
        whose numbers began again finds by this time where to go on.
    """
    if last is None:
        return "DATA"
    sequence, start_ns = last
    start = datetime.fromtimestamp(start_ns // 10**9, UTC)
    if version == 4:
        return f"DATA {sequence + 1} {start:%Y-%m-%dT%H:%M:%SZ}"
    return f"DATA {(sequence + 1) % WRAP:06X} {start:%Y,%m,%d,%H,%M,%S}"


def encode_packet(packet: Packet, version: Version) -> bytes:
    """Write a packet."""
    if version == 4:
        name = packet.station.encode()
        kind = ord("3") if packet.payload[:2] == b"MS" else ord("2")
        size = len(packet.payload)
        head = _HEADER_4.pack(b"SE", kind, ord("D"), size, packet.sequence or 0, len(name))
        return head + name + packet.payload
    head = b"SLINFO  " if packet.sequence is None else b"SL%06X" % (packet.sequence % WRAP)
    return head + packet.payload.ljust(RECORD_SIZE, b"\0")


class PacketFinder:
    """Cuts the bytes of a connection into packets."""

    def __init__(self, version: Version) -> None:
        self._version = version
        self._buffer = bytearray()

    def receive(self, data: bytes) -> list[Packet]:
        """Take bytes; return whole packets.

        Raises
        ------
        RemoteProtocolError
            What came is no packet. Over TCP nothing is lost, so nothing after it can be trusted.
        """
        self._buffer += data
        found: list[Packet] = []
        while True:
            packet = self._next_4() if self._version == 4 else self._next_3()
            if packet is None:
                return found
            found.append(packet)

    def _next_3(self) -> Packet | None:
        buffer = self._buffer
        if len(buffer) < _HEADER_3:
            return None
        head = bytes(buffer[:_HEADER_3])
        match = _SEQUENCE.fullmatch(head)
        if match is None and not head.startswith(b"SLINFO"):
            self._refuse(head)
        if len(buffer) < _HEADER_3 + RECORD_SIZE:
            return None
        payload = bytes(buffer[_HEADER_3 : _HEADER_3 + RECORD_SIZE])
        del buffer[: _HEADER_3 + RECORD_SIZE]
        return Packet(int(match[1], 16) if match else None, payload)

    def _next_4(self) -> Packet | None:
        buffer = self._buffer
        if len(buffer) < _HEADER_4.size:
            return None
        mark, kind, _, size, sequence, n_name = _HEADER_4.unpack_from(buffer)
        if mark != b"SE" or size > MAX_PAYLOAD:
            self._refuse(bytes(buffer[: _HEADER_4.size]))
        start = _HEADER_4.size + n_name
        if len(buffer) < start + size:
            return None
        name = bytes(buffer[_HEADER_4.size : start]).decode("ascii", "replace")
        payload = bytes(buffer[start : start + size])
        del buffer[: start + size]
        is_miniseed = kind in (ord("2"), ord("3"))
        return Packet(sequence if is_miniseed else None, payload, name, is_miniseed)

    def _refuse(self, head: bytes) -> None:
        self._buffer.clear()
        text = head.decode("ascii", "replace")
        expected = "SE" if self._version == 4 else "SL and a sequence number"
        raise RemoteProtocolError(f"no SeedLink packet: {text!r}; expected {expected}")
