"""When samples arrive, by their count: what host time says about a stream.

Theory of operation
-------------------
A sample cannot arrive before it is taken, and latency only adds. So the *earliest* arrivals follow
the count of the samples, and late ones say nothing: a busy host, a full buffer. :class:`Pace` keeps
the earliest arrivals of the last few ``NODE`` seconds, and the rate that they show: an oscillator
may be off by a per mille or more. The lateness of a sample against them tells whether
samples are missing before it (it is late for good), and whether fewer are missing than its stated
time says (it would be too early).

``scatter`` is by how much the lateness of successive arrivals differs. Only steps of several times
that are decided by one arrival. While stored samples are drained it is large.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.protocols.block import HostTime

NODE = 10.0
"""Seconds of arrivals, the earliest of which counts."""
_KEPT = 3  # nodes: a host is not busy for so long
_MIN_BASELINE = 20.0  # seconds between two nodes from which on they show the rate
LOST = 1.0
"""Seconds for which samples must be late at least, to be missing where a clock was set."""
_ODD = 1e-3  # share by which no oscillator is off: the rate is another one
_MAX_DRIFT = 0.02  # share by which a rate may be off
_GAIN = 0.2  # of the average that is the scatter
_SURE = 4.0  # scatters
_UNKNOWN = 900.0  # seconds of scatter before there are two arrivals


class Pace:
    """Earliest arrivals of the samples of one stream.

    Parameters
    ----------
    sampling_rate : float
        Nominal, in Hz.
    """

    def __init__(self, sampling_rate: float) -> None:
        self._rate = sampling_rate
        self.restart()

    def restart(self) -> None:
        """Forget all arrivals: the count begins again."""
        self._nodes: list[tuple[float, float]] = []  # time and lateness of the earliest
        self._first: tuple[float, float] | None = None  # the first complete node
        self._node_since = 0.0
        self._last: float | None = None  # lateness of the last arrival
        self.seen = 0.0
        """Host time of the last arrival, in s."""
        self.drift = 0.0
        """Lateness that is added per second: the share by which the device's clock is slow."""
        self.scatter = 0.0
        """Mean difference in s between the lateness of successive arrivals."""
        self.n_arrivals = 0

    def late(self, index: float, at: HostTime) -> float:
        """Return by how many seconds a sample arrives later than the earliest ones, by the count.

        Negative where it is earlier; 0 before the first arrival.
        """
        if not self._nodes:
            return 0.0
        now = at.monotonic_ns * 1e-9
        earliest = min(late + self.drift * (now - then) for then, late in self._nodes)
        return now - index / self._rate - earliest

    def is_early(self, late: float, seconds: float) -> bool:
        """Return whether samples so late arrive before they were taken, if so much is missing."""
        unsure = max(2 * self.scatter, 1.5 / self._rate)
        return self.is_sure(seconds) and late < seconds - min(unsure, seconds / 2)

    def shows(self, late: float, seconds: float) -> bool:
        """Return whether samples so late show that so much is missing before them, and no more."""
        return self.is_sure(seconds / 2) and late < 1.5 * seconds

    def is_sure(self, seconds: float) -> bool:
        """Return whether one arrival decides about a step of so many seconds."""
        return abs(seconds) > _SURE * (self.scatter if self.n_arrivals > 1 else _UNKNOWN)

    def lost(self, late: float) -> int:
        """Return how many samples are missing before samples so late, if nothing else says it."""
        return round(late * self._rate) if late > LOST and self.is_sure(late) else 0

    def odd_rate(self) -> float | None:
        """Return the rate in Hz by which samples arrive, where no oscillator is so far off.

        None where it may be the nominal one, or the count stepped: its rate was another lately.
        """
        if self._first is None or self._node_since < self._first[0] + _MIN_BASELINE:
            return None
        error = _SURE * self.scatter / (self._node_since - self._first[0])
        (then, late), *_, (now, later) = self._nodes
        lately, unsure = (later - late) / (now - then), _SURE * self.scatter / (now - then)
        is_steady = abs(lately - self.drift) <= abs(self.drift) / 2 + unsure
        is_odd = is_steady and abs(self.drift) > max(_ODD, error)
        return self._rate * (1 - self.drift) if is_odd else None

    def take(self, index: float, at: HostTime) -> None:
        """Take the arrival of a sample; samples that arrive together have that of the last one."""
        now = at.monotonic_ns * 1e-9
        late = now - index / self._rate
        if not self._nodes:
            self._node_since = now
            self._nodes = [(now, late)]
        elif now >= self._node_since + NODE:
            self._complete(now)
            self._nodes = [*self._nodes[1 - _KEPT :], (now, late)]
        elif late <= self._nodes[-1][1] + self.drift * (now - self._nodes[-1][0]):
            self._nodes[-1] = now, late
        if self._last is not None:
            change = abs(late - self._last)
            self.scatter += max(_GAIN, 1 / max(self.n_arrivals, 1)) * (change - self.scatter)
        self._last, self.seen = late, now
        self.n_arrivals += 1

    def _complete(self, now: float) -> None:
        """Take the rate from the first complete node to the latest."""
        then, late = self._nodes[-1]
        if self._first is None:
            self._first = then, late
        elif then >= self._first[0] + _MIN_BASELINE:
            drift = (late - self._first[1]) / (then - self._first[0])
            self.drift = min(max(drift, -_MAX_DRIFT), _MAX_DRIFT)
        self._node_since = now
