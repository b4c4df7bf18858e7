"""Modbus RTU frames, both ends of the line.

Theory of operation
-------------------
A frame is ``unit u8, function u8, …, CRC u16`` (little-endian), told from the next by a silence of
3.5 characters, which no USB adapter passes on. So the length comes from the content: a client knows
which reply it waits for, a server the lengths of requests, and the CRC says whether it was right.
Whatever does not fit is skipped byte by byte.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

READ_HOLDING = 3
READ_INPUT = 4
WRITE_SINGLE = 6
WRITE_MULTIPLE = 16
MAX_FRAME = 256
_EXCEPTION_SIZE = 5

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal address",
    3: "illegal value",
    4: "device failure",
    6: "device busy",
}


@cache
def _tables() -> NDArray[np.uint16]:
    """CRC of every byte followed by 0 to 255 zeros, shape (256, 256): the CRC is linear."""
    table = np.arange(256)
    for _ in range(8):
        table = (table >> 1) ^ (table & 1) * 0xA001
    rows = [table]
    for _ in range(255):
        rows.append((rows[-1] >> 8) ^ table[rows[-1] & 0xFF])
    return np.stack(rows).astype(np.uint16)


def crc(frame: bytes) -> int:
    """Return the CRC-16 of 2 to 256 bytes."""
    octets = np.frombuffer(frame, np.uint8).copy()
    octets[:2] ^= 0xFF  # the same as starting from 0xFFFF
    places = np.arange(len(octets) - 1, -1, -1)
    return int(np.bitwise_xor.reduce(_tables()[places, octets]))


def encode(unit: int, pdu: bytes) -> bytes:
    """Frame a request or reply."""
    frame = bytes((unit,)) + pdu
    return frame + struct.pack("<H", crc(frame))


def is_whole(frame: bytes) -> bool:
    """Whether the last two bytes are the CRC of the others."""
    return len(frame) >= 4 and crc(frame[:-2]) == int.from_bytes(frame[-2:], "little")


def read_request(unit: int, address: int, n_registers: int, *, function: int = READ_INPUT) -> bytes:
    """Ask for registers."""
    return encode(unit, struct.pack(">BHH", function, address, n_registers))


def write_request(unit: int, address: int, value: int) -> bytes:
    """Write one register; the reply is the same."""
    return encode(unit, struct.pack(">BHH", WRITE_SINGLE, address, value))


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply: the bytes after the function code, or the exception it carries."""

    payload: bytes
    exception: int | None = None

    @property
    def registers(self) -> NDArray[np.uint16]:
        """Values of a reply to a read request, uint16, shape (n_registers,)."""
        return np.frombuffer(self.payload[1:], ">u2").astype(np.uint16)


