"""Noise masks of the bench file, and which channels are below them for certain.

A mask is judged in bands a third of an octave wide, where single frequencies scatter less: the mean
noise beside the mean of the mask. Notches, peaks and steps of the mask divide the bands. A channel
passes where the whole interval of its band means is below the mask in every band, and fails where
the whole interval of one band is above it. The intervals hold for all channels, masks and bands
together (Bonferroni): of tests with all channels just at the mask, one in forty fails.

The ends are those of every table (`daq.results.band_summary.levels`) at another quantile: with all
that widens them, and below the bound that needs no model. Noise that is below zero for certain is
wrong, so it decides nothing. Of a channel that is clipped, or was dead for a while, the estimate is
an upper bound.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import averages_at, judged_method, levels
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
from estimator.levels.contributions import Source

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Bench, Limit
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from daq.results.band_summary import Levels
    from daq.results.decision.verdict import Prediction
    from estimator.types import FloatArray

MIN_AVERAGES = 20.0
"""Averages below which the far tails of the interval have not been verified by simulation."""


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
    noise = snapshot.results.get(method)
    of_limit = {
        name: None if noise is None or each.size < 2 else levels(noise, snapshot, settings, each)
        for name, each in edges.items()
    }
    found = [
        _compare(
            bench,
            limit,
            column,
            snapshot,
            of_limit[limit.name],
            edges=edges[limit.name],
            quantile=quantile,
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
    `high` those by the scatter of the estimate alone, `no_clocks` the ends without what the clocks
    do. NaN in bands without an estimate.
    """

    limit: Limit
    label: ChannelLabel
    covers: tuple[float, float]
    judged: tuple[float, float]
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
    is_alone: NDArray[np.bool_]
    is_withdrawn: NDArray[np.bool_]
    is_faulty: bool

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
        added, removed = (
            np.where(np.isfinite(part), np.maximum(part, 0.0), math.inf)
            for part in (self.low - self.outer_low, self.outer_high - self.high)
        )
        return Margins(
            margin=np.where(positive, in_log, in_linear),
            cumulants=self.cumulants / np.stack([unit**k for k in (2, 3, 4)]),
            added=np.log1p(added / self.mask),
            removed=np.log1p(removed / self.mask),
            can_fail=np.full(self.mean.shape, not self.is_faulty),
        )


def _compare(
    bench: Bench,
    limit: Limit,
    column: int,
    snapshot: Snapshot,
    found: Levels | None,
    *,
    edges: NDArray[np.int64],
    quantile: float,
) -> _Comparison:
    label, frequency = snapshot.channels[column], snapshot.frequency
    if edges.size < 2:
        centre = mask = np.empty(0)
    else:
        centre = np.sqrt(frequency[edges[:-1]] * frequency[edges[1:] - 1])
        mask = mean_mask(bench, limit, label, frequency, edges)
    nothing = np.full(centre.shape, np.nan)
    mean, cumulants = nothing, np.full((3, *centre.shape), np.nan)
    scatter = outer = no_clocks = (nothing, nothing)
    withdrawn = np.zeros(centre.shape, np.bool_)
    if found is not None and centre.size:
        complete = found.of_scatter.complete[:, column]
        mean = np.where(complete, found.mean[:, column], np.nan)
        cumulants = found.of_scatter.cumulants[:, :, column]
        scatter, outer, no_clocks = (
            (ends[0][:, column], ends[1][:, column])
            for ends in (
                found.of_scatter.interval(quantile),
                found.ends(quantile),
                found.ends(quantile, without={Source.CLOCKS}),
            )
        )
        withdrawn = found.withdrawn(quantile)[:, column]
    diagnostics = snapshot.diagnostics
    return _Comparison(
        limit=limit,
        label=label,
        covers=(limit.mask.frequency[0], limit.mask.frequency[-1]),
        judged=judged_range(snapshot, limit, edges),
        centre=centre,
        mask=mask,
        mean=mean,
        cumulants=cumulants,
        low=scatter[0],
        high=scatter[1],
        outer_low=outer[0],
        outer_high=outer[1],
        no_clocks=no_clocks,
        averages=averages_at(snapshot, centre),
        is_alone=np.array(
            [column in without_partners(snapshot, (f, f)) for f in centre.tolist()], dtype=bool
        ),
        is_withdrawn=withdrawn,
        is_faulty=column in diagnostics.clipped or column in diagnostics.stood_still,
    )


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
            cumulants=np.concatenate([part.cumulants for part in parts], axis=1),
            added=np.concatenate([part.added for part in parts]),
            removed=np.concatenate([part.removed for part in parts]),
            can_fail=np.concatenate([part.can_fail for part in parts]),
        ),
        quantile=quantile,
        elapsed=snapshot.elapsed,
        averages=min(float(each.averages.min()) for each in found),
        least=MIN_AVERAGES,
    )
