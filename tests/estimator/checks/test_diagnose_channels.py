"""Diagnoses of benches with dead, copied or missing channels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.checks.advice import Rank, Untested
from estimator.checks.advice_on_model import MotionAcross
from estimator.checks.advice_on_signals import Copies, MissingChannels, NoSignal, TooFewSensors
from estimator.checks.diagnose import diagnose
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import model_test
from tests.estimator.checks.test_diagnose import (
    FREQUENCY,
    INDEPENDENT,
    THREE,
    advice_of,
    averages,
    bench,
    of,
)
from tests.estimator.csm_models import wishart


def test_a_dead_channel_leaves_the_rest_of_the_bench_its_diagnostics() -> None:
    csm = averages(bench(*[np.eye(3)] * 4))
    whole = diagnose(csm, FREQUENCY, dims=(3,) * 4, n_effective=1080, neighbours=INDEPENDENT)
    alive = np.delete(np.arange(12), 4)
    part = csm[:, alive[:, None], alive]
    csm[:, 4, :] = csm[:, :, 4] = 0
    csm[5] = np.nan
    found = diagnose(csm, FREQUENCY, dims=(3,) * 4, n_effective=1080, neighbours=INDEPENDENT)
    (problem,) = [advice for advice in found.advice if advice.rank is Rank.INVALIDATES]
    assert isinstance(problem, NoSignal)
    assert (problem.sensors, problem.channels, problem.whole_sensor) == ((1,), (4,), False)
    assert problem.share_of_frequencies == 1
    known = np.delete(np.arange(96), 5)
    assert np.isnan(found.model.statistic[5])
    direct = model_test(maximise(part[known], 3), n_effective=1080)  # never there: fewer degrees
    np.testing.assert_allclose(found.model.statistic[known], direct.statistic, rtol=1e-6)
    np.testing.assert_array_equal(found.model.degrees[known], direct.degrees)
    assert np.isnan(found.snr[:, 4]).all()
    np.testing.assert_allclose(found.snr[known, 0], whole.snr[known, 0], rtol=0.5)
    assert np.all(found.dimension[known] == 3)
    assert np.isfinite(found.coherence[known]).all()
    assert {(r.first, r.second) for r in found.responses} == {(0, 2), (0, 3), (2, 3)}


def test_each_of_many_sensors_is_compared_with_some_spread_over_the_bench() -> None:
    csm = averages(bench(*[np.eye(3)] * 9))
    csm[:, :3, 3:] = csm[:, 3:, :3] = 0  # the first shares no motion
    found = diagnose(csm, FREQUENCY, dims=(3,) * 9, n_effective=1080, neighbours=INDEPENDENT)
    pairs = {(each.first, each.second) for each in found.responses}
    assert all(0 not in pair for pair in pairs)
    assert {(1, each) for each in range(2, 9)} <= pairs  # all with the first that compares
    partners = {1, 2, 3, 5, 6, 8}
    assert pairs == {(j, k) for k in range(2, 9) for j in range(1, k) if {j, k} & partners}
    gains = {pair.gains.round(1).tobytes() for pair in found.responses}
    assert gains == {np.ones(3).tobytes()}


def test_a_signal_connected_twice_is_reported_with_its_copy() -> None:
    csm = averages(bench(*[np.eye(3)] * 3))
    csm[:, 4, :] = csm[:, 1, :]
    csm[:, :, 4] = csm[:, :, 1]
    found = diagnose(csm, FREQUENCY, dims=THREE, n_effective=1080)
    problem, warning = (a for a in found.advice if a.rank is not Rank.TO_KNOW)
    assert isinstance(problem, Copies)
    assert (problem.sensors, problem.channels) == ((0, 1), ((1, 4),))
    assert isinstance(warning, MissingChannels)
    assert (warning.sensors, warning.whole_sensors) == ((1,), (0, 2))
    assert np.median(found.model.p_value) > 0.2
    assert np.isfinite(found.model.p_value).all()


@pytest.mark.parametrize("how", ["dead", "copied"])
def test_two_remaining_sensors_get_the_possible_advice(how: str) -> None:
    csm = averages(bench(*[np.eye(3)] * 3))
    if how == "dead":
        csm[:, 6:, :] = csm[:, :, 6:] = 0
    else:
        csm[:, 6:, :] = csm[:, 3:6, :]
        csm[:, :, 6:] = csm[:, :, 3:6]
    found = of(csm)
    (left,) = advice_of(TooFewSensors, found)
    assert left.sensors == (0, 1)
    assert left.rank is Rank.INVALIDATES
    if how == "dead":
        (dead,) = advice_of(NoSignal, found)
        assert (dead.sensors, dead.channels, dead.whole_sensor) == ((2,), (6, 7, 8), True)
    else:
        (copies,) = advice_of(Copies, found)
        assert copies.channels == ((3, 6), (4, 7), (5, 8))
    assert found.untested is Untested.TOO_FEW_SENSORS
    assert np.isnan(found.model.p_value).all()
    assert np.all(found.dimension == 3)


def test_a_bench_without_signal_is_reported() -> None:
    found = of(np.zeros((96, 9, 9), np.complex128))
    (left,) = advice_of(TooFewSensors, found)
    assert left.sensors == ()
    assert found.untested is Untested.TOO_FEW_SENSORS
    assert found.responses == ()


@pytest.mark.parametrize("d", [1, 2])
def test_sensors_of_fewer_channels_get_advice_on_their_sensor_space(d: int) -> None:
    """Section 5: the motion's dimension against the sensors'."""
    motion = np.diag([100.0, 150.0])[:d, :d]
    found = of(averages(bench(*[np.eye(d)] * 3, motion=motion)), dims=(d,) * 3)
    (space,) = advice_of(MotionAcross, found)
    assert (space.n_channels, space.sensors, space.larger_sensors) == (d, (), ())
    assert space.added_by_one_degree == pytest.approx(space.snr * 3.05e-4, rel=0.01)
    assert not advice_of(MotionAcross, of(averages(bench(*[np.eye(3)] * 3))))


@pytest.mark.parametrize(
    ("dims", "concerned"),
    [
        ((3, 2, 2), [(2, (0, 1, 2), (0,))]),
        ((3, 3, 2), [(2, (0, 1), (0, 1))]),
        ((3, 2, 1), [(1, (0, 1), (0, 1)), (2, (2,), (0,))]),
        ((3, 3, 2, 3), []),
    ],
)
def test_sensors_of_unequal_channels_get_advice_on_the_compared_channels(
    dims: tuple[int, ...], concerned: list[tuple[int, tuple[int, ...], tuple[int, ...]]]
) -> None:
    """As `three_sensor` does: with the two other sensors that have most channels."""
    csm = bench(*(np.eye(3)[:k] for k in dims))
    found = diagnose(averages(csm), FREQUENCY, dims=dims, n_effective=1080)
    space = advice_of(MotionAcross, found)
    assert [(a.n_channels, a.sensors, a.larger_sensors) for a in space] == concerned
    assert all(100 < advice.snr < 300 for advice in space)  # of channels whose noise is known


@pytest.mark.long
@pytest.mark.parametrize("dims", [(3, 2, 1), (3, 3, 1), (2, 2, 1)])
def test_a_sound_bench_of_unequal_sensors_seldom_fails(dims: tuple[int, ...]) -> None:
    """Two channels alone feel a dimension: their noise is divided anyhow, and fits no better."""
    n, n_freqs = 1080, 600  # a degree less of 2 to 6 at each is then 5 to 9 standard deviations
    directions = [
        Rotation.from_euler("x", 3 * i, degrees=True).as_matrix()[:k] for i, k in enumerate(dims)
    ]
    csm = np.broadcast_to(bench(*directions), (n_freqs, sum(dims), sum(dims)))
    draws = wishart(csm, n, np.random.default_rng(6))[0]
    model = diagnose(draws, np.arange(1.0, n_freqs + 1), dims=dims, n_effective=n).model
    degrees = model.degrees.sum()
    assert model.statistic.sum() < degrees + 4 * np.sqrt(2 * degrees)
    assert np.mean(model.p_value < 0.01) < 0.01 + 4 * np.sqrt(0.01 / n_freqs)
