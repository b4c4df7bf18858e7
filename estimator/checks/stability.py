"""Stability of a test: disturbed segments, and scatter between parts of a recording.

Averages of parts of time, of which `estimator.checks.steadiness` has the theory, show whether noise
and responses are steady. Where the noise changes, scores of shared noise and the model test scatter
more, by one factor a band. Single segments show disturbances.
"""

from __future__ import annotations

import functools
import math
import operator
from collections import Counter
from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from estimator.checks.band_steadiness import (
    LONG_TAILS,
    STRONG,
    BandSteadiness,
    band_steadiness,
    beside_weak_motion,
    is_weak_motion,
)
from estimator.checks.disturbed_segments import (
    FREQUENCIES,
    SegmentCourse,
    SegmentFindings,
    segment_findings,
)
from estimator.checks.loudness import Loudness
from estimator.checks.steadied import Steadied, steadied
from estimator.checks.steadiness import (
    FALSE_ALARM,
    MIN_DEGREES,
    MIN_PARTS,
    PartLevels,
    ResponseChange,
    response_change,
    variance_of_changes,
)
from estimator.likelihood.factor_analysis import Maximum
from estimator.likelihood.goodness_of_fit import critical_value
from estimator.likelihood.score_test import usable
from estimator.median import median
from estimator.records import NOT_IN_JSON, dataclass
from estimator.spectra.parts import Parts, grouped
from estimator.types import BoolArray, FloatArray, IntArray

MIN_SEGMENTS = 4
"""Minimum number of segments per part."""
LEAST_LEFT = 0.02
"""Share of the noise that gains add which change from segment to segment, to be named."""
DOUBT = 4.0
"""By which a doubtful noise may be wrong as the scale of a test."""
FEW = 10.0
"""Over the averages of a part, by how much its scores scatter more where the noise changes."""
CERTAIN, FAR = 4.0, 5.0
"""Standard errors by which one change of a sensor is larger than another, to be named for it; and
times by which one of some frequencies is."""
SECOND_ORDER = 4.0
"""Times the variance of a response between parts, a change is at most, squared. Scores are linear
in changes: the share of its statistic that may look like changes of other sensors."""
LEAST_OF = 0.1
"""Noise that changes of a sensor explain, over the most of any sensor, from which it is named."""
ALIKE_BESIDE = 0.4
"""Correlation of neighbouring frequencies, from which every second one tells nearly all of both."""
ALIKE = 0.25
"""What a gain or a turn adds, over what the median of the bands that show a change have, from which
it is a gain or a turn: the response changes otherwise, at some frequencies."""


@dataclass(frozen=True, slots=True)
class Scatter:
    """Standard deviation of the noise PSD between parts, as a fraction of the noise.

    Attributes
    ----------
    n_parts : int
        Number of parts.
    deviation : float64, shape (n_bands, n_channels)
        Standard deviation over the noise; NaN for bands that are not tested.
    expected : float64, shape (n_bands, n_channels)
        Expected deviation for steady noise.
    statistic : float64, shape (n_bands, n_channels)
        Bartlett's, chi-squared with ``n_parts - 1`` degrees for steady noise.
    """

    n_parts: int = field(metadata={"key": "parts"})
    deviation: FloatArray = field(metadata={"key": "deviation_share"})
    expected: FloatArray = field(metadata={"key": "expected_share"})
    statistic: FloatArray = field(metadata=NOT_IN_JSON)

    @classmethod
    def joined(cls, found: Sequence[Scatter]) -> Scatter:
        """Return the scatter of neighbouring ranges of frequencies, rising, as one."""
        return cls(
            max(each.n_parts for each in found),
            np.concatenate([each.deviation for each in found]),
            np.concatenate([each.expected for each in found]),
            np.concatenate([each.statistic for each in found]),
        )

    @classmethod
    def of(cls, levels: Sequence[PartLevels | None], n_channels: int) -> Scatter:
        """Return the scatter of the levels of each band; NaN where there are none."""
        unknown = np.full(n_channels, np.nan)
        return cls(
            max((len(each.level) for each in levels if each is not None), default=0),
            np.stack([unknown if each is None else each.deviation for each in levels]),
            np.stack([unknown if each is None else each.expected for each in levels]),
            np.stack([unknown if each is None else each.statistic for each in levels]),
        )

    @property
    def typically_expected(self) -> FloatArray:
        """Return medians of `expected` over the live channels, (n_bands,); NaN without any."""
        rows = [row[np.isfinite(row)] for row in self.expected]
        return np.array([median(row) if len(row) else np.nan for row in rows])

    def among(self, channels: Sequence[int], n_channels: int) -> Scatter:
        """Return the same with channels numbered among all, dead ones included."""
        deviation, expected, statistic = np.full((3, len(self.deviation), n_channels), np.nan)
        deviation[:, list(channels)] = self.deviation
        expected[:, list(channels)] = self.expected
        statistic[:, list(channels)] = self.statistic
        return replace(self, deviation=deviation, expected=expected, statistic=statistic)


