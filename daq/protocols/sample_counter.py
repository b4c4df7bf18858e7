"""From a device's wrapping counter to sample indices, gaps and restarts.

Theory of operation
-------------------
Frames carry a counter that goes up by one each sample, modulo 2**16 or so. Steps other than one
are a gap, a repetition or a restart of the device, and which of them host time tells: a device
cannot be ahead of time. With *latest* the index that host time allows at the most,

- a step whose end is not past *latest* is a gap, and its length exact; a gap may span whole wraps
  of the counter, of which host time tells the number;
- a short step back with no time gone by repeats what was received before: dropped and counted;
- anything else is a restart: the counter began anew, and only host time says how much is missing.

*Latest* comes from the earliest arrival seen (arrival is never early), and follows a device clock
that is off by up to ``CLOCK_TOLERANCE``.

A device that went on sampling while nobody could hear it is taken on where it is: whether it did
:meth:`SampleCounter.expects` tells, again by host time, and how many wraps went by.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.protocols.block import HostTime

CLOCK_TOLERANCE = 200e-6
"""Largest relative rate error of a device's clock that is followed."""
SLACK = 1.0
"""How far ahead of the earliest arrival a sample may seem, s: the latency of that arrival."""
REPEATED = 1024
"""Longest step back, in samples, that is a repetition."""


@dataclass(frozen=True, slots=True)
class Run:
    """Rows ``start`` to ``stop`` of the frames given, without a gap between them."""

    start: int
    stop: int
    first_sample: int
    counter: int | None = None
    """The device's counter at ``start``, unwrapped since it last began anew."""
    missing: int = 0
    """Samples missing before the run."""
    restarted: bool = False
    """The counter began anew: ``missing`` is estimated, and the clock starts anew."""


class SampleCounter:
    """Gives frames their sample index by their counter.

    Parameters
    ----------
    modulus : int
        The counter runs from 0 to ``modulus - 1``.
    sampling_rate : float
        Counts per second, in Hz.
    """

    def __init__(self, modulus: int, sampling_rate: float) -> None:
        self.modulus = modulus
        self._rate = sampling_rate
        self._base = 0  # what to add to an index to get the unwrapped counter
        self._next = 0  # session index the next frame should have
        self._count: int | None = None  # counter of the frame before it
        self._origin = 0.0  # earliest arrival of sample 0, as far as is known, in s
        self._seen = 0.0  # host time of the read before, in s
        self._resumed = False

    def place(self, counters: NDArray[np.integer[Any]], at: HostTime) -> tuple[list[Run], int]:
        """Give each frame its sample index.

        Parameters
        ----------
        counters : int, shape (n_frames,), n_frames > 0
            The counter of each frame, in the order received.
        at : HostTime
            When the last of them had been received.

        Returns
        -------
        runs : list of Run
            In order; frames in none of them repeat others.
        n_repeated : int
            How many those are.
        """
        counters = counters.astype(np.int64)
        now = at.monotonic_ns * 1e-9
        if self._count is None:
            self._base = int(counters[0])
            self._count = self._base - 1
            self._origin = now - (counters.size - 1) / self._rate
        else:
            self._origin += CLOCK_TOLERANCE * (now - self._seen)
        latest = (now - self._origin) * self._rate
        runs: list[Run] = []
        n_repeated = row = 0
        while row < counters.size:
            ahead = (counters[row:] - self._count) % self.modulus
            index, restarted = self._index(int(ahead[0]), latest - (counters.size - 1 - row))
            if index is None:
                forward = np.flatnonzero((ahead >= 1) & (ahead < self.modulus // 2))
                skipped = int(forward[0]) if forward.size else ahead.size
                n_repeated += skipped
                row += skipped
                continue
            together = np.flatnonzero(np.diff(counters[row:]) % self.modulus != 1)
            stop = row + int(together[0]) + 1 if together.size else counters.size
            if restarted:
                self._base = int(counters[row]) - index
            missing = index - self._next
            runs.append(Run(row, stop, index, index + self._base, missing, restarted))
            self._next = index + stop - row
            self._resumed = False
            self._count = int(counters[stop - 1])
            row = stop
        self._origin = min(self._origin, now - (self._next - 1) / self._rate)
        self._seen = now
        return runs, n_repeated

    def expects(self, counter: int, at: HostTime) -> bool:
        """Whether a frame received now goes on with the counting, however many were missed.

        A counter that began anew meanwhile is taken for one that went on with the chance that it
        stands where it should: twice ``SLACK`` in the time of one wrap.
        """
        if self._count is None:
            return False
        now = at.monotonic_ns * 1e-9
        slack = (SLACK + CLOCK_TOLERANCE * (now - self._seen)) * self._rate
        index = self._next + (counter - self._count - 1) % self.modulus
        ahead = index - (now - self._origin) * self._rate
        off = (ahead + self.modulus / 2) % self.modulus - self.modulus / 2
        return abs(off) <= slack < self.modulus / 4

    def resume(self) -> None:
        """Note that any number may be missing before the next: whole wraps, too."""
        self._resumed = True

    def _index(self, step: int, latest: float) -> tuple[int | None, bool]:
        """Index of a frame ``step`` counts on, None if it repeats; and whether it is a restart."""
        if step == 1 and not self._resumed:
            return self._next, False
        index = self._next + (step - 1) % self.modulus
        if index <= latest + SLACK * self._rate:
            wraps = int((latest - index) / self.modulus + 0.5) if latest > index else 0
            return index + wraps * self.modulus, False
        back = -step % self.modulus
        no_time = latest - self._next < 0.5 * SLACK * self._rate
        if back <= min(REPEATED, self._next - 1) and no_time:
            return None, False
        return max(self._next, round(latest)), True
