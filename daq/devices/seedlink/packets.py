"""SeedLink commands and packets, both ends of the connection.

Theory of operation
-------------------
A client sends commands, lines that end in CR LF, over TCP (port 18000, usually). The server replies
to ``HELLO`` with two lines, the first with its protocol versions. Then the client sends
``STATION``, ``SELECT`` and ``DATA`` for each station; the server replies ``OK`` or ``ERROR`` to
each. Version 4 has ``AUTH`` before them, for servers that ask who the client is, and is also spoken
over TLS (port 18500). After ``END`` the server sends packets until the connection is closed.
Version 3 (SeisComP, "SeedLink" 2 to 3.3)::

    SL  sequence, 6 hexadecimal digits  miniSEED 2 record of 512 bytes
    SLINFO  * or blank                  miniSEED 2 record of 512 bytes, in reply to INFO

Some servers send records of other lengths, 256 bytes for example, as blockette 1000 says. Whether
shorter ones are padded to 512 bytes shows where the next packet begins.

Version 4 (FDSN, 2023), little-endian::

    SE  format u8  subformat u8  payload length u32  sequence u64  id length u8  station id  payload

Sequence numbers count the packets of a station, in version 3 with 24 bits. ``DATA n`` begins with
packet n, or with the oldest that the server still has. A client that requests the packet after its
last one therefore loses no packet that the server still keeps. ``DATA n time`` also states the time
of packet n - 1: a server that restarted and counts from 1 again (as ringserver does after a crash)
continues from that time.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal, TypeAlias

from daq.protocols.errors import RemoteProtocolError

Version: TypeAlias = Literal[3, 4]
WRAP = 1 << 24
"""Modulus of sequence numbers in version 3."""
RECORD_SIZE = 512
_FIXED_HEADER, _RECORD_HEADER = 48, 56
"""Bytes of a record before its first blockette, and up to the end of blockette 1000."""
_BLOCKETTE_1000, _EXPONENTS = 1000, range(7, 13)
"""Its type, and binary logarithms of record lengths in use."""
MAX_PAYLOAD = 1 << 20
"""Maximum length of a payload in bytes; longer ones are not packets."""
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
        None for a reply to INFO.
    payload : bytes
        A miniSEED record.
    station : str
        ``NET_STA`` in version 4; empty in version 3, where only the record has it.
    is_miniseed : bool
        Whether the payload is a miniSEED record.
    """

    sequence: int | None
    payload: bytes
    station: str = ""
    is_miniseed: bool = True


def speaks_version_4(hello: str) -> bool:
    """Return whether the first line of the reply to HELLO offers version 4."""
    return any(major == "4" for major, _ in _VERSIONS.findall(hello))


def station_command(version: Version, network: str, station: str) -> str:
    """Return the command that selects a station."""
    return f"STATION {network}_{station}" if version == 4 else f"STATION {station} {network}"


def auth_command(credentials: Sequence[str]) -> str:
    """Return the command that states user and password, or a token (version 4)."""
    return f"AUTH {'JWT' if len(credentials) == 1 else 'USERPASS'} {' '.join(credentials)}"


def select_command(version: Version, location: str, channel: str) -> str:
    """Return the command that selects channels.

    ``?`` matches any character; the location ``*`` matches any location.
    """
    if version == 4:
        codes = "_".join(channel) if len(channel) == 3 else channel
        return f"SELECT {'' if location == '--' else location}_{codes}"
    return f"SELECT {'' if location == '*' else location}{channel}"


def data_command(version: Version, last: tuple[int, int] | None) -> str:
    """Return the command that requests the packets after ``last``, or only new packets.

    Parameters
    ----------
    last : (int, int) or None
        Sequence number of the last received packet, and UTC of its first sample in ns. A server
        that restarted its numbers uses the time.
    """
    if last is None:
        return "DATA"
    sequence, start_ns = last
    start = datetime.fromtimestamp(start_ns // 10**9, UTC)
    if version == 4:
        return f"DATA {sequence + 1} {start:%Y-%m-%dT%H:%M:%SZ}"
    return f"DATA {(sequence + 1) % WRAP:06X} {start:%Y,%m,%d,%H,%M,%S}"


def encode_packet(packet: Packet, version: Version) -> bytes:
    """Encode a packet."""
    if version == 4:
        name = packet.station.encode()
        kind = ord("3") if packet.payload[:2] == b"MS" else ord("2")
        size = len(packet.payload)
        head = _HEADER_4.pack(b"SE", kind, ord("D"), size, packet.sequence or 0, len(name))
        return head + name + packet.payload
    head = b"SLINFO  " if packet.sequence is None else b"SL%06X" % (packet.sequence % WRAP)
    return head + packet.payload.ljust(RECORD_SIZE, b"\0")


def _record_size(head: bytes) -> int:
    """Return the length of a miniSEED 2 record by its blockette 1000; the usual one without."""
    for order in (">", "<"):
        kind, _, _, _, exponent = struct.unpack_from(f"{order}HHBBB", head, _FIXED_HEADER)
        if kind == _BLOCKETTE_1000 and exponent in _EXPONENTS:
            return 1 << int(exponent)
    return RECORD_SIZE


class PacketFinder:
    """Decodes the bytes of a connection into packets."""

    def __init__(self, version: Version) -> None:
        self._version = version
        self._buffer = bytearray()
        self._pads: bool | None = None  # whether short records are padded, once that is known

    def receive(self, data: bytes) -> list[Packet]:
        """Decode bytes, cut anywhere; return the completed packets.

        Raises
        ------
        RemoteProtocolError
            If the bytes are no packet. TCP loses no bytes, so the connection is then unusable. The
            packets before these bytes are returned first: then the next call raises.
        """
        self._buffer += data
        found: list[Packet] = []
        while True:
            try:
                packet = self._next_4() if self._version == 4 else self._next_3()
            except RemoteProtocolError:
                if found:
                    return found
                raise
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
        size = RECORD_SIZE
        if match is not None and self._pads is not True:
            if len(buffer) < _HEADER_3 + _RECORD_HEADER:
                return None
            size = _record_size(bytes(buffer[_HEADER_3 : _HEADER_3 + _RECORD_HEADER]))
        end = _HEADER_3 + size
        if size < RECORD_SIZE and self._pads is None:
            following = bytes(buffer[end : end + 2])
            if len(following) < 2:
                return None
            self._pads = following != b"SL"
            end = _HEADER_3 + (RECORD_SIZE if self._pads else size)
        if len(buffer) < end:
            return None
        payload = bytes(buffer[_HEADER_3:end])
        del buffer[:end]
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
        if head.startswith(b"ERROR"):  # in reply to END, as by a server that wants AUTH
            line = bytes(self._buffer[:200]).partition(LINE_END)[0].decode("ascii", "replace")
            raise RemoteProtocolError(f"the server sends no packets: {line!r}")
        text = head.decode("ascii", "replace")
        expected = "SE" if self._version == 4 else "SL and a sequence number"
        raise RemoteProtocolError(f"no SeedLink packet: {text!r}; expected {expected}")
