"""Statements of conformity by a named decision rule, and the risk that they are wrong.

The rules are those of ILAC-G8:09/2019. The guard band is ``w = r U`` (JCGM 106:2012, 8.3.2), where
U is the distance in dB from the level to the ends of its 95 % interval, which holds for all
channels, limits and bands together; `Conformity.k` is its coverage factor. The specific risk (JCGM
106:2012, 9.3.2) is that of the item: the probability that its noise is above the limit in any band.
In a band it follows from the distribution of the level itself, by the quantile whose interval ends
at the limit. Bands scatter independently; the sensitivity is common to all of them, so that the
risk is averaged over it.

A statement needs the metrological traceability of the channel (ILAC-P10:07/2020): a certificate of
its sensitivity in the bench file.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.tables.certificate import Rule
from daq.results.decision.limits import Bands, ColumnLevels
from estimator.decision.comparison import joint_quantile
from estimator.decision.verdict import Obstacle
from estimator.records import Hertz

if TYPE_CHECKING:
    from daq.bench.model import Bench
    from daq.results.band_summary import Estimate, Levels
    from estimator.types import FloatArray

QUANTILES = np.arange(0.0, 6.5, 0.25)
"""Standard deviations at which the distribution of a level is tabulated."""


NODES = 15
"""Values of the factor that bands have in common, over which a risk is averaged."""


class Statement(enum.StrEnum):
    """What a decision rule states of a channel beside a limit, best first."""

    PASS = "pass"  # noqa: S105 - no password
    CONDITIONAL_PASS = "conditional-pass"  # noqa: S105 - no password
    CONDITIONAL_FAIL = "conditional-fail"
    FAIL = "fail"
    NOT_STATED = "not-stated"
    """The estimate does not allow a statement by any rule."""


@dataclass(frozen=True, slots=True)
class Conformity:
    """One channel beside one limit.

    Attributes
    ----------
    limit, sensor, channel : str
    statement : Statement
        By the rule.
    risk : float
        Probability that the noise is above the limit in any band; NaN where nothing is known of
        a band.
    frequency : float
        Centre in Hz of the band where that is likeliest.
    k : float
        Coverage factor of U: standard deviations of a normal distribution.
    is_traceable : bool
        Whether the sensitivity has a certificate; without it, nothing is stated.
    """

    limit: str
    sensor: str
    channel: str
    statement: Statement
    risk: float
    frequency: Hertz
    k: float
    is_traceable: bool


def conformity(bench: Bench | None, estimate: Estimate) -> list[Conformity]:
    """Return the statement on every channel beside every limit, by the rule of the bench file.

    The bands and the channels are those of `daq.results.decision.limits.judge`.
    """
    snapshot = estimate.snapshot
    if bench is None or not bench.limits:
        return []
    rule, r = bench.certificate.decision_rule, bench.certificate.guard_band
    bands = [Bands.of(bench, limit, snapshot) for limit in bench.limits]
    quantile = joint_quantile(sum(each.n_bands * len(each.columns) for each in bands))
    spectrum = None if estimate.noise is None else estimate.spectrum(estimate.method)
    found = []
    for each in bands:
        columns, low, high = None, np.empty(0), np.empty(0)
        if spectrum is not None and each.n_bands:
            levels = spectrum.levels(each.edges)
            columns, (low, high) = ColumnLevels.of(levels, quantile), distribution(levels)
        for column in each.columns:
            compared = each.comparison(bench, snapshot, columns, column)
            judged, label = compared.judged(), snapshot.channels[column]
            known = snapshot.sensitivities.get((label.sensor, label.channel))
            traceable = known is not None and known.is_certified
            statement, risk, frequency = Statement.NOT_STATED, math.nan, math.nan
            if columns is not None and judged.band is not None:
                deviation = float(columns.levels.deviation[column])
                risk, worst = risk_of_item(
                    compared.mask, low[..., column], high[..., column], deviation
                )
                frequency = float(compared.centre[worst])
                if traceable and judged.obstacle in {None, Obstacle.SPANS_LIMIT}:
                    statement = stated(
                        rule,
                        r,
                        compared.mean,
                        low=compared.outer_low,
                        high=compared.outer_high,
                        limit=compared.mask,
                    )
            name = each.limit.name, label.sensor, label.channel
            found.append(Conformity(*name, statement, risk, frequency, quantile, traceable))
    return found


def with_rule(bench: Bench | None, about: Bench | None) -> Bench | None:
    """Return a bench, whose limits are judged, with the decision rule that another one states."""
    if bench is None or about is None:
        return bench
    return bench.model_copy(update={"certificate": about.certificate})


def stated(
    rule: Rule,
    r: float,
    level: FloatArray,
    *,
    low: FloatArray,
    high: FloatArray,
    limit: FloatArray,
) -> Statement:
    """Return the statement on a channel: the worst of its bands.

    Parameters
    ----------
    rule : Rule
    r : float
        Guard band over the expanded uncertainty.
    level, low, high, limit : float64, shape (n_bands,)
        In unit**2/Hz; bands without a level are not judged.
    """
    known = np.isfinite(level)
    with np.errstate(invalid="ignore", divide="ignore"):
        value, below, above, most = (
            10 * np.log10(np.maximum(each[known], 0.0)) for each in (level, low, high, limit)
        )
        upper = r * (above - value) if r else np.zeros(value.shape)
        lower = r * (value - below) if r else np.zeros(value.shape)
        passes = most - value >= upper
        fails = value - most > lower
    # an estimate at or below zero has no decibels: the end of its interval decides
    passes = np.where(level[known] > 0, passes, (above <= most) & (r <= 1))
    within = value <= most
    if rule is Rule.SIMPLE_ACCEPTANCE:
        return Statement.PASS if within.all() else Statement.FAIL
    if rule is Rule.GUARD_BAND_BINARY or passes.all():
        return Statement.PASS if passes.all() else Statement.FAIL
    if fails.any():
        return Statement.FAIL
    return Statement.CONDITIONAL_PASS if within.all() else Statement.CONDITIONAL_FAIL


def distribution(levels: Levels) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper ends at `QUANTILES`, shape (n_quantiles, n_bands, n_channels).

    Without what is known of the sensitivities, which is common to all bands.
    """
    ends = [levels.ends(float(quantile), factor=False) for quantile in QUANTILES]
    return np.stack([low for low, _ in ends]), np.stack([high for _, high in ends])