class ReplyFinder:
    """The client's end: finds the reply to the one request that is waited for.

    Parameters
    ----------
    echo : bool
        Whether the adapter is known to send back what is written. Otherwise it is recognised by the
        first request to read that comes back.
    """

    def __init__(self, *, echo: bool = False) -> None:
        self.echo = echo
        self._request = b""
        self._buffer = bytearray()
        self._unit = 0
        self._function = 0
        self._size = 0
        self._heard = bytearray()

    def expect(self, request: bytes) -> None:
        """Wait for the reply to ``request``; whatever came before is forgotten."""
        self._buffer.clear()
        self._heard.clear()
        self._request = request
        self._unit, self._function = request[0], request[1]
        reads = self._function in (READ_HOLDING, READ_INPUT)
        self._size = 5 + 2 * int.from_bytes(request[4:6], "big") if reads else 8

    @property
    def is_damaged(self) -> bool:
        """Whether as many bytes as the reply has came, and are not the reply."""
        return self.waiting and len(self._heard) == self._size

    @property
    def other_unit(self) -> int | None:
        """Unit of an undamaged message that came and is no reply to the request; None if none."""
        frame = _find_message(bytes(self._heard))
        return None if frame is None else frame[0]

    @property
    def waiting(self) -> bool:
        """Whether a reply is waited for."""
        return self._size > 0

    @property
    def instead(self) -> str:
        """What came since the request and was not its reply, in words; empty if nothing did."""
        return describe(bytes(self._heard), self._unit)

    def forget(self) -> None:
        """Wait no longer."""
        self._size = 0
        self._buffer.clear()

    def receive(self, received: bytes) -> Reply | None:
        """Take bytes; return the reply once it is whole."""
        if not self.waiting:
            return None
        self._buffer += received
        self._heard += received[: MAX_FRAME - len(self._heard)]
        if not self._drop_echo():
            return None
        buffer = bytes(self._buffer)
        head = bytes((self._unit,))
        here = 0
        while (at := buffer.find(head, here)) >= 0:
            here = at
            if len(buffer) < here + 2:
                break
            function = buffer[here + 1]
            size = {self._function: self._size, self._function | 0x80: _EXCEPTION_SIZE}.get(
                function
            )
            if size is not None:
                frame = buffer[here : here + size]
                if len(frame) < size:
                    break
                if is_whole(frame) and self._fits(frame):
                    self.forget()
                    if function & 0x80:
                        return Reply(b"", frame[2])
                    return Reply(frame[2:-2])
            here += 1
        else:
            here = len(buffer)
        del self._buffer[:here]
        return None

    def _drop_echo(self) -> bool:
        """Take an echo of the request off the bytes received; return False while it may go on."""
        request = self._request
        if not request or not (self.echo or self._function in (READ_HOLDING, READ_INPUT)):
            return True
        if request.startswith(self._heard) and len(self._heard) < len(request):
            return not self.echo
        if self._heard.startswith(request):
            self.echo = True
            del self._heard[: len(request)]
            self._buffer = bytearray(self._heard)
        self._request = b""
        return True

    def _fits(self, frame: bytes) -> bool:
        """Whether the byte count of a reply with registers is the one that was asked for."""
        if frame[1] not in (READ_HOLDING, READ_INPUT):
            return True
        return frame[2] == len(frame) - 5


def describe(heard: bytes, unit: int) -> str:
    """Say what bytes are that came instead of a reply of ``unit``; empty if there are none."""
    frame = _find_message(heard)
    if frame is None:
        return f"{len(heard)} bytes came that are no reply" if heard else ""
    if frame[0] != unit:
        return f"a reply of unit {frame[0]} came, of unit {unit} was asked"
    if len(frame) > 8 or frame[1] in (READ_HOLDING, READ_INPUT):
        return f"a reply with {frame[2] // 2} registers came, as many were not asked for"
    return f"a reply to function {frame[1] & 0x7F} came, which was not asked for"


def _find_message(heard: bytes) -> bytes | None:
    """Return the first reply of any unit to any request."""
    for start in range(len(heard) - 4):
        function = heard[start + 1]
        size = 8
        if function & 0x80:
            size = _EXCEPTION_SIZE
        elif function in (READ_HOLDING, READ_INPUT):
            size = 5 + heard[start + 2]
        frame = heard[start : start + size]
        if len(frame) == size <= MAX_FRAME and is_whole(frame):
            return frame
    return None


@dataclass(frozen=True, slots=True)
class Request:
    """A request, as a server receives it."""

    function: int
    address: int
    value: int
    """Number of registers, or the value to write to one."""
    values: bytes = b""
    """What is to be written to several."""


class RequestFinder:
    """The server's end: finds the requests to one unit."""

    def __init__(self, unit: int) -> None:
        self._unit = unit
        self._buffer = bytearray()

    def receive(self, received: bytes) -> list[Request]:
        """Take bytes; return whole requests."""
        self._buffer += received
        found: list[Request] = []
        while len(self._buffer) >= 8:
            size = 9 + self._buffer[6] if self._buffer[1] == WRITE_MULTIPLE else 8
            frame = bytes(self._buffer[:size])
            if size > MAX_FRAME or (len(frame) == size and not is_whole(frame)):
                del self._buffer[0]
                continue
            if len(frame) < size:
                break
            del self._buffer[:size]
            if frame[0] == self._unit:
                function, address, value = struct.unpack_from(">BHH", frame, 1)
                found.append(Request(function, address, value, frame[7:-2]))
        return found


def encode_registers(unit: int, function: int, values: NDArray[np.uint16]) -> bytes:
    """Answer a read request."""
    data = values.astype(">u2").tobytes()
    return encode(unit, bytes((function, len(data))) + data)


def encode_exception(unit: int, function: int, exception: int) -> bytes:
    """Refuse a request."""
    return encode(unit, bytes((function | 0x80, exception)))
