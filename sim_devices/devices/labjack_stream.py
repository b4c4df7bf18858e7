"""The stream of a simulated LabJack: a buffer of scans, read in packets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.devices.labjack import registers as reg
from daq.devices.labjack.packets import Packet
from daq.devices.labjack.stream import (
    AUTO_RECOVER_ACTIVE,
    AUTO_RECOVER_END,
    AUTO_RECOVER_OVERFLOW,
    BURST_COMPLETE,
    DUMMY,
)
from sim_devices.devices.interface import NEVER
from sim_devices.devices.sampling import whole

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from sim_devices.devices.sampling import Samples

CENTER = 33523


class Stream:
    """A buffer that is filled with scans and read in packets."""

    def __init__(
        self, samples: Samples, columns: Columns, *, capacity: int, packet_size: int, now: float
    ) -> None:
        self._samples = samples
        self._columns = columns
        self._capacity = max(capacity, packet_size + 2 * columns.n)
        self._packet_size = packet_size
        self.first = self._next = samples.first_after(now)
        self._buffer = np.empty(0, np.uint16)
        self._recovering = False
        self._full_until = -NEVER
        self._skipped = 0
        self.is_due = False
        """Whether a packet is due that is not full."""
        self._mark: int | None = None  # scans skipped before the mark in the buffer
        self.wanted: int | None = None
        """Number of scans of a burst; None for a continuous stream."""
        self.breaks_off: tuple[int, int] | None = None
        """Number of scans after which the stream ends, and its status then."""
        self.ended = 0
        """Status at the end of the stream; 0 while it runs."""

    def advance(self, now: float) -> None:
        """Take the scans up to ``now``."""
        end = self._samples.end_before(now, self._next)
        if self.wanted is not None and end >= self.first + self.wanted:
            end, self.ended = self.first + self.wanted, self.ended or BURST_COMPLETE
        if self.breaks_off is not None and end >= self.first + self.breaks_off[0]:
            end, self.ended = self.first + self.breaks_off[0], self.breaks_off[1]
        while self._next < end:
            self._take(end)

    def overflow(self, until: float) -> None:
        """Take no scans before world time ``until``, as if the buffer were full.

        The scans in the buffer become due immediately, with the status of an overflow.
        """
        self._recovering = self.is_due = True
        self._full_until = until

    def _take(self, end: int) -> None:
        full = self._samples.time(self._next) < self._full_until
        if self._recovering and (full or self.n_waiting >= self._packet_size):
            if full:
                end = self._samples.end_before(
                    min(self._full_until, self._samples.time(end - 1)), self._next
                )
            self._skipped += end - self._next
            self._next = end
            if self._skipped > 65535:
                self.ended = AUTO_RECOVER_OVERFLOW
            return
        if self._recovering:
            self._put(np.full((1, self._columns.n), DUMMY, np.uint16))
            self._recovering, self._mark, self._skipped = False, self._skipped, 0
        n = min((self._capacity - self.n_waiting) // self._columns.n, end - self._next)
        self._put(self._columns.scans(self._samples, self._next, n))
        self._next += n
        self._recovering = self._next < end

    def _put(self, rows: NDArray[np.uint16]) -> None:
        self._buffer = np.concatenate((self._buffer, rows.ravel()))

    @property
    def n_waiting(self) -> int:
        """Number of samples in the buffer."""
        return len(self._buffer)

    def next_full(self) -> float:
        """Return the world time at which the next packet is full or the stream ends."""
        rows = -(-(self._packet_size - self.n_waiting) // self._columns.n)
        if self.ended or self.is_due or rows <= 0:
            return -NEVER
        last = self._next + rows - 1
        for limit in (self.wanted, self.breaks_off and self.breaks_off[0]):
            if limit is not None:
                last = min(last, self.first + limit - 1)
        return self._samples.time(max(last, self.first))

    def take_out(self, n_samples: int) -> Packet:
        """Remove at most ``n_samples`` samples; return them with their status."""
        taken, self._buffer = self._buffer[:n_samples], self._buffer[n_samples:]
        self.is_due = False
        status = information = 0
        if self._mark is not None:
            status, information, self._mark = AUTO_RECOVER_END, self._mark, None
        elif self._recovering:
            status = AUTO_RECOVER_ACTIVE
        if self.ended and not self.n_waiting:
            status = self.ended
            information = len(taken) if status == BURST_COMPLETE else 0
        return Packet(taken, 2 * self.n_waiting, status, information)


class Columns:
    """Values of the addresses of a scan list."""

    def __init__(
        self,
        addresses: Sequence[int],
        inputs: Mapping[int, int],
        rate: float,
        *,
        core_began: int = 0,
        system_began: float = 0.0,
    ) -> None:
        self.n = len(addresses)
        self._addresses = addresses
        self._inputs = inputs  # address of an analog input: column of the samples
        self._ticks = round(reg.CORE_HZ / rate)
        self._rate = rate
        self._core_began = core_began
        self._system_began = system_began

    def timer(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return CORE_TIMER at each scan."""
        return (index * self._ticks - self._core_began) % (1 << 32)

    def scans(self, samples: Samples, first: int, n: int) -> NDArray[np.uint16]:
        """Return ``n`` scans, shape (n, n_columns)."""
        counts = whole(samples.counts(first, n) + CENTER, 0, 65535)
        index = np.arange(first, first + n)
        rows = np.zeros((n, self.n), np.int64)
        wide = np.zeros(n, np.int64)  # the last 32-bit value, for its upper half
        for column, address in enumerate(self._addresses):
            if address == reg.STREAM_DATA_CAPTURE_16:
                rows[:, column] = wide >> 16
                continue
            if address == reg.CORE_TIMER:
                wide = self.timer(index)
            elif address == reg.SYSTEM_TIMER_20HZ:
                seconds = index / self._rate - self._system_began
                wide = (seconds * reg.SYSTEM_HZ).astype(np.int64) % (1 << 32)
            elif address in self._inputs:
                wide = counts[:, self._inputs[address]]
            else:
                wide = np.full(n, CENTER if address < 512 else column)
            rows[:, column] = wide & 0xFFFF
        return rows.astype(np.uint16)
