"""Limits are decided by what is known of noise and sensitivities, and not by what scatters."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from daq.bench.loading import parse
from daq.estimation.contributions import contributions
from daq.estimation.snapshot import Snapshot
from daq.estimation.snapshot_diagnostics import Synchronisation
from daq.results.decision.verdict import LimitResult, TestVerdict
from daq.results.result import Result
from estimator.checks.advice import Rank
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.count_limits import CountLimits
from estimator.checks.relative_response import relative_response
from estimator.checks.sensitivities import CAUSES, Cause
from estimator.decision.verdict import MIN_AVERAGES, Obstacle, Verdict
from estimator.levels.contributions import Source
from estimator.likelihood.dimension import BandDimension
from estimator.likelihood.goodness_of_fit import BandTest
from estimator.methods import self_noise
from estimator.self_noise.result import Flag, SelfNoise
from tests.daq.results.decision.benches import PLAIN, bench_with, verdict_on
from tests.estimator.csm_models import wishart
from tests.tui.example_snapshot import SETTINGS, diagnosed, made_snapshot


def failing(psd: float, more: str = "", *, n_effective: float = 1000.0) -> list[str]:
    found = verdict_on(made_snapshot(n_effective=n_effective), psd, more)
    return [each.name for each in found.having(Verdict.FAIL)]


def test_channels_above_a_mask_fail() -> None:
    # The channels' noise is 1, 2, … 9 pm²/s⁴/Hz, known here to 1 % or so.
    assert failing(12e-12) == []
    assert failing(6.5e-12) == ["C.X", "C.Y", "C.Z"]
    assert verdict_on(made_snapshot(n_effective=5000.0), 12e-12).verdict is Verdict.PASS
    assert verdict_on(made_snapshot(n_effective=5000.0), 6.5e-12).verdict is Verdict.FAIL


def test_a_mask_may_be_for_some_sensors_or_channels() -> None:
    assert failing(6.5e-12, 'sensors = ["A", "B"]') == []
    assert failing(6.5e-12, 'channels = ["Y"]') == ["C.Y"]


def test_what_is_not_known_well_enough_neither_passes_nor_fails() -> None:
    assert "C.Z" in failing(8e-12, n_effective=5000.0)
    found = verdict_on(made_snapshot(n_effective=60.0), 9.8e-12)
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.having(Verdict.FAIL) == []
    assert Obstacle.SPANS_LIMIT in found.obstacles


@pytest.mark.parametrize(
    ("verdict", "limit", "sure"),
    [
        (Verdict.PASS, 1.24, False),
        (Verdict.PASS, 1.26, True),
        (Verdict.FAIL, 0.76, False),
        (Verdict.FAIL, 0.74, True),
        (Verdict.NOT_DECIDED, 0.74, False),
        (Verdict.NOT_DECIDED, 1.26, False),
    ],
)
def test_a_verdict_is_sure_beside_an_interval_a_quarter_wider(
    verdict: Verdict, limit: float, *, sure: bool
) -> None:
    """All channels must pass surely; one that fails surely is enough."""
    made = verdict_on(made_snapshot(), 12e-12).limits[0]
    one = replace(made, verdict=verdict, noise_psd=1.0, low=0.8, high=1.2, limit_psd=limit)
    assert one.is_sure is sure
    assert TestVerdict(verdict, (one,)).is_sure is sure
    two = TestVerdict(verdict, (one, replace(one, limit_psd=1.0)))
    assert two.is_sure is (sure and verdict is Verdict.FAIL)


def test_too_few_averages_decide_nothing() -> None:
    """However far the estimate is from the limit."""
    for psd in (1e-14, 1e-9):
        found = verdict_on(made_snapshot(n_effective=MIN_AVERAGES - 1), psd)
        assert found.verdict is Verdict.NOT_DECIDED
        assert found.obstacles == (Obstacle.TOO_FEW_AVERAGES,)
        assert found.prediction is not None
        assert found.prediction.seconds is not None
        assert found.prediction.seconds >= MIN_AVERAGES  # one a second here
    assert verdict_on(made_snapshot(n_effective=100), 1e-14).verdict is Verdict.FAIL
    assert verdict_on(made_snapshot(n_effective=100), 1e-9).verdict is Verdict.PASS


@pytest.mark.long
def test_a_channel_just_at_its_mask_seldom_fails() -> None:
    rng = np.random.default_rng(11)
    snapshot, settings = made_snapshot(), replace(SETTINGS, window="rectangular", overlap=0.0)
    snapshot = replace(snapshot, n_effective=1e6)  # the c.o.v. is known here
    noise = snapshot.results["three-sensor"]
    shape, level = noise.noise_psd.shape, 4e-12
    cumulants = np.broadcast_to(
        (level ** np.array([2, 3, 4]) / 400.0 ** np.array([1, 2, 3]))[:, None, None], (3, *shape)
    )
    n_tests, n_failing = 120, 0
    for _ in range(n_tests):
        drawn = level * (1 + 0.05 * rng.normal(size=shape))
        results = {"three-sensor": SelfNoise.of("three-sensor", drawn, cumulants, noise.flags)}
        found = verdict_on(replace(snapshot, results=results), level, settings=settings)
        n_failing += found.verdict is Verdict.FAIL
    # One test in forty, and four standard deviations: 10; channel by channel it would be 24.
    expected = n_tests / 40
    assert 0 < n_failing <= expected + 4 * math.sqrt(expected)


def test_without_limits_there_is_no_verdict() -> None:
    assert Result(made_snapshot(), SETTINGS, parse(PLAIN)).verdict is None
    assert Result(made_snapshot(), SETTINGS).verdict is None


def by_channel(psd: float, *, n_effective: float = 1000.0) -> dict[str, LimitResult]:
    found = verdict_on(made_snapshot(n_effective=n_effective), psd)
    return {each.sensor + each.channel: each for each in found.limits}


def test_every_channel_has_its_margin_with_an_interval() -> None:
    of = by_channel(5e-12)
    assert of["AX"].verdict is Verdict.PASS
    assert of["AX"].obstacle is None
    assert of["AX"].margin_db == pytest.approx(10 * math.log10(5), abs=0.5)
    assert 0 < of["AX"].margin_low_db < of["AX"].margin_db < of["AX"].margin_high_db
    assert of["BY"].verdict is Verdict.NOT_DECIDED
    assert of["BY"].obstacle is Obstacle.SPANS_LIMIT
    assert of["BY"].margin_low_db < 0 < of["BY"].margin_high_db
    assert of["CZ"].verdict is Verdict.FAIL
    assert of["CZ"].margin_db == pytest.approx(10 * math.log10(5 / 9), abs=0.5)
    assert of["CZ"].margin_high_db < 0


def with_dead_channel(snapshot: Snapshot) -> Snapshot:
    dead = snapshot.csm.copy()
    dead[:, 0, :] = dead[:, :, 0] = 0
    noise = self_noise("three-sensor", dead, dims=(3, 3, 3), n_effective=snapshot.n_effective)
    return replace(snapshot, csm=dead, results={"three-sensor": noise})


def test_a_channel_without_an_estimate_keeps_the_test_from_passing() -> None:
    found = verdict_on(with_dead_channel(made_snapshot(n_effective=1000.0)), 5e-9)
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.NO_ESTIMATE,)
    assert found.prediction is None  # time does not mend it
    dead = next(each for each in found.limits if each.name == "A.X")
    assert not dead.known
    assert math.isnan(dead.margin_db)


def test_a_method_that_is_only_shown_does_not_judge() -> None:
    """Where the method that was asked for gives no result, nothing is decided by another."""
    snapshot = made_snapshot(n_effective=1000.0)
    three_channel = {"three-channel": snapshot.results["three-channel"]}
    found = verdict_on(replace(snapshot, results=three_channel), 1e-14)
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.NO_ESTIMATE,)


def test_a_test_in_which_every_sensor_was_lost_is_not_decided() -> None:
    snapshot = made_snapshot(n_effective=1000.0)
    for n_lost, expected in ((3, Verdict.NOT_DECIDED), (2, Verdict.PASS)):
        sensors = tuple(
            replace(sensor, is_lost=number < n_lost)
            for number, sensor in enumerate(snapshot.sensors)
        )
        found = verdict_on(replace(snapshot, sensors=sensors), 5e-9)
        assert found.verdict is expected
        assert (Obstacle.SENSORS_LOST in found.obstacles) == (n_lost == 3)


def test_a_test_without_segments_is_not_decided() -> None:
    snapshot = replace(made_snapshot(), results={}, n_segments=0, n_effective=0.0)
    found = verdict_on(replace(snapshot, csm=np.full_like(snapshot.csm, np.nan)), 5e-9)
    assert found.verdict is Verdict.NOT_DECIDED
    assert Obstacle.NO_SEGMENTS in found.obstacles


@pytest.mark.parametrize(("psd", "verdict"), [(5e-9, "not-decided"), (1e-14, "fail")])
def test_a_limit_of_a_channel_that_is_not_recorded_does_not_pass(psd: float, verdict: str) -> None:
    bench = bench_with(psd)
    (limit,) = bench.limits
    other = limit.model_copy(update={"name": "other", "sensors": ("Q",)})
    bench = bench.model_copy(update={"limits": (limit, other)})
    found = Result(made_snapshot(n_effective=5000.0), SETTINGS, bench).verdict
    assert found is not None
    assert found.verdict == verdict
    assert (found.obstacles == (Obstacle.NO_CHANNEL,)) == (verdict == "not-decided")


def test_noise_that_may_come_from_the_clocks_does_not_fail() -> None:
    sure = made_snapshot(n_effective=5000.0, clock_share=0.0)
    assert verdict_on(sure, 6.5e-12).verdict is Verdict.FAIL
    found = verdict_on(made_snapshot(n_effective=5000.0, clock_share=0.2), 6.5e-12)
    assert found.verdict is Verdict.NOT_DECIDED
    assert Obstacle.CLOCKS in found.obstacles
    # What clocks add makes the noise no lower than it is: a pass stays one.
    passing = made_snapshot(n_effective=5000.0, clock_share=0.2)
    assert verdict_on(passing, 12e-12).verdict is Verdict.PASS


def with_clocks(snapshot: Snapshot, found: Synchronisation) -> Snapshot:
    """Return the snapshot with other errors of its clocks."""
    return replace(snapshot, diagnostics=replace(snapshot.diagnostics, synchronisation=found))


def test_noise_that_clocks_may_have_taken_away_does_not_pass() -> None:
    """Where two clocks err in opposite ways, the noise of a third sensor comes out too low."""
    snapshot = made_snapshot(n_effective=5000.0)
    removed = np.full_like(snapshot.results["three-sensor"].noise_psd, 4e-12)
    snapshot = with_clocks(snapshot, Synchronisation(removed=removed))
    found = verdict_on(snapshot, 10e-12)
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.CLOCKS,)
    assert verdict_on(snapshot, 12e-12).verdict is Verdict.PASS  # above the bound without a model


def test_clocks_that_nobody_knows_decide_nothing() -> None:
    for n_effective in (5000.0, MIN_AVERAGES - 1):
        snapshot = made_snapshot(n_effective=n_effective)
        snapshot = with_clocks(snapshot, Synchronisation({"A": 0.0, "B": math.nan}))
        for psd in (1e-14, 1e-9):
            found = verdict_on(snapshot, psd)
            assert found.verdict is Verdict.NOT_DECIDED
            assert Obstacle.CLOCKS in found.obstacles
            assert found.prediction is None  # time does not mend it


def test_a_clock_that_is_not_understood_decides_nothing() -> None:
    snapshot = made_snapshot(n_effective=5000.0)
    assert verdict_on(snapshot, 12e-12).verdict is Verdict.PASS
    clocks = tuple(replace(each, is_understood=each.sensor != "B") for each in snapshot.clocks)
    found = verdict_on(replace(snapshot, clocks=clocks), 12e-12)
    assert found.verdict is Verdict.NOT_DECIDED
    assert Obstacle.CLOCKS in found.obstacles


def test_noise_that_is_negative_for_certain_does_not_pass() -> None:
    snapshot = made_snapshot(n_effective=5000.0)
    noise = snapshot.results["three-sensor"]
    wrong = replace(noise, noise_psd=np.abs(noise.noise_psd) * np.where(np.arange(9) < 1, -1, 1))
    found = verdict_on(replace(snapshot, results={"three-sensor": wrong}), 12e-12)
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.MODEL_MISFIT,)


def test_the_noise_of_a_clipped_channel_is_an_upper_bound() -> None:
    snapshot = made_snapshot(n_effective=5000.0)
    clipped = replace(snapshot.diagnostics, counts=CountLimits(dict.fromkeys(range(9), 0.01)))
    found = verdict_on(replace(snapshot, diagnostics=clipped), 6.5e-12)
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.FAULTY_CHANNEL,)
    assert verdict_on(replace(snapshot, diagnostics=clipped), 12e-12).verdict is Verdict.PASS


def with_misfit(low: float) -> Snapshot:
    """Say that the model fails by 90 % of the noise from a frequency on."""
    snapshot = diagnosed(n_effective=5000.0)
    assert snapshot.diagnostics.diagnosis is not None
    misfit = ModelMisfit(
        rank=Rank.INVALIDATES, band=(low, 99.0), n_factors=3, statistic=50.0, worst_statistic=50.0,
        worst_band=(low, 99.0), p_value=0.0, unexplained=0.1, error=0.9, largest_error=9.0,
        is_wrong=True,
    )  # fmt: skip
    diagnosis = replace(snapshot.diagnostics.diagnosis, advice=(misfit,))
    return replace(snapshot, diagnostics=replace(snapshot.diagnostics, diagnosis=diagnosis))


def test_where_the_model_fails_by_more_than_the_margin_nothing_is_decided() -> None:
    wrong = with_misfit(0.5)
    for psd in (10e-12, 6.5e-12):
        found = verdict_on(wrong, psd)
        assert found.verdict is Verdict.NOT_DECIDED
        assert Obstacle.MODEL_MISFIT in found.obstacles
        assert found.prediction is None
    assert verdict_on(wrong, 5e-11).verdict is Verdict.PASS  # by more than the misfit can do
    assert verdict_on(wrong, 1e-14).verdict is Verdict.FAIL


@pytest.mark.parametrize(("last", "known"), [(99.0, False), (70.0, True)])
def test_a_second_motion_is_felt_beside_the_band_that_shows_it(last: float, known: bool) -> None:
    wrong = with_misfit(50.0)
    noise = wrong.results["three-sensor"]
    none = (wrong.frequency >= 50) & (wrong.frequency <= last)  # a line is at few frequencies
    flags = np.where(none[:, None] & (np.arange(9) >= 6), Flag.NEGATIVE, noise.flags)
    results = {"three-sensor": replace(noise, flags=flags.astype(noise.flags.dtype))}
    (misfit,) = (
        each
        for each in contributions(replace(wrong, results=results), "three-sensor")
        if each.source is Source.MISFIT
    )
    assert np.all(misfit.share[2:20] == (0.0 if known else np.inf))  # 10 to 1000 times the noise


CHOSEN = "dimensions-chosen"


def with_further_dimensions(cov: float, *, accepted: bool) -> Snapshot:
    """Five dimensions from 1 to 10 Hz, and what maximum likelihood makes of one motion."""
    snapshot = made_snapshot(n_effective=1000.0)
    test = BandTest(1.0, 1.0, 0.5 if accepted else 1e-6, 19)
    choice = BandDimension(
        low=1.0,
        high=10.0,
        n_factors=5,
        usual=3,
        accepted=accepted,
        test=test,
        tried=(test,),
        cov=cov,
        usual_cov=0.03,
    )
    noise = self_noise("maximum-likelihood", snapshot.csm, dims=snapshot.dims, n_effective=1000.0)
    return replace(
        snapshot,
        results={"maximum-likelihood": noise},
        diagnostics=replace(snapshot.diagnostics, dimensions=(choice,)),
    )


def test_the_error_of_further_dimensions_is_not_averaged_away() -> None:
    settings = replace(SETTINGS, methods=("maximum-likelihood",))
    plain, wide = (with_further_dimensions(cov, accepted=True) for cov in (0.0, 0.2))
    (said,) = (str(each) for each in Result(plain, settings).facts if each.name == CHOSEN)
    assert said.endswith("no noise that all sensors share.")  # it is like such a dimension
    noise = plain.results["maximum-likelihood"]
    for band, share in (((1.0, 10.0), 0.1), ((20.0, 30.0), 0.0)):  # 2.5 times 0.2 squared
        (old, *_), (new, *_) = (
            Result(s, settings).means(noise.method, band) for s in (plain, wide)
        )
        assert new.mean == old.mean
        wanted = old.high[0] * (1 + 1.96 * share)
        assert new.high[0] == pytest.approx(wanted, rel=1e-3)
    assert Source.DIMENSIONS in {each.source for each in contributions(wide, noise.method)}


@pytest.mark.parametrize(("accepted", "verdict"), [(True, Verdict.PASS), (False, None)])
def test_dimensions_that_do_not_explain_the_averages_decide_nothing(
    accepted: bool, verdict: Verdict | None
) -> None:
    settings = replace(SETTINGS, methods=("maximum-likelihood",))
    snapshot = with_further_dimensions(0.04, accepted=accepted)
    found = verdict_on(snapshot, 1.05e-11, settings=settings)
    assert found.verdict is (verdict or Verdict.NOT_DECIDED)
    if verdict is None:
        undecided = {each.obstacle for each in found.having(Verdict.NOT_DECIDED)}
        assert undecided == {Obstacle.MODEL_MISFIT}


# --- wrong sensitivities ---------------------------------------------------------------------


NOISE = 1e-12
N_AVERAGES = 600


def snapshot_of(
    rng: np.random.Generator, gains: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> Snapshot:
    """Return three sensors turned anyhow, whose channels read the motion so many times."""
    given = diagnosed(n_effective=float(N_AVERAGES))
    turned = np.concatenate(Rotation.random(3, rng=rng).as_matrix())
    motion = 10.0 ** rng.uniform(2, 5) * NOISE / np.maximum(given.frequency, 0.5)[:, None, None]
    true = motion * (turned @ np.diag([1.0, 1.5, 0.7]) @ turned.T) + NOISE * np.eye(9)
    csm = wishart(true.astype(np.complex128), N_AVERAGES, rng)[0] * gains[:, None] * gains
    diagnosis = given.diagnostics.diagnosis
    assert diagnosis is not None
    responses = tuple(
        relative_response(csm, given.frequency, dims=given.dims, first=i, second=j)
        for i, j in ((0, 1), (0, 2), (1, 2))
    )
    noise = self_noise("three-sensor", csm, dims=given.dims, n_effective=float(N_AVERAGES))
    return replace(
        given,
        csm=csm,
        results={"three-sensor": noise},
        diagnostics=replace(
            given.diagnostics, diagnosis=replace(diagnosis, responses=responses, advice=())
        ),
    )


def drawn_gains(rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return wrong gains, beyond 5 %, of one channel or of a whole sensor."""
    gains = np.ones(9)
    wrong = float(np.exp(rng.uniform(np.log(1.051), np.log(30)) * rng.choice([-1, 1])))
    sensor, channel = rng.integers(3), rng.integers(3)
    gains[3 * sensor : 3 * sensor + 3] = wrong if rng.random() < 0.5 else 1.0
    gains[3 * sensor + channel] = wrong
    return gains


