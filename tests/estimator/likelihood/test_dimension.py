"""The dimension the model test accepts, what it buys, and what it costs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.likelihood.dimension import BandDimension, bands, choose_dimension
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import BandTest, model_test, upper_tail
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from estimator.likelihood.prior import expected_noise
from estimator.self_noise.three_sensor import three_sensor
from tests.estimator.csm_models import pentagon, plane_waves, random_bench, rotation, wishart

FIVE = (3,) * 5
THREE = (3,) * 3
INDEPENDENT = np.zeros(0)
ITEM_9_SNR = 400.0
"""Of each horizontal: the mean over all triads then has the biases that item 9 gives."""


def chosen(
    csm: np.ndarray, frequency: np.ndarray, n: int, n_bands: int = 1
) -> tuple[np.ndarray, tuple[BandDimension, ...]]:
    """Choose the dimensions of triaxial sensors in bands of as many independent frequencies."""
    return choose_dimension(
        csm,
        frequency,
        dims=(3,) * (csm.shape[1] // 3),
        n_effective=n,
        band=np.arange(len(frequency)) * n_bands // len(frequency),
        neighbours=INDEPENDENT,
    )


def mean_over_triads(csm: np.ndarray) -> np.ndarray:
    """Three-sensor estimate of five triaxial sensors, all pairs of a sensor weighing the same."""
    total = np.zeros(csm.shape[:2])
    for triad in itertools.combinations(range(5), 3):
        columns = np.ravel([np.arange(3 * sensor, 3 * sensor + 3) for sensor in triad])
        of_triad = three_sensor(csm[:, columns[:, None], columns], dims=THREE, n_effective=1080)
        total[:, columns] += of_triad.noise_psd
    return total / 6  # a sensor belongs to six of the ten triads


@pytest.mark.long
def test_incoherent_motion_is_explained_by_more_dimensions() -> None:
    """Item 9 of method.md: bias of the mean over each band and all channels."""
    centres = np.array([1.0, 3.5, 7, 10, 20, 50])
    frequency = (centres[:, None] * np.linspace(0.95, 1.05, 24)).ravel()
    band = np.repeat(np.arange(len(centres)), 24)
    csm = plane_waves(frequency, pentagon(), snr=ITEM_9_SNR)
    averages = wishart(csm, 1080, np.random.default_rng(1))[0]
    n_factors, choices = chosen(averages, frequency, 1080, n_bands=len(centres))
    found = maximum_likelihood(averages, dims=FIVE, n_effective=1080, n_factors=n_factors)
    plain = mean_over_triads(averages)
    weighted = three_sensor(averages, dims=FIVE, n_effective=1080).noise_psd

    def bias(psd: np.ndarray) -> np.ndarray:
        return np.array([psd[band == b].mean() - 1 for b in range(len(centres))])

    at = dict(zip(centres.tolist(), bias(plain), strict=True))
    assert at[20.0] == pytest.approx(1.95, abs=0.15)
    assert at[50.0] == pytest.approx(11.95, abs=0.6)
    assert np.all(bias(weighted)[centres >= 20] > 0)  # close pairs weigh more, and are less biased
    assert np.all(bias(weighted)[centres >= 20] < bias(plain)[centres >= 20])
    assert np.all(np.abs(bias(found.noise_psd)[centres <= 20]) < 0.05)
    assert abs(bias(found.noise_psd)[-1]) < 0.20
    # 24 frequencies of 15 channels a band; the least visible factors are at 3.5 and 7 Hz
    covered = ((found.low < 1) & (found.high > 1)).reshape(len(centres), -1).mean(axis=1)
    assert np.all(covered > 0.88)
    assert covered[1:].mean() > 0.95
    assert choices[0].n_factors == 3
    assert all(choice.accepted for choice in choices)
    assert all(choice.n_factors >= 9 for choice in choices[-2:])
    assert np.all(np.diff([choice.n_factors for choice in choices]) >= 0)
    assert choices[-1].usual == 3
    assert not any(choice.is_biased for choice in choices)
    for choice in choices[2:]:
        assert choice.cov > choice.usual_cov  # the price
        assert all(test.p_value < 0.05 for test in choice.tried[:-1])


def test_unequal_sensors_keep_the_ratios_of_their_noise() -> None:
    """Aligned sensors whose noise spans a factor of 12, told apart where the motion is one."""
    noise_psd = np.repeat([1, 0.5, 2, 1, 3.0], 3) * np.tile([1, 1, 2.0], 5)
    frequency = np.concatenate([np.linspace(0.95, 1.05, 40), 20 * np.linspace(0.95, 1.05, 40)])
    csm = plane_waves(frequency, pentagon(), snr=ITEM_9_SNR) + np.diag(noise_psd - 1)
    averages = wishart(csm, 1080, np.random.default_rng(7))[0]
    n_factors, (_, above) = chosen(averages, frequency, 1080, n_bands=2)
    assert above.n_factors == 9
    found = maximum_likelihood(averages, dims=FIVE, n_effective=1080, n_factors=n_factors)
    ratio = found.noise_psd[40:] / noise_psd
    assert ratio.mean() == pytest.approx(1, abs=0.05)
    assert np.all(np.abs(ratio.mean(axis=0) - 1) < 0.25)
    covered = (found.low[40:] < noise_psd) & (noise_psd < found.high[40:])
    assert covered.mean() > 0.9


def test_known_ratios_of_noise_require_fewer_factors() -> None:
    """A prior of equal noise would ask for ten to explain noise a hundred times apart."""
    noise_psd = np.repeat([1, 0.2, 5, 1, 20.0], 3)
    frequency = np.concatenate([np.linspace(0.95, 1.05, 40), 10 * np.linspace(0.95, 1.05, 40)])
    csm = plane_waves(frequency, pentagon(), snr=ITEM_9_SNR) + np.diag(noise_psd - 1)
    averages = wishart(csm, 1080, np.random.default_rng(3))[0]
    _, choices = chosen(averages, frequency, 1080, n_bands=2)
    assert choices[0].n_factors == 3
    assert 7 <= choices[1].n_factors <= 9


def test_ratios_come_from_the_nearest_frequencies() -> None:
    noise_psd = np.ones((200, 3))
    noise_psd[:100, 1] = 4.0
    noise_psd[100:, 1] = 0.25
    usual = np.arange(200) % 100 >= 60
    noise_psd[~usual] = np.nan
    kind = np.zeros(3, np.int64)
    expected = expected_noise(noise_psd, usual, kind)
    np.testing.assert_allclose(expected[70, 1] / expected[70, 0], 4)
    np.testing.assert_allclose(expected[190, 1] / expected[190, 0], 0.25)
    np.testing.assert_array_equal(expected_noise(noise_psd, usual & False, kind), 1)


def test_three_sensors_cannot_fit_further_dimensions_and_are_flagged() -> None:
    frequency = np.linspace(18, 22, 20)
    csm = wishart(plane_waves(frequency, pentagon()[:3]), 1080, np.random.default_rng(2))[0]
    n_factors, (choice,) = chosen(csm, frequency, 1080)
    assert not choice.accepted
    assert np.all(n_factors == choice.n_factors)
    assert choice.is_biased


def test_four_sensors_fit_further_dimensions_but_remain_undetermined() -> None:
    """The test does not reject the model, and the noise is far from true."""
    frequency = np.linspace(18, 22, 20)
    csm = wishart(plane_waves(frequency, pentagon()[:4]), 1080, np.random.default_rng(2))[0]
    n_factors, (choice,) = chosen(csm, frequency, 1080)
    assert choice.n_factors > choice.usual
    assert choice.is_undetermined
    assert not choice.accepted
    found = maximum_likelihood(csm, dims=(3,) * 4, n_effective=1080, n_factors=n_factors)
    assert np.abs(found.noise_psd.mean(axis=0) - 1).max() > 0.2


def test_motion_of_too_many_dimensions_is_said_to_bias_the_noise() -> None:
    """Eleven of fifteen would leave sixteen equations for fifteen unknown noises."""
    rng = np.random.default_rng(5)
    loadings = rng.standard_normal((15, 11))
    csm = np.tile((100 * loadings @ loadings.T + np.eye(15)).astype(complex), (8, 1, 1))
    _, (choice,) = chosen(wishart(csm, 450, rng)[0], np.arange(1.0, 9.0), 450)
    assert choice.n_factors == 10
    assert choice.is_biased


def test_a_missing_dimension_is_excluded_and_improves_precision() -> None:
    """Horizontal motion only, triaxial sensors at random orientations."""
    rng = np.random.default_rng(3)
    directions = np.concatenate([rotation(rng, 3) for _ in range(3)])[:, :2]
    csm = directions @ np.diag([100.0, 150.0]) @ directions.T + np.eye(9)
    averages = wishart(csm.astype(np.complex128), 1080, rng, n_draws=200)
    n_factors, (choice,) = chosen(averages, np.linspace(1, 2, 200), 1080)
    assert choice.n_factors == 2
    assert (choice.usual, choice.accepted, choice.is_biased) == (3, True, False)
    found = maximum_likelihood(averages, dims=THREE, n_effective=1080, n_factors=n_factors)
    usual = maximum_likelihood(averages, dims=THREE, n_effective=1080)
    scatter = found.noise_psd.std(axis=0).mean()
    assert scatter < 0.8 * usual.noise_psd.std(axis=0).mean()
    # of noise that is known to be independent; matrices of the sensors cost a tenth
    assert scatter == pytest.approx(choice.cov, rel=0.15)
    assert found.noise_psd.mean() == pytest.approx(1, abs=0.005)


@pytest.mark.parametrize("snr", [0.0, 1.0, 1e4])
def test_the_full_motion_keeps_its_dimension(snr: float) -> None:
    """The fewest dimensions that explain noise alone are none."""
    rng = np.random.default_rng(4)
    csm = random_bench(rng, dims=THREE, snr=snr, noise_psd=np.ones(9))
    averages = wishart(csm, 500, rng, n_draws=60)
    _, choices = chosen(averages, np.linspace(1, 1.2, 60), 500)
    assert [choice.n_factors for choice in choices] == [3 if snr else 0]
    assert choices[0].accepted


def test_a_singular_frequency_does_not_affect_its_band() -> None:
    rng = np.random.default_rng(5)
    averages = wishart(
        random_bench(rng, dims=THREE, snr=1e3, noise_psd=np.ones(9)), 500, rng, n_draws=20
    )
    averages[3] = averages[3, :, :1] @ averages[3, :1, :] / averages[3, 0, 0]
    _, (choice,) = chosen(averages, np.linspace(1, 1.2, 20), 500)
    assert choice.n_factors == 3
    assert choice.test.n_frequencies == 19


def test_one_average_says_that_there_are_too_few() -> None:
    """Its channels are copies of each other, which says nothing of the sensors."""
    one = np.random.default_rng(3).standard_normal((20, 9)).astype(np.complex128)
    csm = one[:, :, np.newaxis] * one[:, np.newaxis]
    with pytest.raises(InsufficientDataError, match=r"1\.0 averages of 9 channels"):
        chosen(csm, np.linspace(1, 2, 20), 1)


def test_a_dead_sensor_does_not_count() -> None:
    """Four sensors of which one is dead are three: no room for further factors; two are refused."""
    frequency = np.linspace(18, 22, 20)
    csm = wishart(plane_waves(frequency, pentagon()[:4]), 1080, np.random.default_rng(2))[0]
    three = csm[:, :9, :9].copy()
    csm[:, 9:, :] = csm[:, :, 9:] = 0
    with_dead, (choice,) = chosen(csm, frequency, 1080)
    without, (same,) = chosen(three, frequency, 1080)
    np.testing.assert_array_equal(with_dead, without)
    assert choice.test.degrees == same.test.degrees
    assert choice.test.statistic == pytest.approx(same.test.statistic, rel=1e-6)
    csm[:, 6:, :] = csm[:, :, 6:] = 0
    with pytest.raises(InsufficientDataError, match="2 sensors have a signal of their own"):
        chosen(csm, frequency, 1080)


def test_channels_keep_their_kind_if_one_is_dead() -> None:
    """Channels x are twelve times noisier than y: who compares one sensor's y with x is misled."""
    frequency = np.concatenate([np.linspace(0.95, 1.05, 24), 20 * np.linspace(0.95, 1.05, 24)])
    band = np.repeat([0, 1], 24)
    noise_psd = np.tile([12.0, 1, 1], 5)
    csm = plane_waves(frequency, pentagon(), snr=400.0) + np.diag(noise_psd - 1)
    averages = wishart(csm, 60, np.random.default_rng(4))[0]
    averages[:, 0] = averages[:, :, 0] = 0
    found = []
    for unit in (1.0, 1e-10):  # the one in which a dead channel's stand-in has noise of one, or not
        n_factors, (_, choice) = chosen(averages * unit, frequency, 60, n_bands=2)
        result = maximum_likelihood(averages * unit, dims=FIVE, n_effective=60, n_factors=n_factors)
        assert choice.n_factors > 3
        found.append(np.append(result.noise_psd[band == 1][:, 1:].mean(axis=0) / unit, choice.cov))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)
    # the median c.o.v. is 0.34; four standard errors of a mean over 24 frequencies
    np.testing.assert_allclose(found[0][:-1], noise_psd[1:], rtol=4 * 0.34 / np.sqrt(24))
    assert choice.cov < 0.4