@dataclass(frozen=True, slots=True)
class Stability:
    """Stability of a test.

    Attributes
    ----------
    low, high : float64, shape (n_bands,)
        First and last frequency of the bands, Hz.
    parts : Scatter
        Scatter between parts of equal length.
    runs : Scatter or None
        Scatter between recordings; None for one recording.
    inflations : float64, shape (n_bands,)
        Variance of the scores of pairs of channels over that for steady noise; 1 unless
        significantly more.
    changes : tuple of ResponseChange
        Responses that change, by sensor, the clearest first.
    added : float64, shape (n_channels,)
        What these changes add to the noise, as a fraction of the PSD of the motion.
    explained, within : float64, shape (n_bands, n_channels)
        Share of the noise that changes of any form between parts explain, where that is clear; and
        that may be left within parts by `steadied`, NaN without. Negative where noise is too low.
    n_segments : int
        Number of examined segments.
    disturbed : int64, shape (n_disturbed,)
        Indices of the disturbed segments.
    excess : float
        Noise added by these segments, as a fraction, for the worst band and channel.
    channel : int
        That channel.
    by_disturbed : float64, shape (n_channels,)
        Noise that they add to each, for the worst band; NaN where that is not known.
    is_restless : bool
        Whether the noise changes from segment to segment, at some frequencies.
    loudness : Loudness or None
        Of the noise, which all frequencies have in common; None where it is not known.
    steadied : tuple of Steadied or None
        Averages without the changes of responses, of each range of frequencies; None where nothing
        tells of any.
    single : SegmentFindings or None
        What single segments show, of the channels that move.
    """

    low: FloatArray = field(metadata={"key": "low_hz"})
    high: FloatArray = field(metadata={"key": "high_hz"})
    parts: Scatter
    runs: Scatter | None
    inflations: FloatArray = field(metadata=NOT_IN_JSON)
    changes: tuple[ResponseChange, ...] = field(metadata=NOT_IN_JSON)
    added: FloatArray = field(metadata=NOT_IN_JSON)
    explained: FloatArray = field(metadata=NOT_IN_JSON)
    within: FloatArray = field(metadata=NOT_IN_JSON)
    n_segments: int = field(metadata={"key": "segments"})
    disturbed: IntArray
    excess: float = field(metadata={"key": "excess_share"})
    channel: int
    by_disturbed: FloatArray = field(metadata=NOT_IN_JSON)
    is_restless: bool = field(default=False, metadata=NOT_IN_JSON)
    loudness: Loudness | None = field(default=None, metadata=NOT_IN_JSON)
    steadied: tuple[Steadied | None, ...] = field(default=(), metadata=NOT_IN_JSON)
    single: SegmentFindings | None = field(default=None, metadata=NOT_IN_JSON)

    @property
    def inflation(self) -> float:
        """The largest of `inflations`."""
        return float(self.inflations.max(initial=1.0))

    @classmethod
    def joined(cls, ranges: Sequence[Stability | None], n_sensors: int) -> Stability | None:
        """Return what neighbouring ranges of frequencies show, rising, as one; None of none.

        Of each sensor the clearest change of all counts, where it is clear among as many tests and
        a second range of frequencies shows one: a burst of motion can disturb one range alone.
        What one range alone shows is in `added`, so that intervals have it, and is no change.
        """
        found = [each for each in ranges if each is not None]
        if len(ranges) < 2 or not found:
            return found[0] if found else None
        alarm = FALSE_ALARM / (LONG_TAILS * n_sensors * len(found))
        seen = Counter(change.sensor for each in found for change in each.changes)
        clearest: dict[int, ResponseChange] = {}
        unsteady = {
            (gain.sensor, each.single.band)
            for each in found
            if each.single
            for gain in each.single.gains
        }
        is_added, second_order = False, 0.0
        for each in sorted((c for one in found for c in one.changes), key=lambda c: -c.statistic):
            most = critical_value(each.degrees, alarm) + second_order
            if (each.sensor, each.band) in unsteady:  # single segments are tested once
                most = 0.0
            if each.statistic <= most:
                continue
            if each.sensor in clearest:
                if _is_larger(each, abs(clearest[each.sensor].size)):
                    clearest[each.sensor] = each
                continue
            is_added = True
            if seen[each.sensor] > 1 or len(found) == 1 or each.band is not None:
                clearest[each.sensor] = each
                second_order += each.statistic * each.size**2
        runs = [each.runs for each in found if each.runs is not None]
        known = [each.loudness for each in found if each.loudness is not None]
        added = np.stack([each.added for each in found]).max(axis=0) * float(is_added)
        return replace(
            found[-1],
            low=np.concatenate([each.low for each in found]),
            high=np.concatenate([each.high for each in found]),
            parts=Scatter.joined([each.parts for each in found]),
            runs=Scatter.joined(runs) if len(runs) == len(found) else None,
            inflations=np.concatenate([each.inflations for each in found]),
            changes=tuple(clearest.values()),
            added=added,
            loudness=functools.reduce(Loudness.joined, known) if known else None,
            explained=np.concatenate([each.explained for each in found]),
            within=np.concatenate([each.within for each in found]),
            steadied=tuple(
                None if each is None or not each.steadied else each.steadied[0] for each in ranges
            )
            if clearest
            else (),
        )

    def inflation_at(self, frequency: FloatArray) -> FloatArray:
        """Return the inflation at frequencies, shape (n_freqs,); 1 outside of the bands."""
        return 1 + self._at(frequency, self.inflations[:, None] - 1)[:, 0]

    def changed_at(self, frequency: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the share of the noise that changes of responses may be, (n_freqs, n_channels).

        Negative where noise may be too low. Also returns where it is that within parts: there the
        averages are those of `steadied`. Octaves of too few averages for parts change as others.
        """
        within = np.isfinite(self.within) & any(self.steadied)
        share = np.where(within, self.within, self.explained)
        tested = self._at(frequency, np.ones_like(share)) > 0
        most = np.take_along_axis(
            self.explained, np.abs(self.explained).argmax(axis=0, keepdims=True), axis=0
        )
        found = np.where(tested, self._at(frequency, share), most)
        return found, self._at(frequency, within.astype(np.float64)) > 0

    def _at(self, frequency: FloatArray, values: FloatArray) -> FloatArray:
        """Return values of bands at frequencies; 0 outside of the bands."""
        place = np.maximum(np.searchsorted(self.low, frequency, side="right") - 1, 0)
        inside = (frequency >= self.low[place]) & (frequency <= self.high[place])
        return np.where(inside[:, None], values[place], 0.0)

    def among(self, channels: Sequence[int], sensors: Sequence[int], n_channels: int) -> Stability:
        """Return the same with channels and sensors numbered among all, dead ones included."""
        added, by_disturbed = np.zeros((2, n_channels))
        added[list(channels)], by_disturbed[list(channels)] = self.added, self.by_disturbed
        explained, within = np.zeros((2, len(self.low), n_channels))
        explained[:, list(channels)], within[:, list(channels)] = self.explained, self.within
        return replace(
            self,
            parts=self.parts.among(channels, n_channels),
            runs=None if self.runs is None else self.runs.among(channels, n_channels),
            channel=channels[self.channel],
            added=added,
            by_disturbed=by_disturbed,
            loudness=self.loudness and self.loudness.among(channels, n_channels),
            explained=explained,
            within=within,
            steadied=self.steadied if len(channels) == n_channels else (),
            changes=tuple(
                replace(
                    each,
                    sensor=sensors[each.sensor],
                    channel=None if each.channel is None else channels[each.channel],
                )
                for each in self.changes
            ),
        )


def _in_all_bands(
    explained: FloatArray,
    changes: Sequence[ResponseChange],
    dims: tuple[int, ...],
    whole: tuple[float, float],
) -> tuple[FloatArray, tuple[ResponseChange, ...]]:
    """Return what changes explain, also in bands whose few averages do not show it, and these."""
    sensor = np.repeat(np.arange(len(dims)), dims)
    moved = np.isin(sensor, [each.sensor for each in changes])
    found = tuple(replace(each, band=each.band and whole) for each in changes)
    return np.where(moved & (explained == 0), explained.max(axis=0), explained), found


def _groups(averages: FloatArray, q: int, n_channels: int) -> tuple[list[IntArray], bool]:
    """Return parts joined to groups, and whether these say only that responses change."""
    groups = grouped(averages, q + max(MIN_DEGREES, n_channels))
    if len(groups) >= MIN_PARTS:
        return groups, False
    return grouped(averages, max(q + MIN_DEGREES, float(averages.sum()) / FEW_PARTS)), True


def _by_run(parts: Parts, q: int) -> list[IntArray]:
    """Return the parts of each recording; nothing of one, or where one has too few averages."""
    runs = np.array([each.run for each in parts.each])
    found = [np.flatnonzero(runs == run) for run in sorted(set(runs.tolist()))]
    enough = all(parts.averages[run].sum() > q + MIN_DEGREES for run in found)
    return found if len(found) > 1 and enough else []


FEW_PARTS = 4
"""Parts of a short recording, in which each has fewer averages than channels."""


def stability(
    course: SegmentCourse | None,
    parts: Parts,
    maximum: Maximum,
    frequency: FloatArray,
    insides: Sequence[BoolArray],
    *,
    psd: FloatArray,
    dims: tuple[int, ...],
    n_effective: float,
    neighbours: FloatArray,
) -> Stability | None:
    """Compare segments, parts of a recording, and recordings with each other.

    Parameters
    ----------
    course : SegmentCourse or None
        Single segments, among which disturbed ones are looked for.
    parts : Parts
    maximum : Maximum
        Maximum of the likelihood for the averages, at all frequencies.
    frequency : float64, shape (n_freqs,)
        Hz.
    insides : sequence of bool, shape (n_freqs,)
        Frequencies of each band.
    psd : float64, shape (n_freqs, n_channels)
        Of the averages.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
        Number of independent averages of all segments.
    neighbours : float64, shape (n_lags,)
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.

    Returns
    -------
    Stability or None
        None with too few parts or frequencies.
    """
    places = np.flatnonzero(parts.bins < len(frequency))
    good, doubtful = _tested(maximum, parts.bins[places], n_effective)
    known = ~maximum.singular
    known[[0, -1]] = False  # real
    every, places = (places[each[parts.bins[places]]] for each in (known, good))
    averages = parts.averages
    q = maximum.n_factors
    groups, is_short = _groups(averages, q, maximum.psi.shape[1])
    if len(groups) < MIN_PARTS:
        return None
    by_run = _by_run(parts, q)
    n_channels = maximum.psi.shape[1]
    begin, end = np.array([(parts.each[i[0]].begin, parts.each[i[-1]].end) for i in groups]).T
    of_bands = functools.partial(
        band_steadiness,
        parts,
        psd=psd,
        groups=groups,
        by_run=by_run,
        correlation=np.concatenate([[1.0], neighbours, [0.0]]),
        dims=dims,
        frequency=frequency,
        burstiness=1.0 if course is None else course.burstiness,
    )
    some, whole = ([e[inside[parts.bins[e]]] for inside in insides] for e in (places, every))
    is_weak = [not doubtful and is_weak_motion(maximum.take(parts.bins[each])) for each in whole]
    step = float(frequency[1] - frequency[0])
    if len(neighbours) and neighbours[0] > ALIKE_BESIDE:
        some = [e[:: 1 + _are_close(frequency[parts.bins[e]], step)] for e in some]
    bands = of_bands(maximum, [e[:0] if weak else e for e, weak in zip(some, is_weak, strict=True)])
    for number in np.flatnonzero(is_weak).tolist():
        bands[number] = beside_weak_motion(of_bands, parts, maximum, whole[number], psd)
    found = [band for band in bands if band is not None]
    if doubtful:
        bands = [None if b is None else replace(b, levels=None, inflation=1.0) for b in bands]
    alarm = FALSE_ALARM / (n_channels * max(len(found), 1))
    explained = np.stack(
        [np.zeros(n_channels) if b is None else b.explained.where_clear(alarm) for b in bands]
    )
    suspect = bool(explained.any())
    levels = [None if band is None else band.levels for band in bands]
    changes, added = _changed(
        bands,
        dims,
        begin,
        end,
        least=min(float(averages[some].sum()) for some in groups),
        doubtful=doubtful and suspect,
    )
    low, high = np.array([frequency[inside][[0, -1]] for inside in insides]).T
    if suspect and not doubtful:
        changes, added = _also_by_band(
            (changes, added),
            bands,
            explained,
            _usual_noise(maximum, [inside & good for inside in insides]),
            edges=(low, high),
            dims=dims,
            time=(begin, end),
        )
    single = _of_segments(course, maximum, good, dims, begin=begin, psd=psd, frequency=frequency)
    if course is not None and course.findings is None:
        span, time = (float(low[0]), float(high[-1])), (float(begin[0]), float(end[-1]))
        single = replace(single, band=span, time=time)
    loudness = single.loudness.joined(Loudness.of_parts(parts, maximum, psd, good))
    without = (
        steadied(parts, maximum, psd, good=good, insides=insides)
        if (changes or suspect) and not is_short
        else None
    )
    changes, added, left = _and_unstable(
        (changes, added),
        single,
        maximum,
        [inside & maximum.converged & ~maximum.singular for inside in insides],
        dims,
    )
    explained = np.maximum(explained, left)
    if is_short:
        explained, changes = _in_all_bands(explained, changes, dims, (low[0], high[-1]))
    if without is not None:
        kept = np.array([not np.isin(some, without.left_out).any() for some in groups])
        if kept.sum() >= MIN_PARTS:
            bands = [None if band is None else band.of_parts(kept) for band in bands]
            levels = [None if band is None else band.levels for band in bands]
    elif not (changes or suspect or loudness.size.any() or single.disturbed.any()) and all(
        each is None for each in levels
    ):
        return None
    within = np.full_like(explained, np.nan) if without is None else without.within
    within[:, left.any(axis=0)] = np.nan  # parts do not show it
    return Stability(
        low=low,
        high=high,
        parts=Scatter.of(levels, n_channels),
        runs=(
            Scatter.of([None if band is None else band.of_runs for band in bands], n_channels)
            if by_run
            else None
        ),
        inflations=np.array([1.0 if band is None else band.inflation for band in bands]),
        changes=changes,
        added=added,
        explained=explained,
        within=within,
        n_segments=parts.n_segments,
        disturbed=np.flatnonzero(single.disturbed),
        excess=float(single.excess.max()),
        channel=int(single.excess.max(axis=0).argmax()),
        by_disturbed=single.excess.max(axis=0),
        is_restless=single.is_restless,
        loudness=loudness,
        steadied=() if without is None else (without,),
        single=single,
    )


def _of_segments(
    course: SegmentCourse | None,
    maximum: Maximum,
    good: BoolArray,
    dims: tuple[int, ...],
    **of_bench: FloatArray,
) -> SegmentFindings:
    """Return what single segments show, if there are enough."""
    if course is None or len(course.spectra) < MIN_SEGMENTS * MIN_PARTS:
        return SegmentFindings.none(0, dims)
    return segment_findings(course, maximum, good, dims, **of_bench)


def _are_close(frequency: FloatArray, step: float) -> bool:
    """Return whether enough frequencies for half of them are mostly neighbours."""
    few = len(frequency) < 2 * FREQUENCIES
    return not few and float(np.ptp(frequency)) < 1.5 * step * len(frequency)


def _usual_noise(maximum: Maximum, insides: Sequence[BoolArray]) -> list[FloatArray]:
    """Return the noise in the middle of bands as a share of the PSD, each (n_channels,)."""
    nothing = np.zeros(maximum.psi.shape[1])
    return [median(maximum.psi[inside]) if inside.any() else nothing for inside in insides]


def _tested(maximum: Maximum, bins: IntArray, n_effective: float) -> tuple[BoolArray, bool]:
    """Return where residuals are tested, shape (n_freqs,), and whether their noise is in doubt."""
    good, strong = usable(maximum, n_effective), maximum.converged & ~maximum.singular
    # the noise of a sensor may seem to be zero where all others change
    strong &= maximum.eigenvalues[:, maximum.n_factors - 1] > STRONG
    few, some = good[bins].sum() < FREQUENCIES, strong[bins].sum() >= FREQUENCIES
    return (strong, True) if few and some else (good, False)


def _and_unstable(
    known: tuple[tuple[ResponseChange, ...], FloatArray],
    single: SegmentFindings,
    maximum: Maximum,
    insides: Sequence[BoolArray],
    dims: tuple[int, ...],
) -> tuple[tuple[ResponseChange, ...], FloatArray, FloatArray]:
    """Return changes with those of gains that change within parts of time, in their place.

    With what changes add to the motion's PSD, as from `_changed`, and what such gains add to the
    noise, as a share, shape (n_bands, n_channels).
    """
    changes, added = known
    left, nothing = np.full((len(insides), sum(dims)), np.nan), np.zeros(sum(dims))
    for number, inside in enumerate(insides if single.gains else ()):
        if inside.any():
            at = maximum.take(np.flatnonzero(inside))
            motion = (np.abs(at.eigenvectors) ** 2 @ at.eigenvalues[:, :, None])[:, :, 0]
            noise = np.einsum("fpp->fp", at.rest).real
            more = np.stack([sum((g.added(m) for g in single.gains), nothing) for m in motion])
            left[number] = median(more / np.where(more > 0, noise, 1.0))
    if np.isnan(left).all():
        return changes, added, np.zeros_like(left)
    left = np.where(np.isnan(left), np.nanmax(left, axis=0), left)
    begin, end = single.time
    for each in single.gains:
        own = [a for a, _, _ in each.pairs]
        if left[:, own].max() <= LEAST_LEFT:
            left[:, own] = 0.0
            continue
        size = math.sqrt(each.variance)
        added = np.maximum(added, each.added(nothing + 1))
        if any(e.sensor == each.sensor and _is_larger(e, size) for e in changes):
            continue
        change = ResponseChange(
            sensor=each.sensor,
            channel=each.pairs[0][0] if each.channel is not None else None,
            is_turn=each.is_turn,
            size=size,
            error=size / (2 * each.sure),
            begin=begin,
            end=end,
            statistic=each.sure**2,
            degrees=1.0,
            band=single.band,
        )
        changes = (change, *(e for e in changes if e.sensor != each.sensor))
    return changes, added, left


def _is_larger(change: ResponseChange, size: float) -> bool:
    """Return whether a change is certainly larger than another of the same sensor.

    Of some frequencies, it is if it is far larger.
    """
    least = size if change.band is None else FAR * size
    return abs(change.size) - CERTAIN * change.error > least


def _also_by_band(
    known: tuple[tuple[ResponseChange, ...], FloatArray],
    bands: Sequence[BandSteadiness | None],
    explained: FloatArray,
    noise: Sequence[FloatArray],
    *,
    edges: tuple[FloatArray, FloatArray],
    dims: tuple[int, ...],
    time: tuple[FloatArray, FloatArray],
) -> tuple[tuple[ResponseChange, ...], FloatArray]:
    """Return the known changes that explain noise of the bands, and others of some bands.

    With what they add as a fraction of the motion's PSD: both as from `_changed`. `noise` of a band
    is a share of the PSD of its channels, `edges` are the frequencies of bands in Hz, `time` is
    that of parts in s.
    """
    changes, added = known
    first = np.cumsum([0, *dims])
    share = np.clip(noise, 0.0, 0.5)
    of_motion = np.maximum(explained, 0.0) * share / (1 - share)
    most = np.maximum.reduceat(of_motion, first[:-1], axis=1)
    seen = most.max(axis=0) > LEAST_OF * most.max()
    usual = median(most[explained.any(axis=1)])
    is_large = np.maximum.reduceat(added, first[:-1]) > ALIKE * usual
    found = [each for each in changes if seen[each.sensor] and is_large[each.sensor]]
    named = {each.sensor for each in found}
    added = added * np.repeat([number in named for number in range(len(dims))], dims)
    worst = np.where(explained.any(axis=1), most.argmax(axis=1), -1)
    for sensor in sorted({*worst.tolist()} - {-1, *named}):
        own = np.flatnonzero(worst == sensor)
        at = int(own[most[own, sensor].argmax()])
        band = bands[at]
        if not seen[sensor] or band is None or band.responses is None:
            continue
        channels = slice(first[sensor], first[sensor + 1])
        added[channels] = of_motion[at, channels]
        size = math.sqrt(added[channels].max())
        span = float(edges[0][own[0]]), float(edges[1][own[-1]])
        alike = response_change(band.responses, sensor, *time, 0, kept=band.responses.kept)
        whole = float(time[0][0]), float(time[1][-1])
        found.append(replace(band.change(alike, whole, size), band=span))
    return tuple(found), added


def _changed(
    bands: Sequence[BandSteadiness | None],
    dims: tuple[int, ...],
    begin: FloatArray,
    end: FloatArray,
    *,
    least: float,
    doubtful: bool,
) -> tuple[tuple[ResponseChange, ...], FloatArray]:
    """Return the responses that change, and what this adds as a fraction of the motion's PSD.

    The fraction has the shape (n_channels,).

    Noise that changes, in any channel, scatters the scores more: they are weighted by the part's
    loudest channel where the noise of the band is not steady, beside what such noise adds on
    average; with the `least` averages of a part, this is known to first order. Where the noise is
    `doubtful`, it is a scale but for a factor.
    """
    n_parts, doubt = len(begin), DOUBT if doubtful else 1.0
    found = []
    for band in bands:
        if band is None or band.responses is None or (band.levels is None and not doubtful):
            continue
        responses = band.responses
        if band.levels is not None:
            # both: levels that are hardly known are below zero at times, and have no logarithm
            linear = (n_parts - 1) * (band.levels.deviation / band.levels.expected) ** 2
            most = critical_value(n_parts - 1, FALSE_ALARM)
            unsteady = np.minimum(band.levels.statistic, linear) > most
            if unsteady.any():
                level = np.maximum(1.0, band.levels.level[:, unsteady].max(axis=1))
                responses = responses.beside_noise(unsteady).weighted(level)
                doubt = max(doubt, 1 + FEW / least)
        found.append(responses)
    if not found:
        return (), np.zeros(sum(dims))
    total = functools.reduce(operator.add, found)
    if doubt > 1 and not doubtful:  # the mean of others is zero
        total = total.centred()
    added = np.zeros(sum(dims))
    first = np.cumsum([0, *dims])
    changes = []
    left = list(range(len(dims)))
    taken: list[int] = []
    second_order = 0.0
    while len(left) > 1:
        tests = {number: total.test(number, taken) for number in left}
        strength = {
            number: (chi - df) / math.sqrt(2 * max(df, 1)) for number, (chi, df) in tests.items()
        }
        for sensor in sorted(left, key=strength.__getitem__, reverse=True):
            chi, df = tests[sensor]
            most = critical_value(df, FALSE_ALARM / len(dims)) if df > 0 else math.inf
            most = doubt * most + second_order
            if chi > most and chi > most + total.leaked(sensor, taken):
                break
        else:
            break
        own = total.without(taken)
        change = response_change(own, sensor, begin, end, int(first[sensor]), kept=total.kept)
        changes.append(change)
        added[first[sensor] : first[sensor + 1]] = variance_of_changes(own, sensor)
        second_order += SECOND_ORDER * chi * float(added[first[sensor] : first[sensor + 1]].max())
        left.remove(sensor)
        taken.append(sensor)
    return tuple(changes), added