@pytest.mark.parametrize(
    ("n_draws", "seed"), [(12, 5), pytest.param(200, 6, marks=pytest.mark.study)]
)
def test_no_channel_passes_by_its_wrong_gain(n_draws: int, seed: int) -> None:
    """The noise is 1 dB above the limit."""
    rng = np.random.default_rng(seed)
    for _ in range(n_draws):
        gains = drawn_gains(rng)
        found = verdict_on(snapshot_of(rng, gains), NOISE / 10**0.1)
        assert not any(each.verdict is Verdict.PASS for each in found.limits)


@pytest.mark.parametrize("limit", [10 * NOISE, 0.1 * NOISE])
def test_a_sound_bench_keeps_its_verdict(limit: float) -> None:
    for seed in range(4):
        snapshot = snapshot_of(np.random.default_rng(seed), np.ones(9))
        found = verdict_on(snapshot, limit)
        assert found.sensitivities == ()
        assert found.verdict is (Verdict.PASS if limit > NOISE else Verdict.FAIL)


def test_the_verdict_names_sensor_factor_and_cause() -> None:
    gains = np.repeat([1.0, 1.0, 0.3], 3)
    snapshot = snapshot_of(np.random.default_rng(2), gains)
    found = verdict_on(snapshot, NOISE / 2)  # C reads 0.09 of its noise
    assert {each.verdict for each in found.limits if each.sensor == "C"} == {Verdict.NOT_DECIDED}
    assert {each.obstacle for each in found.limits if each.sensor == "C"} == {Obstacle.SENSITIVITY}
    assert [each.channels for each in found.sensitivities] == [("C.X", "C.Y", "C.Z")]
    assert found.sensitivities[0].gain == pytest.approx(0.3, rel=0.02)
    assert found.sensitivities[0].against == ("A", "B")
    assert "(" not in found.sensitivities[0].line
    by_gravity = replace(found.sensitivities[0], cause=Cause.GRAVITY)
    assert f"({CAUSES[Cause.GRAVITY]})" in by_gravity.line
    # Neither of both sensitivities passes here, or fails there: the verdict does not depend on it.
    assert verdict_on(snapshot, NOISE * 20).verdict is Verdict.PASS
    assert {each.verdict for each in verdict_on(snapshot, NOISE / 40).limits} == {Verdict.FAIL}