def test_bands_are_third_octaves_of_enough_frequencies() -> None:
    frequency = np.arange(1001) / 10
    number = bands(frequency)
    assert number[0] == number[1] == 0
    assert np.all(np.diff(number) >= 0)
    counts = np.bincount(number)
    assert counts.min() >= 8
    first = frequency[np.flatnonzero(np.diff(number, prepend=-1))]
    np.testing.assert_allclose(first[12:] / first[11:-1], 2 ** (1 / 3), rtol=0.03)
    assert bands(np.array([0.0, 1.0])).tolist() == [0, 0]


def test_invalid_arguments_are_refused() -> None:
    rng = np.random.default_rng(6)
    averages = wishart(random_bench(rng, dims=THREE, snr=1, noise_psd=np.ones(9)), 50, rng)
    with pytest.raises(InvalidMatrixError, match="frequency"):
        choose_dimension(averages, np.zeros(3), dims=THREE, n_effective=50)
    with pytest.raises(InvalidMatrixError, match="band"):
        choose_dimension(
            averages, np.ones(1), dims=THREE, n_effective=50, band=np.zeros(2, np.int64)
        )
    with pytest.raises(InsufficientDataError, match="averages"):
        choose_dimension(averages, np.ones(1), dims=THREE, n_effective=9)
    for n in (np.nan, np.inf, -1):
        with pytest.raises(InsufficientDataError, match="finite number above zero"):
            choose_dimension(averages, np.ones(1), dims=THREE, n_effective=n)
    twice = np.tile(averages, (2, 1, 1))
    for frequency in ([2.0, 1.0], [1.0, np.nan]):
        with pytest.raises(InvalidMatrixError, match="ascending"):
            choose_dimension(twice, np.array(frequency), dims=THREE, n_effective=50)


