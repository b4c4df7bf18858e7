"""Stability of a test: disturbed segments, and scatter between parts of a recording.

Averages of parts of time, of which `estimator.checks.steadiness` has the theory, show whether noise
and responses are steady. Where the noise changes, scores of shared noise and the model test scatter
more, by one factor a band. Single segments show disturbances.
"""

from __future__ import annotations

import copy
import functools
import math
import operator
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimator.checks.steadied import LEAST_MOTION, Steadied, steadied
from estimator.checks.steadiness import (
    FALSE_ALARM,
    MIN_DEGREES,
    MIN_PARTS,
    VALUES_AT_ONCE,
    PartLevels,
    Regression,
    ResponseChange,
    ResponseScores,
    noise_levels,
    regression,
    response_change,
    variance_of_changes,
)
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum, maximise
from estimator.likelihood.goodness_of_fit import critical_value
from estimator.likelihood.score_test import usable
from estimator.median import median
from estimator.records import NOT_IN_JSON, dataclass
from estimator.spectra.parts import Parts, grouped
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MIN_SEGMENTS = 4
"""Minimum number of segments per part."""
FREQUENCIES = 8
"""Number of frequencies per group of residuals."""
DISTURBED = 8.0
"""Residuals of a group from which a segment is disturbed, in standard deviations by the median."""
RESTLESS = 3.0
"""Scatter of single segments over that of steady noise, from which none is disturbed."""
KNOWN = 0.5
"""Standard error of the noise of a part, as a fraction, up to which its changes count."""
MAX_DISTURBED = 0.2
"""Maximum share of disturbed segments; with more, the noise changes and no segment is excluded."""
PAIR_BYTES = 1 << 24
"""Bytes of products of pairs of channels with all others that exist together: 16 MB."""
SIGNIFICANCE = 3.0
"""Standard errors by which scatter must exceed its expectation to be significant."""
LONG_TAILS = 100.0
"""By which alarms of several ranges of frequencies are rarer: parts have few averages in each."""
SURE = 5.0
"""Standard errors that a change of some frequencies has at least, to be dated."""
DOUBT = 4.0
"""By which a doubtful noise may be wrong as the scale of a test."""
SECOND_ORDER = 4.0
"""Times the variance of a response between parts, a change is at most, squared. Scores are linear
in changes: the share of its statistic that may look like changes of other sensors."""
LEAST_OF = 0.1
"""Noise that changes of a sensor explain, over the most of any sensor, from which it is named."""
ALIKE = 0.25
"""What a gain or a turn adds, over what the median of the bands that show a change have, from which
it is a gain or a turn: the response changes otherwise, at some frequencies."""
STRONG = 100.0
"""Motion over noise from which changes of responses are suspected without a noise that is known."""
LEAST_SHARE = 0.01
"""Share of a channel beside the motion, from which what its regression explains counts."""
ADDED = 0.05
"""Share of the noise that changes of responses add, from which a band shows them."""
BEYOND_GUSTS = 5.0
"""Motion and noise over noise, to which noise that changes does not come by scatter."""
LEAKS = 0.85
"""Coherency of two channels, from which a response that varies over a band leaves motion beside its
mean."""
WEAK = 0.4
"""The same, below which motion is no matter where noise is tested."""
LEFT = 5.0
"""Changes of the noise of a part, over those of motion that is left beside the directions of a
band, that this motion may explain: its power is up to twice what channels share of it."""
CONFIRMED = 0.5
"""Power of a direction at other frequencies, over the least of both, if it is of motion."""
LEAST_DEGREES = 8.0
"""Degrees of freedom of the noise of a part from which a band is tested."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentCourse:
    """Spectra of single segments at a few frequencies.

    Attributes
    ----------
    spectra : complex, shape (n_segments, n_kept, n_channels)
        In order of time, in any unit.
    bins : int64, shape (n_kept,)
        Their indices among the frequencies of the averages.
    times : float64, shape (n_segments,)
        Start time of each segment, s.
    runs : int64, shape (n_segments,)
        Index of each segment's recording, from 0.
    """

    spectra: NDArray[np.complexfloating]
    bins: IntArray
    times: FloatArray
    runs: IntArray


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
    is_restless : bool
        Whether the noise changes from segment to segment, at some frequencies.
    steadied : tuple of Steadied or None
        Averages without the changes of responses, of each range of frequencies; None where nothing
        tells of any.
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
    is_restless: bool = field(default=False, metadata=NOT_IN_JSON)
    steadied: tuple[Steadied | None, ...] = field(default=(), metadata=NOT_IN_JSON)

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
        is_added, second_order = False, 0.0
        for each in sorted((c for one in found for c in one.changes), key=lambda c: -c.statistic):
            most = critical_value(each.degrees, alarm) + second_order
            if each.sensor in clearest or each.statistic <= most:
                continue
            is_added = True
            if seen[each.sensor] > 1 or len(found) == 1 or each.band is not None:
                clearest[each.sensor] = each
                second_order += each.statistic * each.size**2
        runs = [each.runs for each in found if each.runs is not None]
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
        averages are those of `steadied`.
        """
        within = np.isfinite(self.within) & any(self.steadied)
        share = np.where(within, self.within, self.explained)
        return self._at(frequency, share), self._at(frequency, within.astype(np.float64)) > 0

    def _at(self, frequency: FloatArray, values: FloatArray) -> FloatArray:
        """Return values of bands at frequencies; 0 outside of the bands."""
        place = np.maximum(np.searchsorted(self.low, frequency, side="right") - 1, 0)
        inside = (frequency >= self.low[place]) & (frequency <= self.high[place])
        return np.where(inside[:, None], values[place], 0.0)

    def among(self, channels: Sequence[int], sensors: Sequence[int], n_channels: int) -> Stability:
        """Return the same with channels and sensors numbered among all, dead ones included."""
        added = np.zeros(n_channels)
        added[list(channels)] = self.added
        explained, within = np.zeros((2, len(self.low), n_channels))
        explained[:, list(channels)], within[:, list(channels)] = self.explained, self.within
        return replace(
            self,
            parts=self.parts.among(channels, n_channels),
            runs=None if self.runs is None else self.runs.among(channels, n_channels),
            channel=channels[self.channel],
            added=added,
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
    groups = grouped(averages, q + max(MIN_DEGREES, maximum.psi.shape[1]))
    if len(groups) < MIN_PARTS:
        return None
    runs = np.array([each.run for each in parts.each])
    by_run = [np.flatnonzero(runs == run) for run in sorted(set(runs.tolist()))]
    several = len(by_run) > 1 and all(averages[run].sum() > q + MIN_DEGREES for run in by_run)
    n_channels = maximum.psi.shape[1]
    begin = np.array([parts.each[some[0]].begin for some in groups])
    end = np.array([parts.each[some[-1]].end for some in groups])
    correlation = np.concatenate([[1.0], neighbours, [0.0]])
    of_band = functools.partial(
        _band,
        parts,
        psd=psd,
        groups=groups,
        by_run=by_run if several else [],
        correlation=correlation,
        dims=dims,
    )
    bands = []
    for inside in insides:
        some, whole = (each[inside[parts.bins[each]]] for each in (places, every))
        if not doubtful and _is_weak(maximum.take(parts.bins[whole])):
            bands.append(_of_weak_motion(of_band, parts, maximum, whole, psd))
        else:
            bands.append(of_band(maximum, some))
    found = [band for band in bands if band is not None]
    if doubtful:
        bands = [None if band is None else replace(band, levels=None) for band in bands]
    alarm = FALSE_ALARM / (n_channels * max(len(found), 1))
    explained = np.stack(
        [np.zeros(n_channels) if b is None else b.explained.where_clear(alarm) for b in bands]
    )
    suspect = bool(explained.any())
    levels = [None if band is None else band.levels for band in bands]
    changes, added = _changed(bands, dims, begin, end, doubtful=doubtful and suspect)
    low = np.array([frequency[inside][0] for inside in insides])
    high = np.array([frequency[inside][-1] for inside in insides])
    if suspect and not doubtful:
        noise = [
            median(maximum.psi[inside & good]) if (inside & good).any() else np.zeros(n_channels)
            for inside in insides
        ]
        changes, added = _also_by_band(
            (changes, added),
            bands,
            explained,
            noise,
            edges=(low, high),
            dims=dims,
            time=(begin, end),
        )
    without = None
    if changes or suspect:
        without = steadied(parts, maximum, psd, good=good, insides=insides)
    if without is not None:
        kept = np.array([not np.isin(some, without.left_out).any() for some in groups])
        if kept.sum() >= MIN_PARTS:
            bands = [None if band is None else band.of_parts(kept) for band in bands]
            levels = [None if band is None else band.levels for band in bands]
    elif not (changes or suspect) and all(each is None for each in levels):
        return None
    out, excess, is_restless = np.zeros(0, np.bool_), np.zeros((1, n_channels)), False
    if course is not None and len(course.spectra) >= MIN_SEGMENTS * MIN_PARTS:
        out, excess, is_restless = _disturbed_segments(course, maximum, good)
    return Stability(
        low=low,
        high=high,
        parts=Scatter.of(levels, n_channels),
        runs=(
            Scatter.of([None if band is None else band.of_runs for band in bands], n_channels)
            if several
            else None
        ),
        inflations=np.array([1.0 if band is None else band.inflation for band in bands]),
        changes=changes,
        added=added,
        explained=explained,
        within=np.full_like(explained, np.nan) if without is None else without.within,
        n_segments=parts.n_segments,
        disturbed=np.flatnonzero(out),
        excess=float(excess.max()),
        channel=int(excess.max(axis=0).argmax()),
        is_restless=is_restless,
        steadied=() if without is None else (without,),
    )


def _tested(maximum: Maximum, bins: IntArray, n_effective: float) -> tuple[BoolArray, bool]:
    """Return where residuals are tested, shape (n_freqs,), and whether their noise is in doubt."""
    good, strong = usable(maximum, n_effective), maximum.converged & ~maximum.singular
    # the noise of a sensor may seem to be zero where all others change
    strong &= maximum.eigenvalues[:, maximum.n_factors - 1] > STRONG
    few, some = good[bins].sum() < FREQUENCIES, strong[bins].sum() >= FREQUENCIES
    return (strong, True) if few and some else (good, False)


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """What the parts show of one band; `levels` are None where they are too uncertain."""

    explained: _Explained
    levels: PartLevels | None
    of_runs: PartLevels | None
    scores: _Scores
    responses: ResponseScores

    def change(
        self, sensor: int, begin: FloatArray, end: FloatArray, *, size: float
    ) -> ResponseChange:
        """Return a change of this band alone, of any form: of `size` rms."""
        found = response_change(self.responses, sensor, begin, end, 0)
        if abs(found.size) < SURE * found.error:
            found = replace(found, begin=float(begin[0]), end=float(end[-1]))
        explained = self.explained
        statistic, degrees = explained.clearest
        return replace(
            found,
            channel=None,
            is_turn=False,
            size=size,
            error=size * math.sqrt(degrees / 2) / (statistic - degrees),
            statistic=statistic,
            degrees=degrees,
        )

    @property
    def is_unsteady(self) -> bool:
        """Whether the noise of a channel changes."""
        if self.levels is None:
            return False
        alarm = FALSE_ALARM / (LONG_TAILS * self.levels.level.shape[1])
        most = critical_value(len(self.levels.level) - 1, alarm)
        return bool((self.levels.statistic > most).any())

    @property
    def is_of_motion(self) -> bool:
        """Whether motion that is left may be what changes."""
        if self.levels is None:
            return False
        more = self.levels.deviation**2 - self.levels.expected**2
        return bool(0 < more.max() < (LEFT * self.scores.left) ** 2)

    @property
    def inflation(self) -> float:
        """Variance of the scores of pairs over that for steady noise; 1 where it is not known."""
        return 1.0 if self.levels is None else self.scores.inflation(self.levels)

    def of_parts(self, some: BoolArray) -> _Band:
        """Return what some parts show of the noise."""
        if self.levels is None:
            return self
        levels = PartLevels(self.levels.level[some], self.levels.degrees[some])
        return replace(self, levels=levels, scores=self.scores.of_parts(some))


def _is_weak(maximum: Maximum) -> bool:
    """Return whether noise that changes may seem to be directions of the motion of a band."""
    strength = maximum.eigenvalues[~maximum.boundary.any(axis=1), maximum.n_factors - 1]
    return not len(strength) or bool(median(strength) < BEYOND_GUSTS)


def _of_weak_motion(
    of_band: Callable[..., _Band | None],
    parts: Parts,
    maximum: Maximum,
    places: IntArray,
    psd: FloatArray,
) -> _Band | None:
    """Return what the parts show of a band whose noise may look like motion where it changes.

    Directions of the motion are those of the mean of the frequencies, as many as each half of these
    shows and the other confirms: the scatter of noise differs between frequencies. None where
    directions of the motion differ, too, so that what changes may be motion that these leave.
    """
    bins = parts.bins[places]
    if len(places) < FREQUENCIES // 2 or (psd[bins] <= 0).any():
        return None
    (whole,) = parts.joined(places, [np.arange(len(parts.each))]).csm
    root = np.sqrt(psd[bins])
    whole = whole / root[:, :, None] / root[:, None, :]
    halves = [some.mean(axis=0) for some in np.array_split(whole, 2)]  # neighbours are correlated
    both = whole.mean(axis=0, keepdims=True)
    shared = np.abs(both[0] - np.eye(both.shape[1])).max()
    q = maximum.n_factors
    found_in = [np.linalg.eigh(half) for half in halves]
    least = np.minimum(found_in[0][0], found_in[1][0]) - 1
    for (_, u), other in zip(found_in, halves[::-1], strict=True):
        again = np.einsum("pa,pq,qa->a", u.conj(), other, u).real
        confirmed = (again - 1 > CONFIRMED * least) & (least > 0)
        q = int(np.cumprod(confirmed[::-1][:q]).sum())
    found = maximise(both, q)
    if found.boundary.any() and shared < WEAK:  # by scatter
        found = maximise(both, 0)
    if shared > LEAKS or not found.converged[0] or found.boundary.any():
        return None
    band = of_band(found, places, is_weak=True)
    if band is None or band.is_of_motion:
        return None
    if found.n_factors and band.is_unsteady:  # its scatter may be in these
        still = of_band(maximise(both, 0), places, is_weak=True)
        return band if still is None else replace(band, scores=still.scores)
    return band


def _band(
    parts: Parts,
    maximum: Maximum,
    places: IntArray,
    *,
    psd: FloatArray,
    is_weak: bool = False,
    groups: Sequence[IntArray],
    by_run: Sequence[IntArray],
    correlation: FloatArray,
    dims: tuple[int, ...],
) -> _Band | None:
    """Return what the parts show at some of their frequencies; None where that is too little.

    Weak motion shows no response.
    """
    if not len(places):
        return None
    at_once = max(1, VALUES_AT_ONCE // (len(parts.each) * sum(dims) ** 2))
    q = max(1, maximum.n_factors)
    levels, of_runs, responses = [], [], []
    scores = _Scores(len(groups), sum(dims))
    spread, beside = 0.0, np.zeros(sum(dims))
    power, noise = np.zeros((2, len(groups), sum(dims)))
    squares = np.zeros((sum(dims), sum(dims)))
    for some in np.array_split(places, -(-len(places) // at_once)):
        bins = parts.bins[some]
        lags = np.minimum(np.abs(bins[:, None] - bins), len(correlation) - 1)
        divided, own = parts.joined(some, groups), correlation[lags]
        at = maximum.take(np.zeros_like(bins) if is_weak else bins)
        if not np.isfinite(divided.csm).all():
            return None
        found = regression(divided, at, psd[bins])
        own_beside = np.einsum("fpp->p", found.projector).real
        level = np.einsum("kfpp->kp", found.covariance)
        motion = np.einsum("kfaa->k", found.motion).real / (found.averages + q) / (q * len(some))
        used = (motion > LEAST_MOTION * (level / own_beside).max(axis=1)) & (not is_weak)
        beside += own_beside / len(places)
        if used.any():
            power += found.explained(used) / len(places)
            noise += level * used[:, None] / len(places)
        squares += (np.abs(found.projector) ** 2).sum(axis=0)
        spread += own.sum()
        piece = noise_levels(found, own)
        levels.append(piece)
        scores.add(found, own, np.repeat(np.arange(len(dims)), dims) if is_weak else None)
        each = ResponseScores(dims, len(groups))
        if not is_weak:
            each.add(found, own)
        responses.append(each)
        if by_run:
            of_run = regression(parts.joined(some, by_run), at, psd[bins])
            of_runs.append(noise_levels(of_run, own))
    whole = PartLevels.joined(levels)
    known = median(np.ravel(whole.degrees)) >= LEAST_DEGREES
    total = parts.averages.sum()
    # few averages of noise that changes look like a response, unless the motion is far stronger
    strong = not is_weak and median(maximum.eigenvalues[parts.bins[places], q - 1]) > STRONG
    more = scores.inflation(whole) if known else 1.0 if strong else np.inf
    power, scatter = power.sum(axis=0) / total, more * q * noise.sum(axis=0) / total
    n_alike = noise.sum(axis=0) ** 2 / np.maximum((noise**2).sum(axis=0), np.finfo(np.float64).tiny)
    return _Band(
        _Explained(
            power=power,
            scatter=scatter,
            beside=beside,
            added=len(places) * fisher.covariance(squares[None])[0] @ (power - scatter),
            degrees=2 * len(places) ** 2 / spread * float(n_alike.min()) * q,
            left=total / len(groups) / q - 1,
        ),
        whole if known else None,
        PartLevels.joined(of_runs) if of_runs and known else None,
        scores,
        functools.reduce(operator.add, responses),
    )


@dataclass(frozen=True, slots=True)
class _Explained:
    """What changes of responses of any form explain of a band, between parts.

    Attributes
    ----------
    power, scatter : float64, shape (n_channels,)
        What regressions explain beside the motion, and what they explain by scatter.
    beside : float64, shape (n_channels,)
        Share of the noise of a channel beside the motion.
    added : float64, shape (n_channels,)
        What the difference adds to the noise, as a share.
    degrees : float
        Of freedom of the power.
    left : float
        Degrees of freedom that scatter is measured by, over those.
    """

    power: FloatArray
    scatter: FloatArray
    beside: FloatArray
    added: FloatArray
    degrees: float
    left: float

    @property
    def clearest(self) -> tuple[float, float]:
        """The largest statistic of any channel, as chi-squared, and its degrees of freedom.

        A channel counts whose noise is seen beside the motion, and grows by `ADDED` at least.
        """
        degrees = self.degrees * self.left / (1 + self.left)
        much = self.power - self.scatter > ADDED * self.scatter * (1 + self.left)
        much &= self.beside > LEAST_SHARE
        return degrees * float((self.power[much] / self.scatter[much]).max(initial=1.0)), degrees

    def where_clear(self, alarm: float) -> FloatArray:
        """Return what is added to the noise, shape (n_channels,); zero where that is by chance."""
        statistic, degrees = self.clearest
        is_clear = degrees > 0 and statistic > critical_value(degrees, alarm)
        return np.nan_to_num(self.added) if is_clear else np.zeros_like(self.added)


def _also_by_band(
    known: tuple[tuple[ResponseChange, ...], FloatArray],
    bands: Sequence[_Band | None],
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
    alike = np.maximum.reduceat(added, first[:-1]) > ALIKE * usual
    found = [each for each in changes if seen[each.sensor] and alike[each.sensor]]
    named = {each.sensor for each in found}
    added = added * np.repeat([number in named for number in range(len(dims))], dims)
    worst = np.where(explained.any(axis=1), most.argmax(axis=1), -1)
    for sensor in sorted({*worst.tolist()} - {-1, *named}):
        own = np.flatnonzero(worst == sensor)
        at = int(own[most[own, sensor].argmax()])
        band = bands[at]
        if not seen[sensor] or band is None:
            continue
        channels = slice(first[sensor], first[sensor + 1])
        added[channels] = of_motion[at, channels]
        size = math.sqrt(added[channels].max())
        span = float(edges[0][own[0]]), float(edges[1][own[-1]])
        found.append(replace(band.change(sensor, *time, size=size), band=span))
    return tuple(found), added


def _changed(
    bands: Sequence[_Band | None],
    dims: tuple[int, ...],
    begin: FloatArray,
    end: FloatArray,
    *,
    doubtful: bool,
) -> tuple[tuple[ResponseChange, ...], FloatArray]:
    """Return the responses that change, and what this adds as a fraction of the motion's PSD.

    The fraction has the shape (n_channels,).

    Noise that changes, in any channel, scatters the scores more: they are weighted by the part's
    loudest channel where the noise of the band is not steady. Where the noise is `doubtful`, it is
    a scale but for a factor.
    """
    n_parts = len(begin)
    total = ResponseScores(dims, n_parts)
    for band in bands:
        if band is None or (band.levels is None and not doubtful):
            continue
        if band.levels is None:
            total = total + band.responses
            continue
        unsteady = band.levels.statistic > critical_value(n_parts - 1, FALSE_ALARM)
        level, responses = np.ones(n_parts), band.responses
        if unsteady.any():
            level = np.maximum(1.0, band.levels.level[:, unsteady].max(axis=1))
            responses = responses.beside_noise(unsteady)
        total = total + responses.weighted(level)
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
        sensor = max(strength, key=lambda each: strength[each])
        chi, df = tests[sensor]
        most = critical_value(df, FALSE_ALARM / len(dims)) if df > 0 else math.inf
        if not chi > (DOUBT if doubtful else 1.0) * most + second_order:
            break
        own = total.without(taken)
        change = response_change(own, sensor, begin, end, int(first[sensor]))
        changes.append(change)
        added[first[sensor] : first[sensor + 1]] = variance_of_changes(own, sensor)
        second_order += SECOND_ORDER * chi * float(added[first[sensor] : first[sensor + 1]].max())
        left.remove(sensor)
        taken.append(sensor)
    return tuple(changes), added


def _disturbed_segments(
    course: SegmentCourse, maximum: Maximum, good: BoolArray
) -> tuple[BoolArray, FloatArray, bool]:
    """Return which segments are disturbed, the noise they add, and whether others change, too.

    The noise has the shape (n_groups, n_channels). Where it changes all the time, at some
    frequencies, segments are not disturbed.
    """
    there = np.flatnonzero(course.bins < len(good))
    there = there[good[course.bins[there]]]
    bins = course.bins[there]
    none = np.zeros(len(course.spectra), np.bool_), np.zeros((1, maximum.psi.shape[1]))
    if len(bins) < FREQUENCIES:
        return *none, False
    at = maximum.take(bins)
    groups = np.array_split(np.arange(len(bins)), len(bins) // FREQUENCIES)
    residuals = _Residuals(course, there, at, groups)
    own = np.einsum("fpp->fp", residuals.projector).real
    out, calm = _disturbed(residuals, np.array([own[group].sum() for group in groups]))
    if not out.any():
        return *none, not calm.all()
    inverse = fisher.covariance(np.abs(residuals.projector) ** 2)
    excess = np.einsum("fpq,fq->fp", inverse, residuals.powers(~out) - own)
    lack = [1 / np.maximum(1 + excess[group].mean(axis=0), 0.01) - 1 for group in groups]
    return out, np.stack(lack)[calm], not calm.all()


class _Residuals:
    """Residuals of the segments: projected on the directions without motion.

    Those of one group of frequencies at a time, since all take several times the memory of the
    segments' spectra.

    Parameters
    ----------
    course : SegmentCourse
    columns : int64, shape (n_bins,)
        Its frequencies that are used.
    at : Maximum
        Maximum of the likelihood at these.
    groups : list of int64
        Indices of each group among them.
    """

    def __init__(
        self, course: SegmentCourse, columns: IntArray, at: Maximum, groups: list[IntArray]
    ) -> None:
        self._spectra, self._columns, self._groups = course.spectra, columns, groups
        self._motion = at.eigenvectors
        share = (np.abs(at.eigenvectors) ** 2 @ at.eigenvalues[:, :, None])[:, :, 0]
        self._fitted = np.einsum("fpp->fp", at.rest).real + share
        self.projector = at.projector
        self.n_channels = at.psi.shape[1]

    def __iter__(self) -> Iterator[ComplexArray]:
        """Yield the residuals of each group, shape (n_segments, n_freqs, n_channels)."""
        for group in self._groups:
            shape = (len(self._spectra), len(group), self.n_channels)
            residual = np.empty(shape, np.complex128)
            for place, number in enumerate(group.tolist()):
                x = self._spectra[:, self._columns[number]].astype(np.complex128)
                x *= np.sqrt(self._fitted[number] / np.mean(np.abs(x) ** 2, axis=0))
                motion = self._motion[number]
                residual[:, place] = x - x @ motion.conj() @ motion.T
            yield residual

    def powers(self, some: BoolArray) -> FloatArray:
        """Return mean powers of the residuals over some segments, shape (n_bins, n_channels)."""
        return np.concatenate([np.mean(np.abs(each[some]) ** 2, axis=0) for each in self])


def _disturbed(
    residuals: Iterable[ComplexArray], degrees: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return whether each segment has outlying residuals, and which groups count.

    Those whose powers scatter no more than by `RESTLESS`, of so many complex degrees of freedom.
    No segment is disturbed if too many are.
    """
    power = np.stack([(np.abs(each) ** 2).sum(axis=(1, 2)) for each in residuals], axis=1)
    middle = median(power)
    scatter = 1.4826 * median(np.abs(power - middle))
    calm = np.asarray(scatter < RESTLESS * middle / np.sqrt(degrees))
    out = np.asarray(((power - middle) > DISTURBED * scatter)[:, calm].any(axis=1))
    return (out if out.mean() <= MAX_DISTURBED else np.zeros_like(out)), calm


class _Scores:
    """Products of the noise of two channels in every part, over the frequencies of a band.

    Parameters
    ----------
    n_channels : int
    n_parts : int
    """

    def __init__(self, n_parts: int, n_channels: int) -> None:
        self._i, self._j = np.array(list(combinations(range(n_channels), 2))).T
        self._n_channels = n_channels
        n_pairs = len(self._i)
        self.score = np.zeros((n_parts, n_pairs))
        self._theory, self._own = np.zeros(n_pairs), np.zeros(n_pairs)
        self._products, self._squares = np.zeros((2, n_parts, n_parts))
        self._n_products = 0

    def add(
        self, found: Regression, correlation: FloatArray, sensor_of: IntArray | None = None
    ) -> None:
        """Add frequencies; where `sensor_of` gives the sensor of each channel, also for `left`."""
        n_freqs = len(found.projector)
        at_once = max(1, PAIR_BYTES // (16 * n_freqs * self._n_channels))
        averages = 1 / np.mean(1 / found.averages)
        products = np.zeros((n_freqs, *self._products.shape))
        for low in range(0, len(self._i), at_once):
            some = slice(low, low + at_once)
            i, j = self._i[some], self._j[some]
            projector = found.projector
            with_noise = 2 * (projector[:, :, i].conj() * projector[:, :, j]).real
            score = 2 * (found.covariance[:, :, i, j] - projector[:, i, j].real)
            score -= (found.noise[:, :, None, :] @ with_noise)[:, :, 0]
            known = 2 * (projector[:, i, j] ** 2 + projector[:, i, i] * projector[:, j, j]).real
            known -= np.einsum("fpa,fpa->fa", with_noise, found.inverse @ with_noise)
            root = np.sqrt(np.clip(known, 0.0, None))
            self.score[:, some] += score.sum(axis=1)
            self._theory[some] += (root * (correlation @ root)).sum(axis=0) / averages
            self._own[some] += known.sum(axis=0)
            if sensor_of is not None:
                shared = score[:, :, sensor_of[i] != sensor_of[j]].swapaxes(0, 1) / 2
                products += shared @ shared.swapaxes(1, 2)
                self._n_products += n_freqs * shared.shape[2]
        self._products += products.sum(axis=0)
        self._squares += (products**2).sum(axis=0)

    @property
    def left(self) -> float:
        """Standard deviation, between parts, of what sensors share; 0 unless that is significant.

        Over the noise, rms of pairs of channels. Noise of two parts is independent; motion has the
        directions of its frequency in both.
        """
        n = len(self._products)
        apart = ~np.eye(n, dtype=np.bool_)
        total, scatter = self._products[apart].sum(), 2 * self._squares[apart].sum()
        if not total > SIGNIFICANCE * np.sqrt(scatter):
            return 0.0
        by_part = (self._products * apart).sum(axis=1) / (n - 1)
        return float(by_part.std(ddof=1) / np.sqrt(total / (n * (n - 1)) * self._n_products))

    def of_parts(self, some: BoolArray) -> _Scores:
        """Return those of some parts."""
        found = copy.copy(self)
        found.score = self.score[some]
        return found

    def inflation(self, levels: PartLevels) -> float:
        """Return the variance of the scores of pairs over that for steady noise.

        Valid for any rate of change of the noise; 1 unless significantly more. Noise of level l_b
        in part b has products of variance ``mean(l_b l_b')``; the fit expects the product of the
        means.
        """
        significant = self._own > 0.1 * max(self._own.max(), np.finfo(np.float64).tiny)
        n_parts = len(self.score)
        ratio = 1.0
        if significant.any():
            found = self.score.var(axis=0, ddof=1)
            ratio = float(np.mean(found[significant] / self._theory[significant]))
        # The number of independent scores is about the number of channels.
        error = float(np.sqrt(2 / ((n_parts - 1) * self._n_channels)))
        level = levels.level / levels.level.mean(axis=0)
        square = (level**2).mean(axis=0)  # of like noise, the product
        # of which the scatter of the levels is a part, that alone exceeds twice itself at times;
        # a channel whose noise parts do not know is no sign of any change
        changed = square > 1 + 2 * SIGNIFICANCE * levels.expected**2
        changed &= levels.expected < KNOWN
        changed &= (levels.level > 0).all(axis=0)
        product = float(np.where(changed, square - levels.expected**2, 1.0).max())
        return max(ratio if ratio > 1 + SIGNIFICANCE * error else 1.0, product)
