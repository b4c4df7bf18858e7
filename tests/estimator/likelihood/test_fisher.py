"""Information, bound, interval and small-sample bias against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import maximise
from estimator.self_noise.three_sensor import three_sensor
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import common_motion, planar_sensors, random_bench, wishart


def bound_by_definition(A: ComplexArray, noise_psd: FloatArray, n: int) -> FloatArray:
    """Invert the whole Fisher matrix ``n Re tr(S^-1 dS S^-1 dS)`` of psi and all of A."""
    S = A @ A.conj().T + np.diag(noise_psd)
    derivatives = [np.diag(row) for row in np.eye(len(noise_psd)) * noise_psd]
    for i, k in np.ndindex(*A.shape):
        for unit in (1.0, 1j):
            dA = np.zeros_like(A)
            dA[i, k] = unit
            derivatives.append(dA @ A.conj().T + A @ dA.conj().T)
    whitened = [np.linalg.solve(S, dS) for dS in derivatives]
    whole = n * np.array([[np.trace(a @ b).real for b in whitened] for a in whitened])
    # A is known up to a unitary factor: the pseudo-inverse leaves those directions out.
    inverse = np.linalg.pinv(whole, rcond=1e-11, hermitian=True)
    return np.asarray(np.sqrt(np.diag(inverse)[: len(noise_psd)]))


def test_the_bound_is_that_of_the_whole_fisher_matrix() -> None:
    rng = np.random.default_rng(1)
    A = rng.standard_normal((8, 3)) + 1j * rng.standard_normal((8, 3))
    noise_psd = np.exp(rng.uniform(-1, 1, 8))
    csm = A @ A.conj().T + np.diag(noise_psd)
    bound = fisher.cramer_rao_cov(csm[None], noise_psd[None], n_effective=50)
    np.testing.assert_allclose(bound[0], bound_by_definition(A, noise_psd, 50), rtol=1e-6)


def test_the_bound_has_the_figures_of_method_md() -> None:
    ones = np.ones((1, 6))
    turned = common_motion(planar_sensors(60, channel_angle_deg=30), ones[0], snr=1e3)[None]
    bound = fisher.cramer_rao_cov(turned, ones, n_effective=1080)
    assert bound[0, 0] == pytest.approx(0.0804, abs=5e-4)
    simple = three_sensor(turned, dims=(2, 2, 2), n_effective=1080)
    assert 1 / fisher.efficiency(simple.cov, bound)[0, 0] == pytest.approx(4.6, abs=0.2)
    orthogonal = common_motion(planar_sensors(10), ones[0], snr=1e3)[None]
    simple = three_sensor(orthogonal, dims=(2, 2, 2), n_effective=1080)
    bound = fisher.cramer_rao_cov(orthogonal, ones, n_effective=1080)
    np.testing.assert_allclose(fisher.efficiency(simple.cov, bound), 1, atol=0.02)
    five = common_motion(np.tile(np.eye(3), (5, 1)), np.ones(15), snr=1e4)[None]
    bound = fisher.cramer_rao_cov(five, np.ones((1, 15)), n_effective=1080)
    np.testing.assert_allclose(bound, 0.0382, atol=2e-4)


def test_an_unidentifiable_model_has_no_bound() -> None:
    """A channel that alone carries one dimension of the motion, and a model without room."""
    A = np.vstack([np.ones((4, 1)) * [1.0, 0.0], [[0.0, 1.0]]])
    csm = (A @ A.T + np.eye(5))[None].astype(np.complex128)
    bound = fisher.cramer_rao_cov(csm, np.ones((1, 5)), n_effective=100)
    assert np.isinf(bound[0, 4])
    with pytest.raises(InvalidMatrixError, match="positive"):
        fisher.cramer_rao_cov(csm[:, :3, :3], np.zeros((1, 3)), n_effective=100)
    with pytest.raises(InvalidMatrixError, match="finite"):
        fisher.cramer_rao_cov(csm * np.nan, np.ones((1, 5)), n_effective=100)
    with pytest.raises(InvalidMatrixError, match=r"\(1, 4\)"):
        fisher.cramer_rao_cov(csm, np.ones((1, 4)), n_effective=100)
    for n in (0, -1, np.nan, np.inf):
        with pytest.raises(InsufficientDataError, match="averages"):
            fisher.cramer_rao_cov(csm, np.ones((1, 5)), n_effective=n)


def test_the_first_cumulant_is_the_cramer_rao_bound() -> None:
    """At the truth, for n - q averages; the third and fourth are those of a PSD far from zero."""
    rng = np.random.default_rng(4)
    csm = random_bench(rng, dims=(2, 2, 2), snr=1e4, noise_psd=np.ones(6))[None]
    fit = maximise(csm, 2)
    found = fisher.cumulants(fit, fisher.spread(fit), n_effective=102)
    bound = fisher.cramer_rao_cov(csm, np.ones((1, 6)), n_effective=100)
    np.testing.assert_allclose(found[0], bound**2, rtol=1e-3)
    assert np.all(found[2] * found[0] >= found[1] ** 2)  # Cauchy and Schwarz


@pytest.mark.parametrize("with_penalty", [False, True])
def test_cumulants_are_traces_of_powers(*, with_penalty: bool) -> None:
    rng = np.random.default_rng(8)
    true = random_bench(rng, dims=(2, 2, 2, 2), snr=30.0, noise_psd=np.linspace(1, 2, 8))
    csm = wishart(true, 150, rng)
    penalty = 0.3 * np.eye(8) + 0.1 if with_penalty else None
    found = maximise(np.repeat(csm.reshape(1, 8, 8), 3, axis=0), 2, penalty=penalty)
    cumulants = fisher.cumulants(found, fisher.spread(found), n_effective=150.0)
    projector = found.projector[1]
    inverse = np.linalg.inv(np.abs(projector) ** 2 + found.penalty)
    for i in range(8):
        K = projector @ np.diag(inverse[i]) @ projector
        for m in range(3):
            trace = np.trace(np.linalg.matrix_power(K, m + 2)).real
            expected = trace * found.psi[1, i] ** (m + 2) / 148.0 ** (m + 1)
            # Of many sensors small terms are left out, and one has single precision.
            assert cumulants[m, 1, i] == pytest.approx(expected, rel=1e-6)


def test_eigenvalues_are_corrected_for_scatter() -> None:
    """One factor in noise: the largest eigenvalue of the averages is above the true one."""
    rng = np.random.default_rng(2)
    csm = np.eye(40, dtype=np.complex128)
    csm[0, 0] = 4.0
    draws = wishart(csm, 200, rng, n_draws=300)
    largest = np.linalg.eigvalsh(draws)[:, -1:].astype(np.float64)
    assert largest.mean() > 4.2
    corrected = fisher.spiked_eigenvalues(largest, 39, 200)
    assert corrected.mean() == pytest.approx(4, abs=4 * corrected.std() / np.sqrt(300) + 0.02)
    assert fisher.spiked_eigenvalues(np.ones((1, 1)), 39, 200)[0, 0] > 1


@pytest.mark.parametrize(
    "d", [1, pytest.param(2, marks=pytest.mark.long), pytest.param(3, marks=pytest.mark.long)]
)
@pytest.mark.parametrize("snr", [1.0, 1e6])
def test_the_bias_is_of_first_order(d: int, snr: float) -> None:
    """With n = 100, terms of second order are below (2 q / n)**2."""
    rng = np.random.default_rng(3)
    n_draws, p = 2500, 3 * d
    csm = random_bench(rng, dims=(d,) * 3, snr=snr, noise_psd=np.ones(p))
    found = maximise(wishart(csm, 100, rng, n_draws=n_draws), d)
    seen = found.psi.mean(axis=1) - 1
    predicted = fisher.bias(found, fisher.spread(found), n_effective=100).mean()
    allowed = 4 * seen.std() / np.sqrt(n_draws) + (2 * d / 100) ** 2
    assert abs(seen.mean() - predicted) < allowed
    if snr == 1e6:
        assert predicted == pytest.approx(-d / 100, rel=1e-3)
    else:
        assert predicted < -1.3 * d / 100