def test_a_sensor_that_was_carried_away_is_not_told_to_correct_its_sensitivity() -> None:
    snapshot = snapshot_of(np.random.default_rng(2), np.repeat([1.0, 1.0, 0.8], 3))
    diagnosis = snapshot.diagnostics.diagnosis
    assert diagnosis is not None
    away = NoSharedMotion(
        rank=Rank.INVALIDATES, sensors=(2,), partners=(0, 1), share=0.0, share_of_partners=1.0
    )
    diagnostics = replace(snapshot.diagnostics, diagnosis=replace(diagnosis, advice=(away,)))
    for given in (snapshot, replace(snapshot, diagnostics=diagnostics)):
        (wrong,) = verdict_on(given, NOISE / 1.3).sensitivities
        assert (wrong.cause is Cause.CHANGED) == (given is not snapshot)
        assert ("correct its sensitivity" in wrong.line) == (given is snapshot)
    assert str(wrong).endswith("(it changed in the test). Record again.")


def test_a_limit_failed_only_by_a_wrong_sensitivity_is_not_failed() -> None:
    snapshot = snapshot_of(np.random.default_rng(2), np.repeat([3.0, 1.0, 1.0], 3))
    found = verdict_on(snapshot, 3 * NOISE)
    assert found.verdict is Verdict.NOT_DECIDED
    assert found.obstacles == (Obstacle.SENSITIVITY,)
    assert found.prediction is None
