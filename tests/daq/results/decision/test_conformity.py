"""Decision rules and risks, beside draws and the definitions of ILAC-G8 and JCGM 106."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.bench.sensitivity import KnownSensitivity
from daq.bench.tables.certificate import Rule
from daq.estimation.contributions import with_sensitivities
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.recording.reader import Recording
from daq.results.decision.conformity import (
    QUANTILES,
    Statement,
    conformity,
    distribution,
    risk_above,
    risk_of_item,
    stated,
)
from daq.results.result import Result
from estimator.decision.verdict import Obstacle, Verdict
from estimator.levels.interval import interval
from tests.tui.night_recording import record

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
    """With an interval from 1 dB below to 2 dB above the level, and a limit of −90 dB."""
    value, low, high = (db(each - 90) for each in (level, level - 1, level + 2))
    found = stated(rule, r, value, low=low, high=high, limit=db(-90))
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
    known = np.tile(np.array([[0.1]]), (len(QUANTILES), 1))
    both = np.hstack([known, -unknown]), np.hstack([known, unknown])
    risk, worst = risk_of_item(np.ones(2), *both, 0.01)
    assert np.isnan(risk)  # of a band that nothing is known of
    assert worst == 0


@pytest.mark.parametrize("deviation", [0.0, 0.02, 0.1])
def test_the_risk_is_that_of_the_item_over_its_bands(deviation: float) -> None:
    """Draws of bands that scatter by themselves, and of a sensitivity that all have in common."""
    n, rng = 200, np.random.default_rng(9)
    level = np.array([0.80, 0.84, 0.78, 0.5])
    cumulants = np.stack([level**k / n ** (k - 1) for k in (2, 3, 4)])
    ends = [interval(level, cumulants, float(q)) for q in QUANTILES]
    low, high = (np.stack([end[side] for end in ends]) for side in (0, 1))
    own = level / rng.gamma(n, 1 / n, (200_000, 4))
    true = own * np.exp(deviation * rng.standard_normal((200_000, 1)))
    of_bands = (true > 1).mean(axis=0)
    expected = float((true > 1).any(axis=1).mean())
    risk, worst = risk_of_item(np.ones(4), low, high, deviation)
    assert worst == 1
    assert risk == pytest.approx(expected, rel=0.15)
    assert risk > 1.05 * of_bands.max()  # more than the worst band alone
    assert risk < 1.1 * of_bands.sum()


def judged_with(snapshot: Snapshot, known: KnownSensitivity | None) -> Snapshot:
    names = [(label.sensor, label.channel) for label in snapshot.channels]
    return with_sensitivities(snapshot, {} if known is None else dict.fromkeys(names, known))


def test_the_guard_band_of_one_uncertainty_agrees_with_the_verdict(tmp_path: Path) -> None:
    """On a whole recording: pass by both, fail by both; and nothing stated where nothing is."""
    recording = record(tmp_path / "night.h5")
    settings = Settings(segment=1.0, methods=("three-sensor",), axis_tolerance={"": 0.0})
    snapshot = estimate([recording], settings)
    with Recording.open(recording) as opened:
        bench = opened.bench
    exact = conformity(bench, Result(snapshot, settings))
    assert {each.statement for each in exact} == {Statement.NOT_STATED}  # without traceability
    toleranced = judged_with(snapshot, KnownSensitivity(own=0.002))
    found = conformity(bench, Result(toleranced, settings))
    assert {each.statement for each in found} == {Statement.NOT_STATED}
    certified = judged_with(snapshot, KnownSensitivity(own=0.002, is_certified=True))
    found = conformity(bench, Result(certified, settings))
    verdict = Result(certified, settings, bench).verdict
    assert verdict is not None
    assert [(e.sensor, e.channel) for e in found] == [(e.sensor, e.channel) for e in verdict.limits]
    for each, before, limit in zip(found, exact, verdict.limits, strict=True):
        assert each.k == verdict.k > 2.5
        assert not each.risk < before.risk * 0.99
        if limit.verdict is Verdict.PASS:
            assert each.statement is Statement.PASS
            assert each.risk < 0.025
    assert {e.statement for e in found} >= {Statement.PASS, Statement.NOT_STATED}  # a dead channel


def test_an_uncertain_sensitivity_widens_the_interval_and_takes_the_pass(tmp_path: Path) -> None:
    """A limit 3 dB above the noise: decided by a sensitivity of 1 %, open with one of 25 %."""
    recording = record(tmp_path / "night.h5", psd=4e-10)
    settings = Settings(segment=1.0, methods=("three-sensor",), axis_tolerance={"": 0.0})
    snapshot = estimate([recording], settings)
    with Recording.open(recording) as opened:
        bench = opened.bench
    found, scatter = {}, []
    for own in (0.01, 0.25):
        known = judged_with(snapshot, KnownSensitivity(own=own, is_certified=True))
        verdict = Result(known, settings, bench).verdict
        assert verdict is not None
        found[own] = verdict.limits[0]
        levels = Result(known, settings).spectrum("three-sensor").levels(np.array([5, 9, 20]))
        scatter.append(distribution(levels))
    np.testing.assert_array_equal(scatter[0], scatter[1])  # the sensitivity is common to all bands
    assert found[0.01].verdict is Verdict.PASS
    assert found[0.25].verdict is Verdict.NOT_DECIDED
    assert found[0.25].obstacle is Obstacle.SPANS_LIMIT
