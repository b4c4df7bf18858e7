"""Güralp's block recovery protocol (BRP): GCF blocks on a serial line, acknowledged or refused.

Theory of operation
-------------------
The digitizer sends frames (SWA-RFC-BRPR; DM24 operator's guide, section 8.3)::

    'G'  sequence u8  size u16  block[size]  checksum u16

big-endian. The checksum is the sum of all bytes before it, 'G' included (the guide names "block
header and body"; Güralp's own code and the specification also count 'G', sequence and size). Other
bytes are terminal text. After each frame the digitizer waits about 150 ms for six bytes::

    01  id[LSB]  control  id[2] id[1] id[MSB]     acknowledged; control 0: any sequence number
    02  id[LSB]  sequence id[2] id[1] id[MSB]     refused: go back to this sequence number

with the stream ID of the last received block, then sends the next frame. It keeps its last 255
frames: after a refusal it repeats all frames from the refused number on, so frames arrive twice.

:class:`Receiver` finds frames among any bytes. It answers a frame with a wrong checksum, or a jump
of the sequence number, by refusing the first missing number, at most ``ATTEMPTS`` times. While a
missing frame may still arrive, ``awaiting`` is true and later blocks should be held back. A
digitizer that restarts also restarts its sequence numbers: this is detected by an earlier number
with a block later than all others (by the date in its header).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

MAX_SIZE = 1024
MIN_SIZE = 16
HISTORY = 255
ATTEMPTS = 3
_REPLY_SIZE = 6
_ACKNOWLEDGE = 1
_REFUSE = 2
_MAX_TEXT = 200


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame with a correct checksum."""

    sequence: int
    block: bytes

    @property
    def raw_stream_id(self) -> bytes:
        """The four bytes of the stream ID, in the order of the block."""
        return self.block[4:8]

    @property
    def date(self) -> int:
        """Start of the block in whole seconds, as a number that only orders blocks."""
        return int.from_bytes(self.block[8:12], "big")


@dataclass(frozen=True, slots=True)
class Damaged:
    """A frame with a wrong checksum, directly after another frame."""

    sequence: int


@dataclass(frozen=True, slots=True)
class Skipped:
    """Bytes between frames: terminal text, or noise."""

    n_bytes: int
    start: bytes
    """The first 200 of these bytes."""


@dataclass(frozen=True, slots=True)
class Lost:
    """Missing frames that are no longer awaited."""

    sequence: int
    n_frames: int


@dataclass(frozen=True, slots=True)
class NumberingRestarted:
    """The digitizer restarted its sequence numbers: ``sequence`` arrived, ``due`` was expected."""

    sequence: int
    due: int


@dataclass(frozen=True, slots=True)
class BrpReply:
    """An acknowledgement (``sequence`` None) or a refusal, as the digitizer receives it."""

    raw_stream_id: bytes
    sequence: int | None


def encode_frame(sequence: int, block: bytes) -> bytes:
    """Encode a frame with a block of 16 to 1024 bytes."""
    if not MIN_SIZE <= len(block) <= MAX_SIZE:
        raise ValueError(f"a block of {len(block)} bytes; expected {MIN_SIZE} to {MAX_SIZE}")
    body = struct.pack(">cBH", b"G", sequence % 256, len(block)) + block
    return body + struct.pack(">H", sum(body) % 65536)


def encode_reply(reply: BrpReply) -> bytes:
    """Encode an acknowledgement or a refusal."""
    low, rest = reply.raw_stream_id[3], reply.raw_stream_id[2::-1]
    if reply.sequence is None:
        return bytes((_ACKNOWLEDGE, low, 0)) + rest
    return bytes((_REFUSE, low, reply.sequence % 256)) + rest


def decode_replies(buffer: bytearray) -> list[BrpReply]:
    """Decode and remove complete replies from ``buffer``; discard bytes that begin none."""
    replies: list[BrpReply] = []
    while True:
        while buffer and buffer[0] not in (_ACKNOWLEDGE, _REFUSE):
            del buffer[0]
        if len(buffer) < _REPLY_SIZE:
            return replies
        kind, low, number, *rest = bytes(buffer[:_REPLY_SIZE])
        del buffer[:_REPLY_SIZE]
        raw = bytes((*reversed(rest), low))
        replies.append(BrpReply(raw, number if kind == _REFUSE else None))


