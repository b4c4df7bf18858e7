"""Sums over the pairs of channels of many sensors, against the same without their structure."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.levels import noise_matrices
from estimator.levels.pooled import Pooled, pooled_noise
from estimator.types import ComplexArray
from tests.estimator.csm_models import white

TRIAXIAL = np.repeat(np.arange(9), 3)


def motion(rng: np.random.Generator, q: int, p: int = len(TRIAXIAL)) -> ComplexArray:
    """Return directions, those of the first matrix in one sensor alone."""
    U = np.linalg.qr(white(rng, 4, p, p))[0][:, :, :q]
    U[0] = np.eye(p)[:, :q]
    return U


@pytest.mark.parametrize("q", [0, 1, 3])
def test_information_is_inverted_sensor_by_sensor(q: int) -> None:
    U = motion(np.random.default_rng(q), q)
    Q = np.eye(len(TRIAXIAL)) - U @ U.conj().swapaxes(1, 2)
    J = noise_matrices.coupling(Q, *noise_matrices.pairs(TRIAXIAL))
    np.testing.assert_allclose(noise_matrices.coupling_beside(U, TRIAXIAL), J, atol=1e-14)
    share, first = np.array([0.5, 0.5, 1.0, 1.0]), np.array([0, 2, 3])
    mean = noise_matrices.mean_coupling(U, TRIAXIAL, share, first)
    np.testing.assert_allclose(mean, [(J[0] + J[1]) / 2, J[2], J[3]], atol=1e-14)
    a, b = noise_matrices.pairs(TRIAXIAL)
    root = np.where(
        TRIAXIAL[:, None] == TRIAXIAL,
        white(np.random.default_rng(q), *U.shape[:2], len(TRIAXIAL)),
        0,
    )
    rows = (root[:, :, a] * root[:, :, b].conj())[[1, 0, 0, 2]].swapaxes(0, 1)
    solved = [noise_matrices.solved(J.swapaxes(1, 2), row) for row in rows]
    expected = np.stack(solved, axis=1)
    found = noise_matrices.weights_beside(root, np.array([1, 0, 0, 2]), U, TRIAXIAL)
    error = np.abs(found - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))
    assert error.max() < 1e-13


@pytest.mark.parametrize(
    ("rest", "error"),  # what is left out of all five terms; single precision of one
    [(1e-4, 5 * noise_matrices.NEGLIGIBLE), (1.0, 1e-6)],
    ids=["own sensor", "all sensors"],
)
def test_traces_of_many_are_those_of_whole_matrices(
    rest: float, error: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(4)
    p, a = len(TRIAXIAL), noise_matrices.pairs(TRIAXIAL)[0]
    U = motion(rng, 3)
    Q = np.eye(p) - U @ U.conj().swapaxes(1, 2)
    weight = rest * white(rng, 4, p, len(a))
    weight[:, np.arange(p)[:, None] // 3 == TRIAXIAL[a]] /= rest
    found = noise_matrices.traces(weight, Q, TRIAXIAL)
    monkeypatch.setattr(noise_matrices, "MANY", p + 1)
    expected = noise_matrices.traces(weight, Q, TRIAXIAL)
    size = expected[0] ** np.array([1, 1.5, 2])[:, None, None]
    assert (np.abs(found - expected) / size).max() < error


@pytest.mark.parametrize("loudness", [0.3, 1.0, 10.0])
def test_noise_is_that_without_bounds_and_structure(
    loudness: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(5)
    p, n, n_bins = len(TRIAXIAL), 60, 12
    felt = white(rng, p, 3) * [3 * loudness, loudness, 0.4]
    felt[3:6, 1] *= 4  # a dimension that one sensor makes strong
    drawn = white(rng, n_bins, p, n) + felt @ white(rng, n_bins, 3, n)
    matrix = drawn @ drawn.conj().swapaxes(1, 2) / (2 * n)

    def noise() -> Pooled:
        block, q = np.repeat(np.arange(3), 4), np.repeat([1, 2, 3], 4)
        return pooled_noise(
            matrix, block, q, dims=(3,) * 9, n_effective=n, correlation=np.array([1.0])
        )

    found = noise()
    monkeypatch.setattr(noise_matrices, "MANY", p + 1)
    expected = noise()
    assert np.isfinite(expected.noise).all()
    np.testing.assert_allclose(found.noise, expected.noise, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.cumulants, expected.cumulants, rtol=1e-6)
