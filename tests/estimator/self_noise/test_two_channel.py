"""The two-channel estimate: its formula, its known weakness, scatter and bad input."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import EstimatorError
from estimator.methods import Flag
from estimator.self_noise.two_channel import two_channel
from tests.estimator.csm_models import common_motion, random_bench, wishart

DIMS = (3, 3, 3)


def aligned(snr: float, n_sensors: int = 2) -> tuple[np.ndarray, np.ndarray]:
    noise_psd = np.random.default_rng(0).uniform(0.5, 2, 3 * n_sensors)
    return common_motion(np.tile(np.eye(3), (n_sensors, 1)), noise_psd, snr=snr), noise_psd


def test_the_true_matrix_gives_the_true_noise_for_any_known_gains() -> None:
    csm, noise_psd = aligned(1e3)
    gain = np.asarray(10.0 ** np.linspace(-3, 3, 6) * np.exp(1j * np.arange(6)), np.complex128)
    csm = gain[:, None] * csm * gain.conj()
    found = two_channel(csm[None], dims=(3, 3), n_effective=50, response=gain)
    np.testing.assert_allclose(found.noise_psd[0], noise_psd * abs(gain) ** 2, rtol=1e-9)
    each = np.broadcast_to(gain, (1, 6))
    again = two_channel(csm[None], dims=(3, 3), n_effective=50, response=each)
    np.testing.assert_array_equal(again.noise_psd, found.noise_psd)


def test_the_formula_holds_for_two_sensors() -> None:
    csm, _ = aligned(10)
    S = wishart(csm, 30, np.random.default_rng(1), n_draws=4)
    found = two_channel(S, dims=(3, 3), n_effective=30)
    expected = (S[:, 1, 1] - S[:, 1, 4]).real
    np.testing.assert_allclose(found.noise_psd[:, 1], expected)


def test_a_wrong_gain_leaves_motion_in_the_noise() -> None:
    csm, noise_psd = aligned(1e4)
    wrong = np.repeat([1.0, 1.01], 3)
    found = two_channel(csm[None], dims=(3, 3), n_effective=50, response=wrong.astype(complex))
    leak = found.noise_psd[0, :3] - noise_psd[:3]
    np.testing.assert_allclose(leak, 1e4 * np.array([1, 1.5, 0.8]) * (1 - 1 / 1.01), rtol=1e-9)


@pytest.mark.parametrize("n", [20, 100, 1080])
@pytest.mark.parametrize("snr", [0.1, 1e3])
@pytest.mark.parametrize("n_sensors", [2, 4])
def test_bias_scatter_and_coverage(n: int, snr: float, n_sensors: int) -> None:
    csm, noise_psd = aligned(snr, n_sensors)
    dims, draws = (3,) * n_sensors, 4000
    sample = wishart(csm, n, np.random.default_rng(2), n_draws=draws)
    found = two_channel(sample, dims=dims, n_effective=n)
    relative = found.noise_psd / noise_psd
    error = relative.std(axis=0) / np.sqrt(draws)
    assert np.all(np.abs(relative.mean(axis=0) - 1) < 4.5 * error)
    truth = two_channel(csm[None], dims=dims, n_effective=n)
    np.testing.assert_allclose(relative.std(axis=0), truth.cov[0], rtol=0.06)
    covers = (found.low < noise_psd) & (noise_psd < found.high)
    # from 20 averages 93 % at high SNR; 0.2 % standard error, channels being correlated
    assert (0.94 if n >= 100 else 0.925) < covers.mean() < 0.96


def test_mixed_and_dead_channels_are_flagged() -> None:
    csm = random_bench(np.random.default_rng(0), dims=DIMS, snr=10, noise_psd=np.ones(9))
    sample = wishart(csm, 60, np.random.default_rng(1), n_draws=3)
    found = two_channel(sample[:, :7, :7], dims=(3, 3, 1), n_effective=60)
    assert not (found.flags & ~int(Flag.NEGATIVE)).any()
    found = two_channel(sample[:, :5, :5], dims=(3, 2), n_effective=60)
    assert np.all(found.flags[:, 2] == Flag.NO_COUNTERPART)
    assert np.isnan(found.noise_psd[:, 2]).all()
    sample[1, 4] = sample[1, :, 4] = 0
    dead = two_channel(sample, dims=DIMS, n_effective=60)
    assert dead.flags[1, 4] == Flag.DEAD_CHANNEL
    without = two_channel(sample[:, [1, 7]][:, :, [1, 7]], dims=(1, 1), n_effective=60)
    assert dead.noise_psd[1, 1] == pytest.approx(without.noise_psd[1, 0])
    copied = sample.copy()
    copied[:, 4], copied[:, :, 4] = copied[:, 1], copied[:, :, 1]
    copied[:, 4, 4] = copied[:, 1, 1]
    copies = two_channel(copied, dims=DIMS, n_effective=60)
    assert np.all(copies.flags[:, [1, 4]] == Flag.DUPLICATE)
    assert np.isnan(copies.noise_psd[:, [1, 4]]).all()
    assert np.isfinite(copies.noise_psd[:, 7]).all()
    alone = two_channel(sample[:, :6, :6], dims=(3, 3), n_effective=60)
    assert alone.flags[1, 1] == Flag.NO_COUNTERPART


@pytest.mark.parametrize("response", [np.ones(5), np.zeros(6), np.full(6, np.nan)])
def test_an_invalid_response_is_refused(response: np.ndarray) -> None:
    csm, _ = aligned(1)
    with pytest.raises(EstimatorError, match="response"):
        two_channel(csm[None], dims=(3, 3), n_effective=9, response=response.astype(complex))
