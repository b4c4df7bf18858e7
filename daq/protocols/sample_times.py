"""Sample indices, gaps and repetitions from the times that a device sends with its samples.

Theory of operation
-------------------
This is the counterpart of :mod:`daq.protocols.sample_counter` for devices that send a time and no
counter. The *offset* is a sample's time, in sample periods since the first sample, minus its index.
The offset is constant except for the drift of the clock, which an average tracks, and for the
resolution of the times. Each time is one of these:

- Half a period or more after the expected time of the next sample: samples are missing. Their
  number is exact if the resolution is half a period or finer. If many samples have the same time,
  only the first of them is compared, and the number may be wrong by one.
- Earlier than a received time: the sample is known (a repeated or late datagram). So is a message
  identical to the one before, unless the resolution is coarser than a period. The same time with
  other samples belongs to the next samples: the device's clock is coarser than its format.
- Later than such earlier times, which arrived at the rate of their times and not in one burst: they
  were no repetitions. The device's clock was set back, and these samples are missing.
- Later than host time allows, or far in the past after a pause: *doubtful*. Either the message is
  damaged or the device's clock was set. If the next time continues from this one, the clock was
  set.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from daq.protocols.block import HostTime

CLOCK_TOLERANCE = 200e-6
"""Largest tolerated relative rate error of a device's clock."""
SLACK_NS = 1_000_000_000
"""Largest latency of the earliest arrival, ns: a time may appear early by this much."""
LATE_NS = 2_000_000_000
"""Largest delay of a message that was overtaken by another, ns."""
HOUR_NS = 3600 * 10**9
_COARSE = 2.0
GAIN = 0.05
"""Gain per message of the average that tracks a drifting clock."""


@dataclass(frozen=True, slots=True)
class Place:
    """Position of samples.

    Attributes
    ----------
    kind
        "next": after ``missing`` others; "known": already received; "doubtful": not decided yet;
        "reset": the device's clock was set. After "reset" come ``missing`` samples, then the
        doubtful samples, if there are any; call :meth:`SampleTimes.place` again for these samples.
    missing
        Number of missing samples before these.
    is_exact
        Whether ``missing`` is exact.
    """

    kind: Literal["next", "known", "doubtful", "reset"]
    missing: int = 0
    is_exact: bool = True


class SampleTimes:
    """Assigns positions to samples by the times that a device sends.

    Parameters
    ----------
    sampling_rate : float
        In Hz.
    """

    def __init__(self, sampling_rate: float) -> None:
        self._rate = sampling_rate
        self._origin_ns: int | None = None  # the time of index 0
        self._next = 0  # expected index of the next sample
        self._offset: float | None = 0.0  # in periods; None until a time changes
        self._n_seen = 0
        self._least_width = 0.0  # observed resolution of the times, in periods
        self._latest_ns = 0  # the last accepted time
        self._at_ns = 0  # its arrival
        self._lag_ns = 0.0  # smallest arrival minus time so far
        self._doubtful: tuple[int, int, HostTime] | None = None  # time, n_samples, arrival
        self._again: tuple[int, int, int] | None = None  # known: first time, its arrival, last time

    def missing(self, time_ns: int) -> int:
        """Return the number of samples missing before a sample of this time."""
        if self._origin_ns is None or self._offset is None:
            return 0
        return max(0, round(self._ahead(time_ns) - self._offset))

    def is_known(self, time_ns: int, at: HostTime, *, resolution_ns: int) -> bool:
        """Return whether samples of this time are repeated or too late."""
        if self._origin_ns is None or self._is_doubtful(time_ns, at, resolution_ns):
            return False
        if time_ns > self._latest_ns:
            return False
        self._came_again(time_ns, at)
        return True

    def place(
        self, time_ns: int, n_samples: int, at: HostTime, *, resolution_ns: int, alike: bool = False
    ) -> Place:
        """Return the position of samples.

        Parameters
        ----------
        time_ns : int
            The device's time of the first sample.
        n_samples : int
            Number of samples.
        at : HostTime
            Their arrival.
        resolution_ns : int
            Resolution of the time's format.
        alike : bool
            Whether the message is identical to the one before.
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
            if width <= 0.5:  # the clock is coarser than the format
                self._least_width = _COARSE
                self._offset = None if self._n_seen == 1 else self._offset
            return self._take(time_ns, n_samples, at, 0, is_exact=True)
        ahead = self._ahead(time_ns)
        if self._offset is None:  # the first change of the time fixes its phase
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
        """Return the number of samples wrongly dropped as known, if the clock was set back."""
        if self._again is None:
            return 0
        first_ns, came_ns, last_ns = self._again
        span_ns, waited_ns = time_ns - first_ns, at.monotonic_ns - came_ns
        continues = 2 * (time_ns - last_ns) <= span_ns  # after at least two messages
        in_real_time = span_ns <= 2 * waited_ns <= 3 * span_ns
        return round(span_ns * 1e-9 * self._rate) if continues and in_real_time else 0

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