def _sharing(snr: float, n_sensors: int, rng: np.random.Generator) -> np.ndarray:
    """Return a true matrix: triaxial sensors, of which the second has noise that it shares."""
    axes = np.concatenate([rotation(rng, 3) for _ in range(n_sensors)])
    csm = (snr * axes @ axes.T + np.eye(3 * n_sensors)).astype(np.complex128)
    csm[3:6, 3:6] += np.outer([4, 2, 0], [4, 2, 0])
    return np.asarray(csm)


@pytest.mark.parametrize("snr", [0.05, 1.0, 1e3, 1e6])
def test_the_ratio_with_a_matrix_for_each_sensor_is_chi_squared(snr: float) -> None:
    """Degrees of freedom ``p**2 - sum d_i**2 - (2pq - q**2)``, whatever channels share."""
    rng, draws = np.random.default_rng(3), 60
    n = 189 if snr >= 1 else 20000  # it is conservative where motion is not resolved
    sample = wishart(_sharing(snr, 4, rng), n, rng, n_draws=draws)
    test = model_test(maximise(sample, 3, dims=(3,) * 4), n_effective=n)
    assert test.degrees[0] == 12**2 - 4 * 9 - (2 * 12 * 3 - 9)
    error = np.sqrt(2 * 45 / draws)
    assert test.statistic.mean() == pytest.approx(45, abs=4 * error)