def risk_of_item(
    limit: FloatArray, low: FloatArray, high: FloatArray, deviation: float
) -> tuple[float, int]:
    """Return the probability that an item is above its limit in any band, and the likeliest band.

    Parameters
    ----------
    limit : float64, shape (n_bands,)
    low, high : float64, shape (n_quantiles, n_bands)
        Ends at `QUANTILES`, as `distribution` returns them.
    deviation : float
        Standard deviation of the logarithm of a factor that all bands have in common.

    Returns
    -------
    risk : float
        NaN where nothing is known of a band.
    worst : int
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES if deviation else 1)
    of_bands = np.stack(
        [risk_above(limit * math.exp(-deviation * node), low, high) for node in nodes]
    )
    weights = weights / weights.sum()
    worst = int(np.nan_to_num(weights @ of_bands, nan=-1.0).argmax())
    return float(weights @ (1 - np.prod(1 - of_bands, axis=1))), worst


def risk_above(limit: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the probability that a level is above its limit, shape (n_bands,).

    Parameters
    ----------
    limit : float64, shape (n_bands,)
    low, high : float64, shape (n_quantiles, n_bands)
        Ends at `QUANTILES`. A limit between the ends at quantile 0, where only contributions
        without a distribution decide, has the probability 1/2.
    """
    normal, risks = NormalDist(), []
    for place, most in enumerate(limit.tolist()):
        upper, lower = high[:, place], low[:, place]
        if not np.isfinite(upper[0]) or math.isnan(most):
            risks.append(math.nan)
        elif most >= upper[0]:
            risks.append(1 - normal.cdf(_quantile(upper, most)))
        elif most <= lower[0]:
            risks.append(normal.cdf(_quantile(-lower, -most)))
        else:
            risks.append(0.5)
    return np.array(risks)


def _quantile(ends: FloatArray, at: float) -> float:
    """Return the quantile at which rising ends reach a value; the last one if they do not."""
    finite = np.isfinite(ends)
    known = ends[finite]
    return float(np.interp(at, np.maximum.accumulate(known), QUANTILES[: finite.sum()]))
