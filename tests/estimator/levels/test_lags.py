"""Sensors that lag: weak motion is divided from the noise as if they did not."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.levels.bands import band_levels
from estimator.levels.lags import FINE, phases
from estimator.methods import self_noise
from estimator.self_noise.result import SelfNoise
from estimator.types import ComplexArray
from tests.estimator.levels.test_pooled import EDGES, N_BINS, ONE, drawn, scene

N = 40
LINES = np.arange(N_BINS)


def lagging(csm: ComplexArray, d: int, turns: float) -> ComplexArray:
    """Return what is measured where the last sensor lags by so many turns a line."""
    turn = np.ones((N_BINS, csm.shape[1]), np.complex128)
    turn[:, -d:] = np.exp(-2j * np.pi * turns * LINES)[:, None]
    return np.asarray(csm * turn[:, :, None] * turn[:, None, :].conj())


def estimated(csm: ComplexArray, d: int) -> SelfNoise:
    return self_noise(
        "three-sensor",
        csm,
        dims=(d,) * 3,
        n_effective=N,
        blocks=np.zeros(N_BINS, np.int64),
    )


@pytest.mark.parametrize("d", [1, 3])
def test_lag_of_a_fine_step_changes_nothing(d: int) -> None:
    noise = np.ones(3 * d)
    for seed in range(5):
        rng = np.random.default_rng([d, seed])
        sample = drawn(rng, scene(rng, (0.6,) * d, noise), N)
        lag = 13 / (FINE * N_BINS)
        np.testing.assert_allclose(
            estimated(lagging(sample, d, lag), d).noise_psd,
            estimated(sample, d).noise_psd,
            rtol=1e-9,
            atol=1e-12,
        )


@pytest.mark.parametrize("turns", [0.0, 0.0137, -0.151])
def test_intervals_of_sensors_that_lag_hold_the_noise(turns: float) -> None:
    held, means = [], []
    for seed in range(30):
        rng = np.random.default_rng([8, seed])
        sample = drawn(rng, scene(rng, (0.6,), np.ones(3)), N)
        found = estimated(lagging(sample, 1, turns), 1)
        level = band_levels(found.noise_psd, found.cumulants, EDGES, ONE)
        low, high = level.interval()
        held.append((low[0] <= 1) & (high[0] >= 1))
        means.append(level.mean[0])
    # 90 values with a standard deviation of .027 each: sqrt(1 / 61 / 40), and that of directions
    assert abs(np.mean(means) - 1) < 5 * 0.05 / np.sqrt(90)
    assert np.mean(held) > 0.95 - 3 * np.sqrt(0.05 * 0.95 / 90)


@pytest.mark.parametrize("d", [1, 3])
def test_independent_sensors_do_not_lag(d: int) -> None:
    for seed in range(50):
        rng = np.random.default_rng([9, seed])
        csm = drawn(rng, np.broadcast_to(np.eye(3 * d), (N_BINS, 3 * d, 3 * d)), 3 * d + 5)
        psd = np.sqrt(np.einsum("fii->fi", csm).real)
        coherency = csm / psd[:, :, None] / psd[:, None, :]
        assert phases(coherency, LINES, (d,) * 3, 3.0 * d + 5, 0 * LINES) is None


def test_lag_of_strong_motion_is_not_taken_off_where_sensors_are_in_step() -> None:
    block = (LINES >= N_BINS // 2).astype(np.int64)
    turn = np.where(block, np.exp(-2j * np.pi * 13 / (FINE * N_BINS) * LINES), 0.1)
    csm = np.repeat(np.eye(3, dtype=np.complex128)[None], N_BINS, axis=0)
    csm[:, 0, 1] = csm[:, 1, 0] = np.abs(turn)
    for one in (0, 1):
        csm[:, 2, one], csm[:, one, 2] = turn, turn.conj()
    found = phases(csm, LINES, (1, 1, 1), N, block)
    assert found is not None
    np.testing.assert_array_equal(found[block == 0], 1)
    np.testing.assert_allclose(found[block == 1, 2] * turn[block == 1], 1)