@pytest.mark.parametrize("n_sensors", [4, 8])
def test_what_a_sensor_s_channels_share_is_no_dimension_of_the_motion(n_sensors: int) -> None:
    rng = np.random.default_rng(n_sensors)
    csm = np.broadcast_to(_sharing(10.0, n_sensors, rng), (24, 3 * n_sensors, 3 * n_sensors))
    n_factors, (choice,) = chosen(wishart(csm, 189, rng)[0], np.linspace(1.0, 1.2, 24), 189)
    assert choice.accepted
    assert n_factors.tolist() == [3] * 24
    assert choice.tried[2].p_value < 1e-6  # nor is it less


def test_a_level_for_all_bands_together() -> None:
    """Clean recordings of four sensors: at 5 % for each band every second one had a bad band."""
    rng, rejected = np.random.default_rng(12), 0
    axes = np.concatenate([rotation(rng, 3) for _ in range(4)])
    csm = (10.0 * axes @ axes.T + np.eye(12)).astype(np.complex128)
    for _ in range(6):
        sample = wishart(np.broadcast_to(csm, (80, 12, 12)), 100, rng)[0]
        _, choices = chosen(sample, np.geomspace(1.0, 10.0, 80), 100, n_bands=10)
        rejected += not all(choice.accepted for choice in choices)
    assert rejected <= 1