class _Scanner:
    """Finds frames in bytes that are cut anywhere."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._in_step = False  # a frame is expected at the front of the buffer
        self._skipped = 0
        self._skipped_start = b""

    def receive(self, data: bytes) -> Iterator[Frame | Damaged | Skipped]:
        self._buffer += data
        buffer = bytes(self._buffer)
        sums = np.concatenate(([0], np.cumsum(np.frombuffer(buffer, np.uint8), dtype=np.int64)))
        here = 0
        while True:
            at = buffer.find(b"G", here)
            if at != here:
                self._skip(buffer[here : at if at >= 0 else None])
                here = at if at >= 0 else len(buffer)
            if at < 0 or len(buffer) - at < 4:
                break
            sequence, size = struct.unpack_from(">BH", buffer, at + 1)
            if not MIN_SIZE <= size <= MAX_SIZE:
                self._skip(b"G")
                here += 1
                continue
            end = at + 4 + size
            if len(buffer) < end + 2:
                break
            if (sums[end] - sums[at]) % 65536 == int.from_bytes(buffer[end : end + 2], "big"):
                if self._skipped:
                    yield Skipped(self._skipped, self._skipped_start)
                    self._skipped, self._skipped_start = 0, b""
                yield Frame(sequence, buffer[at + 4 : end])
                here = end + 2
                self._in_step = True
            else:
                if self._in_step:
                    yield Damaged(sequence)
                self._skip(b"G")
                here += 1
        del self._buffer[:here]

    def _skip(self, data: bytes) -> None:
        if data:
            self._in_step = False
            self._skipped += len(data)
            self._skipped_start += data[: _MAX_TEXT - len(self._skipped_start)]


class Receiver:
    """Decoder of the host: bytes in, frames and replies to the digitizer out.

    Parameters
    ----------
    replies : bool
        Whether the line transmits replies to the digitizer. If not, no missing frame is awaited.
    """

    def __init__(self, *, replies: bool = True) -> None:
        self._replies = replies
        self._scanner = _Scanner()
        self._next: int | None = None  # expected sequence number
        self._missing: deque[int] = deque()  # sequence numbers, in the order sent
        self._attempts = 0
        self._raw_stream_id: bytes | None = None
        self._latest = 0  # latest date of a block
        self._to_send = bytearray()

    @property
    def awaiting(self) -> bool:
        """Whether missing frames may still arrive."""
        return bool(self._missing)

    def receive(
        self, data: bytes
    ) -> Iterator[Frame | Damaged | Skipped | Lost | NumberingRestarted]:
        """Decode ``data``; yield the completed items. Frames sent twice are yielded twice."""
        for found in self._scanner.receive(data):
            if isinstance(found, Frame):
                yield from self._numbering_restarted(found)
            yield found
            if isinstance(found, Frame):
                self._raw_stream_id = found.raw_stream_id
                yield from self._sequence(found.sequence)
            elif isinstance(found, Damaged) and self._next is not None:
                yield from self._refuse(self._missing[0] if self._missing else self._next)

    def take_replies(self) -> bytes:
        """Return and remove the bytes to send to the digitizer."""
        to_send = bytes(self._to_send)
        self._to_send.clear()
        return to_send if self._replies else b""

    def _numbering_restarted(self, frame: Frame) -> Iterator[NumberingRestarted]:
        due = frame.sequence if self._next is None else self._next
        repeated = (frame.sequence - due) % 256 >= 128 and frame.sequence not in self._missing
        if repeated and frame.date > self._latest:
            yield NumberingRestarted(frame.sequence, due)
            self._missing.clear()
            self._next = None
        self._latest = max(self._latest, frame.date)

    def _sequence(self, sequence: int) -> Iterator[Lost]:
        due = sequence if self._next is None else self._next
        ahead = (sequence - due) % 256
        repeated = ahead >= 128
        if not repeated:
            self._missing.extend((due + i) % 256 for i in range(ahead))
            self._next = (sequence + 1) % 256
        elif sequence in self._missing:
            self._missing.remove(sequence)
        if not self._missing:
            self._attempts = 0
        if not self._missing or repeated:  # a digitizer that went back repeats all missing frames
            self._reply(None)
        else:
            yield from self._refuse(self._missing[0])

    def _refuse(self, sequence: int) -> Iterator[Lost]:
        if self._replies and self._attempts < ATTEMPTS and len(self._missing) < HISTORY:
            self._attempts += 1
            self._reply(sequence)
            return
        if self._missing:
            yield Lost(self._missing[0], len(self._missing))
            self._missing.clear()
            self._attempts = 0
        self._reply(None)

    def _reply(self, sequence: int | None) -> None:
        if self._raw_stream_id is not None and len(self._to_send) < HISTORY * _REPLY_SIZE:
            self._to_send += encode_reply(BrpReply(self._raw_stream_id, sequence))


@dataclass(slots=True)
class Transmitter:
    """Encoder of the digitizer: numbers frames, keeps the last ones, repeats refused ones."""

    _queue: deque[tuple[int, bytes]] = field(default_factory=deque)  # not yet sent
    _sent: deque[tuple[int, bytes]] = field(default_factory=lambda: deque(maxlen=HISTORY))
    _next: int = 0
    _received: bytearray = field(default_factory=bytearray)

    def queue(self, block: bytes) -> None:
        """Append a block to the queue, with the next sequence number."""
        self._queue.append((self._next, encode_frame(self._next, block)))
        self._next = (self._next + 1) % 256

    def take_frame(self) -> bytes | None:
        """Return and remove the next frame to send, or None."""
        if not self._queue:
            return None
        self._sent.append(self._queue.popleft())
        return self._sent[-1][1]

    @property
    def waiting(self) -> bool:
        """Whether a frame is queued."""
        return bool(self._queue)

    def clear(self) -> None:
        """Discard queued and sent frames; sequence numbers continue."""
        self._queue.clear()
        self._sent.clear()
        self._received.clear()

    def receive(self, data: bytes) -> bool:
        """Decode replies; return whether one arrived."""
        self._received += data
        replies = decode_replies(self._received)
        for reply in replies:
            if reply.sequence is not None:
                self._wind_back(reply.sequence)
        return bool(replies)

    def _wind_back(self, sequence: int) -> None:
        if any(number == sequence for number, _ in self._sent):
            while self._sent:
                self._queue.appendleft(self._sent.pop())
                if self._queue[0][0] == sequence:
                    return
