"""Verdicts on simulated tests whose noise is known: seldom wrong, and decided when predicted."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.studies.verdicts import SimulatedTest, verdicts
from estimator.decision.verdict import Obstacle, Verdict


def test_forty_seconds_of_noise_just_above_the_limit_do_not_pass() -> None:
    """The noise is 0.8 dB above the limit in all nine channels."""
    verdicts_found = []
    for seed in range(12):
        test = SimulatedTest(np.random.default_rng(seed), snr=1e4)
        test.record_until(40.0)
        verdicts_found.append(test.verdict(10**-0.08))
    assert all(each.verdict is not Verdict.PASS for each in verdicts_found)
    undecided = [each for each in verdicts_found if each.verdict is Verdict.NOT_DECIDED]
    assert len(undecided) >= 6
    assert all(each.obstacles == (Obstacle.SPANS_LIMIT,) for each in undecided)
    assert all(each.prediction is not None for each in undecided)


@pytest.mark.parametrize("length", [0.1, pytest.param(0.3, marks=pytest.mark.long)])
def test_the_study_agrees_with_what_is_stated(length: float) -> None:
    shares: list[float] = []
    study = verdicts(lambda _, share: shares.append(share), length=length)
    assert study.agrees
    assert len({point.x for _, series in study.series() for point in series.points}) == 3
    assert shares == sorted(shares)
