"""Sample indices, gaps and repetitions from the times that a device sends with its samples.

Theory of operation
-------------------
This is the counterpart of :mod:`daq.protocols.sample_counter` for devices that send a time and no
counter. The *offset* is a sample's time, in sample periods since the first sample, minus its index.
The offset is constant except for the drift of the clock, which an average tracks, and for the
resolution of the times. A time within half a period of the expected one continues the count. If
many samples have the same time, only the first of them is compared, and a number of missing samples
may be wrong by one; the same time with other samples belongs to the next samples: the device's
clock is coarser than its format. Each other time is one of these:

- That of a message received before, with the same content: it is *known*, and dropped. So is a
  message identical to the one before, unless the resolution is coarser than a period.
- In a gap that was recorded: the message came too late.
- Else *doubtful*, until the next message arrives. If that one continues the count from before, the
  message was damaged. If not, the device's clock was set, or samples are missing. Host time decides
  (:mod:`daq.protocols.pace`): samples cannot arrive before they are taken. The number of missing
  samples is an estimate where the resolution is coarser than half a period, or arrivals are too
  unsteady to show that anything is missing and such steps are rare. No sample is dropped.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from daq.protocols.pace import Pace

if TYPE_CHECKING:
    from daq.protocols.block import HostTime

SLACK_NS = 1_000_000_000
"""Time in ns by which a device's clock may gain on the host's between two messages."""
LATE_NS = 2_000_000_000
"""Largest delay of a message that was overtaken by another, ns."""
GAIN = 0.05
"""Gain per message of the average that tracks a drifting clock."""
MAX_KNOWN = 1 << 15
"""Messages that are remembered to tell repeated ones."""
_MAX_HOLES = 64
_COARSE = 2.0
_FREQUENT_NS = 60 * 10**9  # in which a clock is not set three times
_WHOLE = 0.1  # samples that lost packets may be off a multiple of their length


@dataclass(frozen=True, slots=True)
class SamplePlace:
    """Position of samples.

    Attributes
    ----------
    kind
        "next": they continue the count; "known": already received, or too late; "doubtful": not
        decided yet. "before" and "damaged" decide about the doubtful samples: these come first,
        after ``missing`` others, or their time is wrong. Call :meth:`SampleTimes.place` again then.
    missing
        Number of samples missing before the doubtful ones.
    is_exact
        Whether ``missing`` is exact.
    is_reset
        Whether the device's clock was set before the doubtful samples.
    """

    kind: Literal["next", "known", "doubtful", "before", "damaged"]
    missing: int = 0
    is_exact: bool = True
    is_reset: bool = False


@dataclass(frozen=True, slots=True)
class _Samples:
    """Samples with one time; ``n_behind`` more arrived together with them."""

    time_ns: int
    n: int
    at: HostTime
    n_behind: int


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
        self._set_at = 0  # samples of the session before index 0
        self._offset: float | None = 0.0  # in periods; None until a time changes
        self._n_seen = 0
        self._least_width = 0.0  # observed resolution of the times, in periods
        self._latest_ns = 0  # the last accepted time
        self._pace = Pace(sampling_rate)
        self._known: dict[int, None] = {}  # in order
        self._holes: deque[tuple[int, int]] = deque(maxlen=_MAX_HOLES)  # times of missing samples
        self._doubtful: _Samples | None = None
        self._forward_ns: deque[int] = deque(maxlen=3)  # when times stepped forward

    def missing(self, time_ns: int) -> int:
        """Return the number of samples missing before a sample of this time."""
        return max(0, round(self._off(time_ns)))

    def is_known(self, time_ns: int, content: int) -> bool:
        """Return whether samples are repeated or too late; remember them otherwise.

        `content`: hash of the message.
        """
        if self._origin_ns is not None and (content in self._known or self._is_late(time_ns)):
            return True
        self._known[content] = None
        if len(self._known) > MAX_KNOWN:
            del self._known[next(iter(self._known))]
        return False

    def arrived(self, at: HostTime) -> None:
        """Take the arrival of the last sample that was placed."""
        self._pace.take(self._set_at + self._next - 1, at)

    def place(
        self,
        time_ns: int,
        n_samples: int,
        at: HostTime,
        *,
        resolution_ns: int,
        n_behind: int = 0,
        is_damaged: bool = False,
    ) -> SamplePlace:
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
        n_behind : int
            Number of samples that arrived together with them, and are placed later.
        is_damaged : bool
            Whether a message before them could not be read: samples are missing.
        """
        width = max(self._least_width, resolution_ns * 1e-9 * self._rate)
        samples = _Samples(time_ns, n_samples, at, n_behind)
        if self._origin_ns is None:
            self._begin(time_ns, width)
            return self._take(samples)
        doubtful = self._doubtful
        if doubtful is not None and not self._fills(samples, doubtful, width):
            self._doubtful = None
            return self._decided(doubtful, samples, width, is_damaged=is_damaged)
        if time_ns == self._latest_ns:
            if width <= 0.5:  # the clock is coarser than the format
                self._least_width = _COARSE
                self._offset = None if self._n_seen == 1 else self._offset
            return self._take(samples)
        if self._offset is None and time_ns > self._latest_ns:
            self._offset = self._ahead(time_ns)  # the first change of the time fixes its phase
        off = self._off(time_ns)
        if round(off) > 0 or off < -0.5 - width:
            self._doubtful = samples
            return SamplePlace("doubtful")
        self._n_seen += 1
        self._offset = (self._offset or 0.0) + max(GAIN, 1 / self._n_seen) * off
        return self._take(samples)

    def settle(self) -> SamplePlace | None:
        """Return the position of the doubtful samples, if any: nothing follows them."""
        doubtful, self._doubtful = self._doubtful, None
        if doubtful is None:
            return None
        late = self._pace.late(self._set_at + self._next + doubtful.n - 1, doubtful.at)
        return SamplePlace("before", self._pace.lost(late), is_exact=False)

    def _fills(self, samples: _Samples, doubtful: _Samples, width: float) -> bool:
        """Return whether samples continue the count, overtaken by the doubtful ones."""
        in_time = samples.at.monotonic_ns - doubtful.at.monotonic_ns <= LATE_NS
        in_turn = abs(self._off(samples.time_ns)) < 0.5 + width
        return in_time and in_turn and samples.time_ns < doubtful.time_ns

    def _decided(
        self, doubtful: _Samples, samples: _Samples, width: float, *, is_damaged: bool
    ) -> SamplePlace:
        """Return what the next samples say of the doubtful ones."""
        off = self._off(doubtful.time_ns)
        if abs(off) < 0.5:  # overtaken samples came before
            self._take(doubtful)
            return SamplePlace("before")
        step_ns = samples.time_ns - doubtful.time_ns
        waited_ns = samples.at.monotonic_ns - doubtful.at.monotonic_ns
        ahead = step_ns * 1e-9 * self._rate - doubtful.n
        goes_on = ahead > -0.5 - width and step_ns <= waited_ns + SLACK_NS + doubtful.n / self._rate
        if not goes_on and not (step_ns == 0 and width > 0.5):
            return SamplePlace("damaged")
        count = self._set_at + self._next + doubtful.n - 1
        late = self._pace.late(count + doubtful.n_behind, doubtful.at)
        last = count + samples.n + samples.n_behind
        late = min(late, self._pace.late(last, samples.at)) if ahead < 0.5 + width else late
        seconds = off / self._rate
        missing, is_sure = round(off), self._pace.is_sure(seconds)
        # Packets are lost as a whole; a clock is hardly set by a multiple of their length.
        is_whole = doubtful.n == 1 or (missing % doubtful.n == 0 and abs(off - missing) < _WHOLE)
        if off > 0 and not self._pace.is_early(late, seconds) and (is_sure or is_whole):
            of_packets = is_whole and doubtful.n > 1
            shown = is_damaged or of_packets or self._pace.shows(late, seconds)
            shown |= self._are_frequent(doubtful.at.monotonic_ns)
            self._holes.append((self._time_of_next(), doubtful.time_ns))
            self._next += missing
            self._take(doubtful)
            return SamplePlace("before", missing, is_exact=width <= 0.5 and shown)
        missing = self._pace.lost(late)
        self._set_at += self._next + missing
        self._begin(doubtful.time_ns, width)
        self._take(doubtful)
        return SamplePlace("before", missing, is_exact=not missing, is_reset=True)

    def _are_frequent(self, now_ns: int) -> bool:
        """Return whether steps forward are frequent: samples are lost, for no clock is set so."""
        self._forward_ns.append(now_ns)
        full = len(self._forward_ns) == self._forward_ns.maxlen
        return full and now_ns - self._forward_ns[0] < _FREQUENT_NS

    def _ahead(self, time_ns: int) -> float:
        return (time_ns - (self._origin_ns or 0)) * 1e-9 * self._rate - self._next

    def _off(self, time_ns: int) -> float:
        """Return by how many periods a time is after that of the next sample."""
        if self._origin_ns is None or self._offset is None:
            return 0.0
        return self._ahead(time_ns) - self._offset

    def _time_of_next(self) -> int:
        periods = self._next + (self._offset or 0.0)
        return (self._origin_ns or 0) + round(periods / self._rate * 1e9)

    def _is_late(self, time_ns: int) -> bool:
        half = round(0.5e9 / self._rate)
        return any(low - half <= time_ns < high - half for low, high in self._holes)

    def _begin(self, time_ns: int, width: float) -> None:
        self._origin_ns, self._next, self._n_seen = time_ns, 0, 1
        self._offset = 0.0 if width <= 1 else None
        self._holes.clear()

    def _take(self, samples: _Samples) -> SamplePlace:
        self._next += samples.n
        self._latest_ns = samples.time_ns
        return SamplePlace("next")
