"""Weights over the pairs of more than three sensors: poor sensors, equal sensors, few averages."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.methods import self_noise
from estimator.self_noise.three_sensor import DENSE_BINS, sampled, three_sensor
from tests.estimator.csm_models import random_bench, wishart

FIVE = (3,) * 5
GOOD = slice(0, 9)


def two_poor_sensors(ratio: float) -> np.ndarray:
    noise_psd = np.ones(15)
    noise_psd[9:] = ratio
    return noise_psd


@pytest.mark.parametrize(
    ("ratio", "snr", "n"),
    [
        pytest.param(ratio, snr, n, marks=() if (ratio, n) == (100.0, 30) else pytest.mark.long)
        for ratio, snr in ((10.0, 1e3), (100.0, 1e3), (1000.0, 1e4))
        for n in (30, 200)
    ],
)
def test_two_poor_sensors_hardly_affect_the_others(ratio: float, snr: float, n: int) -> None:
    """Scatter within 10 % of maximum likelihood; no bias; the interval is that of these weights."""
    noise_psd = two_poor_sensors(ratio)
    rng = np.random.default_rng(4)
    csm = random_bench(rng, dims=FIVE, snr=snr, noise_psd=noise_psd)
    sample = wishart(csm, n, rng, n_draws=400)
    found = three_sensor(sample, dims=FIVE, n_effective=n)
    best = self_noise("maximum-likelihood", sample[:150], dims=FIVE, n_effective=n)
    relative = found.noise_psd / noise_psd
    error = relative.std(axis=0) / np.sqrt(len(sample))
    assert np.all(np.abs(relative.mean(axis=0) - 1) < 4.5 * error)
    scatter, least = (each.noise_psd[:150, GOOD].std(axis=0).mean() for each in (found, best))
    # the mean of nine standard deviations of 150 draws: below 3.8 % standard error of their ratio
    assert scatter < 1.1 * least
    predicted = np.median(found.cov * np.abs(found.noise_psd) / noise_psd, axis=0)
    np.testing.assert_allclose(predicted, relative.std(axis=0), rtol=0.14 + 1 / n)  # 4 / √(2 · 400)
    covers = (found.low < noise_psd) & (noise_psd < found.high)
    assert 0.93 < covers.mean() < 0.97


def test_equal_sensors_have_equal_weights() -> None:
    rng = np.random.default_rng(2)
    for n, dims in ((30, FIVE), (200, (1,) * 4), (200, FIVE)):
        noise_psd = np.ones(sum(dims))
        csm = random_bench(rng, dims=dims, snr=1e3, noise_psd=noise_psd)
        sample = wishart(csm, n, rng, n_draws=400)
        found = three_sensor(sample, dims=dims, n_effective=n)
        # one frequency alone has no neighbours to take weights from
        plain = [three_sensor(one[None], dims=dims, n_effective=n) for one in sample[:50]]
        expected = np.concatenate([one.noise_psd for one in plain])
        np.testing.assert_allclose(found.noise_psd[:50], expected, rtol=1e-9)


def test_weights_follow_a_sensor_that_is_poor_at_some_frequencies_only() -> None:
    """The noise of two sensors rises a thousandfold over a decade, that of one by a resonance."""
    n, n_freqs = 100, 1000
    frequency = np.arange(n_freqs) / n_freqs
    noise_psd = np.ones((n_freqs, 15))
    noise_psd[:, 9:] = (1 + (frequency / 0.1) ** 3)[:, None]
    noise_psd *= 10.0 ** (3 * np.exp(-(((frequency - 0.3) / 0.03) ** 2)))[:, None]
    rng = np.random.default_rng(5)
    directions = random_bench(rng, dims=FIVE, snr=1e6, noise_psd=np.zeros(15))
    sample = wishart(directions + noise_psd[:, :, None] * np.eye(15), n, rng)[0]
    found = three_sensor(sample, dims=FIVE, n_effective=n)
    relative = (found.noise_psd / noise_psd)[:, GOOD]
    covers = ((found.low < noise_psd) & (noise_psd < found.high))[:, GOOD]
    equal, poor = frequency < 0.05, frequency > 0.5
    for some in (equal, poor, (frequency > 0.25) & (frequency < 0.35)):
        # nine channels share the scatter of three sensors: at least 3 n independent numbers
        error = relative[some].std() / np.sqrt(3 * some.sum())
        assert abs(relative[some].mean() - 1) < 4.5 * error
        assert abs(covers[some].mean() - 0.95) < 4.5 * np.sqrt(0.05 * 0.95 / (3 * some.sum()))
    assert relative[equal].std() == pytest.approx(np.sqrt(1.575 / n), rel=0.1)  # all six pairs
    assert relative[poor].std() == pytest.approx(np.sqrt(2.5 / n), rel=0.1)  # the good pair


def test_an_unusable_pair_does_not_affect_the_others() -> None:
    noise_psd = two_poor_sensors(100.0)
    rng = np.random.default_rng(6)
    csm = random_bench(rng, dims=FIVE, snr=1e3, noise_psd=noise_psd)
    sample = wishart(csm, 100, rng, n_draws=300)
    expected = three_sensor(sample, dims=FIVE, n_effective=100)
    spoilt = sample.copy()
    spoilt[140] = np.nan
    spoilt[150, 3:6] = spoilt[150, :, 3:6] = 0
    found = three_sensor(spoilt, dims=FIVE, n_effective=100)
    others = np.delete(np.arange(300), [140, 150])
    # a neighbour less of 32 changes weights by little, and the estimate by less
    difference = np.abs(found.noise_psd - expected.noise_psd)[others]
    assert np.all(difference < 0.05 * expected.cov[others] * np.abs(expected.noise_psd[others]))
    assert np.isnan(found.noise_psd[140]).all()
    assert np.isfinite(np.delete(found.noise_psd[150], [3, 4, 5])).all()


def test_sampled_frequencies_are_dense_below_and_rising() -> None:
    bins = sampled(10_000)
    steps = np.diff(bins)
    assert bins[0] == 0
    assert np.all(steps >= 1)
    assert np.all(steps <= np.maximum(1, bins[:-1] / DENSE_BINS))
    np.testing.assert_array_equal(bins[:64], np.arange(64))
    assert len(bins) < 250


def test_channels_may_be_estimated_in_parts_and_without_scatter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(5)
    dims = (3, 3, 2, 3, 3)
    noise_psd = np.geomspace(1, 100, sum(dims))
    csm = random_bench(rng, dims=dims, snr=1e3, noise_psd=noise_psd)
    sample = wishart(csm, 50, rng, n_draws=100)
    found = three_sensor(sample, dims=dims, n_effective=50)
    monkeypatch.setattr("estimator.self_noise.three_sensor.WEIGHT_BYTES", 1)
    in_parts = three_sensor(sample, dims=dims, n_effective=50)
    for one, other in ((found.noise_psd, in_parts.noise_psd), (found.cov, in_parts.cov)):
        np.testing.assert_allclose(one, other, rtol=1e-9)
    np.testing.assert_array_equal(found.flags, in_parts.flags)
    quick = self_noise("three-sensor", sample, dims=dims, n_effective=50, scatter=False)
    np.testing.assert_allclose(quick.noise_psd, found.noise_psd, rtol=1e-9)
    assert np.isnan(quick.cov).all()
