"""Modbus RTU frames, both ends of the line.

Theory of operation
-------------------
A frame is ``unit u8, function u8, …, CRC u16`` (little-endian). The standard separates frames by a
silence of 3.5 characters, but USB adapters do not preserve it. The length therefore follows from
the content: a client knows the expected reply, a server the lengths of requests, and the CRC
confirms the frame. Other bytes are skipped one by one.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

READ_HOLDING = 3
READ_INPUT = 4
WRITE_SINGLE = 6
WRITE_MULTIPLE = 16
MAX_FRAME = 256
_EXCEPTION_SIZE = 5

EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledged, not done yet",
    6: "device busy",
    10: "no path through the gateway",
    11: "no reply behind the gateway",
}


@cache
def _tables() -> NDArray[np.uint16]:
    """Return the CRC of every byte followed by 0 to 255 zeros, shape (256, 256).

    The CRC is linear, so the CRC of a frame is the XOR of one entry per byte.
    """
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
    octets[:2] ^= 0xFF  # equivalent to the initial value 0xFFFF
    places = np.arange(len(octets) - 1, -1, -1)
    return int(np.bitwise_xor.reduce(_tables()[places, octets]))


def encode(unit: int, pdu: bytes) -> bytes:
    """Encode the frame of a request or reply."""
    frame = bytes((unit,)) + pdu
    return frame + struct.pack("<H", crc(frame))


def is_whole(frame: bytes) -> bool:
    """Return whether the last two bytes are the CRC of the others."""
    return len(frame) >= 4 and crc(frame[:-2]) == int.from_bytes(frame[-2:], "little")


def read_request(unit: int, address: int, n_registers: int) -> bytes:
    """Encode a request to read input registers."""
    return encode(unit, struct.pack(">BHH", READ_INPUT, address, n_registers))


def write_request(unit: int, address: int, value: int) -> bytes:
    """Encode a request to write one register; the reply has the same bytes."""
    return encode(unit, struct.pack(">BHH", WRITE_SINGLE, address, value))


@dataclass(frozen=True, slots=True)
class RtuReply:
    """A reply: the bytes after the function code, or an exception."""

    payload: bytes
    exception: int | None = None

    @property
    def registers(self) -> NDArray[np.uint16]:
        """Register values in the reply to a read request, uint16, shape (n_registers,)."""
        return np.frombuffer(self.payload[1:], ">u2").astype(np.uint16)


class ReplyFinder:
    """Decoder of the client: finds the reply to the pending request.

    Parameters
    ----------
    echo : bool
        Whether the adapter is known to echo sent bytes. Otherwise an echo is detected when the
        first read request is received back.
    """

    def __init__(self, *, echo: bool = False) -> None:
        self.echo = echo
        self._request = b""
        self._buffer = bytearray()
        self._unit = 0
        self._function = 0
        self._size = 0
        self._heard = bytearray()
        self._late_sizes: dict[int, set[int]] = {}
        self._is_within_late = False
        self.n_late = 0
        """Number of late replies since the request."""

    def expect(self, request: bytes, *, late: Mapping[int, Collection[int]] | None = None) -> None:
        """Expect the reply to ``request``; discard the bytes received before.

        ``late`` has the numbers of registers that earlier requests asked of each unit. Such
        replies are skipped; the request of the same unit must ask for another number.
        """
        self._buffer.clear()
        self._heard.clear()
        self._request = request
        self._unit, self._function = request[0], request[1]
        self._late_sizes = {
            unit: {5 + 2 * count for count in counts} for unit, counts in (late or {}).items()
        }
        self._is_within_late, self.n_late = False, 0
        reads = self._function in (READ_HOLDING, READ_INPUT)
        self._size = 5 + 2 * int.from_bytes(request[4:6], "big") if reads else 8

    @property
    def is_damaged(self) -> bool:
        """Whether as many bytes as the expected reply has were received, but not the reply."""
        return self.waiting and not self._is_within_late and len(self._heard) == self._size

    @property
    def other_unit(self) -> int | None:
        """Unit of a valid message that is no reply to the request; None without such a message."""
        frame = _find_message(bytes(self._heard))
        return None if frame is None else frame[0]

    @property
    def waiting(self) -> bool:
        """Whether a reply is pending."""
        return self._size > 0

    @property
    def unexpected(self) -> str:
        """Description of bytes since the request that are not its reply; empty without bytes."""
        return describe(bytes(self._heard), self._unit)

    def cancel(self) -> None:
        """Stop waiting for the reply."""
        self._size = 0
        self._buffer.clear()

    def receive(self, received: bytes) -> RtuReply | None:
        """Decode bytes, cut anywhere; return the reply once it is complete."""
        if not self.waiting:
            return None
        self._buffer += received
        self._heard += received[: MAX_FRAME - len(self._heard)]
        if not self._drop_echo():
            return None
        self._skip_late()
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
                    self.cancel()
                    if function & 0x80:
                        return RtuReply(b"", frame[2])
                    return RtuReply(frame[2:-2])
            here += 1
        else:
            here = len(buffer)
        if not self._is_within_late:
            del self._buffer[:here]
        return None

    def _skip_late(self) -> None:
        """Remove replies to earlier requests, which come first: a device replies in order."""
        buffer = self._buffer
        self._is_within_late = False
        while len(buffer) > 2 and buffer[1] in (READ_HOLDING, READ_INPUT):
            size = 5 + buffer[2]
            if size not in self._late_sizes.get(buffer[0], ()):
                return
            self._is_within_late = len(buffer) < size
            if self._is_within_late or not is_whole(bytes(buffer[:size])):
                return
            del buffer[:size], self._heard[:size]
            self.n_late += 1

    def _drop_echo(self) -> bool:
        """Remove an echo of the request; return False while the echo may be incomplete."""
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
        """Return whether the byte count of a reply with registers fits the frame."""
        if frame[1] not in (READ_HOLDING, READ_INPUT):
            return True
        return frame[2] == len(frame) - 5


def describe(heard: bytes, unit: int) -> str:
    """Describe bytes received instead of a reply of ``unit``; return "" without bytes."""
    frame = _find_message(heard)
    if frame is None:
        return f"received {len(heard)} bytes that are no reply" if heard else ""
    if frame[0] != unit:
        return f"received a reply of unit {frame[0]}, expected unit {unit}"
    if len(frame) > 8 or frame[1] in (READ_HOLDING, READ_INPUT):
        return f"received a reply with {frame[2] // 2} registers, a number not requested"
    return f"received a reply to function {frame[1] & 0x7F}, which was not requested"


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
class RtuRequest:
    """A request received by a server."""

    function: int
    address: int
    value: int
    """Number of registers, or the value to write to one register."""
    values: bytes = b""
    """Values to write to several registers."""


class RequestFinder:
    """Decoder of the server: finds the requests to one unit."""

    def __init__(self, unit: int) -> None:
        self._unit = unit
        self._buffer = bytearray()

    def receive(self, received: bytes) -> list[RtuRequest]:
        """Decode bytes, cut anywhere; return the completed requests."""
        self._buffer += received
        found: list[RtuRequest] = []
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
                found.append(RtuRequest(function, address, value, frame[7:-2]))
        return found


def encode_registers(unit: int, function: int, values: NDArray[np.uint16]) -> bytes:
    """Encode the reply to a read request."""
    data = values.astype(">u2").tobytes()
    return encode(unit, bytes((function, len(data))) + data)


def encode_exception(unit: int, function: int, exception: int) -> bytes:
    """Encode the refusal of a request."""
    return encode(unit, bytes((function | 0x80, exception)))
