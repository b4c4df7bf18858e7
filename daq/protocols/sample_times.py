"""From the times a device writes beside its samples to sample indices, gaps and repetitions.

Theory of operation
-------------------
The counterpart of :mod:`daq.protocols.sample_counter` for devices that send a time and no counter.
A time, in sample periods since the first, less the index it should belong to is the *offset* of the
two: constant but for the slow drift of a clock, which is followed, and for how finely times are
written. A time

- that is half a period or more past where the next sample should be says that samples are missing:
  as many as fit. Where times are written to half a period or finer their number is exact. Where
  one time stands for many samples, only its first occurrence is looked at, and the number may be
  wrong by one;
- that lies before one that came belongs to a sample that is known (a datagram that came twice or
  too late), and so does a message that repeats the one before to the letter, unless times are
  coarser than a period. The same time with other samples is of the next: the device's clock is
  coarser than it writes;
- that goes on after such earlier ones, which came as their times say and not at once, tells that
  they were no repetitions: the device's clock was set back, and they are missing;
- further ahead than host time allows, or long past when nothing else has come for a while, is
  *doubtful*: damaged on the way, or somebody set the device's clock. The next one tells: if it
  goes on from there, it was the clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from daq.protocols.block import HostTime

CLOCK_TOLERANCE = 200e-6
"""Largest relative rate error of a device's clock that is followed."""
SLACK_NS = 1_000_000_000
"""How far ahead of the earliest arrival a time may seem: the latency of that arrival."""
LATE_NS = 2_000_000_000
"""Nothing comes later than this after what was sent behind it."""
HOUR_NS = 3600 * 10**9
_COARSE = 2.0
GAIN = 0.05
"""Of the average that follows a drifting clock, a message."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where samples belong.

    Attributes
    ----------
    kind
        "next": after ``missing`` others; "known": they came before; "doubtful": their time says
        nothing yet; "reset": the device's clock was set; first come the doubtful ones before these,
        if there are any, after ``missing`` others; these are to be placed again.
    is_exact
        Whether ``missing`` is.
    """

    kind: Literal["next", "known", "doubtful", "reset"]
    missing: int = 0
    is_exact: bool = True


