"""Diagnostics on models whose faults are known."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.checks.advice import Advice, Rank, Untested
from estimator.checks.advice_on_model import (
    MissingDimension,
    ModelMisfit,
    TooFewDimensions,
    WeakMotion,
)
from estimator.checks.advice_on_noise import LinesOfOne, ResponseChanges, SharedNoise
from estimator.checks.advice_on_sensors import (
    Delay,
    Gain,
    NotOrthogonal,
    ReversedPolarity,
    Rotated,
    SwappedChannels,
)
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.diagnose import Diagnostics, diagnose
from estimator.checks.rules import advise
from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import rejected_below
from estimator.self_noise.coherency import coherency
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import pentagon, plane_waves, random_bench, wishart

FREQUENCY = np.linspace(1, 20, 96)
THREE = (3, 3, 3)
INDEPENDENT = np.zeros(0)
Kind = TypeVar("Kind", bound=Advice)


def averages(csm: ComplexArray, *, n: int = 1080, seed: int = 1) -> ComplexArray:
    whole = np.broadcast_to(csm, (len(FREQUENCY), *csm.shape[-2:]))
    return np.asarray(wishart(whole, n, np.random.default_rng(seed))[0])


def bench(*sensors: FloatArray, motion: FloatArray | None = None) -> ComplexArray:
    channels = np.concatenate(sensors)
    strength = np.diag([100.0, 150, 80]) if motion is None else motion
    return np.asarray(channels @ strength @ channels.T + np.eye(len(channels)), np.complex128)


def of(csm: ComplexArray, *, dims: tuple[int, ...] = THREE, n: int = 1080) -> Diagnostics:
    return diagnose(csm, FREQUENCY, dims=dims, n_effective=n, neighbours=INDEPENDENT)


def advice_of(kind: type[Kind], found: Diagnostics) -> list[Kind]:
    return [advice for advice in found.advice if isinstance(advice, kind)]


def test_every_kind_of_advice_is_one_class() -> None:
    kinds = {each.__name__: each.name for each in Advice.__subclasses__()}
    assert len(set(kinds.values())) == len(kinds)


def test_a_good_bench_gets_no_warning() -> None:
    found = of(averages(bench(np.eye(3), np.eye(3), np.eye(3))))
    assert [advice for advice in found.advice if advice.rank is not Rank.TO_KNOW] == []
    assert found.untested is None
    assert np.all(found.dimension == 3)
    assert np.median(found.snr[:, 0]) == pytest.approx(100, rel=0.05)
    assert np.median(found.snr[:, 1]) == pytest.approx(150, rel=0.05)
    assert found.coherence.shape == (96, 3)
    assert np.median(found.coherence) == pytest.approx((80 / 81) ** 2, abs=0.005)
    assert found.condition.max() < 1.5
    assert [band.test.p_value > 0.001 for band in found.bands].count(False) == 0


def test_frequencies_without_averages_do_not_count_in_their_band() -> None:
    """A linear trend, taken off, leaves none of four bins: "condition number inf" was said."""
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))
    whole = of(csm).bands[0]
    csm[: whole.n_frequencies // 2 + 1] = np.nan
    found = of(csm).bands[0]
    assert found.condition == pytest.approx(whole.condition, rel=0.1)
    assert found.coherence == pytest.approx(whole.coherence, rel=0.1)


def elsewhere(sensor: int, *, n_sensors: int = 3, snr: float = 100.0) -> ComplexArray:
    """Sensors on one floor, but for one that stands on another and moves as much."""
    csm = snr * np.kron(np.ones((n_sensors, n_sensors)), np.diag([1.0, 1.5, 0.8]))
    apart = np.arange(3 * n_sensors) // 3 == sensor
    csm[apart[:, None] != apart] = 0.0
    return np.asarray(csm + np.eye(3 * n_sensors), np.complex128)


@pytest.mark.parametrize("n", [10, 1080])
@pytest.mark.parametrize("n_sensors", [3, pytest.param(5, marks=pytest.mark.long)])
def test_a_sensor_on_another_floor_is_named(n_sensors: int, n: int) -> None:
    """Without advice that contradicts it, such as to record longer."""
    for sensor in range(3):
        averaged = averages(elsewhere(sensor, n_sensors=n_sensors), n=max(n, 3 * n_sensors))
        found = of(averaged, dims=(3,) * n_sensors, n=max(n, 3 * n_sensors))
        (advice,) = [each for each in found.advice if each.rank is not Rank.TO_KNOW]
        assert isinstance(advice, NoSharedMotion)
        assert advice.sensors == (sensor,)
        assert advice.partners == tuple(i for i in range(n_sensors) if i != sensor)
        assert advice.rank is Rank.INVALIDATES
        assert advice.share < 0.05
        assert advice.share_of_partners > 0.9
        assert advice.band == (1.0, 20.0)
        kinds = {each.name for each in found.advice}
        assert "weak-motion" not in kinds


def test_weakly_coherent_sensors_are_not_reported_without_common_motion() -> None:
    """Where no two agree, where all do, and where one shares a part of the motion."""
    weak = bench(np.eye(3), np.eye(3), np.eye(3), motion=0.05 * np.eye(3))
    assert advice_of(NoSharedMotion, of(averages(weak))) == []
    assert advice_of(NoSharedMotion, of(averages(weak, n=12), n=12)) == []
    noisy = bench(np.eye(3), np.eye(3), np.eye(3)) + np.diag([100.0] * 3 + [0.0] * 6)
    assert advice_of(NoSharedMotion, of(averages(noisy))) == []
    pairs = np.kron(np.kron(np.eye(2), np.ones((2, 2))), 100 * np.eye(3)) + np.eye(12)
    found = of(averages(pairs.astype(np.complex128)), dims=(3,) * 4)
    assert advice_of(NoSharedMotion, found) == []  # who of the two pairs is elsewhere?


def test_a_sensor_coherent_only_at_low_frequencies_is_reported_above_them() -> None:
    together, apart = (averages(each) for each in (elsewhere(9), elsewhere(1)))
    csm = np.where((FREQUENCY < 5)[:, None, None], together, apart)
    (advice,) = advice_of(NoSharedMotion, of(csm))
    assert advice.sensors == (1,)
    assert advice.band is not None
    assert advice.band[0] == pytest.approx(5, abs=1)
    assert advice.band[1] == 20.0


def test_weak_motion_that_the_noise_of_a_sensor_hides_is_to_know() -> None:
    """It has 14 dB more noise than the others, and is coherent with them at low frequencies."""
    strength = 100.0 / FREQUENCY[:, None, None] ** 1.5
    noise = np.repeat([1.0, 1.0, 25.0], 3)
    csm = strength * bench(*3 * [np.eye(3)], motion=np.eye(3)) + np.diag(noise)
    for seed in range(4):
        found = advice_of(NoSharedMotion, of(averages(csm, n=200, seed=seed), n=200))
        assert {each.rank for each in found} <= {Rank.TO_KNOW}


def test_rotated_sensors_are_found_with_their_angle() -> None:
    turned = Rotation.from_euler("z", -4.1, degrees=True).as_matrix()
    found = of(averages(bench(np.eye(3), turned, np.eye(3))))
    rotated = advice_of(Rotated, found)
    assert [advice.sensors for advice in rotated] == [(0, 1), (1, 2)]
    assert {advice.rank for advice in rotated} == {Rank.TO_KNOW}
    assert rotated[0].angle_deg == pytest.approx(4.1, abs=0.1)
    assert rotated[0].error_deg < 0.1
    assert np.isnan(rotated[0].horizontal_deg)  # nobody said which channel is vertical


@pytest.mark.parametrize(
    ("gain", "rank"), [(1.04, Rank.TO_KNOW), (1.1, Rank.DELAYS), (10.0, Rank.DELAYS)]
)
def test_a_wrong_gain_is_found_with_its_channel(gain: float, rank: Rank) -> None:
    found = of(averages(bench(np.eye(3), np.diag([1.0, gain, 1.0]), np.eye(3))))
    first, second = advice_of(Gain, found)
    assert (first.sensors, first.channel, first.counterpart) == ((0, 1), 4, 1)
    assert first.ratio == pytest.approx(gain, rel=0.005)
    assert (second.sensors, second.channel, second.counterpart) == ((1, 2), 7, 4)
    assert second.ratio == pytest.approx(1 / gain, rel=0.005)
    assert (first.rank, second.rank) == (rank, rank)


def test_a_gain_of_a_sensor_that_changes_is_no_wrong_sensitivity() -> None:
    """Of a sensor that was carried away, the first line said "correct its sensitivity"."""
    csm = averages(bench(np.eye(3), np.eye(3), 0.8 * np.eye(3)))
    found = of(csm)
    change = ResponseChanges(
        rank=Rank.DELAYS, sensors=(2,), channel=None, is_turn=False, size=-0.5, size_error=0.01,
        begin=30.0, end=30.0, variance=0.06,
    )  # fmt: skip
    advice = advise(
        found.bands, found.responses, coherency(csm, THREE), dims=THREE, n_factors=3,
        n_effective=1080, nyquist=100.0, further=(change,),
    )  # fmt: skip
    gains = [each for each in advice if isinstance(each, Gain)]
    assert len(gains) == 2
    assert {each.rank for each in gains} == {Rank.TO_KNOW}
    assert {each.rank for each in advice_of(Gain, found)} == {Rank.DELAYS}


def test_reversed_polarity_is_found_with_its_channel() -> None:
    found = of(averages(bench(np.eye(3), np.diag([1.0, -1.0, 1.0]), np.eye(3))))
    first, second = advice_of(ReversedPolarity, found)
    assert (first.sensors, first.channel, first.counterpart) == ((0, 1), 4, 1)
    assert (second.sensors, second.channel, second.counterpart) == ((1, 2), 7, 4)
    assert first.rank is Rank.DELAYS


def test_a_channel_whose_phase_turns_over_the_band_is_neither_weak_nor_reversed() -> None:
    """What it has in common with others cancels in sums over the band: gains were .01 or 20."""
    late = np.ones((len(FREQUENCY), 9), np.complex128)
    late[:, 4] = np.exp(-2j * np.pi * FREQUENCY * 0.1)
    csm = bench(*3 * [np.eye(3)]) * late[:, :, None] * late[:, None].conj()
    for seed in range(4):
        found = of(averages(csm, seed=seed))
        assert not advice_of(Gain, found)
        assert not advice_of(ReversedPolarity, found)


def test_a_reversed_channel_is_named_beside_one_whose_phase_turns() -> None:
    late = np.ones((len(FREQUENCY), 9), np.complex128)
    late[:, 4] = np.exp(-2j * np.pi * FREQUENCY * 0.1)
    csm = bench(np.eye(3), np.diag([-1.0, 1, 1]), np.eye(3))
    for seed in range(4):
        found = of(averages(csm * late[:, :, None] * late[:, None].conj(), seed=seed))
        named = {(each.counterpart, each.channel) for each in advice_of(ReversedPolarity, found)}
        assert named == {(0, 3)}


@pytest.mark.parametrize(
    ("angle_deg", "level"), [(5.7, Rank.TO_KNOW), (25.0, Rank.DELAYS)], ids=["some", "much"]
)
def test_channels_that_are_not_orthogonal(angle_deg: float, level: Rank) -> None:
    angle = np.deg2rad(angle_deg)
    fault = np.array([[1, 0, 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    found = of(averages(bench(np.eye(3), fault, np.eye(3))))
    skewed = advice_of(NotOrthogonal, found)
    assert skewed[0].sensors == (0, 1)
    assert skewed[0].deviation_deg == pytest.approx(angle_deg, abs=0.2)
    assert skewed[0].rank is level


def test_swapped_channels_are_distinguished_from_a_rotated_sensor() -> None:
    near = Rotation.from_euler("z", 7, degrees=True).as_matrix()
    found = of(averages(bench(np.eye(3), near[[1, 0, 2]], np.eye(3))))
    swapped = advice_of(SwappedChannels, found)
    assert [advice.sensors for advice in swapped] == [(0, 1), (1, 2)]
    assert swapped[0].channels == ((3, 1), (4, 0))
    assert swapped[1].channels == ((6, 4), (7, 3))
    assert not advice_of(ReversedPolarity, found)
    far = Rotation.from_euler("z", 60, degrees=True).as_matrix()
    beside = of(averages(bench(np.eye(3), near[[1, 0, 2]], far)))  # of it no swap is said
    assert [advice.sensors for advice in advice_of(SwappedChannels, beside)] == [(0, 1)]
    assert not advice_of(ReversedPolarity, beside)
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    other = of(averages(bench(np.eye(3), turned, np.eye(3))))
    assert not advice_of(SwappedChannels, other)
    assert advice_of(Rotated, other)[0].angle_deg == pytest.approx(90, abs=0.1)


@pytest.mark.parametrize("snr", [0.3, 1e4])
def test_noise_that_one_sensor_shares_within_does_not_fail_the_model(snr: float) -> None:
    """The paper's formula is unbiased for it; motion that differs still fails, next test."""
    rng = np.random.default_rng(46)
    csm = random_bench(rng, dims=(3, 3, 3), snr=snr, noise_psd=np.ones(9))
    csm[3:6, 3:6] += np.outer([1.0, 0.7, 0.5], [1.0, 0.7, 0.5])
    frequency = np.linspace(1, 20, 40)
    found = diagnose(
        wishart(csm, 226, rng, n_draws=40),
        frequency,
        dims=(3, 3, 3),
        n_effective=226,
        neighbours=np.zeros(0),
    )
    assert min(band.test.p_value for band in found.bands) > rejected_below(
        band.test for band in found.bands
    )
    assert not [each for each in found.advice if isinstance(each, ModelMisfit)]


