"""Whether noise is below a mask, on arrays alone."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from estimator.decision.comparison import Comparison, joint_quantile, mask_edges, prediction, whole
from estimator.decision.verdict import MIN_AVERAGES, Obstacle, Verdict

QUANTILE = joint_quantile(3)


def comparison(low: float, high: float, *, mask: float = 1.0, **changes: Any) -> Comparison:  # noqa: ANN401 - fields
    """Return three bands of which the first two are well below the mask."""
    mean = np.array([0.1, 0.1, (low + high) / 2])
    ends = np.array([0.05, 0.05, low]), np.array([0.2, 0.2, high])
    fields: dict[str, Any] = {
        "centre": np.array([1.0, 2.0, 4.0]),
        "mask": np.full(3, mask),
        "mean": mean,
        "cumulants": np.stack([mean**k * 0.01 ** (k - 1) for k in (2, 3, 4)]),
        "low": ends[0],
        "high": ends[1],
        "outer_low": ends[0],
        "outer_high": ends[1],
        "no_clocks": ends,
        "averages": np.full(3, 100.0),
        "is_alone": np.zeros(3, np.bool_),
        "is_withdrawn": np.zeros(3, np.bool_),
        "is_faulty": False,
    } | changes
    return Comparison(**fields)


@pytest.mark.parametrize(
    ("low", "high", "verdict", "obstacle"),
    [
        (0.2, 0.9, Verdict.PASS, None),
        (1.1, 2.0, Verdict.FAIL, None),
        (0.5, 2.0, Verdict.NOT_DECIDED, Obstacle.SPANS_LIMIT),
        (-math.inf, math.inf, Verdict.NOT_DECIDED, Obstacle.NO_ESTIMATE),  # its mean is NaN
        (-0.5, -0.1, Verdict.NOT_DECIDED, Obstacle.MODEL_MISFIT),  # below zero for certain
    ],
)
def test_all_of_an_interval_decides(
    low: float, high: float, verdict: Verdict, obstacle: Obstacle | None
) -> None:
    with np.errstate(invalid="ignore"):
        judged = comparison(low, high).judged()
    assert (judged.verdict, judged.obstacle) == (verdict, obstacle)
    assert judged.band in {2, 0} if obstacle is Obstacle.NO_ESTIMATE else judged.band is not None


@pytest.mark.parametrize("gains", [(0.9, 1.1), (1.1,)])
def test_what_the_sensitivity_may_be_must_not_change_the_verdict(gains: tuple[float, ...]) -> None:
    for ends, verdict in (((0.2, 0.7), Verdict.PASS), ((1.3, 2.0), Verdict.FAIL)):
        assert comparison(*ends, gains=gains).judged().verdict is verdict
    judged = comparison(1.1, 2.0, gains=gains).judged()  # 1.1 / 1.1**2 is below the mask
    assert (judged.verdict, judged.obstacle) == (Verdict.NOT_DECIDED, Obstacle.SENSITIVITY)


def test_few_averages_and_channels_without_partners_decide_nothing() -> None:
    for averages, least in ((19.0, MIN_AVERAGES), (24.0, 25.0)):
        few = comparison(1.1, 2.0, averages=np.full(3, averages), least=least).judged()
        assert few.obstacle is Obstacle.TOO_FEW_AVERAGES
    alone = comparison(1.1, 2.0, is_alone=np.array([False, False, True])).judged()
    assert alone.obstacle is Obstacle.NO_SHARED_MOTION
    nothing = comparison(1.1, 2.0, mean=np.full(3, np.nan)).judged()
    assert (nothing.band, nothing.obstacle) == (None, Obstacle.NO_ESTIMATE)


def test_the_whole_verdict() -> None:
    good, bad, open_ = (comparison(*e).judged() for e in ((0.2, 0.9), (1.1, 2.0), (0.5, 2.0)))
    assert whole([good, good], (), is_complete=True) == (Verdict.PASS, ())
    assert whole([good], (), is_complete=False)[0] is Verdict.NOT_DECIDED
    assert whole([good, bad, open_], (), is_complete=True) == (Verdict.FAIL, ())
    assert whole([good, open_], (), is_complete=True)[1] == (Obstacle.SPANS_LIMIT,)
    assert whole([bad], {Obstacle.CLOCKS}, is_complete=True)[0] is Verdict.NOT_DECIDED
    assert whole([], (), is_complete=True)[0] is Verdict.NOT_DECIDED


def test_only_what_time_removes_is_predicted() -> None:
    found = [comparison(0.5, 1.2)]
    ahead = prediction(found, [Obstacle.SPANS_LIMIT], quantile=QUANTILE, elapsed=100.0)
    assert ahead is not None
    assert ahead.longest > 100.0
    assert ahead.resolution_db < 0.1
    assert prediction(found, [Obstacle.CLOCKS], quantile=QUANTILE, elapsed=100.0) is None
    assert prediction(found, [], quantile=QUANTILE, elapsed=100.0) is not None  # a pass, not sure


def test_the_margin_of_a_level_below_zero_is_in_standard_deviations() -> None:
    scatter = np.stack([np.full(3, 0.04), np.full(3, 0.5), np.zeros(3)])
    margin = comparison(-0.5, -0.1, cumulants=scatter).margins().margin
    assert margin[2] == pytest.approx((1 + 0.3) / 0.2)
    assert margin[0] == pytest.approx(math.log(10))


def test_nothing_is_known_of_the_margins_of_ends_that_are_infinite() -> None:
    low, high = np.full(3, -math.inf), np.full(3, math.inf)
    known = comparison(0.5, 2.0, outer_low=low, outer_high=high)
    margins = replace(known, low=low, high=high).margins()
    assert np.isinf(margins.added).all()
    assert np.isinf(margins.removed).all()


@pytest.mark.parametrize("level", [0.8, 1.25])
def test_an_uncertain_sensitivity_takes_time_by_squares_and_no_time_decides_beside_it(
    level: float,
) -> None:
    """The margin is a logarithm: what scatter may use of it is the root of the rest."""
    noise: dict[str, Any] = {"mean": np.full(3, level)}
    noise["cumulants"] = np.stack([noise["mean"] ** k * 0.01 ** (k - 1) for k in (2, 3, 4)])
    whole = abs(math.log(level))
    times = []
    for part in (0.0, 0.6, 0.9):
        found = comparison(0.5, 1.2, reach=part * whole, **noise)
        left = np.abs(found.margins().margin)
        np.testing.assert_allclose(left, whole * math.sqrt(1 - part**2))
        ahead = prediction([found], [Obstacle.SPANS_LIMIT], quantile=QUANTILE, elapsed=100.0)
        assert ahead is not None
        assert ahead.seconds is not None
        times.append(ahead.seconds)
    bound = 0.4 * whole  # what may have been added, or removed, takes its part of the margin first
    beside = replace(found, reach=0.3 * whole)
    beside = replace(beside, outer_low=found.low - math.expm1(bound))
    beside = replace(beside, outer_high=found.high + math.expm1(bound))
    expected = bound + whole * math.sqrt(0.6**2 - 0.3**2)
    np.testing.assert_allclose(np.abs(beside.margins().margin), expected)
    assert times == sorted(times)
    assert times[2] > 2 * times[0]
    never = comparison(0.5, 1.2, reach=2 * whole, **noise)
    ahead = prediction([never], [Obstacle.SPANS_LIMIT], quantile=QUANTILE, elapsed=100.0)
    assert ahead is not None
    assert ahead.seconds is None


def test_more_bands_take_wider_intervals() -> None:
    assert joint_quantile(1) == pytest.approx(1.96, abs=0.001)
    assert joint_quantile(81) > 3.4


@pytest.mark.parametrize(
    ("points", "lowest"), [((200.0, 300.0), 0.0), ((1.0, 50.0), 60.0), ((1.0, 50.0), 50.0)]
)
def test_a_mask_outside_of_what_is_known_has_no_bands(
    points: tuple[float, float], lowest: float
) -> None:
    """Nor has one whose last frequency is the first that is known."""
    frequency = np.arange(101, dtype=np.float64)
    edges = mask_edges(frequency, np.ones(101), np.array(points), known=(lowest, math.inf))
    assert edges.shape == (0,)
