"""Bias, scatter and coverage of estimates from few averages."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.methods import Flag
from estimator.self_noise.three_channel import three_channel
from estimator.self_noise.three_sensor import three_sensor
from estimator.spectra.welch import CrossSpectra, WelchSettings
from tests.estimator.csm_models import common_motion, wishart
from tests.estimator.self_noise.noisy_benches import BENCHES, bench


@pytest.mark.parametrize(
    ("dims", "snr"),
    [
        pytest.param(dims, snr, marks=() if (len(dims), snr) == (4, 10) else pytest.mark.long)
        for dims in BENCHES
        for snr in (10, 1e6)
    ],
)
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
