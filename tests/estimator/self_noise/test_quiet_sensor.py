"""A quiet sensor among noisy ones: bias and coverage down to a motion far below their noise."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import InsufficientDataError
from estimator.self_noise.quiet_sensor import quiet_sensor_noise
from tests.estimator.csm_models import random_bench, wishart

INDEPENDENT = np.eye(1, 8)[0]
RATIO = 1000.0
"""Noise of the others over that of the quiet sensor."""


@pytest.mark.parametrize(
    ("dims", "n", "snr", "n_freqs"),
    [
        ((3, 3, 3), 226, 0.03, 64),
        pytest.param((3, 3, 3), 226, 0.3, 490, marks=pytest.mark.long),
        pytest.param((3, 3, 3), 226, 3.0, 64, marks=pytest.mark.long),
        pytest.param((3, 3, 3), 40, 1.0, 64, marks=pytest.mark.long),
        ((1, 1, 1), 226, 0.3, 64),
        pytest.param((3,) * 5, 226, 0.1, 64, marks=pytest.mark.long),
    ],
)
def test_the_interval_covers_the_truth_and_the_estimate_is_unbiased(
    dims: tuple[int, ...], n: int, snr: float, n_freqs: int
) -> None:
    """`snr` is that of the noisy sensors; 200 draws of as many orientations."""
    rng = np.random.default_rng(7)
    d, p = dims[0], sum(dims)
    noise_psd = np.full(p, RATIO)
    noise_psd[:d] = 1.0
    found = []
    for _ in range(200):
        csm = random_bench(rng, dims=dims, snr=snr * RATIO, noise_psd=noise_psd)
        sample = wishart(np.broadcast_to(csm, (n_freqs, p, p)), n, rng)[0]
        found.append(
            quiet_sensor_noise(sample, dims=dims, sensor=0, n_effective=n, correlation=INDEPENDENT)
        )
    noise, low, high = np.array(found).swapaxes(0, 1)
    covers = ((low < 1) & (high > 1)).mean()
    # the channels of a sensor share little: 200 d draws
    assert abs(covers - 0.95) < 4 * np.sqrt(0.05 * 0.95 / (200 * d))
    # half of the estimates are below: the scatter below zero is not that above
    assert abs((noise < 1).mean() - 0.5) < 4 * np.sqrt(0.25 / (200 * d))


def test_units_have_no_effect_and_invalid_frequencies_are_ignored() -> None:
    rng = np.random.default_rng(1)
    noise_psd = np.repeat([1.0, 100, 100], 2)
    csm = random_bench(rng, dims=(2, 2, 2), snr=1000.0, noise_psd=noise_psd)
    sample = wishart(np.broadcast_to(csm, (50, 6, 6)), 100, rng)[0]
    known = {"dims": (2, 2, 2), "sensor": 0, "n_effective": 100.0, "correlation": INDEPENDENT}
    noise, low, high = quiet_sensor_noise(sample, **known)
    gain = np.array([1e-9, 1e-9, 1e3, 1e4, 1e-5, 1.0])
    scaled = np.concatenate([gain[:, None] * sample * gain, np.full((3, 6, 6), np.nan)])
    for value, other in zip(
        (noise, low, high),
        quiet_sensor_noise(scaled, **known),
        strict=True,
    ):
        np.testing.assert_allclose(other, value * 1e-18, rtol=1e-9)


def test_correlated_frequencies_widen_the_interval() -> None:
    rng = np.random.default_rng(1)
    csm = random_bench(rng, dims=(1, 1, 1), snr=100.0, noise_psd=np.array([1.0, 100, 100]))
    sample = wishart(np.broadcast_to(csm, (100, 3, 3)), 100, rng)[0]
    narrow, wide = (
        quiet_sensor_noise(sample, dims=(1, 1, 1), sensor=0, n_effective=100, correlation=r)
        for r in (INDEPENDENT, np.array([1, 0.5, 0, 0, 0, 0, 0, 0]))
    )
    width = [float((high - low)[0]) for _, low, high in (narrow, wide)]
    assert width[1] / width[0] == pytest.approx(np.sqrt(1 + 2 * 0.5 * 0.99), rel=0.02)


def test_undetermined_noise_is_nan() -> None:
    csm = np.eye(4, dtype=np.complex128)[None].repeat(5, axis=0)
    for dims in ((2, 2), (4,)):
        found = quiet_sensor_noise(
            csm, dims=dims, sensor=0, n_effective=50, correlation=INDEPENDENT
        )
        assert np.isnan(found).all()
    nothing = quiet_sensor_noise(
        np.full((5, 3, 3), np.nan),
        dims=(1, 1, 1),
        sensor=0,
        n_effective=50,
        correlation=INDEPENDENT,
    )
    assert np.isnan(nothing).all()
    with pytest.raises(InsufficientDataError):
        quiet_sensor_noise(
            np.eye(6)[None].astype(complex),
            dims=(2, 2, 2),
            sensor=0,
            n_effective=2,
            correlation=INDEPENDENT,
        )


def test_a_sensor_as_noisy_as_its_partners_has_no_estimate() -> None:
    rng = np.random.default_rng(3)
    csm = random_bench(rng, dims=(3, 3, 3), snr=100.0, noise_psd=np.ones(9))
    sample = wishart(np.broadcast_to(csm, (64, 9, 9)), 100, rng)[0]
    found = quiet_sensor_noise(
        sample, dims=(3, 3, 3), sensor=0, n_effective=100, correlation=INDEPENDENT
    )
    assert np.isnan(found).all()
