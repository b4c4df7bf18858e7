"""Block FIFO behind Modbus RTU registers (ProWaveDAQ, PWRVT): level, then samples, in one read.

Theory of operation
-------------------
Input register 0x02 holds how many words wait in the device's FIFO. A read of 1 + N registers from
there returns a header and takes N words out: samples of the channels in turn (i16), N a multiple of
the channels, at most 123. What the header says differs between public clients: the level when it
was read (``"size"``), or what is left after this read (``"left"``). Holding register 0x01 is the
sampling rate in Hz.

There is neither counter nor time: samples are numbered as they come, and their time is the arrival
of a read that left less than one more in the FIFO. What waits when sampling starts is stale and
thrown away. A level at the FIFO's capacity means that the device has dropped samples; that it drops
the newest, not the oldest, is assumed: the gap is put behind what waits then, its length estimated
from host time. Fewer words than are known to wait, and zeros behind them, tell that the device was
restarted (with ``"size"``; with ``"left"`` it is not noticed). If there is more than zeros, the
header is what is left, whatever was said: nothing is thrown away. A reply that does not arrive may
have taken N words with it: whether it did, the next level tells, since the device makes samples at
a known rate meanwhile.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Literal

import numpy as np

from daq.protocols.block import Block, BlockFlag, Event, EventKind, HostTime
from daq.protocols.modbus import rtu
from daq.protocols.modbus.rtu import ReplyFinder

if TYPE_CHECKING:
    from numpy.typing import NDArray

RATE_REGISTER = 0x01
FIFO_REGISTER = 0x02
MAX_WORDS = 123
READ_OVERHEAD = 15
"""Bytes on the line for each read but for its words: the request, and of the reply the rest."""
BLOCK_SAMPLES = 1024
"""A block is handed over when the FIFO is read up, or when it has grown to this."""

Header = Literal["size", "left"]


class FifoDecoder:
    """Asks for what waits in the FIFO and numbers the samples.

    Send :meth:`request`, hand what comes to :meth:`receive` until ``waiting`` is false, or call
    :meth:`timed_out`; pause while ``level`` is low.

    Parameters
    ----------
    sensor : str
        Name of the sensor.
    sampling_rate : float
        Of the device, in Hz.
    n_channels : int
        Channels in the FIFO, in turn.
    header : "size" or "left"
        What the first register of a read means.
    unit : int
        Address of the device.
    capacity : int or None
        Words the FIFO holds, where known.
    """

    def __init__(
        self,
        sensor: str,
        sampling_rate: float,
        *,
        n_channels: int = 3,
        header: Header = "size",
        unit: int = 1,
        capacity: int | None = None,
    ) -> None:
        self._sensor = sensor
        self._rate = sampling_rate
        self._n_channels = n_channels
        self._header = header
        self._unit = unit
        self._capacity = capacity
        self._finder = ReplyFinder()
        self._asked = 0  # words asked for
        self._doubtful = 0  # words that an unanswered read may have taken
        self._n_unanswered = self._n_refused = 0
        self._started = False
        self._next = 0
        self._caught_up = (0, 0)  # sample that followed when the FIFO was last read up, and when
        self._full: deque[tuple[int, int]] = deque()  # words before each gap, index after it
        self._last: HostTime | None = None
        self._rows: list[NDArray[np.int16]] = []
        self._n_rows = 0
        self._flags = BlockFlag.CLOCK_RESTART
        self._reason = ""
        self.level = 0
        """Words known to wait."""

    @property
    def started(self) -> bool:
        """Whether the FIFO has been read up once, so that what comes is recorded."""
        return self._started

    @property
    def waiting(self) -> bool:
        """Whether a reply is outstanding."""
        return self._finder.waiting

    @property
    def is_damaged(self) -> bool:
        """Whether the outstanding reply came, damaged."""
        return self._finder.is_damaged

    def request(self) -> bytes:
        """Return the next request: for the level, with all the samples known to wait."""
        most = MAX_WORDS // self._n_channels * self._n_channels
        self._asked = min(self.level // self._n_channels * self._n_channels, most)
        if self._doubtful:  # first the level: it tells what became of them
            self._asked = 0
        request = rtu.read_request(self._unit, FIFO_REGISTER, 1 + self._asked)
        self._finder.expect(request)
        return request

    def timed_out(self, at: HostTime) -> list[Block | Event]:
        """Note that no reply came."""
        instead = self._finder.instead
        self._finder.forget()
        self._doubtful += self._asked
        self._n_unanswered += 1
        text = f"no reply to a read: {instead or 'nothing came'} ({self._n_unanswered} so far)"
        return [
            Event(self._sensor, EventKind.RESYNCHRONISED if instead else EventKind.STATUS, text, at)
        ]

    def receive(self, data: bytes, at: HostTime) -> list[Block | Event]:
        """Take bytes of the line."""
        reply = self._finder.receive(data)
        if reply is None:
            return []
        if reply.exception is not None:
            why = rtu.EXCEPTIONS.get(reply.exception, f"exception {reply.exception}")
            self.level = 0
            self._n_refused += 1
            text = f"the device refused a read: {why} ({self._n_refused} so far)"
            return [Event(self._sensor, EventKind.REFUSED, text, at)]
        registers = reply.registers
        level = int(registers[0]) + (self._asked if self._header == "left" else 0)
        found = self._resolve_doubt(level, at)
        if self._capacity is not None and level >= self._capacity and self._started:
            if not self._full:
                text = f"{level} words wait: the FIFO is full and samples were dropped"
                found.append(Event(self._sensor, EventKind.OVERFLOW, text, at))
            index, since = self._caught_up
            index += round((at.monotonic_ns - since) * 1e-9 * self._rate)
            self._full.append((level, index))
        words = registers[1:].view(np.int16)
        if level < self._asked and not words[level:].any():  # the rest of what came is nothing
            words = words[: level // self._n_channels * self._n_channels]
            found += self._emptied(level, at)
        self.level = max(0, level - self._asked)
        self._last = at
        found += self._take(words, at)
        return found

    def _emptied(self, level: int, at: HostTime) -> list[Block | Event]:
        """Note that fewer words wait than were known to: the device was restarted."""
        if not self._started:
            return []
        text = f"{level} words wait where {self._asked} did: the device was restarted"
        found = [*self._hand_over(at), Event(self._sensor, EventKind.RESET, text, at)]
        index, since = self._caught_up
        index += round((at.monotonic_ns - since) * 1e-9 * self._rate)
        self._full.clear()
        self._skip_to(max(self._next, index - level // self._n_channels), "FIFO emptied")
        self._flags |= BlockFlag.CLOCK_RESTART
        return found

    def _take(self, words: NDArray[np.int16], at: HostTime) -> list[Block | Event]:
        caught_up = self.level < MAX_WORDS
        if not self._started:  # what waits is stale
            self._started = caught_up
            self._caught_up = (self.level // self._n_channels, at.monotonic_ns)
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
            self._caught_up = (self._next + self.level // self._n_channels, at.monotonic_ns)
        return found

    def _gather(self, words: NDArray[np.int16]) -> None:
        if len(words):
            self._rows.append(words.reshape(-1, self._n_channels))
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
        return Block(self._sensor, first, counts, at, flags=flags, reason=reason)

    def _resolve_doubt(self, level: int, at: HostTime) -> list[Block | Event]:
        """Find out by the level whether reads that were not answered took samples out."""
        doubtful, self._doubtful = self._doubtful, 0
        if not doubtful or self._last is None or not self._started:
            return []
        found = self._hand_over(self._last)
        self._flags |= BlockFlag.MISSING_ESTIMATED  # also where none are: host time may mislead
        made = (at.monotonic_ns - self._last.monotonic_ns) * 1e-9 * self._rate * self._n_channels
        if self.level + made - level > doubtful / 2:
            self._skip_to(self._next + doubtful // self._n_channels, "lost reply")
        return found

    def _skip_to(self, index: int, reason: str) -> None:
        self._next = index
        self._flags |= BlockFlag.MISSING_ESTIMATED
        self._reason = reason
