"""Three-channel and three-sensor estimates: known answers, and no dependence on units or order."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from estimator.errors import (
    InsufficientDataError,
)
from estimator.methods import Flag, self_noise
from estimator.self_noise.three_channel import three_channel
from estimator.self_noise.three_sensor import three_sensor
from tests.estimator.csm_models import common_motion, planar_sensors, random_bench, wishart
from tests.estimator.self_noise.noisy_benches import BENCHES, bench


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
