"""Three-channel and three-sensor estimates: known answers, bias, scatter, coverage, bad input."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import pytest

from estimator.errors import (
    EstimatorError,
    InsufficientDataError,
    InvalidMatrixError,
    UnknownMethodError,
)
from estimator.methods import METHODS, Flag, SelfNoise, self_noise
from estimator.self_noise.three_channel import three_channel
from estimator.self_noise.three_sensor import three_sensor
from estimator.spectra.welch import CrossSpectra, WelchSettings
from tests.estimator.csm_models import common_motion, planar_sensors, random_bench, wishart

if TYPE_CHECKING:
    from estimator.types import ComplexArray

BENCHES = [(1, 1, 1), (2, 2, 2), (3, 3, 3), (2, 2, 2, 2), (3, 3, 3, 3, 3)]


def bench(dims: tuple[int, ...], snr: float, seed: int = 0) -> tuple[ComplexArray, np.ndarray]:
    rng = np.random.default_rng(seed)
    noise_psd = rng.uniform(0.5, 2, sum(dims))
    return random_bench(rng, dims=dims, snr=snr, noise_psd=noise_psd), noise_psd


@pytest.mark.parametrize("dims", [*BENCHES, (3, 3, 3, 1), (3, 3, 1, 2, 3)])
@pytest.mark.parametrize("snr", [1e-2, 1, 1e6])
def test_the_true_matrix_gives_the_true_noise(dims: tuple[int, ...], snr: float) -> None:
    csm, noise_psd = bench(dims, snr)
    result = three_sensor(csm[None], dims=dims, n_effective=100, correct=False)
    np.testing.assert_allclose(result.noise_psd[0], noise_psd, rtol=1e-13 * max(snr, 1 / snr, 1e3))
    assert not result.flags.any()


def test_eq_26_term_by_term() -> None:
    csm, _ = bench((2, 2, 2), 10)
    sample = wishart(csm, 30, np.random.default_rng(1), n_draws=4)
    result = three_sensor(sample, dims=(2, 2, 2), n_effective=30, correct=False)
    for f, (i, j, k) in itertools.product(range(4), [(0, 1, 2), (1, 2, 0), (2, 0, 1)]):
        S = sample[f].reshape(3, 2, 3, 2).swapaxes(1, 2)
        swapped = S[i, j] @ np.linalg.inv(S[k, j]) @ S[k, i]
        expected = S[i, i] - (S[i, k] @ np.linalg.inv(S[j, k]) @ S[j, i] + swapped) / 2
        np.testing.assert_allclose(
            result.noise_psd[f, 2 * i : 2 * i + 2], np.diag(expected).real, rtol=1e-10
        )


def test_with_one_channel_per_sensor_it_is_the_three_channel_method() -> None:
    csm, _ = bench((1, 1, 1), 100)
    sample = wishart(csm, 30, np.random.default_rng(1), n_draws=50)
    one = three_channel(sample, dims=(1,) * 3, n_effective=30)
    other = three_sensor(sample, dims=(1,) * 3, n_effective=30)
    np.testing.assert_array_equal(one.noise_psd, other.noise_psd)
    np.testing.assert_array_equal(one.high, other.high)
    assert (one.method, other.method) == ("three-channel", "three-sensor")


def test_three_channel_is_sleeman_and_takes_the_same_channel_of_each_sensor() -> None:
    csm, _ = bench((3, 3, 3), 10)
    S = wishart(csm, 30, np.random.default_rng(1), n_draws=5)
    result = three_channel(S, dims=(3, 3, 3), n_effective=30, correct=False)
    for r in range(3):
        i, j, k = r, 3 + r, 6 + r
        expected = (S[:, i, i] - S[:, j, i] * S[:, i, k] / S[:, j, k]).real  # Eq. (6)
        np.testing.assert_allclose(result.noise_psd[:, i], expected, rtol=1e-10)


@pytest.mark.parametrize("method", ["three-channel", "three-sensor"])
def test_units_and_order_of_sensors_have_no_effect(method: str) -> None:
    csm, _ = bench((3, 3, 3, 3), 100)
    sample = wishart(csm, 40, np.random.default_rng(1), n_draws=20)
    rng = np.random.default_rng(2)
    gain = 10.0 ** rng.uniform(-12, 12, 12) * np.exp(2j * np.pi * rng.random(12))
    result = self_noise(method, sample, dims=(3,) * 4, n_effective=40)
    scaled = self_noise(method, gain[:, None] * sample * gain.conj(), dims=(3,) * 4, n_effective=40)
    np.testing.assert_allclose(scaled.noise_psd, abs(gain) ** 2 * result.noise_psd, rtol=1e-7)
    np.testing.assert_allclose(scaled.low, abs(gain) ** 2 * result.low, rtol=1e-7)
    np.testing.assert_allclose(scaled.cov, result.cov, rtol=1e-7)
    order = np.concatenate([np.arange(3) + 3 * sensor for sensor in (2, 0, 3, 1)])
    turned = self_noise(method, sample[:, order][:, :, order], dims=(3,) * 4, n_effective=40)
    np.testing.assert_allclose(turned.noise_psd, result.noise_psd[:, order], rtol=1e-9)
    np.testing.assert_allclose(turned.high, result.high[:, order], rtol=1e-9)


def test_the_known_biases_of_three_channel_and_none_of_three_sensor() -> None:
    # method.md: sensor i along x, the others turned by 10 or 5 degrees; S_y = 1.5 S_x
    for theta, fraction in ((10.0, 0.0445), (5.0, 0.0113)):
        for snr in (10, 100, 1000):
            csm = common_motion(planar_sensors(theta)[::2], np.ones(3), snr=snr)
            found = three_channel(csm[None], dims=(1, 1, 1), n_effective=1080, correct=False)
            assert found.noise_psd[0, 0] - 1 == pytest.approx(fraction * snr, rel=0.01)
            csm = common_motion(planar_sensors(theta), np.ones(6), snr=snr)
            found = three_sensor(csm[None], dims=(2, 2, 2), n_effective=1080, correct=False)
            np.testing.assert_allclose(found.noise_psd, 1, rtol=1e-9)


@pytest.mark.parametrize(
    ("alpha", "theta", "noise_psd", "cov"),
    [
        (90, 10, (1, 1, 1), np.sqrt(2.5 / 1080)),
        (90, 60, (1, 1, 1), 0.0481),
        (30, 60, (1, 1, 1), 0.173),
        (90, 10, (1, 10, 10), 0.238),
    ],
)
def test_predicted_scatter_has_the_known_values(
    alpha: float, theta: float, noise_psd: tuple[float, ...], cov: float
) -> None:
    directions = planar_sensors(theta, channel_angle_deg=alpha)
    csm = common_motion(directions, np.repeat(noise_psd, 2), snr=1e4)
    found = three_sensor(csm[None], dims=(2, 2, 2), n_effective=1080, correct=False)
    assert found.cov[0, 0] == pytest.approx(cov, rel=0.005)


def test_five_sensors_reach_what_all_triads_can() -> None:
    csm = random_bench(np.random.default_rng(0), dims=(3,) * 5, snr=1e3, noise_psd=np.ones(15))
    five = three_sensor(csm[None], dims=(3,) * 5, n_effective=1080, correct=False)
    np.testing.assert_allclose(five.cov, 0.0382, rtol=0.01)


@pytest.mark.parametrize("dims", BENCHES)
@pytest.mark.parametrize("snr", [10, pytest.param(1e6, marks=pytest.mark.long)])
def test_bias_scatter_and_coverage_from_twenty_averages_on(
    dims: tuple[int, ...], snr: float
) -> None:
    csm, noise_psd = bench(dims, snr)
    rng = np.random.default_rng(3)
    for n, draws in ((20, 2000), (100, 2000), (1080, 2000)):
        found = three_sensor(wishart(csm, n, rng, n_draws=draws), dims=dims, n_effective=n)
        relative = found.noise_psd / noise_psd
        error = relative.std(axis=0) / np.sqrt(draws)
        assert np.all(np.abs(relative.mean(axis=0) - 1) < 4.5 * error)
        covers = (found.low < noise_psd) & (noise_psd < found.high)
        # pooled over channels: at most 0.5 % standard error; single channels are correlated
        low, high = (0.93, 0.97) if n >= 100 else (0.92, 0.98)
        assert low < covers.mean() < high
        if n >= 100:
            truth = three_sensor(csm[None], dims=dims, n_effective=n)
            # the deviation of 2000 draws has 1.6 % standard error; delta method: order 1/n
            np.testing.assert_allclose(relative.std(axis=0), truth.cov[0], rtol=0.06 + 1 / n)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_ten_times_less_motion_than_noise_biases_by_less_than_one_percent(d: int) -> None:
    csm, noise_psd = bench((d,) * 3, 0.1)
    sample = wishart(csm, 1080, np.random.default_rng(6), n_draws=6000)
    found = three_sensor(sample, dims=(d,) * 3, n_effective=1080)
    relative = found.noise_psd / noise_psd
    error = relative.std(axis=0) / np.sqrt(len(sample))
    assert np.all(np.abs(relative.mean(axis=0) - 1) < 0.01 + 4.5 * error)
    covers = (found.low < noise_psd) & (noise_psd < found.high)
    assert 0.93 < covers.mean() < 0.99  # too wide where the motion drowns, never too narrow


@pytest.mark.parametrize("d", [1, 2, 3])
def test_uncorrected_bias_is_minus_d_over_n(d: int) -> None:
    csm, noise_psd = bench((d,) * 3, 100)
    sample = wishart(csm, 20, np.random.default_rng(5), n_draws=10_000)
    found = three_sensor(sample, dims=(d,) * 3, n_effective=20, correct=False)
    relative = found.noise_psd / noise_psd
    error = relative.std(axis=0) / np.sqrt(len(sample))
    assert np.all(np.abs(relative.mean(axis=0) - 1 + d / 20) < 4.5 * error)


@pytest.mark.parametrize("snr", [0.1, 0.5])
def test_motion_left_in_by_few_averages_is_that_of_decision_10(snr: float) -> None:
    """One channel a sensor: rho (1 - g)**n, exactly; 4.5 standard errors of heavy tails."""
    n, n_draws = 20, 40_000
    csm = np.full((3, 3), snr, dtype=np.complex128) + np.eye(3)
    sample = wishart(csm, n, np.random.default_rng(8), n_draws=n_draws)
    found = three_sensor(sample, dims=(1, 1, 1), n_effective=n).noise_psd.mean(axis=1)
    coherence = (snr / (1 + snr)) ** 2
    rest = snr / (1 + 2 * snr)  # of the motion, when both other sensors have predicted it
    error = found.std() / np.sqrt(n_draws)
    left = rest * (1 - coherence) ** n
    assert left > 2 * error
    assert abs(found.mean() - 1 - left) < 4.5 * error


@pytest.mark.long
@pytest.mark.parametrize("overlap", [0.5, 0.75])
def test_overlapping_segments_are_worth_n_effective_for_the_bias_too(overlap: float) -> None:
    # method.md: d = 3, 20 segments, Hann, 75 %: -0.273 uncorrected, -0.281 predicted
    settings = WelchSettings(1.0, 64, overlap)
    rng = np.random.default_rng(4)
    turn = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(3)]
    length, draws = 64 + 19 * settings.hop, 300
    csm = []
    for _ in range(draws):
        motion = 10 * rng.standard_normal((length, 3))
        samples = np.hstack([motion @ q for q in turn]) + rng.standard_normal((length, 9))
        spectra = CrossSpectra(settings, 9)
        spectra.add(samples, np.arange(20) * settings.hop)
        csm.append(spectra.csm()[2:-2])
    relative, uncorrected = (
        three_sensor(
            np.concatenate(csm), dims=(3,) * 3, n_effective=spectra.n_effective, correct=correct
        )
        .noise_psd.reshape(draws, -1)
        .mean(axis=1)
        / 2
        for correct in (True, False)
    )
    error = np.std(relative) / np.sqrt(draws)
    assert error < 0.01
    # two sides of the same: what is left is of order (d / n_eff)**2
    left = (3 / spectra.n_effective) ** 2
    assert abs(np.mean(relative) - 1) < 4 * error + left / 2
    assert np.mean(uncorrected) - 1 == pytest.approx(
        -3 / spectra.n_effective, abs=4 * error + left / 2
    )


def test_intervals_hold_where_estimates_come_out_negative() -> None:
    # Sec. 2.2 (iii): sensor k far from aligned, so that leaking motion swamps the noise
    angles = np.deg2rad([0, 0, 60])
    csm = common_motion(np.column_stack([np.cos(angles), np.sin(angles)]), np.ones(3), snr=1e3)
    for n in (20, 100, 1080):
        sample = wishart(csm, n, np.random.default_rng(7), n_draws=4000)
        found = three_channel(sample, dims=(1, 1, 1), n_effective=n)
        negative = found.noise_psd[:, 0] < 0
        assert negative.mean() > 0.05
        np.testing.assert_array_equal(found.flags[:, 0] == Flag.NEGATIVE, negative)
        np.testing.assert_array_equal(found.flags[:, 0] == 0, ~negative)
        assert np.isfinite(found.cov).all()
        assert np.all(found.low <= found.noise_psd)
        assert np.all(found.noise_psd <= found.high)
        covers = (found.low < 1) & (found.high > 1)
        assert 0.93 < covers[:, 0].mean() < (0.97 if n >= 100 else 0.98)


def test_mixed_sensors_use_the_channels_shared_by_the_others() -> None:
    csm, noise_psd = bench((3, 3, 3, 1), 1e4)
    found = three_sensor(csm[None], dims=(3, 3, 3, 1), n_effective=100, correct=False)
    np.testing.assert_allclose(found.noise_psd[0], noise_psd, rtol=1e-9)
    # two triaxial and two biaxial sensors: the triaxial ones' third channels stand alone
    csm, _ = bench((3, 3, 2, 2), 10)
    found = three_sensor(csm[None], dims=(3, 3, 2, 2), n_effective=100)
    alone = [2, 5]
    assert np.all(found.flags[0, alone] == Flag.NO_COUNTERPART)
    assert np.isnan(found.noise_psd[0, alone]).all()
    assert np.isfinite(np.delete(found.noise_psd[0], alone)).all()
    found = three_channel(csm[None], dims=(3, 3, 2, 2), n_effective=100)
    assert np.all(found.flags[0, alone] == Flag.NO_COUNTERPART)
    assert np.isnan(found.low[0, alone]).all()


def spoilt(fault: str) -> ComplexArray:
    """Seven frequencies of three triaxial sensors; something is wrong with the fourth."""
    csm, _ = bench((3, 3, 3), 10)
    sample = wishart(csm, 60, np.random.default_rng(1), n_draws=7)
    if fault == "nan":
        sample[3, 2, 5] = np.nan
    elif fault == "infinite":
        sample[3, 0, 0] = np.inf
    elif fault == "dead":
        sample[3, 4, :] = sample[3, :, 4] = 0
    elif fault == "zero":
        sample[3] = 0
    elif fault == "faint":  # as good as dead: what becomes of it must not overflow
        sample[3] *= 1e-300
    elif fault.startswith("singular"):
        block = {"singular": 0.0, "singular but for rounding": 1e-17, "singular, tiny": 1e-200}
        sample[3, 3:6, 6:9] = block[fault] * np.eye(3)
        sample[3, 6:9, 3:6] = block[fault] * np.eye(3)
    else:
        copy, original = {"copied": (7, 2), "copied within": (5, 4)}[fault]
        transfer = np.eye(9)
        transfer[copy] = 0
        transfer[copy, original] = 3
        sample[3] = transfer @ sample[3] @ transfer.T
    return sample


@pytest.mark.parametrize("method", ["three-channel", "three-sensor"])
@pytest.mark.parametrize(
    ("fault", "flag"),
    [
        ("nan", Flag.NOT_FINITE),
        ("infinite", Flag.NOT_FINITE),
        ("dead", Flag.DEAD_CHANNEL),
        ("zero", Flag.DEAD_CHANNEL),
        ("copied", Flag.DUPLICATE),
        ("copied within", Flag.DUPLICATE),
        ("faint", Flag.DEAD_CHANNEL),
        ("singular", Flag.SINGULAR),
        ("singular but for rounding", Flag.SINGULAR),
        ("singular, tiny", Flag.SINGULAR),
    ],
)
def test_an_invalid_frequency_is_flagged_and_does_not_affect_the_others(
    method: str, fault: str, flag: Flag
) -> None:
    csm = spoilt(fault)
    found = self_noise(method, csm, dims=(3, 3, 3), n_effective=60)
    good = np.delete(np.arange(7), 3)
    expected = self_noise(method, csm[good], dims=(3, 3, 3), n_effective=60)
    np.testing.assert_array_equal(found.noise_psd[good], expected.noise_psd)
    np.testing.assert_array_equal(found.flags[good], expected.flags)
    assert (found.flags[3] & flag).any()
    for values in (found.noise_psd, found.cov, found.low, found.high):
        np.testing.assert_array_equal(np.isnan(values[3]), (found.flags[3] & ~Flag.NEGATIVE) != 0)


def test_a_dead_sensor_affects_only_its_own_triads() -> None:
    csm, noise_psd = bench((3,) * 5, 100)
    csm = csm.copy()
    csm[3:6] = csm[:, 3:6] = 0
    found = three_sensor(csm[None], dims=(3,) * 5, n_effective=60, correct=False)
    dead = np.arange(15) // 3 == 1
    np.testing.assert_array_equal(found.flags[0] == Flag.DEAD_CHANNEL, dead)
    np.testing.assert_allclose(found.noise_psd[0, ~dead], noise_psd[~dead], rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_sensors_without_noise_give_no_warning(method: str) -> None:
    directions = np.array([[1, 0], [0, 1], [1, 1], [1, -1], [2, 1], [1, -2]])
    csm = (directions @ directions.T)[None].astype(np.complex128)
    found = self_noise(method, csm, dims=(2, 2, 2), n_effective=60)
    assert np.all((found.flags[0] != 0) | (found.noise_psd[0] > 0.1))


@pytest.mark.parametrize("method", METHODS)
def test_an_invalid_matrix_at_one_frequency_does_not_affect_the_others(
    method: str,
) -> None:
    good = np.tile(spoilt("nan")[4:], (2, 1, 1))
    spoils = good.copy()
    spoils[0, 0, 1] += 1e-3
    spoils[1, 0, 0] *= -1
    spoils[2, [0, 3], [3, 0]] = 1.001 * np.sqrt(spoils[2, 0, 0] * spoils[2, 3, 3])
    spoils[3, [0, 3], [3, 0]] = 1e300
    found = self_noise(method, spoils, dims=(3, 3, 3), n_effective=60)
    alone = self_noise(method, good[4:], dims=(3, 3, 3), n_effective=60)
    assert np.all(found.flags[:4] & Flag.INVALID)
    assert not np.any(found.flags[4:] & Flag.INVALID)
    assert np.isnan(found.noise_psd[:4]).all()
    np.testing.assert_allclose(found.noise_psd[4:], alone.noise_psd, rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_invalid_arguments_are_refused(method: str) -> None:
    good = spoilt("nan")[:3]

    def estimate(
        csm: np.ndarray, dims: tuple[int, ...] = (3, 3, 3), n_effective: float = 60.0
    ) -> SelfNoise:
        return self_noise(method, csm, dims=dims, n_effective=n_effective)

    for csm, dims in (
        (good[0], (3, 3, 3)),
        (good[:, :8], (3, 3, 3)),
        (good[:, :8, :8], (3, 3, 3)),
        (good, (3, 3, 2)),
    ):
        with pytest.raises(InvalidMatrixError, match="shape"):
            estimate(csm, dims)
    with pytest.raises(InvalidMatrixError, match="NaN"):
        estimate(np.full_like(good, np.nan))
    lopsided = good.copy()
    lopsided[:, 0, 4] *= 1.001
    with pytest.raises(InvalidMatrixError, match="not Hermitian at 3"):
        estimate(lopsided)
    with pytest.raises(InvalidMatrixError, match="negative"):
        estimate(-good)
    with pytest.raises(InsufficientDataError, match="sensors"):
        estimate(good[:, :3, :3], (3,))
    if method != "two-channel":
        with pytest.raises(InsufficientDataError, match="sensors"):
            estimate(good[:, :6, :6], (3, 3))
    for n_effective in (np.nan, np.inf, -1.0):
        with pytest.raises(InsufficientDataError, match="finite number above zero"):
            estimate(good, n_effective=n_effective)
    with pytest.raises(InvalidMatrixError, match="whole number"):
        estimate(good, (9, 3, -3))
    with pytest.raises(InvalidMatrixError, match="whole number"):
        estimate(good, (3.0, 3.0, 3.0))  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(EstimatorError, match="real of shape"):
        self_noise(method, good, dims=(3, 3, 3), n_effective=60, real=np.zeros(2, np.bool_))
    for n_effective in (0.0, 1.0, np.nan):
        with pytest.raises(InsufficientDataError, match="averages"):
            estimate(good, n_effective=n_effective)


def test_an_unknown_method_is_refused_with_the_known_names() -> None:
    with pytest.raises(UnknownMethodError, match=r"'magic'.*three-sensor"):
        self_noise("magic", spoilt("nan"), dims=(3, 3, 3), n_effective=60)


def test_two_threads_give_the_result_of_one() -> None:
    """The same bits each time, no warning, and an error comes through from a block's thread."""
    dims = (3,) * 3  # of more sensors, neighbours share the weights of pairs
    csm = wishart(bench(dims, 10)[0], 40, np.random.default_rng(6), n_draws=300)
    csm[[3, 299]] = np.nan
    csm[140, 2] = csm[140, :, 2] = 0  # dead
    csm[150] = 1  # every channel the same
    csm[160, 0:3, 3:6] = csm[160, 3:6, 0:3] = 0  # singular
    csm[170] *= 1e-280
    together, again = (three_sensor(csm, dims=dims, n_effective=40) for _ in range(2))
    for first in range(0, 300, 100):
        alone = three_sensor(csm[first : first + 100], dims=dims, n_effective=40)
        for name in ("noise_psd", "cov", "low", "high", "flags"):
            part = getattr(together, name)[first : first + 100]
            np.testing.assert_allclose(getattr(alone, name), part, rtol=1e-9)
            np.testing.assert_array_equal(getattr(again, name), getattr(together, name))
    with pytest.raises(InsufficientDataError, match="averages"):
        three_sensor(csm, dims=dims, n_effective=3)
