"""Decision rules and risks, beside draws and the definitions of ILAC-G8 and JCGM 106."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.bench.tables.certificate import Rule
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.results.decision.conformity import QUANTILES, Statement, conformity, risk_above, stated
from daq.results.decision.limits import judge
from estimator.decision.verdict import Verdict
from estimator.levels.interval import interval
from tests.tui.night_recording import record

if TYPE_CHECKING:
    from pathlib import Path

LIMIT = np.array([1.0])


def db(value: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([10 ** (value / 10)])


@pytest.mark.parametrize(
    ("rule", "r", "level", "expected"),
    [
        (Rule.SIMPLE_ACCEPTANCE, 1.0, -0.1, Statement.PASS),
        (Rule.SIMPLE_ACCEPTANCE, 1.0, 0.1, Statement.FAIL),
        (Rule.GUARD_BAND_BINARY, 1.0, -2.1, Statement.PASS),
        (Rule.GUARD_BAND_BINARY, 1.0, -1.9, Statement.FAIL),
        (Rule.GUARD_BAND_BINARY, 0.5, -1.1, Statement.PASS),
        (Rule.GUARD_BAND, 1.0, -2.1, Statement.PASS),
        (Rule.GUARD_BAND, 1.0, -1.9, Statement.CONDITIONAL_PASS),
        (Rule.GUARD_BAND, 1.0, 0.9, Statement.CONDITIONAL_FAIL),
        (Rule.GUARD_BAND, 1.0, 1.1, Statement.FAIL),
        (Rule.GUARD_BAND, 0.0, 0.1, Statement.FAIL),
        (Rule.GUARD_BAND, 0.0, -0.1, Statement.PASS),
    ],
)
def test_the_rules_are_those_of_ilac_g8(
    rule: Rule, r: float, level: float, expected: Statement
) -> None:
    """With an interval from 1 dB below to 2 dB above the level, and a limit of 0 dB."""
    found = stated(rule, r, db(level), low=db(level - 1), high=db(level + 2), limit=LIMIT)
    assert found is expected


def test_the_worst_band_decides() -> None:
    level = np.concatenate([db(-5.0), db(0.5), db(-3.0)])
    low, high = level / 10**0.1, level * 10**0.2
    limit = np.ones(3)
    found = stated(Rule.GUARD_BAND, 1.0, level, low=low, high=high, limit=limit)
    assert found is Statement.CONDITIONAL_FAIL
    found = stated(Rule.SIMPLE_ACCEPTANCE, 1.0, level, low=low, high=high, limit=limit)
    assert found is Statement.FAIL


@pytest.mark.parametrize(
    ("r", "high", "expected"),
    [
        (1.0, 0.5, Statement.PASS),
        (1.5, 0.5, Statement.CONDITIONAL_PASS),
        (1.0, 1.5, Statement.CONDITIONAL_PASS),
    ],
)
def test_the_end_of_the_interval_of_an_estimate_below_zero_decides(
    r: float, high: float, expected: Statement
) -> None:
    level, low, above = np.array([-0.1]), np.array([-1.0]), np.array([high])
    found = stated(Rule.GUARD_BAND, r, level, low=low, high=above, limit=LIMIT)
    assert found is expected


@pytest.mark.parametrize("share", [0.7, 0.85, 1.0, 1.2, 1.5])
def test_the_risk_is_the_share_of_draws_above_the_limit(share: float) -> None:
    """Of a chi-squared level of 60 averages, the true level by its fiducial distribution."""
    n = 60
    level = np.array([1.0])
    cumulants = np.array([[1 / n], [1 / n**2], [1 / n**3]])
    ends = [interval(level, cumulants, float(q)) for q in QUANTILES]
    low, high = (np.stack([end[side] for end in ends]) for side in (0, 1))
    true = 1.0 / np.random.default_rng(5).gamma(n, 1 / n, 400_000)
    expected = float((true > share).mean())
    assert risk_above(np.array([share]), low, high)[0] == pytest.approx(expected, abs=0.02)


def test_nothing_known_has_no_risk() -> None:
    unknown = np.full((len(QUANTILES), 1), np.inf)
    assert np.isnan(risk_above(LIMIT, -unknown, unknown)[0])


def test_the_guard_band_of_one_uncertainty_agrees_with_the_verdict(tmp_path: Path) -> None:
    """On a whole recording: pass by both, fail by both; and nothing stated where nothing is."""
    recording = record(tmp_path / "night.h5")
    settings = Settings(segment=1.0, methods=("three-sensor",), axis_tolerance={"": 0.0})
    snapshot = estimate([recording], settings)
    with Recording.open(recording) as opened:
        bench = opened.bench
    verdict = judge(bench, snapshot, settings)
    assert verdict is not None
    found = conformity(bench, snapshot, settings)
    assert [(e.sensor, e.channel) for e in found] == [(e.sensor, e.channel) for e in verdict.limits]
    for each, limit in zip(found, verdict.limits, strict=True):
        if limit.verdict is Verdict.PASS:
            assert each.statement is Statement.PASS
            assert each.risk < 0.025
    assert {e.statement for e in found} >= {Statement.PASS, Statement.NOT_STATED}  # a dead channel
