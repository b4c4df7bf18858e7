"""Noise masks of the bench file, and which channels are below them for certain.

A mask is judged in bands a third of an octave wide, where single frequencies scatter less: the mean
noise beside the mean of the mask. Notches, peaks and steps of the mask divide the bands. A channel
passes where the whole interval of its band means is below the mask in every band, and fails where
the whole interval of one band is above it. The intervals hold for all channels, masks and bands
together (Bonferroni): of tests with all channels just at the mask, one in forty fails.

What the clocks may have added to the noise or taken from it, and what the estimate may be off by
where one common motion does not explain the averages, widens the interval. Noise that is below zero
for certain is wrong, so it decides nothing. Of a channel that is clipped, or was dead
for a while, the estimate is an upper bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import (
    averages_at,
    correlation_of,
    deviation_at_bound,
    dimension_error,
    judged_method,
    mean_in_bands,
    second_order_error,
    taken_by_bound,
)
from daq.results.decision.decision_time import Margins, predict
from daq.results.decision.mask_bands import judged_range, mask_edges, mean_mask
from daq.results.decision.verdict import (
    REMOVED_BY_TIME,
    LimitResult,
    Obstacle,
    TestVerdict,
    Verdict,
)
from daq.results.partners import without_partners
from estimator.diagnostics.advice import ModelMisfit, TooFewDimensions
from estimator.diagnostics.kinds import Level
from estimator.diagnostics.misfit import SharedNoise
from estimator.self_noise.band_means import NORMAL_95, band_means, decision_interval

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Bench, Limit
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from daq.results.decision.verdict import Prediction
    from estimator.self_noise.band_means import FloatArray
    from estimator.self_noise.result import SelfNoise

MIN_AVERAGES = 20.0
"""Averages below which the far tails of the interval have not been verified by simulation."""

LARGE_SHARE = 0.25
"""Share of motion in the estimate, at most, from which it is named as an obstacle."""


def judge(bench: Bench | None, snapshot: Snapshot, settings: Settings) -> TestVerdict | None:
    """Return the verdict on all limits, by the method of the settings; None without limits."""
    if bench is None or not bench.limits:
        return None
    method = judged_method(snapshot, settings)
    pairs = [
        (limit, column)
        for limit in bench.limits
        for column, label in enumerate(snapshot.channels)
        if concerns(limit, label)
    ]
    edges = {limit.name: mask_edges(snapshot, limit) for limit in bench.limits}
    n_bands = sum(max(0, edges[limit.name].size - 1) for limit, _ in pairs)
    quantile = NormalDist().inv_cdf(1 - 0.025 / max(1, n_bands))
    found = [
        _compare(
            bench, limit, column, snapshot, settings, edges=edges[limit.name], quantile=quantile
        )
        for limit, column in pairs
    ]
    limits = tuple(each.result(method) for each in found)
    general = _general_obstacles(snapshot)
    of_channels = {each.obstacle for each in limits if each.obstacle is not None}
    obstacles = tuple(each for each in Obstacle if each in general or each in of_channels)
    verdicts = {each.verdict for each in limits}
    if general or not limits:
        verdict = Verdict.NOT_DECIDED
    elif Verdict.FAIL in verdicts:
        verdict, obstacles = Verdict.FAIL, tuple(o for o in obstacles if o not in REMOVED_BY_TIME)
    else:
        undecided = Verdict.NOT_DECIDED in verdicts or bool(snapshot.not_estimated)
        verdict = Verdict.NOT_DECIDED if undecided else Verdict.PASS
    prediction = None
    if verdict is Verdict.NOT_DECIDED and obstacles and set(obstacles) <= REMOVED_BY_TIME:
        prediction = _prediction(found, snapshot, quantile)
    return TestVerdict(verdict, limits, obstacles, prediction)


def concerns(limit: Limit, label: ChannelLabel) -> bool:
    """Whether a mask is for a channel."""
    return limit.concerns(label.sensor, label.channel)


@dataclass(frozen=True, slots=True)
class _Comparison:
    """One channel beside one mask in all bands of it; arrays of shape (n_bands,).

    `outer_low` and `outer_high` are the ends of the interval with all that widens it; `low` and
    `high` those by the scatter of the estimate alone. NaN in bands without an estimate.
    """

    limit: Limit
    label: ChannelLabel
    covers: tuple[float, float]
    judged: tuple[float, float]
    centre: FloatArray
    mask: FloatArray
    mean: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray
    added: FloatArray
    removed: FloatArray
    by_clocks: FloatArray
    left_in: FloatArray
    error: FloatArray
    averages: FloatArray
    is_alone: NDArray[np.bool_]
    is_faulty: bool

    @property
    def outer_low(self) -> FloatArray:
        low = (self.low - self.added) * np.where(self.low > self.added, 1 - self.error, 1.0)
        return np.full_like(low, -math.inf) if self.is_faulty else low

    @property
    def outer_high(self) -> FloatArray:
        high = self.high + self.removed
        return np.asarray(high * np.where(high > 0, 1 + self.error, 1.0))

    def result(self, method: str) -> LimitResult:
        """Return the verdict, with the numbers of the band where the channel does worst."""

        def in_band(band: int | None, verdict: Verdict, obstacle: Obstacle | None) -> LimitResult:
            def number(values: FloatArray) -> float:
                return math.nan if band is None else float(values[band])

            return LimitResult(
                limit=self.limit.name,
                sensor=self.label.sensor,
                channel=self.label.channel,
                method=method,
                frequency=number(self.centre),
                noise_psd=number(self.mean),
                low=number(self.outer_low),
                high=number(self.outer_high),
                limit_psd=number(self.mask),
                verdict=verdict,
                covers=self.covers,
                judged=self.judged,
                obstacle=obstacle,
            )

        known = np.isfinite(self.mean)
        if not known.any():
            why = Obstacle.NO_ESTIMATE if self.centre.size else Obstacle.OUTSIDE_SPECTRUM
            return in_band(None, Verdict.NOT_DECIDED, why)
        trusted = known & (self.averages >= MIN_AVERAGES) & ~self.is_alone
        above = np.where(trusted, self.outer_low / self.mask, -math.inf)
        if above.max() > 1:
            return in_band(int(above.argmax()), Verdict.FAIL, None)
        highest = np.where(known, self.outer_high / self.mask, -math.inf)
        worst = int(highest.argmax())
        if trusted.all() and highest.max() <= 1 and self.outer_high.min() > 0:
            return in_band(worst, Verdict.PASS, None)
        return in_band(worst, Verdict.NOT_DECIDED, self._obstacle(known, trusted))

    def _obstacle(self, known: NDArray[np.bool_], trusted: NDArray[np.bool_]) -> Obstacle:
        """Return what keeps the limit from being decided."""
        would_fail = bool((self.low > self.mask).any())  # by scatter alone
        would_pass = bool((self.high <= self.mask).all())
        without = self.low - self.left_in <= self.mask
        is_large = (self.left_in >= LARGE_SHARE * np.abs(self.mean)) & (self.mean > self.mask)
        by_motion = bool(((is_large | (self.low > self.mask)) & without).any())
        by_clocks = would_fail and not bool((self.low - self.by_clocks > self.mask).any())
        by_clocks |= would_pass and not bool((self.high + self.removed <= self.mask).all())
        by_clocks |= bool(np.isinf(self.removed).any())  # nothing is known of them
        reads_high = self.is_faulty and (would_fail or bool((self.mean > self.mask).any()))
        reasons = (
            (Obstacle.NO_ESTIMATE, not known.all()),
            (Obstacle.NO_SHARED_MOTION, bool(self.is_alone.any())),
            (Obstacle.TOO_FEW_AVERAGES, not trusted.all()),
            (Obstacle.FAULTY_CHANNEL, reads_high),
            (Obstacle.WEAK_MOTION, by_motion),
            (Obstacle.CLOCKS, by_clocks),
            (Obstacle.MODEL_MISFIT, would_fail or would_pass),
        )
        return next((reason for reason, holds in reasons if holds), Obstacle.SPANS_LIMIT)

    def margins(self) -> Margins:
        """Return the margins for a prediction; where the mean is not positive, from its spread."""
        positive = self.mean > 0
        with np.errstate(invalid="ignore", divide="ignore"):
            in_log = np.log(self.mask / self.mean)
            in_linear = (self.mask - self.mean) / self.spread
        return Margins(
            margin=np.where(positive, in_log, in_linear),
            cov=np.where(positive, self.spread / np.abs(self.mean), 1.0),
            added=np.log1p(self.added / self.mask),
            removed=np.log1p(self.removed / self.mask),
            can_fail=np.full(self.mean.shape, not self.is_faulty),
        )


def _compare(
    bench: Bench,
    limit: Limit,
    column: int,
    snapshot: Snapshot,
    settings: Settings,
    *,
    edges: NDArray[np.int64],
    quantile: float,
) -> _Comparison:
    label, frequency = snapshot.channels[column], snapshot.frequency
    noise = snapshot.results.get(judged_method(snapshot, settings))
    if edges.size < 2:
        centre = mask = np.empty(0)
    else:
        centre = np.sqrt(frequency[edges[:-1]] * frequency[edges[1:] - 1])
        mask = mean_mask(bench, limit, label, frequency, edges)

    def in_bands(psd: FloatArray | None) -> FloatArray:
        if psd is None or noise is None or not centre.size:
            return np.zeros(centre.shape)
        return mean_in_bands(psd[:, column], noise.noise_psd[:, column], edges, frequency)

    averages = averages_at(snapshot, centre)
    mean = spread = low = high = np.full(centre.shape, np.nan)
    if noise is not None and centre.size:
        means = band_means(
            noise.noise_psd[:, column],
            noise.cov[:, column],
            edges,
            correlation_of(settings),
            weights=np.gradient(frequency),
            deviation=deviation_at_bound(noise, column),
        )
        mean, spread = means.mean, means.spread
        low, high = decision_interval(means, quantile, averages)
        high = high + in_bands(taken_by_bound(noise, snapshot.dims))
        mean = np.where(_is_complete(noise, column, edges), mean, np.nan)
    diagnostics = snapshot.diagnostics
    unknown = 0.0 if diagnostics.synchronisation.is_known else math.inf
    return _Comparison(
        limit=limit,
        label=label,
        covers=(limit.mask.frequency[0], limit.mask.frequency[-1]),
        judged=judged_range(snapshot, limit, edges),
        centre=centre,
        mask=mask,
        mean=mean,
        spread=spread,
        low=low,
        high=high,
        added=in_bands(snapshot.added) + unknown,
        removed=in_bands(snapshot.removed) + unknown,
        by_clocks=in_bands(snapshot.added_by_clocks),
        left_in=in_bands(snapshot.left_in),
        error=_errors(snapshot, edges, judged_method(snapshot, settings), column),
        averages=averages,
        is_alone=np.array(
            [column in without_partners(snapshot, (f, f)) for f in centre.tolist()], dtype=bool
        ),
        is_faulty=column in diagnostics.clipped or column in diagnostics.stood_still,
    )


def _is_complete(noise: SelfNoise, column: int, edges: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether the noise is known at every frequency of each band."""
    certain = np.isfinite(noise.cov[:, column]) | np.isfinite(deviation_at_bound(noise, column))
    known = (np.isfinite(noise.noise_psd[:, column]) & certain)[edges[0] : edges[-1]]
    return np.asarray(np.logical_and.reduceat(known, edges[:-1] - edges[0]))