def test_incoherence_is_reported_in_its_band() -> None:
    csm = plane_waves(FREQUENCY, pentagon()[:3], snr=400.0)
    found = of(averages(csm))
    (problem,) = [advice for advice in found.advice if advice.rank is Rank.INVALIDATES]
    assert isinstance(problem, ModelMisfit)
    assert problem.n_factors == 3
    assert problem.worst_statistic >= problem.statistic > 1
    assert problem.p_value < 1e-10
    assert not problem.is_wrong  # unless waves cross the sensors: then it is
    assert problem.largest_error > 0.5 > problem.error
    # three triaxial sensors bound it
    assert problem.largest_error == pytest.approx(10 * problem.error)
    assert problem.band is not None
    assert problem.band[0] > 2
    assert problem.band[1] == FREQUENCY[-1]
    assert found.bands[-1].test.p_value < 1e-10
    assert problem.band[0] <= problem.worst_band[0] < problem.worst_band[1] <= problem.band[1]
    five = of(averages(plane_waves(FREQUENCY, pentagon(), snr=400.0)), dims=(3,) * 5)
    misfit = advice_of(ModelMisfit, five)[0]
    assert misfit.largest_error == 2 * misfit.error  # five bound it closer


def test_planar_sensors_in_motion_of_three_dimensions_get_advice() -> None:
    tilted = Rotation.from_euler("x", 10, degrees=True).as_matrix()
    two = [tilted[:2], np.eye(3)[:2], tilted.T[:2]]
    found = of(averages(bench(*two)), dims=(2, 2, 2))
    misfit = advice_of(ModelMisfit, found)[0]
    assert misfit.n_factors == 2
    assert np.isinf(misfit.largest_error)  # three planar sensors do not bound it
    assert misfit.is_wrong
    assert misfit.error >= 0.5


