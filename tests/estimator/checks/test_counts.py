"""The covariance of rounding errors, against errors of samples that are rounded."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from estimator.checks.counts import before_rounding, covariance, shared_rounding, step_of

N_SAMPLES, LENGTH = 1 << 17, 512
RNG = np.random.default_rng(9)


def _segments(samples: np.ndarray) -> np.ndarray:
    segments = (samples - samples.mean()).reshape(-1, LENGTH)
    return np.fft.rfft(segments * np.hanning(LENGTH), axis=1)


def _means(seen: list[np.ndarray]) -> Callable[[], np.ndarray]:
    return lambda: np.stack([each.reshape(-1, LENGTH).mean(axis=1) for each in seen], axis=1)


def _cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    found = np.mean(_segments(one) * _segments(other).conj(), axis=0)
    return np.asarray(2 * found / np.sum(np.hanning(LENGTH) ** 2))


@pytest.mark.parametrize("own", [0.02, 0.1, 0.25])
@pytest.mark.parametrize(("slope", "motion"), [(0.0, 3.0), (-1.5, 3.0), (0.0, 0.6)])
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (-1.02, 0.0), (-1.02, 0.35), (1.0, 0.5)])
def test_errors_share_what_the_difference_before_rounding_says(
    own: float, slope: float, motion: float, gain: float, offset: float
) -> None:
    rng = np.random.default_rng(5)
    shape = np.maximum(np.fft.rfftfreq(N_SAMPLES), 0.002) ** slope
    moved = np.fft.irfft(np.fft.rfft(rng.standard_normal(N_SAMPLES)) * shape)
    moved *= motion / moved.std()
    exact = [a * moved + own * rng.standard_normal(N_SAMPLES) for a in (1.0, gain)]
    exact[0] += offset
    seen = [np.round(each) for each in exact]
    errors = [np.sign(a) * (s - t) for a, s, t in zip((1.0, gain), seen, exact, strict=True)]
    difference = np.array([np.var(exact[0] - np.sign(gain) * exact[1])])
    cosines = np.cos(2 * np.pi * np.arange(1, 12) * offset)
    scatter = 5 / np.sqrt(N_SAMPLES) / 12
    slow = 4 if slope else 1  # such errors are alike for several samples
    assert np.mean(errors[0] * errors[1]) == pytest.approx(
        covariance(difference, cosines)[0], abs=slow * scatter
    )
    after = np.var(seen[0] - np.sign(gain) * seen[1])
    assert after == pytest.approx(
        (difference + 1 / 6 - 2 * covariance(difference, cosines))[0], rel=0.03
    )
    # a small difference hardly changes what is seen of channels half a count apart
    loose = 1.2 if offset == 0 else float("inf")
    found = covariance(before_rounding(np.array([after]), cosines), cosines)
    true = abs(covariance(difference, cosines)[0])
    assert 0.95 * true - 6 * scatter < abs(found[0]) < loose * true + 6 * scatter
    csm = np.stack([[_cross(a, b) for b in seen] for a in seen]).transpose(2, 0, 1)
    frequency = np.arange(LENGTH // 2 + 1) / LENGTH
    counts = np.ones((len(frequency), 2), np.complex128)
    psd, _ = shared_rounding(
        csm, frequency, counts=counts, sensor=np.array([0, 1]), means=_means(seen)
    )
    expected = _cross(errors[0], errors[1]).real
    for low, high in ((2, 8), (8, 64), (64, 256)):
        band = slice(low, high)
        independent = (high - low) / 1.9 * N_SAMPLES / LENGTH
        within = 4 / 6 / np.sqrt(2 * independent) * slow
        true = abs(expected[band].mean())
        assert 0.85 * true - within < psd[band, 0].mean() < loose * true + within


def test_channels_that_are_not_alike_share_no_rounding() -> None:
    rng = np.random.default_rng(5)
    moved = 30 * rng.standard_normal(N_SAMPLES)
    seen = [np.round(a * moved + 0.1 * rng.standard_normal(N_SAMPLES)) for a in (1.0, 1.05)]
    csm = np.stack([[_cross(a, b) for b in seen] for a in seen]).transpose(2, 0, 1)
    frequency = np.arange(LENGTH // 2 + 1) / LENGTH
    counts = np.ones((len(frequency), 2), np.complex128)
    for scale, sensor in ((1.0, [0, 1]), (1e-3, [0, 0])):  # within a sensor nothing is lost
        psd, lacking = shared_rounding(
            np.asarray(csm * scale, np.complex128),
            frequency,
            counts=counts,
            sensor=np.array(sensor),
            means=_means(seen),
        )
        assert not psd.any()
        assert not lacking.any()


@pytest.mark.parametrize(
    ("samples", "step"),
    [
        (np.round(RNG.standard_normal(5000), 2) + 9.81, 0.01),
        (np.round(RNG.standard_normal(5000), 2).astype("f4") + np.float32(9.81), 0.01),
        ((3000 * RNG.standard_normal(5000)).round() * 2.44e-4, 2.44e-4),
        ((1e6 + RNG.standard_normal(5000)).astype("f4"), 0.0625),
        (RNG.standard_normal(5000), np.nan),
        (RNG.standard_normal(5000).astype("f4"), np.nan),
        (np.repeat([0.0, 5.0, np.nan], 100), np.nan),
    ],
)
def test_the_step_of_digits_is_found(samples: np.ndarray, step: float) -> None:
    assert step_of(samples) == pytest.approx(step, rel=1e-3, nan_ok=True)