def _errors(snapshot: Snapshot, edges: NDArray[np.int64], method: str, column: int) -> FloatArray:
    """Return what the estimate may be off by in each band, as a share of the noise."""
    if edges.size < 2:
        return np.empty(0)
    low, high = snapshot.frequency[edges[:-1]], snapshot.frequency[edges[1:] - 1]
    centre = np.sqrt(low * high)
    share = dimension_error(snapshot, method)[: edges[-1]]
    noise = snapshot.results.get(method)
    if noise is not None:
        weak = second_order_error(noise, snapshot.frequency)[: edges[-1], column]
        share = np.hypot(share, weak)
    error = NORMAL_95 * np.maximum.reduceat(share, edges[:-1])
    explained = np.zeros(centre.shape, np.bool_)
    for choice in snapshot.diagnostics.dimensions if method == "maximum-likelihood" else ():
        here = (high >= choice.low) & (low <= choice.high)
        explained |= here
        if choice.is_biased or choice.is_undetermined:
            error = np.where(here, np.inf, error)
    for advice in snapshot.diagnostics.advice:
        if advice.band is None or advice.level is Level.NOTE:
            continue
        here = (high >= advice.band[0]) & (low <= advice.band[1])
        if isinstance(advice, ModelMisfit):
            here &= ~explained
            error = np.where(here, np.maximum(error, advice.error), error)
        elif isinstance(advice, SharedNoise):
            error = np.where(here, np.maximum(error, advice.harm), error)
        elif isinstance(advice, TooFewDimensions):
            error = np.where(here & ~explained, np.inf, error)
    return error


def _general_obstacles(snapshot: Snapshot) -> set[Obstacle]:
    """Return what keeps the whole test from a decision."""
    found = set()
    if snapshot.sensors and all(sensor.is_lost for sensor in snapshot.sensors):
        found.add(Obstacle.SENSORS_LOST)
    if snapshot.n_segments == 0:
        found.add(Obstacle.NO_SEGMENTS)
    if not snapshot.diagnostics.synchronisation.is_known:
        found.add(Obstacle.CLOCKS)
    return found


def _prediction(
    found: Sequence[_Comparison], snapshot: Snapshot, quantile: float
) -> Prediction | None:
    parts = [each.margins() for each in found]
    return predict(
        Margins(
            margin=np.concatenate([part.margin for part in parts]),
            cov=np.concatenate([part.cov for part in parts]),
            added=np.concatenate([part.added for part in parts]),
            removed=np.concatenate([part.removed for part in parts]),
            can_fail=np.concatenate([part.can_fail for part in parts]),
        ),
        quantile=quantile,
        elapsed=snapshot.elapsed,
        averages=min(float(each.averages.min()) for each in found),
        least=MIN_AVERAGES,
    )
