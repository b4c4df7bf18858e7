"""Spectra from undisturbed segments.

A segment is excluded if

- a sample is no number;
- the power of a channel in an octave differs much from that of the earlier accepted segments;
- its largest step between samples differs much (a spike attenuated by the window can still exceed
  noise far below the motion);
- a channel is constant for a much longer time than before (a briefly dead channel loses little
  power).

The decision on a segment uses only earlier segments, so it is the same live and offline.

The first segments have no predecessors: a start-up set is held back and compared with its own
median. If a complete start-up set of consecutive segments is excluded, the level has changed, and a
new start-up set begins.
"""

from __future__ import annotations

import enum
from collections import Counter, deque
from collections.abc import Iterable

import numpy as np

from estimator.errors import EstimatorError
from estimator.median import median
from estimator.records import dataclass
from estimator.spectra.parts import PartEnds
from estimator.spectra.welch import TAPERED_VALUES, CrossSpectra, SegmentSpectra, WelchSettings
from estimator.spectra.windows import get_window
from estimator.types import FloatArray, IntArray

FIRST_BAND = 8  # frequencies in the lowest band; every other band is an octave
FLATLINE_SAMPLES = 32  # consecutive equal samples of a dead channel
LONGER = 2.0  # ratio to the usual time for channels that are often constant, at threshold 6
MIN_FOR_MEDIAN = 5  # minimum number of segments for a median
REPORTED = 20_000  # maximum number of excluded segments kept individually


class Reason(enum.StrEnum):
    """Reason for the exclusion of a segment."""

    GAP = "gap"
    CLIPPED = "clipped"
    TRANSIENT = "transient"
    CHOSEN = "chosen"
    REPEATED = "repeated"


@dataclass(frozen=True, slots=True)
class RejectionSettings:
    """Criteria for the exclusion of a segment.

    Attributes
    ----------
    threshold : float
        Maximum deviation above the running median, in standard deviations (1.4826 times the median
        absolute deviation, or the scatter of stationary noise if larger), of three quantities: the
        logarithmic power of a band, the logarithm of the largest squared step between samples, and
        the logarithm of the longest time for which a channel is constant. Twice this deviation is
        allowed below the median for the first two, because logarithms of powers have a long lower
        tail. Infinity disables these criteria.
    start_up : int
        Number of first segments that are compared with each other.
    memory : int
        Number of accepted segments in the running median.
    renewal : int
        Number of accepted segments after which the median is updated.
    """

    threshold: float = 6.0
    start_up: int = 16
    memory: int = 64
    renewal: int = 16

    def __post_init__(self) -> None:
        if not self.threshold > 0:
            raise EstimatorError(f"rejection threshold {self.threshold}: expected above 0")
        if self.start_up < MIN_FOR_MEDIAN or self.memory < self.start_up or self.renewal < 1:
            raise EstimatorError(
                f"rejection start_up {self.start_up}, memory {self.memory}, renewal "
                f"{self.renewal}: expected {MIN_FOR_MEDIAN} or more, no less than that, and 1 or"
                " more"
            )


@dataclass(frozen=True, slots=True)
class Rejected:
    """One excluded segment.

    Attributes
    ----------
    segment : int
        Its number, by default from 0 in the order of addition.
    reason : Reason
    channel : int or None
        The channel with the largest deviation; None for a gap.
    deviation : float
        Standard deviations from the median, for a transient; NaN otherwise.
    """

    segment: int
    reason: Reason
    channel: int | None
    deviation: float


