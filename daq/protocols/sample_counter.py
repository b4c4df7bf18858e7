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

*Latest* follows from the earliest arrival so far, and tolerates a relative rate error of the
device's clock of up to ``CLOCK_TOLERANCE``.

A device may continue to sample while its connection is interrupted.
:meth:`SampleCounter.expects` tests this by host time, which also gives the number of wraps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.protocols.block import HostTime

CLOCK_TOLERANCE = 200e-6
"""Largest tolerated relative rate error of a device's clock."""
SLACK = 1.0
"""Largest latency of the earliest arrival, s: a sample may appear early by this much."""
REPEATED = 1024
"""Longest step back that counts as a repetition, in samples."""


@dataclass(frozen=True, slots=True)
class Run:
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
        self._origin = 0.0  # earliest known arrival of sample 0, in s
        self._seen = 0.0  # host time of the last read, in s
        self._resumed = False

    def place(self, counters: NDArray[np.integer[Any]], at: HostTime) -> tuple[list[Run], int]:
        """Assign a sample index to each frame.

        Parameters
        ----------
        counters : int, shape (n_frames,), n_frames > 0
            The counter of each frame, in the order received.
        at : HostTime
            Arrival of the last frame.

        Returns
        -------
        runs : list of Run
            In order; they contain all frames but repetitions.
        n_repeated : int
            Number of repeated frames.
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
            step = (int(counters[row]) - self._count) % self.modulus
            index, restarted = self._index(step, latest - (counters.size - 1 - row))
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
        """Return whether a frame received now continues the count, after any number of lost frames.

        A restarted counter passes by chance with a probability of twice ``SLACK`` divided by the
        time of one wrap.
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
        """Allow any number of missing samples before the next frame, also whole wraps."""
        self._resumed = True

    def _index(self, step: int, latest: float) -> tuple[int | None, bool]:
        """Return the index of a frame ``step`` counts later, and whether it is a restart.

        The index is None for a repetition.
        """
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
