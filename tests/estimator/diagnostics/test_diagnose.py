"""Diagnostics in numbers and in words, on models whose faults are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.diagnostics.diagnose import Diagnostics, diagnose
from estimator.errors import EstimatorError, InsufficientDataError, InvalidMatrixError
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import model_test
from estimator.self_noise.three_sensor import three_sensor
from tests.estimator.csm_models import pentagon, plane_waves, random_bench, wishart

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray

FREQUENCY = np.linspace(1, 20, 96)
THREE = (3, 3, 3)
INDEPENDENT = np.zeros(0)


def averages(csm: ComplexArray, *, n: int = 1080, seed: int = 1) -> ComplexArray:
    whole = np.broadcast_to(csm, (len(FREQUENCY), *csm.shape[-2:]))
    return np.asarray(wishart(whole, n, np.random.default_rng(seed))[0])


def bench(*sensors: FloatArray, motion: FloatArray | None = None) -> ComplexArray:
    channels = np.concatenate(sensors)
    strength = np.diag([100.0, 150, 80]) if motion is None else motion
    return np.asarray(channels @ strength @ channels.T + np.eye(len(channels)), np.complex128)


def of(csm: ComplexArray, *, dims: tuple[int, ...] = THREE, n: int = 1080) -> Diagnostics:
    return diagnose(csm, FREQUENCY, dims=dims, n_effective=n, neighbours=INDEPENDENT)


def test_a_good_bench_gets_no_warning() -> None:
    found = of(averages(bench(np.eye(3), np.eye(3), np.eye(3))))
    assert [advice for advice in found.advice if advice.level != "note"] == []
    assert np.all(found.dimension == 3)
    assert np.median(found.snr[:, 0]) == pytest.approx(100, rel=0.05)
    assert np.median(found.snr[:, 1]) == pytest.approx(150, rel=0.05)
    assert found.coherence.shape == (96, 3)
    assert np.median(found.coherence) == pytest.approx((80 / 81) ** 2, abs=0.005)
    assert found.condition.max() < 1.5
    assert [band.test.p_value > 0.001 for band in found.bands].count(False) == 0


def test_turned_sensors_are_told_with_their_angle() -> None:
    turned = Rotation.from_euler("z", -4.1, degrees=True).as_matrix()
    found = of(averages(bench(np.eye(3), turned, np.eye(3))))
    texts = [advice for advice in found.advice if "are turned by" in advice.text]
    assert [advice.sensors for advice in texts] == [(0, 1), (1, 2)]
    assert texts[0].text.startswith("Sensors 1 and 2 are turned by 4.1°")
    assert "no bias" in texts[0].text
    assert texts[0].numbers["angle_deg"] == pytest.approx(4.1, abs=0.1)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (np.diag([1.0, 1.05, 1.0]), "2.2 reads 1.05"),
        (np.diag([1.0, -1.0, 1.0]), "2.2 has the opposite polarity"),
        (np.array([[1, 0, 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]]), "5.7° away"),
    ],
    ids=["gain", "polarity", "not orthogonal"],
)
def test_faults_of_one_sensor(fault: FloatArray, words: str) -> None:
    found = of(averages(bench(np.eye(3), fault, np.eye(3))))
    assert any(words in advice.text for advice in found.advice if 1 in advice.sensors)


def test_swapped_channels_are_told_from_a_turned_sensor() -> None:
    near = Rotation.from_euler("z", 7, degrees=True).as_matrix()
    found = of(averages(bench(np.eye(3), near[[1, 0, 2]], np.eye(3))))
    swapped = [advice for advice in found.advice if "swapped" in advice.text]
    assert [advice.sensors for advice in swapped] == [(0, 1), (1, 2)]
    assert "2.1 moves as 1.2 does, 2.2 moves as 1.1 does" in swapped[0].text
    assert not any("polarity" in advice.text for advice in found.advice)
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    other = of(averages(bench(np.eye(3), turned, np.eye(3))))
    assert not any("swapped" in advice.text for advice in other.advice)
    assert any("turned by 90.0°" in advice.text for advice in other.advice)


def test_incoherence_is_a_problem_where_it_is() -> None:
    csm = plane_waves(FREQUENCY, pentagon()[:3], snr=400.0)
    found = of(averages(csm))
    (problem,) = [advice for advice in found.advice if advice.level == "problem"]
    assert "does not explain" in problem.text
    assert problem.band is not None
    assert problem.band[0] > 2
    assert problem.band[1] == FREQUENCY[-1]
    assert found.bands[-1].test.p_value < 1e-10
    assert "dimension auto" not in problem.remedy
    five = of(averages(plane_waves(FREQUENCY, pentagon(), snr=400.0)), dims=(3,) * 5)
    assert any("dimension auto" in advice.remedy for advice in five.advice)


def test_planar_sensors_in_motion_of_three_dimensions_are_told_why() -> None:
    tilted = Rotation.from_euler("x", 10, degrees=True).as_matrix()
    two = [tilted[:2], np.eye(3)[:2], tilted.T[:2]]
    found = of(averages(bench(*two)), dims=(2, 2, 2))
    assert any("use triaxial data" in advice.remedy for advice in found.advice)


def test_a_missing_dimension_is_seen() -> None:
    flat = np.diag([100.0, 150.0, 0.0])
    turned = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    found = of(averages(bench(np.eye(3), turned, np.eye(3), motion=flat)))
    assert np.mean(found.dimension == 2) > 0.95
    assert any("only 2 of 3 dimensions" in advice.text for advice in found.advice)


def test_noise_alone_is_said_to_be_so() -> None:
    rng = np.random.default_rng(3)
    csm = random_bench(rng, dims=THREE, snr=0.05, noise_psd=np.ones(9))
    found = of(averages(csm))
    assert any("weaker than the noise" in advice.text for advice in found.advice)
    assert not any("left in" in advice.numbers for advice in found.advice)  # too many averages


@pytest.mark.parametrize("snr", [0.1, 0.3])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_motion_left_in_by_few_averages_is_no_silent_bias(d: int, snr: float) -> None:
    """What is said of twenty averages holds, and is no more than twice as much at its worst."""
    rng = np.random.default_rng(d)
    csm = random_bench(rng, dims=(d,) * 3, snr=snr, noise_psd=np.ones(3 * d))
    found = of(averages(csm, n=20), dims=(d,) * 3, n=20)
    said = [advice for advice in found.advice if "left in" in advice.numbers]
    covered = sum(a.band[0] <= f <= a.band[1] for a in said if a.band for f in FREQUENCY)
    assert covered > 0.8 * len(FREQUENCY)
    assert "too high" in said[0].text
    draws = wishart(csm, 20, rng, n_draws=8000)
    noise = three_sensor(draws, dims=(d,) * 3, n_effective=20).noise_psd
    bias = noise.mean() - 1
    error = noise.mean(axis=1).std() / np.sqrt(len(draws))
    assert bias > 5 * error
    assert bias - 3 * error < said[0].numbers["left in"] < 2 * bias


def test_a_lagging_sensor() -> None:
    phase = np.exp(-2j * np.pi * FREQUENCY[:, None] * np.repeat([0, 0.02, 0], 3))
    csm = phase[:, :, None] * (bench(*[np.eye(3)] * 3) - np.eye(9)) * phase[:, None].conj()
    found = of(averages(csm + np.eye(9)))
    lags = [advice for advice in found.advice if "lags" in advice.text]
    assert lags[0].sensors == (0, 1)
    assert lags[0].numbers["delay_s"] == pytest.approx(0.02, rel=0.01)
    assert lags[0].numbers["samples"] == pytest.approx(0.8, rel=0.01)


def test_a_dead_channel_leaves_the_rest_of_the_bench_its_diagnostics() -> None:
    csm = averages(bench(*[np.eye(3)] * 4))
    whole = diagnose(csm, FREQUENCY, dims=(3,) * 4, n_effective=1080, neighbours=INDEPENDENT)
    alive = np.delete(np.arange(12), 4)
    part = csm[:, alive[:, None], alive]
    csm[:, 4, :] = csm[:, :, 4] = 0
    csm[5] = np.nan
    found = diagnose(
        csm,
        FREQUENCY,
        dims=(3,) * 4,
        n_effective=1080,
        neighbours=INDEPENDENT,
        names=("A", "B", "C", "D"),
        channels=("X", "Y", "Z") * 4,
    )
    (problem,) = [advice for advice in found.advice if advice.level == "problem"]
    assert problem.text.startswith("B.Y has no signal")
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


def test_a_signal_wired_twice_is_named_with_its_twin() -> None:
    csm = averages(bench(*[np.eye(3)] * 3))
    csm[:, 4, :] = csm[:, 1, :]
    csm[:, :, 4] = csm[:, :, 1]
    found = diagnose(
        csm,
        FREQUENCY,
        dims=THREE,
        n_effective=1080,
        names=("A", "B", "C"),
        channels=("X", "Y", "Z") * 3,
    )
    problem, warning = (a for a in found.advice if a.level != "note")
    assert "B.Y repeats A.Y" in problem.text
    assert problem.sensors == (0, 1)
    assert "three-sensor estimates say nothing of A and C" in warning.text
    assert "maximum-likelihood" in warning.remedy
    assert np.median(found.model.p_value) > 0.2
    assert np.isfinite(found.model.p_value).all()


@pytest.mark.parametrize("how", ["dead", "copied"])
def test_two_sensors_that_are_left_are_told_what_can_still_be_said(how: str) -> None:
    csm = averages(bench(*[np.eye(3)] * 3))
    if how == "dead":
        csm[:, 6:, :] = csm[:, :, 6:] = 0
    else:
        csm[:, 6:, :] = csm[:, 3:6, :]
        csm[:, :, 6:] = csm[:, :, 3:6]
    found = of(csm)
    (left,) = [advice for advice in found.advice if "signal of their own" in advice.text]
    assert left.text.startswith("Only sensors 1 and 2 have")
    assert left.level == "problem"
    assert "no channel's noise is above its own spectrum" in left.text
    assert "--method two-channel" in left.remedy
    assert np.isnan(found.model.p_value).all()
    assert np.all(found.dimension == 3)


def test_nothing_alive_is_said_too() -> None:
    found = of(np.zeros((96, 9, 9), np.complex128))
    assert any("Fewer than two sensors" in advice.text for advice in found.advice)
    assert found.responses == ()


def test_a_small_certain_misfit_is_graded_by_what_it_does() -> None:
    """Noise shared by two channels: a few per cent of it, in many averages of many frequencies."""
    turned = [Rotation.from_rotvec(v).as_matrix() for v in ([1, 2, -1], [-0.5, 0.4, 1], [0, 1, 2])]
    csm = bench(*turned)
    csm[0, 3] += 0.1
    csm[3, 0] += 0.1
    n = 8000
    found = of(averages(csm, n=n), n=n)
    misfits = [advice for advice in found.advice if "does not explain" in advice.text]
    misfit = max(misfits, key=lambda advice: advice.numbers["worst"])
    truth = maximise(csm[None], 3)
    off = np.abs(truth.psi - 1).max()
    seen = np.sqrt(2 * truth.discrepancy[0] / 27)
    assert misfit.level == "warning"
    assert "certain, but small" in misfit.text
    assert misfit.numbers["worst"] < 2.5
    assert misfit.numbers["unexplained"] == pytest.approx(seen, rel=0.2)
    assert off < misfit.numbers["off"] < 5 * off
    assert "may be off, by up to about" in misfit.text
    assert "sensors closer together" in misfit.remedy


def test_a_good_test_is_seldom_said_to_fail_in_any_band() -> None:
    """One in a hundred, however many bands are tested: with one in a hundred each, 19 of these."""
    rng = np.random.default_rng(11)
    csm = np.broadcast_to(bench(*[np.eye(2)] * 3, motion=np.diag([100.0, 150])), (96, 6, 6))
    draws = wishart(csm, 400, rng, n_draws=250)
    found = [of(draw, dims=(2, 2, 2), n=400) for draw in draws]
    failing = sum(any("does not explain" in a.text for a in each.advice) for each in found)
    assert failing <= 8  # Poisson of mean 2.5: more in one of a thousand


def test_what_waves_do_stays_within_what_is_said() -> None:
    csm = plane_waves(FREQUENCY, pentagon()[:3], snr=100.0)
    found = of(averages(csm, n=8000), n=8000)
    problems = [advice for advice in found.advice if "does not explain" in advice.text]
    off = np.abs(maximise(csm[-1:], 3).psi - 1).max()
    assert any(off < advice.numbers["off at most"] < 4 * off for advice in problems)


@pytest.mark.parametrize("d", [1, 2])
def test_sensors_of_fewer_channels_are_told_what_their_sensor_space_asks(d: int) -> None:
    """Section 5: the motion's dimension against the sensors'."""
    motion = np.diag([100.0, 150.0])[:d, :d]
    found = of(averages(bench(*[np.eye(d)] * 3, motion=motion)), dims=(d,) * 3)
    (space,) = [advice for advice in found.advice if "three dimensions of motion" in advice.text]
    assert "parallel" in space.remedy
    assert space.numbers["added by 1 degree"] == pytest.approx(
        space.numbers["SNR"] * 3.05e-4, rel=0.01
    )
    assert not any(
        "three dimensions" in a.text for a in of(averages(bench(*[np.eye(3)] * 3))).advice
    )


@pytest.mark.parametrize(
    ("dims", "concerned"),
    [
        ((3, 2, 2), [(2, (0, 1, 2))]),
        ((3, 3, 2), [(2, (0, 1))]),
        ((3, 2, 1), [(1, (0, 1)), (2, (2,))]),
        ((3, 3, 2, 3), []),
    ],
)
def test_sensors_of_unequal_channels_are_told_which_of_them_are_compared(
    dims: tuple[int, ...], concerned: list[tuple[int, tuple[int, ...]]]
) -> None:
    """As `three_sensor` does: with the two other sensors that have most channels."""
    csm = bench(*(np.eye(3)[:k] for k in dims))
    found = diagnose(
        averages(csm), FREQUENCY, dims=dims, n_effective=1080, names=tuple("ABCD")[: len(dims)]
    )
    space = [advice for advice in found.advice if "three dimensions of motion" in advice.text]
    assert [advice.sensors for advice in space] == [sensors for _, sensors in concerned]
    for advice, (d, _) in zip(space, concerned, strict=True):
        assert f"these feel {d} of three" in advice.text
        assert 100 < advice.numbers["SNR"] < 300  # of channels whose noise is known
        assert "maximum likelihood, which compares with the further channels of A" in advice.remedy


@pytest.mark.parametrize("dims", [(3, 2, 1), (3, 3, 1), (2, 2, 1)])
def test_a_good_bench_of_unequal_sensors_is_seldom_said_to_fail(dims: tuple[int, ...]) -> None:
    """Two channels alone feel a dimension: their noise is divided anyhow, and fits no better."""
    n, n_freqs = 1080, 1500
    directions = [
        Rotation.from_euler("x", 3 * i, degrees=True).as_matrix()[:k] for i, k in enumerate(dims)
    ]
    csm = np.broadcast_to(bench(*directions), (n_freqs, sum(dims), sum(dims)))
    draws = wishart(csm, n, np.random.default_rng(6))[0]
    model = diagnose(draws, np.arange(1.0, n_freqs + 1), dims=dims, n_effective=n).model
    degrees = model.degrees.sum()
    assert model.statistic.sum() < degrees + 4 * np.sqrt(2 * degrees)
    assert np.mean(model.p_value < 0.01) < 0.01 + 4 * np.sqrt(0.01 / n_freqs)


def test_a_model_of_fewer_dimensions_than_the_motion_fails_in_its_own_name() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))
    for q, model in ((0, "a model without motion"), (1, "one motion of 1 dimension"), (3, "")):
        found = diagnose(
            csm, FREQUENCY, dims=THREE, n_effective=1080, n_factors=q, neighbours=INDEPENDENT
        )
        failing = [advice for advice in found.advice if "does not explain" in advice.text]
        assert found.n_factors == q
        assert bool(failing) == bool(model)
        for advice in failing:
            assert advice.level == "problem"
            assert f"{model} does not explain what the sensors have in common" in advice.text
            assert "--dimension auto" in advice.remedy
        assert np.median(found.snr) > 50  # whatever is tested
    assert np.isfinite(found.model.p_value).all()


@pytest.mark.parametrize("rank", [0, 1])
def test_the_dimension_is_overrated_as_seldom_as_its_level_says(rank: int) -> None:
    """Bartlett's degrees of freedom: with fewer it would be too often, with more hardly ever."""
    n_freqs, n = 3000, 40
    csm = bench(*[np.eye(2)] * 3, motion=np.diag([1e6 * rank, 0.0]))
    draws = wishart(np.broadcast_to(csm, (n_freqs, 6, 6)), n, np.random.default_rng(5))[0]
    found = diagnose(draws, np.linspace(1, 20, n_freqs), dims=(2, 2, 2), n_effective=n)
    share = np.mean(found.dimension > rank)
    assert 0.004 < share < 0.016  # 1 % ± 0.18 %, and what Bonferroni and the expansion leave open


