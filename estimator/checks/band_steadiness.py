"""What parts of a recording show of one band: noise that changes, and responses.

Where motion is weak, noise that changes may look like it: directions are those of the band.
"""

from __future__ import annotations

import copy
import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from estimator.checks.disturbed_segments import FREQUENCIES
from estimator.checks.steadied import LEAST_MOTION
from estimator.checks.steadiness import (
    FALSE_ALARM,
    VALUES_AT_ONCE,
    PartLevels,
    Regression,
    ResponseChange,
    ResponseScores,
    noise_levels,
    regression,
    response_change,
)
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum, maximise
from estimator.likelihood.goodness_of_fit import critical_value, upper_tail
from estimator.median import median
from estimator.records import dataclass
from estimator.spectra.parts import Parts
from estimator.types import BoolArray, FloatArray, IntArray

KNOWN = 0.5
"""Standard error of the noise of a part, as a fraction, up to which its changes count."""
PAIR_BYTES = 1 << 24
"""Bytes of products of pairs of channels with all others that exist together: 16 MB."""
SIGNIFICANCE = 3.0
"""Standard errors by which scatter must exceed its expectation to be significant."""
LONG_TAILS = 100.0
"""By which alarms of several ranges of frequencies are rarer: parts have few averages in each."""
SURE = 5.0
"""Standard errors that a change of some frequencies has at least, to be dated."""
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
"""Changes of the noise of a channel, over those of what channels share, that motion may explain:
that is less where channels differ."""
ROUNDS = 8
"""In which the course of motion that is left is found."""
CONFIRMED = 0.5
"""Power of a direction at other frequencies, over the least of both, if it is of motion."""
LEAST_DEGREES = 8.0
"""Degrees of freedom of the noise of a part from which a band is tested."""


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
        is_clear = degrees > 0 and upper_tail(degrees, statistic) < alarm
        return np.nan_to_num(self.added) if is_clear else np.zeros_like(self.added)


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
        """Add frequencies; with the sensor of each channel, also for motion that is left."""
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
        """Standard deviation between parts of motion that is left; 0 unless that is significant.

        Over the noise, as two channels share it, rms of pairs. Noise of two parts is independent;
        motion has the directions of its frequency in both.
        """
        apart = self._products * ~np.eye(len(self._products), dtype=np.bool_)
        squares = self._squares.sum() - np.trace(self._squares)
        if not apart.sum() > SIGNIFICANCE * np.sqrt(2 * squares):
            return 0.0
        course = np.ones(len(apart))
        for _ in range(ROUNDS):
            course = apart @ course / (course @ course - course**2)
            course /= course.mean()
        power = course @ apart @ course / ((course @ course) ** 2 - (course**4).sum())
        return float(np.sqrt(max(power, 0.0) / self._n_products) * course.std(ddof=1))

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


@dataclass(frozen=True, slots=True, eq=False)
class BandSteadiness:
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
        """Whether what changes may be motion that directions leave."""
        if self.levels is None:
            return False
        more = (self.levels.deviation**2 - self.levels.expected**2).max()
        return bool(0 < more < (LEFT * self.scores.left) ** 2)

    @property
    def inflation(self) -> float:
        """Variance of the scores of pairs over that for steady noise; 1 where it is not known."""
        return 1.0 if self.levels is None else self.scores.inflation(self.levels)

    def of_parts(self, some: BoolArray) -> BandSteadiness:
        """Return what some parts show of the noise."""
        if self.levels is None:
            return self
        levels = PartLevels(self.levels.level[some], self.levels.degrees[some])
        return replace(self, levels=levels, scores=self.scores.of_parts(some))


def is_weak_motion(maximum: Maximum) -> bool:
    """Return whether noise that changes may seem to be directions of the motion of a band."""
    strength = maximum.eigenvalues[~maximum.boundary.any(axis=1), maximum.n_factors - 1]
    return not len(strength) or bool(median(strength) < BEYOND_GUSTS)


def beside_weak_motion(
    of_band: Callable[..., BandSteadiness | None],
    parts: Parts,
    maximum: Maximum,
    places: IntArray,
    psd: FloatArray,
) -> BandSteadiness | None:
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


def band_steadiness(
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
) -> BandSteadiness | None:
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
    return BandSteadiness(
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
