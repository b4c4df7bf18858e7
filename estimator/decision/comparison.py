"""The noise of channels beside masks: which are below for certain, which above.

A channel passes where the whole interval of its band means is below the mask in every band, and
fails where the whole interval of one band is above it. The intervals hold for all channels, masks
and bands together (Bonferroni): of tests with all channels just at the mask, one in forty fails.

Noise that is below zero for certain is wrong, so it decides nothing. Of a channel that is clipped,
or was dead for a while, the estimate is an upper bound. Where the motion contradicts a channel's
sensitivity, the verdict must be the same with either, or the channel is not decided.

A mask is judged in bands, which follow from it and from the spectrum.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from estimator.decision.decision_time import Margins, predict
from estimator.decision.verdict import MIN_AVERAGES, REMOVED_BY_TIME, Obstacle, Prediction, Verdict
from estimator.levels.bands import third_octaves
from estimator.types import BoolArray, FloatArray


def joint_quantile(n_bands: int) -> float:
    """Return the standard deviations to either end of intervals that hold for all bands at once."""
    return NormalDist().inv_cdf(1 - 0.025 / max(1, n_bands))


@dataclass(frozen=True, slots=True)
class Judged:
    """One channel beside one mask.

    Attributes
    ----------
    verdict : Verdict
    band : int or None
        Where the channel does worst; None without an estimate in any band.
    obstacle : Obstacle or None
        None where it is decided.
    """

    verdict: Verdict
    band: int | None
    obstacle: Obstacle | None = None


@dataclass(frozen=True, slots=True)
class Comparison:
    """The noise of one channel beside one mask in all bands of it; arrays of shape (n_bands,).

    `outer_low` and `outer_high` are the ends of the interval with all that widens it; `low` and
    `high` those by what is random alone, the scatter of the estimate and the sensitivity;
    `no_clocks` the ends without what the clocks do. NaN in bands without an estimate. `gains` has
    what the channel reads of the motion of the others, in place of 1; empty where the motion does
    not contradict its sensitivity. `reach` is how far the sensitivity, which no time improves,
    moves the ends in logarithms of the noise, `least` the averages from which they are trusted.
    """

    centre: FloatArray
    mask: FloatArray
    mean: FloatArray
    cumulants: FloatArray
    low: FloatArray
    high: FloatArray
    outer_low: FloatArray
    outer_high: FloatArray
    no_clocks: tuple[FloatArray, FloatArray]
    averages: FloatArray
    is_alone: BoolArray
    is_withdrawn: BoolArray
    is_faulty: bool
    gains: tuple[float, ...] = ()
    reach: float = 0.0
    least: float = MIN_AVERAGES

    def judged(self) -> Judged:
        """Return the verdict, and the band where the channel does worst."""
        own = self._judged()
        for gain in self.gains:  # the noise is divided by its square, or the mask multiplied
            other = replace(self, mask=self.mask * gain**2, gains=())
            if other.judged().verdict is not own.verdict:
                return Judged(Verdict.NOT_DECIDED, own.band, Obstacle.SENSITIVITY)
        return own

    def _judged(self) -> Judged:
        known = np.isfinite(self.mean)
        if not known.any():
            why = Obstacle.NO_ESTIMATE if self.centre.size else Obstacle.OUTSIDE_SPECTRUM
            return Judged(Verdict.NOT_DECIDED, None, why)
        trusted = known & (self.averages >= self.least) & ~self.is_alone
        above = np.where(trusted, self.outer_low / self.mask, -math.inf)
        if above.max() > 1:
            return Judged(Verdict.FAIL, int(above.argmax()))
        highest = np.where(known, self.outer_high / self.mask, -math.inf)
        worst = int(highest.argmax())
        withdrawn = self.is_withdrawn & (self.high < 0)  # the upper end is a bound then
        is_positive = self.outer_high.min() > 0 and not withdrawn.any()
        if trusted.all() and highest.max() <= 1 and is_positive:
            return Judged(Verdict.PASS, worst)
        return Judged(Verdict.NOT_DECIDED, worst, self._obstacle(known, trusted))

    def _obstacle(self, known: BoolArray, trusted: BoolArray) -> Obstacle:
        """Return what keeps the limit from being decided."""
        would_fail = bool((self.low > self.mask).any())  # by scatter alone
        would_pass = bool((self.high <= self.mask).all())
        low, high = self.no_clocks
        by_clocks = bool(((low > self.mask) & (self.outer_low <= self.mask)).any())
        by_clocks |= bool((high <= self.mask).all() and (self.outer_high > self.mask).any())
        reads_high = self.is_faulty and (would_fail or bool((self.mean > self.mask).any()))
        reasons = (
            (Obstacle.NO_ESTIMATE, not known.all()),
            (Obstacle.NO_SHARED_MOTION, bool(self.is_alone.any())),
            (Obstacle.TOO_FEW_AVERAGES, not trusted.all()),
            (Obstacle.FAULTY_CHANNEL, reads_high),
            (Obstacle.CLOCKS, by_clocks),
            (Obstacle.MODEL_MISFIT, would_fail or would_pass or bool(self.is_withdrawn.any())),
        )
        return next((reason for reason, holds in reasons if holds), Obstacle.SPANS_LIMIT)

    def margins(self) -> Margins:
        """Return the margins for a prediction; where the mean is not positive, from its spread."""
        spread = np.sqrt(np.maximum(self.cumulants[0], 0.0))
        positive = self.mean > 0
        unit = np.where(positive, self.mean, spread)
        with np.errstate(invalid="ignore", divide="ignore"):
            in_log = np.log(self.mask / self.mean)
            in_linear = (self.mask - self.mean) / spread
        with np.errstate(invalid="ignore"):  # of ends that are infinite, both parts are
            added, removed = (
                np.where(np.isfinite(part), np.maximum(part, 0.0), math.inf)
                for part in (self.low - self.outer_low, self.outer_high - self.high)
            )
        added, removed = np.log1p(added / self.mask), np.log1p(removed / self.mask)
        margin = np.where(positive, in_log, in_linear)
        if self.reach:  # by squares: what it takes off the room that scatter may use
            bounds = np.where(margin > 0, removed, -added)
            room = np.where(np.isfinite(bounds), margin - bounds, 0.0)
            left = np.sqrt(np.maximum(room**2 - self.reach**2, 0.0))
            margin = np.where(left > 0, bounds + np.sign(room) * left, margin)
            added, removed = (np.where(left > 0, part, math.inf) for part in (added, removed))
        return Margins(
            margin=margin,
            cumulants=self.cumulants / np.stack([unit**k for k in (2, 3, 4)]),
            added=added,
            removed=removed,
            can_fail=np.full(self.mean.shape, not self.is_faulty),
        )


def whole(
    judged: Sequence[Judged], general: Collection[Obstacle], *, is_complete: bool
) -> tuple[Verdict, tuple[Obstacle, ...]]:
    """Return the verdict on all channels and masks together, and what keeps it from a decision.

    Parameters
    ----------
    judged : sequence of Judged
    general : collection of Obstacle
        What keeps the whole test from a decision.
    is_complete : bool
        Whether all channels are among them.
    """
    of_channels = {each.obstacle for each in judged if each.obstacle is not None}
    obstacles = tuple(each for each in Obstacle if each in general or each in of_channels)
    verdicts = {each.verdict for each in judged}
    if general or not judged:
        return Verdict.NOT_DECIDED, obstacles
    if Verdict.FAIL in verdicts:
        return Verdict.FAIL, tuple(each for each in obstacles if each not in REMOVED_BY_TIME)
    if Verdict.NOT_DECIDED in verdicts or not is_complete:
        return Verdict.NOT_DECIDED, obstacles
    return Verdict.PASS, obstacles


def prediction(
    found: Sequence[Comparison],
    obstacles: Collection[Obstacle],
    *,
    quantile: float,
    elapsed: float,
) -> Prediction | None:
    """Return how long a recording takes to decide surely; None where other than time is missing.

    `elapsed` is the length of the recording so far, in seconds.
    """
    if not found or not set(obstacles) <= REMOVED_BY_TIME:
        return None
    parts = [each.margins() for each in found]
    predicted = predict(
        Margins(
            margin=np.concatenate([part.margin for part in parts]),
            cumulants=np.concatenate([part.cumulants for part in parts], axis=1),
            added=np.concatenate([part.added for part in parts]),
            removed=np.concatenate([part.removed for part in parts]),
            can_fail=np.concatenate([part.can_fail for part in parts]),
        ),
        quantile=quantile,
        elapsed=elapsed,
        averages=min(float(each.averages.min()) for each in found),
        least=max(each.least for each in found),
    )
    starts = np.cumsum([0, *(each.centre.size for each in found)])
    at = int(np.searchsorted(starts, predicted.slowest, side="right")) - 1
    frequency = float(found[at].centre[predicted.slowest - starts[at]])
    return replace(predicted, slowest=at, frequency=frequency)


BENT = 2.0
"""Ratio of a mask to a straight line through its band from which on its points divide the band."""


def mask_edges(
    frequency: FloatArray, mask: FloatArray, points: FloatArray, *, known: tuple[float, float]
) -> NDArray[np.int64]:
    """Return edges of third-octave bands within a mask's frequencies, each with a bin or more.

    Where the mask leaves a straight line through a band by more than `BENT`, its own points divide
    the band: notches, peaks and steps.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz.
    mask : float64, shape (n_freqs,)
        PSD of the mask, with the values of its ends beyond them.
    points : float64, shape (n_points,)
        Frequencies that define the mask, in Hz, rising.
    known : (float, float)
        Frequencies below and above which nothing is known.
    """
    low = max(float(points[0]), float(frequency[1]), known[0])
    high = min(float(points[-1]), float(frequency[-2]), known[1])
    if high <= low:
        return np.empty(0, dtype=np.int64)
    edges = third_octaves(frequency, low, high)
    if len(points) <= 2:
        return edges  # straight in log-log
    bent = _is_bent(np.log(frequency[edges[0] : edges[-1]]), np.log(mask), edges)
    inner = np.searchsorted(frequency, points[1:-1])
    inner = inner[(inner >= edges[0]) & (inner < edges[-1])]
    inner = inner[bent[np.searchsorted(edges, inner, side="right") - 1]]
    return np.unique(np.concatenate([edges, inner])).astype(np.int64)


def _is_bent(x: FloatArray, log_mask: FloatArray, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether a mask leaves a straight line in log-log, by band."""
    y = log_mask[edges[0] : edges[-1]]
    starts, counts = edges[:-1] - edges[0], np.diff(edges)
    first, last = starts, starts + counts - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.nan_to_num((y[last] - y[first]) / (x[last] - x[first]))
    line = np.repeat(y[first], counts) + np.repeat(slope, counts) * (
        x - np.repeat(x[first], counts)
    )
    return np.asarray(np.maximum.reduceat(np.abs(y - line), starts) > np.log(BENT))


def mean_mask(frequency: FloatArray, mask: FloatArray, edges: NDArray[np.int64]) -> FloatArray:
    """Return the mean of a mask over the frequencies of each band, as that of the noise."""
    first, last = int(edges[0]), int(edges[-1])
    starts, width = edges[:-1] - first, np.gradient(frequency)[first:last]
    weighted = np.add.reduceat(mask[first:last] * width, starts)
    return np.asarray(weighted / np.add.reduceat(width, starts))