class SampleTimes:
    """Places samples by the times a device states.

    Parameters
    ----------
    sampling_rate : float
        In Hz.
    """

    def __init__(self, sampling_rate: float) -> None:
        self._rate = sampling_rate
        self._origin_ns: int | None = None  # the time of index 0
        self._next = 0  # index the next sample should have
        self._offset: float | None = 0.0  # of times and indices, in periods
        self._n_seen = 0
        self._least_width = 0.0  # in periods, of the times as they turn out
        self._latest_ns = 0  # the last time that was believed
        self._at_ns = 0  # when it came
        self._lag_ns = 0.0  # least time between a sample and its arrival, but for a constant
        self._doubtful: tuple[int, int, HostTime] | None = None  # time, samples, arrival
        self._again: tuple[int, int, int] | None = None  # what was known: first time, arrival; last

    def missing(self, time_ns: int) -> int:
        """Return how many samples lie between those known and these."""
        if self._origin_ns is None or self._offset is None:
            return 0
        return max(0, round(self._ahead(time_ns) - self._offset))

    def is_known(self, time_ns: int, at: HostTime, *, resolution_ns: int) -> bool:
        """Return whether samples of this time came before, or come too late."""
        if self._origin_ns is None or self._is_doubtful(time_ns, at, resolution_ns):
            return False
        if time_ns > self._latest_ns:
            return False
        self._came_again(time_ns, at)
        return True

    def place(
        self, time_ns: int, n_samples: int, at: HostTime, *, resolution_ns: int, alike: bool = False
    ) -> Place:
        """Place samples.

        Parameters
        ----------
        time_ns : int
            What the device says of the first of them.
        n_samples : int
            How many there are.
        at : HostTime
            When they came.
        resolution_ns : int
            How finely times are written.
        alike : bool
            Whether the message is the one before, to the letter.
        """
        width = max(self._least_width, resolution_ns * 1e-9 * self._rate)
        if self._origin_ns is None:
            self._begin(time_ns, at, width=width)
            return self._take(time_ns, n_samples, at, 0, is_exact=True)
        if self._is_doubtful(time_ns, at, resolution_ns):
            return self._doubt(time_ns, n_samples, at, resolution_ns)
        self._doubtful = None
        is_same = time_ns == self._latest_ns
        if time_ns < self._latest_ns or (is_same and width <= 1 and alike):
            self._came_again(time_ns, at)
            return Place("known")
        if (n_dropped := self._set_back(time_ns, at)) > 0:
            self._begin(time_ns, at, width=width)
            return Place("reset", n_dropped, is_exact=False)
        if is_same:
            if width <= 0.5:  # written finely, and coarse all the same
                self._least_width = _COARSE
                self._offset = None if self._n_seen == 1 else self._offset
            return self._take(time_ns, n_samples, at, 0, is_exact=True)
        ahead = self._ahead(time_ns)
        if self._offset is None:  # the first time that says when it began
            self._offset = ahead
        missing = max(0, round(ahead - self._offset))
        self._n_seen += 1
        gain = max(GAIN, 1 / self._n_seen)
        self._offset += gain * (ahead - missing - self._offset)
        return self._take(time_ns, n_samples, at, missing, is_exact=width <= 0.5)

    def _ahead(self, time_ns: int) -> float:
        return (time_ns - (self._origin_ns or 0)) * 1e-9 * self._rate - self._next

    def _begin(self, time_ns: int, at: HostTime, *, width: float) -> None:
        self._origin_ns, self._next, self._n_seen = time_ns, 0, 1
        self._offset = 0.0 if width <= 1 else None
        self._lag_ns = at.monotonic_ns - time_ns
        self._again = None

    def _take(
        self, time_ns: int, n_samples: int, at: HostTime, missing: int, *, is_exact: bool
    ) -> Place:
        self._next += missing + n_samples
        self._again = None
        self._lag_ns = min(self._least_lag(at), at.monotonic_ns - time_ns)
        self._latest_ns, self._at_ns = time_ns, at.monotonic_ns
        return Place("next", missing, is_exact)

    def _came_again(self, time_ns: int, at: HostTime) -> None:
        if self._again is None or time_ns < self._again[2]:
            self._again = time_ns, at.monotonic_ns, time_ns
        else:
            self._again = *self._again[:2], time_ns

    def _set_back(self, time_ns: int, at: HostTime) -> int:
        """Return how many samples were dropped as known that were not, before these."""
        if self._again is None:
            return 0
        first_ns, came_ns, last_ns = self._again
        span_ns, waited_ns = time_ns - first_ns, at.monotonic_ns - came_ns
        goes_on = 2 * (time_ns - last_ns) <= span_ns  # after two messages at least
        as_they_say = span_ns <= 2 * waited_ns <= 3 * span_ns
        return round(span_ns * 1e-9 * self._rate) if goes_on and as_they_say else 0

    def _least_lag(self, at: HostTime) -> float:
        return self._lag_ns + CLOCK_TOLERANCE * (at.monotonic_ns - self._at_ns)

    def _is_doubtful(self, time_ns: int, at: HostTime, resolution_ns: int) -> bool:
        if at.monotonic_ns - time_ns < self._least_lag(at) - SLACK_NS - resolution_ns:
            return True
        back_ns, waited_ns = self._latest_ns - time_ns, at.monotonic_ns - self._at_ns
        return back_ns > HOUR_NS or (back_ns > 0 and waited_ns > LATE_NS)

    def _doubt(self, time_ns: int, n_samples: int, at: HostTime, resolution_ns: int) -> Place:
        before, self._doubtful = self._doubtful, (time_ns, n_samples, at)
        if before is None:
            return Place("doubtful")
        first_ns, n_first, came = before
        step_ns, waited_ns = time_ns - first_ns, at.monotonic_ns - came.monotonic_ns
        if not -SLACK_NS <= waited_ns - step_ns + resolution_ns <= HOUR_NS or step_ns < 0:
            return Place("doubtful")
        self._doubtful = None
        missing = round((came.monotonic_ns - self._at_ns) * 1e-9 * self._rate) - n_first
        self._begin(first_ns, came, width=resolution_ns * 1e-9 * self._rate)
        self._take(first_ns, n_first, came, 0, is_exact=True)
        return Place("reset", max(0, missing), is_exact=False)
