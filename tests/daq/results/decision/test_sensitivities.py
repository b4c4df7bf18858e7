"""A limit passed only by a wrong sensitivity is not passed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from daq.estimation.snapshot import Snapshot
from estimator.checks.advice import Rank
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.relative_response import relative_response
from estimator.checks.sensitivities import CAUSES, Cause
from estimator.decision.verdict import Obstacle, Verdict
from estimator.methods import self_noise
from tests.daq.results.decision.benches import verdict_on
from tests.estimator.csm_models import wishart
from tests.tui.example_snapshot import diagnosed

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
