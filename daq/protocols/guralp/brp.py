"""Güralp's block recovery protocol (BRP): GCF blocks on a serial line, acknowledged or refused.

Theory of operation
-------------------
The digitizer sends frames (SWA-RFC-BRPR; DM24 operator's guide, section 8.3)::

    'G'  sequence u8  size u16  block[size]  checksum u16

big-endian, the checksum being the sum of all bytes before it, 'G' included (the guide says "block
header and body"; Güralp's own code and the specification count 'G', sequence and size too). Other
bytes are terminal text. After each frame it waits about 150 ms for six bytes::

    01  id[LSB]  control  id[2] id[1] id[MSB]     acknowledged; control 0: whatever the sequence
    02  id[LSB]  sequence id[2] id[1] id[MSB]     refused: go back to that sequence number

with the stream ID of the last block that was received, then sends the next frame. It keeps its last
255 frames: a refusal winds it back, and it goes on from there, so frames come twice.

:class:`Receiver` finds frames in any bytes. A frame with a bad checksum, or a jump of the sequence
number, is answered by a refusal of the first number that is missing, at most ``ATTEMPTS`` times.
While one is awaited, ``awaiting`` is true and later blocks are best held back. A number that was
due before, with a block later than all others (by the date in its header), is of a digitizer that
was restarted and numbers anew.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_SIZE = 1024
MIN_SIZE = 16
HISTORY = 255
ATTEMPTS = 3
_OVERHEAD = 6
_REPLY_SIZE = 6
_ACKNOWLEDGE = 1
_REFUSE = 2
_MAX_TEXT = 200


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame whose checksum is right."""

    sequence: int
    block: bytes

    @property
    def raw_stream_id(self) -> bytes:
        """The four bytes of the stream ID, as they stand in the block."""
        return self.block[4:8]

    @property
    def date(self) -> int:
        """When the block starts, as a number that grows, whole seconds."""
        return int.from_bytes(self.block[8:12], "big")


@dataclass(frozen=True, slots=True)
class Damaged:
    """A frame that stood where one was due, and whose checksum is wrong."""

    sequence: int


@dataclass(frozen=True, slots=True)
class Skipped:
    """Bytes between frames: terminal text, or noise."""

    n_bytes: int
    start: bytes
    """The first 200 of them."""


@dataclass(frozen=True, slots=True)
class Lost:
    """Frames that were given up."""

    sequence: int
    n_frames: int


@dataclass(frozen=True, slots=True)
class Anew:
    """The digitizer numbers its frames anew: ``sequence`` came where ``due`` was due."""

    sequence: int
    due: int


@dataclass(frozen=True, slots=True)
class Reply:
    """An acknowledgement (``sequence`` None) or a refusal, as the digitizer receives it."""

    raw_stream_id: bytes
    sequence: int | None


def encode_frame(sequence: int, block: bytes) -> bytes:
    """Frame a block of 16 to 1024 bytes."""
    if not MIN_SIZE <= len(block) <= MAX_SIZE:
        raise ValueError(f"a block of {len(block)} bytes; expected {MIN_SIZE} to {MAX_SIZE}")
    body = struct.pack(">cBH", b"G", sequence % 256, len(block)) + block
    return body + struct.pack(">H", sum(body) % 65536)


def encode_reply(reply: Reply) -> bytes:
    """Write an acknowledgement or a refusal."""
    low, rest = reply.raw_stream_id[3], reply.raw_stream_id[2::-1]
    if reply.sequence is None:
        return bytes((_ACKNOWLEDGE, low, 0)) + rest
    return bytes((_REFUSE, low, reply.sequence % 256)) + rest


def decode_replies(buffer: bytearray) -> list[Reply]:
    """Take whole replies from the front of ``buffer``; bytes that begin none are dropped."""
    replies: list[Reply] = []
    while True:
        while buffer and buffer[0] not in (_ACKNOWLEDGE, _REFUSE):
            del buffer[0]
        if len(buffer) < _REPLY_SIZE:
            return replies
        kind, low, number, *rest = bytes(buffer[:_REPLY_SIZE])
        del buffer[:_REPLY_SIZE]
        raw = bytes((*reversed(rest), low))
        replies.append(Reply(raw, number if kind == _REFUSE else None))


class _Scanner:
    """Finds frames in bytes, wherever they are cut."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._in_step = False  # a frame is due at the front of the buffer
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
    """The host's end of the line: frames out, replies to send back.

    Parameters
    ----------
    replies : bool
        Whether the line carries replies to the digitizer. Without them nothing is awaited.
    """

    def __init__(self, *, replies: bool = True) -> None:
        self._replies = replies
        self._scanner = _Scanner()
        self._next: int | None = None  # the sequence number that is due
        self._missing: deque[int] = deque()  # in the order they were sent
        self._attempts = 0
        self._raw_stream_id: bytes | None = None
        self._latest = 0  # date of a block
        self._to_send = bytearray()

    @property
    def awaiting(self) -> bool:
        """Whether frames that were refused may still come."""
        return bool(self._missing)

    def receive(self, data: bytes) -> Iterator[Frame | Damaged | Skipped | Lost | Anew]:
        """Yield what ``data`` completes. Frames sent twice are yielded twice."""
        for found in self._scanner.receive(data):
            if isinstance(found, Frame):
                yield from self._numbered_anew(found)
            yield found
            if isinstance(found, Frame):
                self._raw_stream_id = found.raw_stream_id
                yield from self._sequence(found.sequence)
            elif isinstance(found, Damaged) and self._next is not None:
                yield from self._refuse(self._missing[0] if self._missing else self._next)

    def take_replies(self) -> bytes:
        """Return what is to be sent to the digitizer, once."""
        to_send = bytes(self._to_send)
        self._to_send.clear()
        return to_send if self._replies else b""

    def _numbered_anew(self, frame: Frame) -> Iterator[Anew]:
        due = frame.sequence if self._next is None else self._next
        repeated = (frame.sequence - due) % 256 >= 128 and frame.sequence not in self._missing
        if repeated and frame.date > self._latest:
            yield Anew(frame.sequence, due)
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
        if not self._missing or repeated:  # wound back, it goes on through all that is missing
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
            self._to_send += encode_reply(Reply(self._raw_stream_id, sequence))


@dataclass(slots=True)
class Transmitter:
    """The digitizer's end of the line: numbers frames, keeps the last ones, winds back."""

    _queue: deque[tuple[int, bytes]] = field(default_factory=deque)  # still to be sent
    _sent: deque[tuple[int, bytes]] = field(default_factory=lambda: deque(maxlen=HISTORY))
    _next: int = 0
    _received: bytearray = field(default_factory=bytearray)

    def queue(self, block: bytes) -> None:
        """Give a block its sequence number and its place in the line."""
        self._queue.append((self._next, encode_frame(self._next, block)))
        self._next = (self._next + 1) % 256

    def take_frame(self) -> bytes | None:
        """Return the next frame to send, None where there is none."""
        if not self._queue:
            return None
        self._sent.append(self._queue.popleft())
        return self._sent[-1][1]

    @property
    def waiting(self) -> bool:
        """Whether there is a frame to send."""
        return bool(self._queue)

    def clear(self) -> None:
        """Forget what was to be sent and what was sent; numbering goes on."""
        self._queue.clear()
        self._sent.clear()
        self._received.clear()

    def receive(self, data: bytes) -> bool:
        """Take replies; return whether the last frame was answered."""
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
