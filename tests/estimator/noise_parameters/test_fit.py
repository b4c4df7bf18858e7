"""Noise terms and Allan deviation: known answers, bias, coverage, lines, what cannot be fitted."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.levels.bands import N_LAGS, bin_correlation
from estimator.methods import self_noise
from estimator.noise_parameters.allan import allan_deviation, averaging_times
from estimator.noise_parameters.fit import NoiseParameters, Term, fit, terms_at
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.spectra.windows import get_window
from estimator.types import FloatArray

FREQUENCY: FloatArray = np.arange(1001, dtype=np.float64) * 0.1
INDEPENDENT = np.eye(1, N_LAGS)[0]
TERMS = np.array([2e-13, 5e-12, 1e-12, 2e-16])


def drawn(rng: np.random.Generator, terms: FloatArray, n: float) -> tuple[FloatArray, FloatArray]:
    """Return PSD estimates of n averages as a window shows them, and their c.o.v."""
    psd = np.zeros(len(FREQUENCY))
    psd[1:] = terms_at(FREQUENCY[1:], 0.1) @ terms
    return psd * rng.gamma(n, 1 / n, len(psd)), np.full(len(psd), 1 / np.sqrt(n))


@pytest.mark.long
@pytest.mark.parametrize("n", [20, 400])
def test_terms_are_unbiased_and_their_errors_cover_the_truth(n: int) -> None:
    rng = np.random.default_rng(1)
    found = [fit(FREQUENCY, *drawn(rng, TERMS, n), INDEPENDENT) for _ in range(60)]
    values = np.array([each.values for each in found])
    errors = np.array([each.errors for each in found])
    away = np.abs(values.mean(axis=0) - TERMS)
    # the weights follow from the estimate, which leaves a bias of order 1 / n
    assert np.all(away < 4 * values.std(axis=0) / np.sqrt(len(found)) + 0.3 * TERMS / n)
    covers = np.abs(values - TERMS) < 1.96 * errors
    assert np.all(np.abs(covers.mean(axis=0) - 0.95) < 4 * np.sqrt(0.05 * 0.95 / len(found)))
    chi_square = np.mean([each.chi_square for each in found])
    assert chi_square == pytest.approx(1.0, abs=0.04 if n == 20 else 0.015)


@pytest.mark.long
def test_an_absent_term_is_zero_within_its_error() -> None:
    rng = np.random.default_rng(2)
    white = np.array([0, 0, 1e-12, 0])
    found = [fit(FREQUENCY, *drawn(rng, white, 100), INDEPENDENT) for _ in range(50)]
    scores = np.array([each.values / each.errors for each in found])[:, [0, 1, 3]]
    assert np.abs(scores.mean(axis=0)).max() < 4 / np.sqrt(len(found))
    assert (scores < 0).mean() > 0.3  # not clipped
    assert np.mean([each.error(Term.WHITE) / 1e-12 for each in found]) < 0.02


def own_noise(rng: np.random.Generator, n_samples: int, rate: float) -> FloatArray:
    f: FloatArray = np.asarray(np.fft.rfftfreq(2 * n_samples, 1 / rate), np.float64)
    psd = np.zeros(len(f))
    psd[1:] = terms_at(f[1:]) @ TERMS
    coefficients = rng.standard_normal((2, len(f)))
    spectrum = (coefficients[0] + 1j * coefficients[1]) * np.sqrt(psd * rate * n_samples / 2)
    return np.asarray(np.fft.irfft(spectrum)[:n_samples])


def true_deviation(tau: FloatArray, high: float) -> FloatArray:
    f = np.geomspace(1e-6, high, 50_000)
    x = np.pi * f * tau[:, None]
    return np.asarray(np.sqrt(np.trapezoid(2 * (terms_at(f) @ TERMS) * np.sin(x) ** 4 / x**2, f)))


@pytest.mark.long
def test_terms_are_recovered_from_samples_with_strong_motion() -> None:
    """Motion taken out, windows, neighbouring frequencies correlated: terms and Allan deviation."""
    rate, settings = 50.0, WelchSettings(50.0, 1000)
    correlation = bin_correlation(get_window("hann", 512), 256)
    rng = np.random.default_rng(3)
    terms, errors, scores, inside = [], [], [], []
    truth = np.empty(0)
    for _ in range(6):
        motion = 1e-4 * rng.standard_normal((15_000, 3))
        samples = []
        for _ in range(3):
            turned = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
            noise_of = [own_noise(rng, 15_000, rate) for _ in range(3)]
            samples.append(turned + np.column_stack(noise_of))
        spectra = CrossSpectra(settings, 9)
        spectra.add(np.hstack(samples), np.arange(0, 14_001, settings.hop))
        f = settings.frequencies
        noise = self_noise(
            "three-sensor", spectra.csm(), dims=(3, 3, 3), n_effective=spectra.n_effective
        )
        for column in range(9):
            psd, cov = noise.noise_psd[:, column], noise.cov[:, column]
            found = fit(f, psd, cov, correlation, band=(0.0, 22.5))
            terms.append(found.values / TERMS)
            errors.append(found.errors / TERMS)
            allan = allan_deviation(f, psd, cov, correlation, found)
            if not len(truth):
                truth = true_deviation(allan.tau, found.high)
            scores.append(allan.deviation / truth)
            inside.append((allan.low < truth) & (truth < allan.high))
    away = np.abs(np.mean(terms, axis=0) - 1)
    # nine channels share the scatter of three sensors: a third of them are independent
    one = np.std(terms, axis=0) / np.sqrt(len(terms) / 3)
    assert np.all(away[1:] < 4 * one[1:])
    assert np.all(away[:1] < 4 * one[:1] + 0.1)  # f**-2 at four bins: the window's next order
    covers = np.abs(np.array(terms) - 1) < 1.96 * np.array(errors)
    assert covers.mean() == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / (len(terms) / 3)))
    assert np.mean(scores, axis=0) == pytest.approx(1, abs=0.04)
    assert np.mean(inside) == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / (len(terms) / 3)))


def test_lines_are_excluded_and_counted() -> None:
    rng = np.random.default_rng(4)
    psd, cov = drawn(rng, TERMS, 200)
    plain = fit(FREQUENCY, psd, cov, INDEPENDENT)
    hum = psd.copy()
    hum[[499, 500, 501]] *= [20, 1000, 20]  # 50 Hz
    found = fit(FREQUENCY, hum, cov, INDEPENDENT)
    assert 3 <= found.n_lines <= 7
    assert np.all(np.abs(found.values - plain.values) < 0.5 * plain.errors)


def test_a_misfit_of_the_terms_is_reported_with_its_band() -> None:
    rng = np.random.default_rng(5)
    psd, cov = drawn(rng, TERMS, 200)
    good = fit(FREQUENCY, psd, cov, INDEPENDENT)
    assert abs(good.worst_score) < 5
    resonance = psd * (1 + 0.3 * np.exp(-(((FREQUENCY - 30) / 2) ** 2)))
    found = fit(FREQUENCY, resonance, cov, INDEPENDENT)
    assert found.worst_score > 10
    assert found.worst_low < 30 < found.worst_high
    assert found.worst_ratio > 1.1
    assert found.errors[2] > good.errors[2]


@pytest.mark.parametrize(
    ("term", "closed"),
    [
        (Term.WHITE, lambda tau: 1 / (2 * tau)),
        (Term.FLICKER, lambda tau: 2 * np.log(2) + 0 * tau),
        (Term.RANDOM_WALK, lambda tau: (2 * np.pi) ** 2 * tau / 6),
    ],
)
def test_the_allan_deviation_of_each_term_is_the_closed_form(
    term: Term, closed: Callable[[FloatArray], FloatArray]
) -> None:
    values = np.array([1.0 if each is term else 0.0 for each in Term])
    f: FloatArray = np.arange(1, 100_001, dtype=np.float64) * 2e-3
    psd = terms_at(f, 2e-3) @ values
    parameters = NoiseParameters(
        values, np.zeros(4), np.zeros((4, 4)), 8e-3, 200.0, len(f), 0, 1.0, 0.1, 1.0, 1.0, 0.0
    )
    found = allan_deviation(f, psd, np.full(len(f), 1e-6), INDEPENDENT, parameters)
    some = (found.tau > 1) & (found.tau < 50)
    expected = np.sqrt(closed(found.tau[some]))
    # a tail 3 / (8 pi**2 f tau) of the white noise is above the highest frequency
    np.testing.assert_allclose(found.deviation[some], expected, rtol=2e-3)
    np.testing.assert_allclose(found.fitted[some], expected, rtol=2e-3)
    assert averaging_times(0.1, 100.0).tolist() == [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0]


def test_too_little_and_mismatched_input_is_refused() -> None:
    psd, cov = drawn(np.random.default_rng(0), TERMS, 100)
    with pytest.raises(InsufficientDataError, match="at least 24"):
        fit(FREQUENCY, psd, cov, INDEPENDENT, band=(1.0, 2.0))
    with pytest.raises(InsufficientDataError, match="at least 24"):
        fit(FREQUENCY[:9], psd[:9], cov[:9], INDEPENDENT)
    with pytest.raises(InsufficientDataError, match="0 frequencies"):
        fit(FREQUENCY, np.full_like(psd, np.nan), cov, INDEPENDENT)
    psd[: len(psd) // 4] = 0.0  # of one of two copies that differ by a sample
    with pytest.raises(InsufficientDataError, match="zero at most frequencies"):
        fit(FREQUENCY, psd, cov, INDEPENDENT)
    with pytest.raises(EstimatorError, match="one shape"):
        fit(FREQUENCY, psd[:-1], cov, INDEPENDENT)


def test_channels_without_cov_at_some_frequencies_take_their_neighbours() -> None:
    """Estimates at the bound of maximum likelihood have none, and still count."""
    psd, cov = drawn(np.random.default_rng(6), TERMS, 100)
    cov[100:140:7] = np.nan
    found = fit(FREQUENCY, psd, cov, INDEPENDENT)
    complete = fit(FREQUENCY, psd, np.full_like(cov, 0.1), INDEPENDENT)
    assert np.all(np.abs(found.values - complete.values) < 0.05 * complete.errors)
    assert found.n_frequencies == complete.n_frequencies