def test_a_band_without_averages_is_not_called_biased() -> None:
    rng, frequency = np.random.default_rng(1), np.linspace(0.1, 10, 100)
    averages = wishart(np.broadcast_to(np.eye(6) + 100, (100, 6, 6)), 200, rng)[0]
    averages[75:] = np.nan
    _, choices = choose_dimension(averages, frequency, dims=(1,) * 6, n_effective=200)
    assert not choices[-1].accepted
    assert not any(each.is_biased for each in choices)


def test_the_order_of_a_matrix_in_memory_does_not_count() -> None:
    averages = wishart(np.broadcast_to(np.eye(6) + 9, (24, 6, 6)), 99, np.random.default_rng(1))[0]
    turned = averages.swapaxes(1, 2).copy().swapaxes(1, 2)
    one, other = (
        choose_dimension(each, np.linspace(1, 2, 24), dims=(1,) * 6, n_effective=99)[1]
        for each in (averages, turned)
    )
    assert [each.test for each in one] == [each.test for each in other]


def test_further_dimensions_are_left_where_noise_that_changes_explains_them() -> None:
    def tested(share: float) -> BandTest:
        return BandTest(100 * share, 100.0, upper_tail(100.0, 100 * share), 10)

    tests = (tested(300), tested(280), tested(7), tested(1))
    choice = BandDimension(
        1.0, 2.0, 3, 2, accepted=True, test=tests[3], tried=tests, cov=0.5, usual_cov=0.1
    )
    assert choice.beside(1.0, 0.01) is choice
    assert choice.beside(2.0, 0.01).n_factors == 3
    usual = choice.beside(7.0, 0.01)
    assert (usual.n_factors, usual.accepted, usual.cov) == (2, True, 0.1)
    assert usual.beside(7.0, 0.01) is usual
