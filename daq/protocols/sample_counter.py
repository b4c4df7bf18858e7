"""Sample indices, gaps and restarts from a device's wrapping counter.

Theory of operation
-------------------
Frames have a counter that increases by one per sample, modulo 2**16 or another modulus. Any other
step is a gap, a repetition or a restart of the device. Host time decides which, because samples
cannot arrive before they are taken. *Latest* is the largest index that host time allows:

- a step to an index up to *latest* is a gap, of exact length; host time gives the number of whole
  wraps of the counter in the gap;
- a short step back without elapsed time is a repetition: the frames are dropped and counted;
- any other step is a restart: the counter was reset, and the number of missing samples is estimated
  from host time.

*Latest* follows from the earliest recent arrivals and the rate that they show
(:mod:`daq.protocols.pace`): a counter may be slow by a per mille, and late arrivals do not count.
In a time without arrivals, the rate is known to ``CLOCK_TOLERANCE``.

A device may continue to sample while its connection is interrupted.
:meth:`SampleCounter.expects` tests this by host time, which also gives the number of wraps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.protocols.block import HostTime
from daq.protocols.pace import Pace

CLOCK_TOLERANCE = 200e-6
"""Relative error of the rate of a device's clock, as measured or nominal."""
SLACK = 1.0
"""Largest latency of the earliest arrival, s: a sample may appear early by this much."""
REPEATED = 1024
"""Longest step back that counts as a repetition, in samples."""


@dataclass(frozen=True, slots=True)
class FrameRun:
    """Rows ``start`` to ``stop`` of the given frames, without a gap."""

    start: int
    stop: int
    first_sample: int
    counter: int | None = None
    """The device's counter at ``start``, unwrapped since its last restart."""
    missing: int = 0
    """Samples missing before the run."""
    restarted: bool = False
    """Whether the counter restarted: ``missing`` is then an estimate, and the clock restarts."""


class SampleCounter:
    """Assigns sample indices to frames by their counter.

    Parameters
    ----------
    modulus : int
        The counter counts from 0 to ``modulus - 1``.
    sampling_rate : float
        Counts per second, in Hz.
    """

    def __init__(self, modulus: int, sampling_rate: float) -> None:
        self.modulus = modulus
        self._rate = sampling_rate
        self._base = 0  # unwrapped counter minus index
        self._next = 0  # expected session index of the next frame
        self._count: int | None = None  # counter of the last frame
        self._pace = Pace(sampling_rate)
        self._resumed = False

    def place(self, counters: NDArray[np.integer[Any]], at: HostTime) -> tuple[list[FrameRun], int]:
        """Assign a sample index to each frame.

        Parameters
        ----------
        counters : int, shape (n_frames,), n_frames > 0
            The counter of each frame, in the order received.
        at : HostTime
            Arrival of the last frame.

        Returns
        -------
        runs : list of FrameRun
            In order; they contain all frames but repetitions.
        n_repeated : int
            Number of repeated frames.
        """
        counters = counters.astype(np.int64)
        if self._count is None:
            self._base = int(counters[0])
            self._count = self._base - 1
            self._pace.take(counters.size - 1, at)
        latest = self._pace.late(0, at) * self._rate
        slack = (SLACK + self._doubt(at)) * self._rate
        runs: list[FrameRun] = []
        n_repeated = row = 0
        while row < counters.size:
            step = (int(counters[row]) - self._count) % self.modulus
            index, restarted = self._index(step, latest - (counters.size - 1 - row), slack)
            if index is None:
                ahead = (counters[row:] - self._count) % self.modulus
                forward = np.flatnonzero((ahead >= 1) & (ahead < self.modulus // 2))
                skipped = int(forward[0]) if forward.size else ahead.size
                n_repeated += skipped
                row += skipped
                continue
            jumps = (counters[row + 1 :] - counters[row:-1]) % self.modulus != 1
            stop = row + int(jumps.argmax()) + 1 if jumps.any() else counters.size
            if restarted:
                self._base = int(counters[row]) - index
                self._pace.restart()
            missing = index - self._next
            runs.append(FrameRun(row, stop, index, index + self._base, missing, restarted))
            self._next = index + stop - row
            self._resumed = False
            self._count = int(counters[stop - 1])
            row = stop
        if runs:
            self._pace.take(self._next - 1, at)
        return runs, n_repeated

    def expects(self, counter: int, at: HostTime) -> bool:
        """Return whether a frame received now continues the count, after any number of lost frames.

        A restarted counter passes by chance with a probability of twice ``SLACK`` divided by the
        time of one wrap.
        """
        if self._count is None:
            return False
        slack = (SLACK + self._doubt(at)) * self._rate
        index = self._next + (counter - self._count - 1) % self.modulus
        ahead = -self._pace.late(index, at) * self._rate
        off = (ahead + self.modulus / 2) % self.modulus - self.modulus / 2
        return abs(off) <= slack < self.modulus / 4

    def resume(self) -> None:
        """Allow any number of missing samples before the next frame, also whole wraps."""
        self._resumed = True

    def _doubt(self, at: HostTime) -> float:
        """Return by how much, in s, the count may be off the pace after a time without arrivals."""
        return CLOCK_TOLERANCE * (at.monotonic_ns * 1e-9 - self._pace.seen)

    def _index(self, step: int, latest: float, slack: float) -> tuple[int | None, bool]:
        """Return the index of a frame ``step`` counts later, and whether it is a restart.

        The index is None for a repetition.
        """
        if step == 1 and not self._resumed:
            return self._next, False
        index = self._next + (step - 1) % self.modulus
        if index <= latest + slack:
            wraps = int((latest - index) / self.modulus + 0.5) if latest > index else 0
            return index + wraps * self.modulus, False
        back = -step % self.modulus
        no_time = latest - self._next < 0.5 * SLACK * self._rate
        if back <= min(REPEATED, self._next - 1) and no_time:
            return None, False
        return max(self._next, round(latest)), True
