"""The paper's bias theory, against its own cases and against the estimators."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import EstimatorError
from estimator.methods import self_noise
from estimator.self_noise.bias import (
    motion_csm,
    snr,
    three_channel_bias,
    three_sensor_bias,
)
from tests.estimator.csm_models import rotation

PLANE = np.diag([1.0, 1.5])


def unit(degrees: list[float]) -> np.ndarray:
    """Uniaxial sensors at these angles from x: responses of shape (n, 1, 2)."""
    angles = np.deg2rad(degrees)
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, None, :]


def incoherent(motion: np.ndarray, coherency: np.ndarray) -> np.ndarray:
    """Motions with equal PSDs of which only part is coherent: ``S_ZiZj = coherency[i, j] S_Z``."""
    return np.asarray(coherency[..., None, None] * motion)


@pytest.mark.parametrize(("theta", "fraction"), [(10, 0.0445), (5, 0.0113)])
def test_the_bias_has_known_values(theta: float, fraction: float) -> None:
    for level in (10, 100, 1000):
        c = motion_csm(unit([0, theta, theta]), level * PLANE)
        bias = three_channel_bias(c, np.ones(3), dims=(1, 1, 1))
        assert bias[0] == pytest.approx(fraction * level, rel=0.01)
        assert snr(c, np.ones(3))[0] == pytest.approx(level)


def test_the_three_unbiased_cases_have_no_bias() -> None:
    dims, ones = (1, 1, 1), np.ones(3)
    # (i) low SNR
    c = motion_csm(unit([10, 20, 40]), 1e-6 * PLANE)
    assert np.abs(three_channel_bias(c, ones, dims=dims)).max() < 1e-5
    # (ii) motion in one direction, (15)
    c = motion_csm(unit([10, 20, 40]), np.diag([1e6, 0.0]))
    np.testing.assert_allclose(three_channel_bias(c, ones, dims=dims), 0, atol=1e-8)
    # (iii) one other sensor aligned with the target: targets 0 and 1, not 2
    c = motion_csm(unit([10, 10, 40]), 1e3 * PLANE)
    bias = three_channel_bias(c, ones, dims=dims)
    np.testing.assert_allclose(bias[:2], 0, atol=1e-9)
    assert bias[2] > 100


def test_three_sensor_has_no_bias_by_orientation_or_one_incoherent_sensor() -> None:
    rng = np.random.default_rng(0)
    H = np.stack([rotation(rng, 3) for _ in range(3)])
    motion = np.diag([1.0, 1.5, 0.8]) * 1e4
    common = motion_csm(H, motion)
    np.testing.assert_allclose(three_sensor_bias(common, np.ones(9), dims=(3, 3, 3)), 0, atol=1e-7)
    # section 4.1: unbiased as long as one other sensor moves with the target
    coherency = np.array([[1, 1, 0.9], [1, 1, 0.9], [0.9, 0.9, 1]])
    c = motion_csm(H, incoherent(motion, coherency))
    bias = three_sensor_bias(c, np.ones(9), dims=(3, 3, 3))
    np.testing.assert_allclose(bias[:6], 0, atol=1e-7)
    assert bias[6:].min() > 100


def test_equal_coherency_biases_by_snr_times_the_incoherence() -> None:
    # (30) with S_ZiZj = g S_Z: gamma (1 - g g / g)
    H = np.broadcast_to(np.eye(2), (3, 2, 2))
    g = 0.99
    coherency = np.full((3, 3), g) + (1 - g) * np.eye(3)
    c = motion_csm(H, incoherent(100 * PLANE, coherency))
    bias = three_sensor_bias(c, np.ones(6), dims=(2, 2, 2))
    np.testing.assert_allclose(bias, np.tile([100, 150], 3) * (1 - g))
    np.testing.assert_allclose(bias, three_channel_bias(c, np.ones(6), dims=(2, 2, 2)))


@pytest.mark.parametrize(
    ("method", "theory"),
    [("three-channel", three_channel_bias), ("three-sensor", three_sensor_bias)],
)
@pytest.mark.parametrize("n_sensors", [3, 5])
def test_the_bias_of_the_estimators_agrees_with_the_theory(
    method: str, theory: object, n_sensors: int
) -> None:
    rng = np.random.default_rng(1)
    d, dims = 3, (3,) * n_sensors
    gains = 10 ** rng.uniform(-1, 1, (4, n_sensors, d, 1)) * np.exp(
        2j * np.pi * rng.random((4, n_sensors, d, 1))
    )
    H = gains * np.stack([rotation(rng, d) for _ in range(4 * n_sensors)]).reshape(
        4, n_sensors, d, d
    )
    delays = rng.uniform(0, 0.3, n_sensors)
    coherency = np.exp(-np.abs(delays[:, None] - delays) + 1j * (delays[:, None] - delays))
    c = motion_csm(H, incoherent(np.diag([1.0, 1.5, 0.8]) * 100, coherency))
    noise_psd = rng.uniform(0.5, 2, (4, 3 * n_sensors))
    csm = c + noise_psd[:, :, None] * np.eye(3 * n_sensors)
    found = self_noise(method, csm, dims=dims, n_effective=1e9, correct=False).noise_psd
    assert callable(theory)
    np.testing.assert_allclose(
        found / noise_psd - 1, theory(c, noise_psd, dims=dims), rtol=1e-8, atol=1e-8
    )


def test_motion_that_lacks_a_dimension_causes_no_bias_for_parallel_sensors() -> None:
    rng = np.random.default_rng(2)
    H = np.stack([rotation(rng, 2) for _ in range(60)]).reshape(20, 3, 2, 2)
    c = motion_csm(H, np.diag([1e4, 0.0]))
    np.testing.assert_allclose(three_sensor_bias(c, np.ones(6), dims=(2, 2, 2)), 0, atol=1e-8)


def test_unequal_sensors_are_refused() -> None:
    c = motion_csm(unit([0, 5, 10]), PLANE)
    with pytest.raises(EstimatorError, match="expected equal numbers"):
        three_sensor_bias(c, np.ones(4), dims=(1, 1, 2))
    with pytest.raises(EstimatorError, match="expected"):
        motion_csm(unit([0, 5, 10]), np.eye(3))


def test_a_channel_without_motion_has_no_bias() -> None:
    response = np.zeros((3, 2, 2))
    response[:, 0] = [[1, 0], [np.cos(0.1), np.sin(0.1)], [1, 0]]
    motion = motion_csm(response, np.eye(2))
    bias = three_channel_bias(motion, np.ones(6), dims=(2, 2, 2))
    np.testing.assert_array_equal(bias[1::2], 0)
    assert np.all(bias[::2] != 0)
    with pytest.raises(EstimatorError, match="shape"):
        three_channel_bias(motion, np.ones(5), dims=(2, 2, 2))
    with pytest.raises(EstimatorError, match="finite"):
        three_sensor_bias(motion * np.nan, np.ones(6), dims=(2, 2, 2))