class SelectedSpectra:
    """Accumulates the `CrossSpectra` of undisturbed segments.

    Parameters
    ----------
    settings : WelchSettings
    n_channels : int
    rejection : RejectionSettings, optional
    segments, ends : SegmentSpectra and PartEnds, optional
        As of `CrossSpectra`, of accepted segments. Those of a start-up set are in the part in which
        it ends.

    Attributes
    ----------
    n_segments : int
        Number of tested segments, including those held back.
    counts : Counter of Reason
        Number of excluded segments by reason.
    rejected : deque of Rejected
        The latest excluded segments.
    """

    def __init__(
        self,
        settings: WelchSettings,
        n_channels: int,
        *,
        rejection: RejectionSettings | None = None,
        segments: SegmentSpectra | None = None,
        ends: PartEnds | None = None,
    ) -> None:
        self.settings = settings
        self.rejection = RejectionSettings() if rejection is None else rejection
        self.n_segments = 0
        self.counts: Counter[Reason] = Counter()
        self.rejected: deque[Rejected] = deque(maxlen=REPORTED)
        self._accepted = CrossSpectra(settings, n_channels, segments=segments, ends=ends)
        self._window = get_window(settings.window, settings.segment_length)[:, None]
        n_freqs = settings.segment_length // 2 + 1
        octaves = int(np.log2(max(1, n_freqs // FIRST_BAND)))
        self._bands = np.array([0, *FIRST_BAND * 2 ** np.arange(octaves)])
        self._least = np.array(
            [
                *_stationary_scatter(self._window[:, 0], np.diff([*self._bands, n_freqs])),
                _scatter_of_largest(settings.segment_length - 1),
                np.log(LONGER) / 6,
            ]
        )
        self._held: list[_Held] = []
        self._before: deque[FloatArray] = deque(maxlen=self.rejection.memory)
        self._normal: tuple[FloatArray, FloatArray] | None = None  # median, scatter
        self._since_renewal = 0
        self._in_a_row = 0

    def add(self, samples: FloatArray, starts: IntArray, *, places: IntArray | None = None) -> None:
        """Test the segments of `samples` that begin at `starts`, and add the accepted ones.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
            NaN counts as a gap.
        starts : int64, shape (n_segments,)
            In order of time.
        places : int64, shape (n_segments,), optional
            Numbers in time of the segments; default: how many were tested before.

        Raises
        ------
        EstimatorError
            As `CrossSpectra.add`; then no segment has been added.
        """
        starts = np.asarray(starts, dtype=np.int64)
        self._accepted.check(samples, starts)
        if places is None:
            places = self.n_segments + np.arange(len(starts))
        self.n_segments += len(starts)
        passed: list[tuple[int, int]] = []
        block = max(1, TAPERED_VALUES // (self.settings.segment_length * samples.shape[1]))
        for first in range(0, len(starts), block):
            some = slice(first, first + block)
            tested = zip(starts[some].tolist(), places[some].tolist(), strict=True)
            levels_of = self._levels(samples, starts[some])
            for (row, number), levels in zip(tested, levels_of, strict=True):
                stretch = slice(row, row + self.settings.segment_length)
                whole = bool(np.isfinite(levels).all())
                if self._passes(number, samples[stretch], levels, whole=whole):
                    passed.append((row, number))
        rows, numbers = np.array(passed, dtype=np.int64).reshape(-1, 2).T
        self._accepted.add(samples, rows, places=numbers)

    def spectra(self) -> CrossSpectra:
        """Return the spectra of all segments accepted so far.

        Includes the segments held back that agree with each other, but for single spectra.
        """
        total = CrossSpectra(self.settings, self._accepted.n_channels, ends=self.ends)
        total.merge(self._accepted)
        for held in self._agreeing(self._held)[0]:
            total.add(held.samples, np.zeros(1, dtype=np.int64))
        total.segments = self._accepted.segments
        return total

    def all_rejected(self) -> list[Rejected]:
        """Return the latest excluded segments, and those held back that do not agree."""
        return [*self.rejected, *self._agreeing(self._held)[1]]

    @property
    def ends(self) -> PartEnds | None:
        """Sums at the ends of parts of time."""
        return self._accepted.ends

    def end_part(self, place: int) -> None:
        """End a part of time before this place of the segments."""
        self._accepted.end_part(place)

    def drain(
        self, *, segments: SegmentSpectra | None = None, ends: PartEnds | None = None
    ) -> CrossSpectra:
        """Return the spectra of segments accepted since the last call, and keep all criteria.

        Segments held back are returned by a later call. `segments` and `ends` are of the next ones.
        """
        accepted = self._accepted
        self._accepted = CrossSpectra(
            self.settings, accepted.n_channels, segments=segments, ends=ends
        )
        return accepted

    def _levels(self, samples: FloatArray, rows: IntArray) -> FloatArray:
        """Return logarithms of the power in each band, the largest squared step, the constant time.

        Returns
        -------
        float64, shape (n_segments, n_bands + 2, n_channels)
        """
        shape = (self.settings.segment_length, samples.shape[1])
        frames = np.lib.stride_tricks.sliding_window_view(samples, shape)[rows, 0]
        steps = np.diff(frames, axis=1)
        np.abs(steps, out=steps)
        step = steps.max(axis=1, keepdims=True)
        still = np.stack([_longest_still(each) for each in steps])
        frames -= frames.mean(axis=1, keepdims=True)
        frames *= self._window
        spectra = np.fft.rfft(frames, axis=1)
        power = np.add.reduceat(spectra.real**2 + spectra.imag**2, self._bands, axis=1)
        levels = np.concatenate([power, step**2, still[:, None]], axis=1)
        return np.asarray(np.log(np.maximum(levels, np.finfo(np.float64).tiny)))

    def _passes(self, number: int, segment: FloatArray, levels: FloatArray, *, whole: bool) -> bool:
        if not whole:
            self._leave_out(Rejected(number, Reason.GAP, None, np.nan))
            return False
        if self._normal is None:
            self._held.append(_Held(number, segment.copy(), levels))
            if len(self._held) == self.rejection.start_up:
                self._end_start_up()
            return False
        off = _deviation(levels, *self._normal)
        if off.max() > self.rejection.threshold:
            self._leave_out(_transient(number, off))
            self._in_a_row += 1
            if self._in_a_row == self.rejection.start_up:
                self._normal, self._in_a_row = None, 0
                self._before.clear()
            return False
        self._in_a_row = 0
        self._before.append(levels)
        self._since_renewal += 1
        if self._since_renewal == self.rejection.renewal:
            self._renew()
        return True

    def _end_start_up(self) -> None:
        agreeing, others = self._agreeing(self._held)
        for held in agreeing:
            at = np.array([held.number])
            self._accepted.add(held.samples, np.zeros(1, dtype=np.int64), places=at)
            self._before.append(held.levels)
        for rejected in others:
            self._leave_out(rejected)
        self._held.clear()
        self._renew()

    def _agreeing(self, held: list[_Held]) -> tuple[list[_Held], list[Rejected]]:
        """Return the segments near the median of all, and the others."""
        if len(held) < MIN_FOR_MEDIAN:
            return held, []
        normal = self._median([segment.levels for segment in held])
        off = [_deviation(segment.levels, *normal) for segment in held]
        passes = [bool(o.max() <= self.rejection.threshold) for o in off]
        return (
            [segment for segment, good in zip(held, passes, strict=True) if good],
            [
                _transient(segment.number, o)
                for segment, o, good in zip(held, off, passes, strict=True)
                if not good
            ],
        )

    def _renew(self) -> None:
        self._normal = self._median(self._before) if self._before else None
        self._since_renewal = 0

    def _median(self, levels: Iterable[FloatArray]) -> tuple[FloatArray, FloatArray]:
        stack = np.stack(list(levels))
        middle = median(stack)
        scatter = 1.4826 * median(np.abs(stack - middle))
        return middle, np.maximum(scatter, self._least[:, None])

    def _leave_out(self, rejected: Rejected) -> None:
        self.counts[rejected.reason] += 1
        self.rejected.append(rejected)


@dataclass(frozen=True, slots=True)
class _Held:
    """A segment of the start-up set."""

    number: int
    samples: FloatArray
    levels: FloatArray


def _longest_still(steps: FloatArray) -> FloatArray:
    """Return the longest time for which each channel is nearly constant.

    Parameters
    ----------
    steps : float64, shape (segment_length - 1, n_channels)
        Magnitudes of the differences of consecutive samples.

    Returns
    -------
    float64, shape (n_channels,)
        In samples, not below half of `FLATLINE_SAMPLES`; the length of the segment for a constant
        channel; NaN for a channel with NaN.
    """
    limit = 1e-3 * np.sqrt(np.mean(steps**2, axis=0))  # resampling blurs the ends
    place = np.arange(1, len(steps) + 1, dtype=np.int32)[:, None]
    last_moved = np.maximum.accumulate(np.where(steps > limit, place, 0), axis=0)
    longest = (place - last_moved).max(axis=0) + 1.0
    return np.where(np.isnan(limit), np.nan, np.maximum(longest, (FLATLINE_SAMPLES - 1) / LONGER))


def _deviation(levels: FloatArray, median: FloatArray, scatter: FloatArray) -> FloatArray:
    """Return the largest deviation of each channel, shape (n_channels,).

    Constant times below the median do not count.
    """
    above = (levels - median) / scatter
    below = -above[:-1] / 2
    return np.asarray(np.maximum(above.max(axis=0), below.max(axis=0)))


def _stationary_scatter(window: FloatArray, widths: IntArray) -> FloatArray:
    """Return the scatter of the logarithmic power of bands with these numbers of frequencies."""
    correlation = np.abs(np.fft.fft(window**2)) ** 2
    correlation /= correlation[0]
    lags = [np.arange(1, min(width, len(window) // 2)) for width in widths]
    return np.sqrt(
        [
            (1 + 2 * np.sum((1 - lag / width) * correlation[lag])) / width
            for lag, width in zip(lags, widths, strict=True)
        ]
    )


def _scatter_of_largest(n_samples: int) -> float:
    """Return the scatter of the logarithm of the largest square of independent normal samples.

    The largest square is near 2 ln n, with a Gumbel distribution of scale 2.
    """
    return float(np.pi / np.sqrt(6) / np.log(max(n_samples, 3)))


def _transient(number: int, off: FloatArray) -> Rejected:
    return Rejected(number, Reason.TRANSIENT, int(np.argmax(off)), float(off.max()))