def test_zero_frequency_is_no_part_of_the_test() -> None:
    """There the spectra are real, and their scatter another."""
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))
    frequency = FREQUENCY - FREQUENCY[0]
    found = diagnose(csm, frequency, dims=THREE, n_effective=1080, neighbours=INDEPENDENT)
    assert np.isnan(found.model.statistic[0])
    assert found.bands[0].test.n_frequencies == np.sum(frequency <= found.bands[0].high) - 1


def test_early_averages_leave_the_model_open() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)), n=9)
    found = of(csm, n=9)
    assert np.isnan(found.model.p_value).all()
    assert len(found.responses) == 3


def test_refusals() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))
    with pytest.raises(InvalidMatrixError, match="frequency"):
        diagnose(csm, FREQUENCY[:5], dims=THREE, n_effective=100)
    with pytest.raises(InsufficientDataError, match="2 sensors"):
        diagnose(csm[:, :6, :6], FREQUENCY, dims=(3, 3), n_effective=100)
    with pytest.raises(InvalidMatrixError, match="rising"):
        diagnose(csm, FREQUENCY[::-1], dims=THREE, n_effective=100)
    for n in (np.nan, np.inf, -1):
        with pytest.raises(InsufficientDataError, match="finite number above zero"):
            diagnose(csm, FREQUENCY, dims=THREE, n_effective=n)
    for labels in ({"names": ("a", "b")}, {"channels": ("x", "y", "z")}):
        with pytest.raises(EstimatorError, match="expected 3 and 9"):
            diagnose(csm, FREQUENCY, dims=THREE, n_effective=100, **labels)


def test_lists_do_as_well_as_arrays() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))[:12]
    array = diagnose(csm, FREQUENCY[:12], dims=THREE, n_effective=100)
    lists = diagnose(csm.tolist(), FREQUENCY[:12].tolist(), dims=THREE, n_effective=100)
    np.testing.assert_array_equal(lists.snr, array.snr)
