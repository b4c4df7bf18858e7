"""The time to a decision, beside many draws of what a longer recording would show."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator.decision.decision_time import INTERVAL_FACTOR, LIKELY, Margins, predict
from estimator.decision.verdict import Prediction
from estimator.types import FloatArray

QUANTILE = 3.5


def like_psd(cov: float, n: int) -> FloatArray:
    """Return the cumulants of n estimates that scatter like a PSD."""
    return np.repeat([[cov**2], [cov**4], [cov**6]], n, axis=1)


def margins_of(
    margin: FloatArray, cov: float, clocks: float = 0.0, *, can_fail: bool = True
) -> Margins:
    n = len(margin)
    return Margins(margin, like_psd(cov, n), np.full(n, clocks), np.zeros(n), np.full(n, can_fail))


def predicted(margins: Margins, averages: float = 100.0, elapsed: float = 100.0) -> Prediction:
    return predict(margins, quantile=QUANTILE, elapsed=elapsed, averages=averages, least=20.0)


def prediction(
    margin: float, *, cov: float = 0.1, n: int = 50, clocks: float = 0.0, can_fail: bool = True
) -> Prediction:
    """Return the prediction for channels that are all as far from the limit."""
    return predicted(margins_of(np.full(n, margin), cov, clocks, can_fail=can_fail))


@pytest.mark.parametrize("sign", [1, -1])
def test_half_the_margin_takes_about_four_times_as_long(sign: int) -> None:
    near, far = prediction(0.1 * sign).seconds, prediction(0.2 * sign).seconds
    assert near is not None
    assert far is not None
    assert 100 < far < near
    assert 2.5 < near / far < 7


def test_on_the_limit_no_time_is_promised_and_what_is_left_is_said() -> None:
    found = prediction(0.0, n=1)
    assert found.seconds is None or found.seconds > 20 * 100
    assert found.latest is None  # a day does not decide one in ten
    assert not found.is_close
    many = prediction(0.0, cov=0.5)
    assert many.longest == 86400.0
    assert many.resolution_db == pytest.approx(
        10 * math.log10(math.e) * QUANTILE * 0.5 * math.sqrt(100 / 86400), rel=0.1
    )


def test_what_clocks_may_have_added_does_not_fail_with_time() -> None:
    assert prediction(-0.2).seconds is not None
    by_clocks = prediction(-0.2, clocks=0.4)
    assert by_clocks.seconds is None
    assert by_clocks.is_bounded  # the noise is not too close to the limit
    assert not prediction(0.0, cov=0.5, clocks=0.4).is_bounded
    assert prediction(-0.2, can_fail=False).seconds is None


def test_too_few_averages_take_as_long_as_it_takes_to_have_enough() -> None:
    found = predicted(margins_of(np.full(9, 5.0), 0.3), averages=10.0, elapsed=10.0)
    assert found.seconds is not None
    assert 20 <= found.seconds < 28


def test_it_says_which_channel_takes_longest_and_how_far_off_it_may_be() -> None:
    margin = np.full(9, 0.6)
    margin[4] = 0.25
    known = [predicted(margins_of(margin, cov)) for cov in (0.2, 0.05)]
    early, late = known
    assert [each.slowest for each in known] == [4, 4]
    assert all(each.is_pass for each in known)
    assert early.earliest is not None
    assert early.seconds is not None
    assert early.earliest < early.seconds
    assert not early.is_close
    assert late.is_close


@pytest.mark.parametrize(("n", "seed"), [(1, 1), (2, 4), (3, 2), (4, 3), (9, 5)])
def test_a_look_at_the_predicted_length_decides_as_likely_as_the_model_says(
    n: int, seed: int
) -> None:
    """Draws of the model of the module: the mean of true margins, these, the later estimate."""
    rng, cov, draws = np.random.default_rng(seed), 0.12, 40_000
    margin = rng.normal(0.35, 0.12, n)
    margins = margins_of(margin, cov)
    found = predicted(margins, averages=1e4)
    mean, trust = margin, 1.0  # of one margin, nothing else is known
    if n > 1:
        variance = max(0.0, float(margin.var(ddof=1)) - cov**2)
        error = math.sqrt((cov**2 + variance) / n)
        mean = margin.mean() + error * rng.standard_normal((draws, 1))
        trust = variance / (variance + cov**2)
    truth = trust * margin + (1 - trust) * mean
    truth = truth + math.sqrt(trust) * cov * rng.standard_normal((draws, n))
    for seconds, chance in zip(
        (found.earliest, found.seconds, found.latest), (0.1, LIKELY, 0.9), strict=True
    ):
        assert seconds is not None
        share = 100.0 / seconds
        later = truth + cov * math.sqrt(share / (1 - share)) * rng.standard_normal((draws, n))
        low, high = (1 + INTERVAL_FACTOR * (e - 1) for e in margins.ends(share, QUANTILE))
        then = share * margin + (1 - share) * later
        passes, fails = then > np.log(high), then < np.log(low)
        decided = (passes.all(axis=1) | fails.any(axis=1)).mean()
        # three standard errors of the draws, and 1 % of the five nodes for the mean
        assert decided == pytest.approx(chance, abs=3 * math.sqrt(0.25 / draws) + 0.01)


@pytest.mark.long
def test_it_decides_as_often_as_it_says() -> None:
    """Channels of different noise, each estimated with scatter, now and after the time stated."""
    rng, cov, n = np.random.default_rng(3), 0.12, 40
    decided = n_predicted = 0
    for _ in range(150):
        truth = rng.normal(0.5, 0.15, n)
        now = truth + cov * rng.standard_normal(n)
        found = predicted(margins_of(now, cov), averages=1e4)
        if found.seconds is None:
            continue
        n_predicted += 1
        share = 100.0 / found.seconds
        later = truth + cov * np.sqrt(share / (1 - share)) * rng.standard_normal(n)
        then = share * now + (1 - share) * later
        reach = INTERVAL_FACTOR * QUANTILE * cov * math.sqrt(share)
        decided += bool((then > reach).all() or (then < -reach).any())
    assert n_predicted > 50
    error = math.sqrt(LIKELY * (1 - LIKELY) / n_predicted)
    assert abs(decided / n_predicted - LIKELY) <= 4 * error