def test_a_missing_dimension_is_reported() -> None:
    flat = np.diag([100.0, 150.0, 0.0])
    turned = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    found = of(averages(bench(np.eye(3), turned, np.eye(3), motion=flat)))
    assert np.mean(found.dimension == 2) > 0.95
    (missing,) = advice_of(MissingDimension, found)
    assert (missing.n_dimensions, missing.n_channels) == (2, 3)
    assert missing.condition > np.sqrt(1080)


@pytest.mark.parametrize("snr", [0.5, 0.6, 0.8, 1.0])
def test_no_dimension_of_motion_alike_in_all_is_said_to_miss(snr: float) -> None:
    """With 45 averages, some of three dimensions are significant by chance."""
    turned = Rotation.from_euler("yz", [30, 70], degrees=True).as_matrix()
    csm = bench(np.eye(3), turned, turned.T, motion=snr * np.eye(3))
    found = of(averages(csm, n=45), n=45)
    assert np.any(found.dimension < 3)
    assert not advice_of(MissingDimension, found)


def test_noise_without_motion_is_reported() -> None:
    rng = np.random.default_rng(3)
    csm = random_bench(rng, dims=THREE, snr=0.05, noise_psd=np.ones(9))
    found = of(averages(csm))
    assert all(advice.snr < 1 for advice in advice_of(WeakMotion, found))
    assert advice_of(WeakMotion, found)


