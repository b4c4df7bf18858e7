"""Matrices of many channels: work in blocks of frequencies, with the same results to the bit."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from estimator import blocks
from estimator.checks import band_steadiness, shared_noise
from estimator.checks.diagnose import diagnose
from estimator.checks.shared_motion import CanonicalCoherence, is_coherent, seen_by_others
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.maximum_likelihood import standard_error
from estimator.self_noise.coherency import coherency
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import white
from tests.traced_memory import peak_of

N_FREQS, N_AVERAGES = 60, 200


def _averages(n_sensors: int, *, apart: int = 0) -> ComplexArray:
    """Return averages of triaxial sensors; the last `apart` of them record another motion."""
    rng = np.random.default_rng(1)
    motion = 10 * white(rng, 2, N_FREQS, 3, N_AVERAGES)
    parts = [motion[int(k >= n_sensors - apart)] for k in range(n_sensors)]
    x = np.concatenate(parts, axis=1) + white(rng, N_FREQS, 3 * n_sensors, N_AVERAGES)
    return np.asarray(x @ x.conj().swapaxes(1, 2) / N_AVERAGES)


def _fitted(csm: ComplexArray, n_factors: int) -> tuple[FloatArray | ComplexArray, ...]:
    given = coherency(csm, (3, 3, 3, 3))
    fit = maximise(given.matrix, n_factors)
    error = standard_error(fit, n_effective=N_AVERAGES)
    return given.matrix, given.psd, fit.psi, fit.eigenvectors, fit.discrepancy, error


@pytest.mark.parametrize("n_factors", [0, 3])
def test_blocks_of_frequencies_change_no_result(
    monkeypatch: pytest.MonkeyPatch, n_factors: int
) -> None:
    csm = _averages(4)
    csm[[5, 40]] = np.nan
    csm[20:30] = 0.0  # a block with no usable frequency
    whole = _fitted(csm, n_factors)
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 7 * csm[0].nbytes)
    for one, other in zip(whole, _fitted(csm, n_factors), strict=True):
        assert np.array_equal(one, other, equal_nan=True)


def test_a_few_frequencies_have_the_coherence_of_all() -> None:
    csm = _averages(4, apart=2)
    where = np.arange(N_FREQS) % 3 == 0
    some = CanonicalCoherence(csm).between(range(3), range(3, 12), where=where)
    every = CanonicalCoherence(csm).between(range(3), range(3, 12))
    np.testing.assert_allclose(some[where], every[where], rtol=1e-12)
    assert not some[~where].any()


@pytest.mark.parametrize("apart", [0, 1, 2])
def test_responses_use_the_frequencies_at_which_all_other_sensors_see_the_motion(
    apart: int,
) -> None:
    csm, dims = _averages(4, apart=apart), (3, 3, 3, 3)
    wanted = np.ones(N_FREQS, np.bool_)
    for pair in combinations(range(4), 2):
        found = seen_by_others(CanonicalCoherence(csm), dims, pair, wanted)
        rest = [c for c in range(12) if c // 3 not in pair]
        own = range(3 * pair[0], 3 * pair[0] + 3)
        together = CanonicalCoherence(csm).between(own, np.array(rest))[:, -1]
        assert apart or found.all()
        assert np.array_equal(found, is_coherent(together, wanted))


def test_an_estimate_of_many_channels_keeps_few_matrices(monkeypatch: pytest.MonkeyPatch) -> None:
    csm, dims = _averages(8), (3,) * 8
    frequency = np.arange(1.0, N_FREQS + 1)
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 2 * csm[0].nbytes)
    monkeypatch.setattr(band_steadiness, "PAIR_BYTES", 1 << 16)
    monkeypatch.setattr(shared_noise, "MAX_CHANNELS", 0)  # it takes the square of all pairs
    few = 20.0  # averages, with which nothing is fitted
    assert peak_of(lambda: diagnose(csm, frequency, dims=dims, n_effective=few)) < 5 * csm.nbytes
    most = peak_of(lambda: diagnose(csm, frequency, dims=dims, n_effective=N_AVERAGES))
    assert most < 6 * csm.nbytes


def test_averages_of_many_channels_take_little_beside_their_sum() -> None:
    n_channels, length = 120, 64
    spectra = CrossSpectra(WelchSettings(100.0, length), n_channels)
    samples = np.random.default_rng(0).standard_normal((2 * length, n_channels))
    starts = np.arange(3) * length // 2
    one = (length // 2 + 1) * n_channels**2 * 16
    assert peak_of(lambda: spectra.add(samples, starts)) < 6 * one
