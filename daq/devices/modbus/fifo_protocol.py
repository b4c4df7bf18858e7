"""Block FIFO behind Modbus RTU registers (ProWaveDAQ, PWRVT): level, then samples, in one read.

Theory of operation
-------------------
Input register 0x02 holds the level: the number of words in the device's FIFO. A read of 1 + N
registers from there returns a header and removes N words: samples of the channels in turn (i16), N
a multiple of the number of channels, at most 123. Public clients disagree on the header: the level
before this read (``"size"``), or after it (``"left"``). Holding register 0x01 is the sampling rate
in Hz.

The device sends neither counter nor time. Samples are numbered in order of arrival; their time is
the arrival of a read that leaves less than one further read in the FIFO. Words in the FIFO when
sampling starts are stale and discarded.

- A level at the FIFO's capacity means that the device dropped samples. Assumed: it drops the
  newest, so the gap follows the words in the FIFO. Its length is estimated from host time.
- A level below the known number of words, with zeros behind the words, means that the device
  restarted (``"size"`` only; with ``"left"`` a restart is not detected). If other values than zeros
  follow, the header must be the level after the read, and no words are discarded.
- A lost reply may have removed N words. The next level decides, because the device samples at a
  known rate.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from daq.devices.modbus import rtu
from daq.devices.modbus.rtu import ReplyFinder
from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime

RATE_REGISTER = 0x01
FIFO_REGISTER = 0x02
MAX_WORDS = 123
READ_OVERHEAD = 15
"""Bytes on the line per read, without the words of the reply."""
BLOCK_SAMPLES = 1024
"""A block is complete when the FIFO is empty, or when the block has this many samples."""

Header = Literal["size", "left"]


@dataclass(eq=False)
class FifoDecoder:
    """Client of a FIFO: requests out, replies in, blocks out.

    Send :meth:`request`, pass the received bytes to :meth:`receive` until ``waiting`` is false, or
    call :meth:`timed_out`; pause while ``level`` is low.

    Attributes
    ----------
    sensor : str
        Name of the sensor.
    sampling_rate : float
        Sampling rate of the device, in Hz.
    n_channels : int
        Number of channels in the FIFO.
    header : "size" or "left"
        Meaning of the first register of a read: level before or after it.
    unit : int
        Address of the device.
    capacity : int or None
        Capacity of the FIFO in words, if known.
    """

    sensor: str
    sampling_rate: float
    n_channels: int = 3
    header: Header = "size"
    unit: int = 1
    capacity: int | None = None

    def __post_init__(self) -> None:
        self._rate = self.sampling_rate
        self._finder = ReplyFinder()
        self._n_requested = 0  # words requested
        self._doubtful = 0  # words that an unanswered read may have removed
        self._n_unanswered = self._n_refused = 0
        self._started = False
        self._next = 0
        self._caught_up = (0, 0)  # when the FIFO was last empty: index of the next sample, time
        self._full: deque[tuple[int, int]] = deque()  # words before each gap, index after it
        self._last: HostTime | None = None
        self._rows: list[NDArray[np.int16]] = []
        self._n_rows = 0
        self._flags = BlockFlag.CLOCK_RESTART
        self._reason = ""
        self.level = 0
        """Number of words known to be in the FIFO."""

    @property
    def started(self) -> bool:
        """Whether the FIFO has been emptied once; later samples are recorded."""
        return self._started

    @property
    def waiting(self) -> bool:
        """Whether a reply is pending."""
        return self._finder.waiting

    @property
    def is_damaged(self) -> bool:
        """Whether the pending reply arrived damaged."""
        return self._finder.is_damaged

    def request(self) -> bytes:
        """Return the next request: for the level and the samples known to be in the FIFO."""
        most = MAX_WORDS // self.n_channels * self.n_channels
        self._n_requested = min(self.level // self.n_channels * self.n_channels, most)
        if self._doubtful:  # the level alone decides whether these words were removed
            self._n_requested = 0
        request = rtu.read_request(self.unit, FIFO_REGISTER, 1 + self._n_requested)
        self._finder.expect(request)
        return request

    def timed_out(self, at: HostTime) -> list[Block | Event]:
        """End the wait for a reply."""
        other = self._finder.unexpected
        self._finder.cancel()
        self._doubtful += self._n_requested
        self._n_unanswered += 1
        text = f"no reply to a read: {other or 'nothing received'} ({self._n_unanswered} so far)"
        kind = EventKind.RESYNCHRONISED if other else EventKind.STATUS
        return [*self.flush(), Event(self.sensor, kind, text, at)]

    def flush(self) -> list[Block | Event]:
        """Return the collected samples; they arrived with the last reply."""
        return [] if self._last is None else self._hand_over(self._last)

    def receive(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Decode bytes of the line, cut anywhere."""
        reply = self._finder.receive(data)
        if reply is None:
            return []
        if reply.exception is not None:
            why = rtu.EXCEPTIONS.get(reply.exception, f"exception {reply.exception}")
            self.level = 0
            self._n_refused += 1
            text = f"the device refused a read: {why} ({self._n_refused} so far)"
            return [Event(self.sensor, EventKind.REFUSED, text, at)]
        registers = reply.registers
        level = int(registers[0]) + (self._n_requested if self.header == "left" else 0)
        found = self._resolve_doubt(level, at)
        if self.capacity is not None and level >= self.capacity and self._started:
            if not self._full:
                text = f"{level} words in the FIFO: it is full and samples were dropped"
                found.append(Event(self.sensor, EventKind.OVERFLOW, text, at))
            index, since = self._caught_up
            index += round((at.monotonic_ns - since) * 1e-9 * self._rate)
            self._full.append((level, index))
        words = registers[1:].view(np.int16)
        if level < self._n_requested and not words[level:].any():  # zeros behind the words
            words = words[: level // self.n_channels * self.n_channels]
            found += self._emptied(level, at)
        self.level = max(0, level - self._n_requested)
        self._last = at
        found += self._take(words, at)
        return found

    def _emptied(self, level: int, at: HostTime) -> list[Block | Event]:
        """Handle a restart of the device: fewer words in the FIFO than known."""
        if not self._started:
            return []
        text = f"{level} words in the FIFO, expected {self._n_requested}: the device was restarted"
        found = [*self._hand_over(at), Event(self.sensor, EventKind.RESET, text, at)]
        index, since = self._caught_up
        index += round((at.monotonic_ns - since) * 1e-9 * self._rate)
        self._full.clear()
        self._skip_to(max(self._next, index - level // self.n_channels), "FIFO emptied")
        self._flags |= BlockFlag.CLOCK_RESTART
        return found

    def _take(self, words: NDArray[np.int16], at: HostTime) -> list[Block | Event]:
        caught_up = self.level < MAX_WORDS
        if not self._started:  # these words are stale
            self._started = caught_up
            self._caught_up = (self.level // self.n_channels, at.monotonic_ns)
            return []
        found: list[Block | Event] = []
        while self._full and len(words):
            old, words = words[: self._full[0][0]], words[self._full[0][0] :]
            self._gather(old)
            self._full = deque((n_words - len(old), index) for n_words, index in self._full)
            if not self._full[0][0]:
                _, index = self._full.popleft()
                found += self._hand_over(at)
                self._skip_to(max(self._next, index), "FIFO full")
        self._gather(words)
        if caught_up or self._n_rows >= BLOCK_SAMPLES:
            found += self._hand_over(at)
        if caught_up:
            self._caught_up = (self._next + self.level // self.n_channels, at.monotonic_ns)
        return found

    def _gather(self, words: NDArray[np.int16]) -> None:
        if len(words):
            self._rows.append(words.reshape(-1, self.n_channels))
            self._n_rows += len(self._rows[-1])

    def _hand_over(self, at: HostTime) -> list[Block | Event]:
        return [self._block(at)] if self._n_rows else []

    def _block(self, at: HostTime) -> Block:
        counts = np.concatenate(self._rows)
        self._rows, self._n_rows = [], 0
        first, self._next = self._next, self._next + len(counts)
        flags, self._flags = self._flags, BlockFlag.NONE
        reason, self._reason = self._reason, ""
        if counts.max() == np.iinfo(np.int16).max or counts.min() == np.iinfo(np.int16).min:
            flags |= BlockFlag.CLIPPED
        return Block(self.sensor, first, counts, at, flags=flags, reason=reason)

    def _resolve_doubt(self, level: int, at: HostTime) -> list[Block | Event]:
        """Decide by the level whether unanswered reads removed samples."""
        doubtful, self._doubtful = self._doubtful, 0
        if not doubtful or self._last is None or not self._started:
            return []
        found = self._hand_over(self._last)
        self._flags |= BlockFlag.MISSING_ESTIMATED  # also for 0 missing: host time is uncertain
        made = (at.monotonic_ns - self._last.monotonic_ns) * 1e-9 * self._rate * self.n_channels
        if self.level + made - level > doubtful / 2:
            self._skip_to(self._next + doubtful // self.n_channels, "lost reply")
        return found

    def _skip_to(self, index: int, reason: str) -> None:
        self._next = index
        self._flags |= BlockFlag.MISSING_ESTIMATED
        self._reason = reason