def test_a_lagging_sensor_is_reported_with_its_delay() -> None:
    phase = np.exp(-2j * np.pi * FREQUENCY[:, None] * np.repeat([0, 0.02, 0], 3))
    csm = phase[:, :, None] * (bench(*[np.eye(3)] * 3) - np.eye(9)) * phase[:, None].conj()
    found = of(averages(csm + np.eye(9)))
    first, second = advice_of(Delay, found)
    assert (first.sensors, second.sensors) == ((0, 1), (1, 2))
    assert first.delay == pytest.approx(0.02, rel=0.01)
    assert first.delay_samples == pytest.approx(0.8, rel=0.01)
    assert second.delay == pytest.approx(-0.02, rel=0.01)  # the third leads the second


def test_a_small_significant_misfit_is_graded_by_its_effect() -> None:
    """Noise shared by all channels, about one per cent of it: too many pairs to be named."""
    turned = [Rotation.from_rotvec(v).as_matrix() for v in ([1, 2, -1], [-0.5, 0.4, 1], [0, 1, 2])]
    csm = bench(*turned)
    shared = np.tril(np.random.default_rng(3).normal(scale=0.008, size=(9, 9)), -1)
    csm += shared + shared.T
    n = 8000
    found = of(averages(csm, n=n), n=n)
    misfit = max(advice_of(ModelMisfit, found), key=lambda advice: advice.worst_statistic)
    truth = maximise(csm[None], 3)
    off = np.abs(truth.psi - 1).max()
    seen = np.sqrt(2 * truth.discrepancy[0] / 27)
    assert misfit.rank is Rank.DELAYS
    assert misfit.worst_statistic < 2.5
    assert misfit.unexplained == pytest.approx(seen, rel=0.2)
    assert off < misfit.error < 5 * off
    assert not misfit.is_wrong


