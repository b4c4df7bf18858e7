"""Long segments for low frequencies, short ones for high frequencies, in one pass.

The samples pass through a cascade of stages, each at half the sampling rate of the one above. All
stages use segments of the same number of samples, so that those of each stage are twice as long in
time, and half as many, as those of the stage above. Each stage contributes the octave from 0.2 to
0.4 of its rate; the top stage extends up to half its rate, the bottom one down to 0. The filter
between stages prevents aliasing into the used octave; its response in that octave is divided out.

Disturbed segments are excluded separately at each stage, by comparison with earlier segments of
equal length: a knock may disturb the highest octave and not the lowest.

Segments that only some channels have count for these channels, as in
`estimator.spectra.channel_sets`, at each stage by its own segments.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import field, replace
from functools import cache
from itertools import takewhile

import numpy as np

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.records import dataclass
from estimator.spectra.channel_sets import ChannelSets
from estimator.spectra.parts import Part, PartEnds, Parts, by_part
from estimator.spectra.segment_rejection import Reason, RejectionSettings, SelectedSpectra
from estimator.spectra.welch import CrossSpectra, SegmentSpectra, WelchSettings, kept_bins
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

Columns = tuple[int, ...]

LOW, HIGH = 0.2, 0.4  # octave of a stage, as fractions of its rate
TAPS = 89  # odd; stop-band from 0.3 of the rate above, 120 dB down
KAISER_BETA = 12.3
BLOCK = 64  # samples of the next stage that one product makes
PART_BINS, PART_BINS_BELOW = 96, 32
"""Frequencies of a stage that are kept in parts of time: from its octave on, and below it."""


@dataclass(frozen=True, slots=True)
class Band:
    """Contribution of one stage.

    Attributes
    ----------
    settings : WelchSettings
        Settings of the stage, with its own sampling rate.
    frequencies : float64, shape (n_freqs,)
        In Hz, ascending.
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided, in unit**2/Hz.
    n_segments : int
    n_effective : float
    left_out : Counter of Reason
        Segments of this stage that do not count for all channels: incomplete (GAP) or disturbed.
    parts : Parts or None
        The same averages in parts of time; None where they are not kept.
    """

    settings: WelchSettings
    frequencies: FloatArray
    csm: ComplexArray
    n_segments: int
    n_effective: float
    left_out: Counter[Reason] = field(default_factory=Counter)
    parts: Parts | None = None


class MultiResolution:
    """Cross-spectra of consecutive samples, octave by octave.

    Parameters
    ----------
    settings : WelchSettings
        Settings of the top stage, with the shortest segments.
    n_channels : int
    n_stages : int
        Number of stages; the longest segments are ``2**(n_stages - 1)`` times as long as the
        shortest.
    rejection : RejectionSettings, optional
        Criteria for disturbed segments; default: only incomplete segments are excluded.
    segments : SegmentSpectra, optional
        Receives the spectra of single segments of the top stage, as of `CrossSpectra`.
    """

    def __init__(
        self,
        settings: WelchSettings,
        n_channels: int,
        *,
        n_stages: int,
        rejection: RejectionSettings | None = None,
        segments: SegmentSpectra | None = None,
    ) -> None:
        if n_stages < 1:
            raise EstimatorError(f"{n_stages} stages: at least one is needed")
        if settings.segment_length < 16:
            raise EstimatorError(
                f"segment length {settings.segment_length}: an octave needs 16 samples or more"
            )
        self._stages = [
            _Stage(
                replace(settings, sampling_rate=settings.sampling_rate / 2**level),
                n_channels,
                rejection,
                segments if level == 0 else None,
            )
            for level in range(n_stages)
        ]

    def add(self, samples: FloatArray, present: BoolArray | None = None) -> None:
        """Add the next samples.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
            Contiguous with the previous samples, including gaps.
        present : bool, shape (n_samples, n_channels) or (n_samples,), optional
            Which channels have each sample; the second shape states it for all channels. Absent
            samples are not used.
        """
        samples = np.array(samples, dtype=np.float64)
        if present is None:
            present = np.ones(samples.shape, dtype=bool)
        self._stages[0].check(samples)
        if present.shape == samples.shape[:1]:
            present = np.repeat(present[:, None], samples.shape[1], axis=1)
        if present.shape != samples.shape:
            raise EstimatorError(
                f"presence of shape {present.shape}, expected {samples.shape} or"
                f" {samples.shape[:1]}"
            )
        samples[~present] = 0  # might be NaN, which would spread through the filter
        for stage in self._stages:
            stage.take(samples, present)
            if stage is not self._stages[-1]:
                samples, present = stage.halve(samples, present)

    @property
    def n_segments(self) -> int:
        """Number of accepted segments of the top stage."""
        return self._stages[0].total().n_segments

    @classmethod
    def like(cls, other: MultiResolution) -> MultiResolution:
        """Return an empty accumulator with the same settings and channels, to merge into."""
        top = other._stages[0]
        return cls(top.settings, top.n_channels, n_stages=len(other._stages))

    def merge(self, other: MultiResolution, *, later: float = 0.0, run: int = 0) -> None:
        """Add the accepted segments of another recording, which is number `run` of all.

        It begins `later` than the first one by so many seconds.

        Raises
        ------
        EstimatorError
            If settings, stages or channels differ, or this accumulator rejects segments itself.
        """
        if len(other._stages) != len(self._stages):
            raise EstimatorError(f"{len(other._stages)} stages, expected {len(self._stages)}")
        for own, added in zip(self._stages, other._stages, strict=True):
            own.merge(added, later=later, run=run)

    def rejected(self) -> list[tuple[int, int, int]]:
        """Return which samples the segments with transients have, and in which channel these are.

        Returns
        -------
        list of (int, int, int)
            First sample, the one after the last, and the channel, of each stage in turn.
        """
        found = []
        for level, stage in enumerate(self._stages):
            size, late = 2**level, TAPS // 2 * (2**level - 1)
            hop, length = stage.settings.hop, stage.settings.segment_length
            found += [
                (begin - late, begin - late + length * size, channel)
                for number, channel in stage.rejected()
                for begin in [number * hop * size]
            ]
        return found

    @property
    def sets(self) -> ChannelSets:
        """Segments of the top stage that only some channels have."""
        return self._stages[0].sets

    def depth(self, least_effective: float, columns: Columns | None = None) -> int:
        """Return how many stages, from the top, have enough averages.

        Parameters
        ----------
        least_effective : float
            Minimum number of effective averages of a stage.
        columns : tuple of int, optional
            Channels of a set of `sets`; default: segments that all channels have.
        """
        enough = (stage.n_effective(columns) >= max(least_effective, 1.0) for stage in self._stages)
        return sum(1 for _ in takewhile(bool, enough))

    def bands(
        self,
        least_effective: float = 1.0,
        *,
        columns: Columns | None = None,
        depth: int | None = None,
    ) -> tuple[Band, ...]:
        """Return the contributions of the stages, in ascending order of frequency.

        Parameters
        ----------
        least_effective : float
            Minimum number of effective averages of a stage. Stages with fewer are excluded.
        columns : tuple of int, optional
            Channels of a set of `sets`; default: segments that all channels have.
        depth : int, optional
            Number of stages that divide the frequencies; the lowest of these extends down to 0.
            Default: all that are not excluded. With more, the lowest frequencies are not among the
            bands.

        Raises
        ------
        InsufficientDataError
            If no stage has this number of averages.
        """
        own = self.depth(least_effective, columns)
        if not own:
            raise InsufficientDataError(
                f"no segment length has {least_effective:g} effective averages yet"
            )
        depth = own if depth is None else depth
        bands = []
        for level in reversed(range(min(own, depth))):
            stage = self._stages[level]
            frequencies = stage.settings.frequencies
            rate = stage.settings.sampling_rate
            inside = np.ones(len(frequencies), dtype=bool)
            if level > 0:
                inside &= frequencies <= HIGH * rate
            if level < depth - 1:
                inside &= frequencies > LOW * rate
            gain = np.ones(int(inside.sum()))
            for above in self._stages[:level]:
                gain *= _response(frequencies[inside], above.settings)
            spectra = stage.total(columns)
            csm = spectra.csm()[inside] / gain[:, None, None] ** 2
            bands.append(
                Band(
                    stage.settings,
                    frequencies[inside],
                    csm,
                    spectra.n_segments,
                    spectra.n_effective,
                    stage.left_out,
                    stage.parts(inside, gain) if columns is None else None,
                )
            )
        return tuple(bands)

    def top(self) -> Band:
        """Return the averages of the shortest segments, at some of all their frequencies.

        Among these are `estimator.spectra.welch.kept_bins`.

        Raises
        ------
        InsufficientDataError
            If there is no segment.
        """
        stage = self._stages[0]
        spectra, frequencies = stage.total(), stage.settings.frequencies
        inside = np.isin(np.arange(len(frequencies)), kept_bins(len(frequencies)))
        inside[stage.kept] = True
        return Band(
            stage.settings,
            frequencies[inside],
            spectra.csm()[inside],
            spectra.n_segments,
            spectra.n_effective,
            parts=stage.parts(inside, np.ones(int(inside.sum()))),
        )


class _Stage:
    """Adds segments at one rate, and computes the samples of the next stage."""

    def __init__(
        self,
        settings: WelchSettings,
        n_channels: int,
        rejection: RejectionSettings | None,
        segments: SegmentSpectra | None,
    ) -> None:
        self.settings = settings
        self.n_channels = n_channels
        self.incomplete = 0
        self.judged = 0
        self._begun = False
        self._ends = PartEnds(_kept_in_parts(len(settings.frequencies)))
        self._n_seen = 0
        self._parts: tuple[Part, ...] = ()  # of other recordings
        self._spectra = CrossSpectra(settings, n_channels, segments=segments, ends=self._ends)
        self._undisturbed: SelectedSpectra | None = None
        if rejection is not None:
            self._undisturbed = SelectedSpectra(
                settings, n_channels, rejection=rejection, segments=segments, ends=self._ends
            )
        self.sets = ChannelSets(settings, short=0.0, rejection=rejection)
        self._total: CrossSpectra | None = None
        self._samples = np.zeros((0, n_channels))  # start of the next segment
        self._present = np.zeros((0, n_channels), dtype=bool)
        # before the first sample, the filter treats the input as a gap
        tail = (TAPS - 1, n_channels)
        self._tail = np.zeros(tail), np.zeros(tail, dtype=bool)

    def check(self, samples: FloatArray) -> None:
        """Raise the errors of `take`."""
        self._spectra.check(samples, np.zeros(0, dtype=np.int64))

    def total(self, columns: Columns | None = None) -> CrossSpectra:
        """Return the spectra of the accepted segments of all channels, or of a set of them."""
        if columns is not None:
            found = self.sets.spectra.get(columns)
            return CrossSpectra(self.settings, len(columns)) if found is None else found
        if self._undisturbed is None:
            return self._spectra
        if self._total is None:
            self._total = self._undisturbed.spectra()
        return self._total

    def n_effective(self, columns: Columns | None) -> float:
        """Return the effective averages of `total`; 0 without segments."""
        total = self.total(columns)
        return total.n_effective if total.n_segments else 0.0

    @property
    def left_out(self) -> Counter[Reason]:
        """Segments that do not count for all channels."""
        disturbed = self.sets.n_disturbed
        transient = self.judged - self.total().n_segments + disturbed
        return Counter({Reason.GAP: self.incomplete - disturbed, Reason.TRANSIENT: transient})

    def rejected(self) -> list[tuple[int, int]]:
        """Return numbers of the segments with transients, and the channel with the largest."""
        found = () if self._undisturbed is None else self._undisturbed.all_rejected()
        return [(each.segment, each.channel) for each in found if each.channel is not None]

    @property
    def kept(self) -> IntArray:
        """Frequencies that are kept in parts."""
        return self._ends.bins

    def _own_parts(self) -> tuple[Part, ...]:
        """Return the averages of the accepted segments in parts of time."""
        return self._parts or self.total().parts(self._n_seen)

    def parts(self, inside: BoolArray, gain: FloatArray) -> Parts:
        """Return these at the frequencies `inside`, of which `gain` is taken out."""
        kept = inside[self._ends.bins]
        bins = (np.cumsum(inside) - 1)[self._ends.bins[kept]]
        response = np.repeat(gain[bins][:, None], self.n_channels, axis=1).astype(np.complex128)
        some = (part.at(kept) for part in self._own_parts())
        return Parts(bins, tuple(some), response)

    def merge(self, other: _Stage, *, later: float, run: int) -> None:
        """Add the segments of the same stage of another recording."""
        if self._undisturbed is not None:
            raise EstimatorError("segments of another recording cannot be judged by these")
        self._parts += tuple(
            replace(part, begin=part.begin + later, end=part.end + later, run=run)
            for part in other._own_parts()
        )
        self._spectra.merge(other.total())
        self.sets.merge(other.sets)
        disturbed = other.sets.n_disturbed
        self.incomplete += other.incomplete - disturbed
        self.judged += other.judged + disturbed

    def take(self, samples: FloatArray, present: BoolArray) -> None:
        """Test and add the segments completed by these samples."""
        self._samples = np.concatenate([self._samples, samples])
        self._present = np.concatenate([self._present, present])
        n = (len(self._samples) - self.settings.segment_length) // self.settings.hop + 1
        if n <= 0:
            return
        starts = np.arange(n) * self.settings.hop
        whole = _whole(self._present, starts, self.settings.segment_length).all(axis=1)
        if not self._begun:  # segments before the first sample are not lost
            some = np.flatnonzero(self._present.any(axis=1))
            first = int(some[0]) if len(some) else len(self._present)
            self.incomplete -= int(np.sum(starts < first))
            self._begun = first <= starts[-1]
        self.incomplete += n - int(whole.sum())
        self.judged += int(whole.sum())
        sums = self._spectra if self._undisturbed is None else self._undisturbed
        places = self._n_seen + np.flatnonzero(whole)
        for part in by_part(sums, places):
            sums.add(self._samples, starts[whole][part], places=places[part])
        self._n_seen += n
        self._total = None
        if not whole.all():
            self.sets.take(self._samples, self._present, None, starts[~whole])
        self._samples = self._samples[n * self.settings.hop :]
        self._present = self._present[n * self.settings.hop :]

    def halve(self, samples: FloatArray, present: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Return the new samples at half the rate, and which channels have them."""
        samples = np.concatenate([self._tail[0], samples])
        present = np.concatenate([self._tail[1], present])
        n = max(0, (len(samples) - TAPS) // 2 + 1)
        self._tail = samples[2 * n :], present[2 * n :]
        if n == 0:
            return samples[:0], present[:0]
        return _filtered(samples, n), _whole(present, 2 * np.arange(n), TAPS)


def _kept_in_parts(n_freqs: int) -> IntArray:
    """Return the frequencies of a stage that are kept in parts."""
    first = max(1, int(2 * LOW * (n_freqs - 1)))
    octave = np.linspace(first, n_freqs - 1, min(PART_BINS, n_freqs - first))
    below = np.geomspace(1, first, PART_BINS_BELOW)
    return np.unique(np.concatenate([below, octave]).round().astype(np.int64))


def _whole(present: BoolArray, starts: IntArray, length: int) -> BoolArray:
    """Return which channels have all of `length` samples from each start on."""
    if present.all():
        return np.ones((len(starts), present.shape[1]), dtype=bool)
    missing = np.zeros((len(present) + 1, present.shape[1]), np.int64)
    np.cumsum(~present, axis=0, out=missing[1:])
    return np.asarray(missing[starts + length] == missing[starts])


def _filtered(samples: FloatArray, n: int) -> FloatArray:
    """Return n samples at half the rate, shape (n, n_channels).

    But for the middle one, taps of a half-band filter are zero at every second sample. The others
    are a banded matrix, which is multiplied by stretches of every second sample.
    """
    length = BLOCK + TAPS // 2
    n_blocks = -(-n // BLOCK)
    others = np.zeros((n_blocks * BLOCK + TAPS // 2, samples.shape[1]))
    every_second = samples[(TAPS // 2 + 1) % 2 :: 2][: len(others)]
    others[: len(every_second)] = every_second
    stretches = np.lib.stride_tricks.sliding_window_view(others, length, axis=0)[::BLOCK]
    found = (_banded() @ stretches.swapaxes(1, 2)).reshape(-1, samples.shape[1])[:n]
    middle = samples[TAPS // 2 :: 2][:n]
    return np.asarray(found + _taps()[TAPS // 2] * middle)


@cache
def _banded() -> FloatArray:
    """Return the taps beside the middle one for `BLOCK` samples, one after the other."""
    others = _taps()[(TAPS // 2 + 1) % 2 :: 2]
    banded = np.zeros((BLOCK, BLOCK + TAPS // 2))
    for row in range(BLOCK):
        banded[row, row : row + len(others)] = others
    return banded


@cache
def _taps() -> FloatArray:
    """Return the half-band low-pass filter, with unit gain at 0 Hz."""
    n = np.arange(TAPS) - TAPS // 2
    taps = np.sinc(n / 2) * np.kaiser(TAPS, KAISER_BETA)
    return np.asarray(taps / taps.sum())


def _response(frequencies: FloatArray, settings: WelchSettings) -> FloatArray:
    """Return the gain of the filter after a stage; real, because the filter is symmetric."""
    n = np.arange(TAPS) - TAPS // 2
    phase = 2 * np.pi * frequencies[:, None] / settings.sampling_rate * n
    return np.asarray(np.cos(phase) @ _taps())
