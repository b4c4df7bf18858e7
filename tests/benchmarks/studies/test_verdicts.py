"""Verdicts on simulated tests whose noise is known: seldom wrong, and decided when predicted."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.studies.verdicts import WRONG, Outcome, SimulatedTest, outcomes, verdicts
from estimator.decision.verdict import Obstacle, Verdict

N_TESTS = 60


@pytest.fixture(scope="module")
def found() -> list[Outcome]:
    return outcomes(N_TESTS, seed=7)


@pytest.mark.long
def test_verdicts_are_seldom_wrong(found: list[Outcome]) -> None:
    """Four standard deviations: a rule that passes what does not fail is wrong in twenty of 60."""
    for verdict in (Verdict.PASS, Verdict.FAIL):
        n_wrong = sum(
            each.is_wrong(judged)
            for each in found
            for judged in (each.first, each.second)
            if judged is verdict
        )
        assert n_wrong <= N_TESTS * WRONG + 4 * np.sqrt(N_TESTS * WRONG)


@pytest.mark.long
def test_tests_are_decided_where_they_can_be(found: list[Outcome]) -> None:
    decided = {each.first for each in found if abs(each.above_db) > 1.5 and each.seconds > 150}
    assert {Verdict.PASS, Verdict.FAIL} <= decided
    assert any(each.first is Verdict.NOT_DECIDED for each in found)


@pytest.mark.long
def test_the_predicted_time_decides(found: list[Outcome]) -> None:
    prolonged = [each for each in found if each.second is not None]
    held = sum(each.second is not Verdict.NOT_DECIDED for each in prolonged)
    assert len(prolonged) >= 12
    assert held >= 0.7 * len(prolonged)  # nine in ten are stated


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


def test_the_study_agrees_with_what_is_stated() -> None:
    shares = []
    study = verdicts(lambda _, share: shares.append(share), length=0.1)
    assert study.agrees
    assert len({point.x for _, series in study.series() for point in series.points}) == 3
    assert shares == sorted(shares)