@pytest.mark.long
def test_a_sound_test_seldom_fails_in_any_band() -> None:
    """One in a hundred, however many bands are tested: with one in a hundred each, 8 of these."""
    rng = np.random.default_rng(11)
    csm = np.broadcast_to(bench(*[np.eye(2)] * 3, motion=np.diag([100.0, 150])), (96, 6, 6))
    draws = wishart(csm, 400, rng, n_draws=100)
    found = [of(draw, dims=(2, 2, 2), n=400) for draw in draws]
    failing = sum(bool(advice_of(ModelMisfit, each)) for each in found)
    assert failing <= 5  # Poisson of mean 1: more in one of a thousand


def test_the_effect_of_waves_is_within_the_stated_bound() -> None:
    csm = plane_waves(FREQUENCY, pentagon()[:3], snr=100.0)
    found = of(averages(csm, n=8000), n=8000)
    off = np.abs(maximise(csm[-1:], 3).psi - 1).max()
    assert any(off < advice.largest_error < 4 * off for advice in advice_of(ModelMisfit, found))


def test_a_model_of_too_few_dimensions_has_its_own_advice() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))
    for q in (0, 1, 3):
        found = diagnose(
            csm, FREQUENCY, dims=THREE, n_effective=1080, n_factors=q, neighbours=INDEPENDENT
        )
        failing = advice_of(TooFewDimensions, found)
        assert found.n_factors == q
        assert bool(failing) == (q < 3)
        assert not advice_of(ModelMisfit, found)
        for advice in failing:
            assert advice.rank is Rank.INVALIDATES
            assert advice.n_factors == q
            assert advice.worst_statistic >= advice.statistic > 2
        assert np.median(found.snr) > 50  # whatever is tested
    assert np.isfinite(found.model.p_value).all()


@pytest.mark.long
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
    assert found.untested is Untested.TOO_FEW_AVERAGES
    assert len(found.responses) == 3


def test_the_reason_for_a_missing_model_test_is_reported() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))
    for q in (6, 7):  # nothing is left for the test; more than can be told from the noise
        many = diagnose(csm, FREQUENCY, dims=THREE, n_effective=1080, n_factors=q)
        assert many.untested is Untested.TOO_FEW_CHANNELS
        assert np.isnan(many.model.p_value).all()
    singular = averages(csm[0], n=1080)
    singular[:, 8, :] = singular[:, 7, :] + singular[:, 6, :]
    singular[:, :, 8] = singular[:, :, 7] + singular[:, :, 6]
    found = of(singular)
    assert found.untested is Untested.SINGULAR
    assert np.isnan(found.model.p_value).all()


def test_invalid_arguments_are_refused() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))
    with pytest.raises(InvalidMatrixError, match="frequency"):
        diagnose(csm, FREQUENCY[:5], dims=THREE, n_effective=100)
    with pytest.raises(InsufficientDataError, match="1 sensors"):
        diagnose(csm[:, :3, :3], FREQUENCY, dims=(3,), n_effective=100)
    with pytest.raises(InvalidMatrixError, match="ascending"):
        diagnose(csm, FREQUENCY[::-1], dims=THREE, n_effective=100)
    for n in (np.nan, np.inf, -1):
        with pytest.raises(InsufficientDataError, match="finite number above zero"):
            diagnose(csm, FREQUENCY, dims=THREE, n_effective=n)


def test_lists_are_accepted_like_arrays() -> None:
    csm = averages(bench(np.eye(3), np.eye(3), np.eye(3)))[:12]
    array = diagnose(csm, FREQUENCY[:12], dims=THREE, n_effective=100)
    lists = diagnose(csm.tolist(), FREQUENCY[:12].tolist(), dims=THREE, n_effective=100)
    np.testing.assert_array_equal(lists.snr, array.snr)


@pytest.mark.parametrize(("hum", "n"), [(30.0, 4), (3000.0, 3)])  # below and above the motion
def test_hum_of_one_sensor_is_its_noise_and_no_misfit(hum: float, n: int) -> None:
    """It failed the model test of its band, and other sensors were said to share noise."""
    turned = [Rotation.random(random_state=seed).as_matrix() for seed in range(n)]
    csm = np.repeat(bench(*turned)[None], len(FREQUENCY), axis=0)
    csm[60:63, 3:6, 3:6] += hum  # equal in all channels of the second
    found = of(csm, dims=(3,) * n)
    (lines,) = advice_of(LinesOfOne, found)
    assert lines.sensors == (1,)
    np.testing.assert_allclose(lines.frequencies, FREQUENCY[61:62])
    assert not advice_of(ModelMisfit, found)
    assert not advice_of(SharedNoise, found)


@pytest.mark.parametrize(("hum", "is_line"), [(30.0, True), (3000.0, False)])
def test_hum_of_two_sensors_is_no_line_of_the_third(hum: float, *, is_line: bool) -> None:
    """It looks like one, but for the power: that of two may be motion that the third lacks."""
    csm = np.repeat(bench(*[np.eye(3)] * 3)[None], len(FREQUENCY), axis=0)
    csm[60:63, 3:, 3:] += hum
    found = of(csm)
    assert advice_of(ModelMisfit, found)
    lines = [(each.rank, each.sensors) for each in advice_of(LinesOfOne, found)]
    assert lines == [(Rank.DELAYS, ())] * is_line


def test_a_tone_that_all_feel_is_no_line_of_the_sensor_whose_gain_moves() -> None:
    turned = [Rotation.random(random_state=seed).as_matrix() for seed in range(4)]
    csm = np.repeat(bench(*turned)[None], len(FREQUENCY), axis=0)
    felt = np.concatenate([each @ np.array([0.6, 0.5, 0.62]) for each in turned])
    moved = np.where(np.arange(12) // 3 == 1, felt, 0.0)  # independent of the tone, on average
    csm[60:63] += 1e5 * np.outer(felt, felt) + 1e5 * 0.02**2 * np.outer(moved, moved)
    assert not advice_of(LinesOfOne, of(csm, dims=(3,) * 4))


def test_motion_that_differs_at_some_frequencies_is_no_line() -> None:
    turned = [Rotation.random(random_state=seed).as_matrix() for seed in range(3)]
    csm = np.repeat(bench(*turned)[None], len(FREQUENCY), axis=0)
    felt = np.random.default_rng(2).standard_normal(9)
    csm[60:63] += 30 * np.outer(felt, felt)
    found = of(csm)
    assert advice_of(ModelMisfit, found)
    assert not advice_of(LinesOfOne, found)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_band_of_few_frequencies_that_all_fail_has_no_lines() -> None:
    rng = np.random.default_rng(2)
    felt = rng.standard_normal(9)
    true = bench(*[np.eye(3)] * 3) + 300 * np.outer(felt, felt)
    csm = wishart(np.broadcast_to(true, (5, 9, 9)), 1080, rng)[0]
    found = diagnose(csm, FREQUENCY[:5], dims=THREE, n_effective=1080, neighbours=INDEPENDENT)
    assert advice_of(ModelMisfit, found)
    assert not advice_of(LinesOfOne, found)
