"""Noise where waves cross the bench: gradients of the motion with the loadings of positions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from estimator.likelihood.dimension import BandDimension
from estimator.likelihood.goodness_of_fit import BandTest, pool
from estimator.likelihood.gradients import (
    known_loadings_test,
    maximise_known,
    noise_by_gradients,
    with_gradients,
)
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from tests.estimator.csm_models import plane_waves, rotation, wishart

N, FREQUENCIES = 5, 24
CENTRES = (1.0, 5.0, 14.0, 60.0)
FREQUENCY = np.outer(CENTRES, np.linspace(0.95, 1.05, FREQUENCIES)).ravel()
BAND = np.repeat(np.arange(len(CENTRES)), FREQUENCIES)
POSITIONS = np.array([[0.0, 0.1], [0.09, 0.03], [0.05, -0.08], [-0.06, -0.07], [-0.1, 0.02]])


def turned_bench(rng: np.random.Generator) -> np.ndarray:
    """Return true cross-spectra of sensors turned at random, with a noise PSD of 1."""
    turn = np.zeros((3 * N, 3 * N))
    for sensor in range(N):
        own = slice(3 * sensor, 3 * sensor + 3)
        turn[own, own] = rotation(rng, 3)
    csm = plane_waves(FREQUENCY, POSITIONS, snr=1e3)
    return turn @ (csm - np.eye(3 * N)) @ turn.T + np.eye(3 * N)


def choice(band: int, *, usual: bool, n_sensors: int = N) -> BandDimension:
    """Return what free factors say of a band: one motion explains it, or nine dimensions do."""
    inside = FREQUENCY[band == BAND]
    test = BandTest(1.0, 1.0, 0.5, FREQUENCIES)
    return BandDimension(
        low=float(inside[0]),
        high=float(inside[-1]),
        n_factors=3 if usual else 9,
        usual=3,
        accepted=True,
        test=test,
        tried=(*[test] * 3, test if usual else replace(test, p_value=1e-9)),
        cov=0.035 if usual else 0.15,
        usual_cov=0.035,
        n_sensors=n_sensors,
    )


def test_gradients_give_back_the_precision_that_free_factors_cost() -> None:
    """At 60 Hz, 2.5 m to a wavelength, they do not explain the motion."""
    rng = np.random.default_rng(1)
    csm = wishart(turned_bench(rng), 1080, rng)[0]
    known: dict[str, Any] = {"dims": (3,) * N, "n_effective": 1080.0}
    choices = tuple(choice(band, usual=band == 0) for band in range(len(CENTRES)))
    free = maximum_likelihood(csm, n_factors=np.where(BAND == 0, 3, 9), **known)
    gradients, chosen = with_gradients(csm, FREQUENCY, choices, neighbours=np.zeros(0), **known)
    assert [each.gradients for each in chosen] == [False, True, True, False]
    assert gradients is not None
    # the space that positions span, to 1 %: 1 mm of 10 cm
    true = np.linalg.qr(np.c_[np.ones(N), POSITIONS])[0]
    assert np.linalg.norm(true - gradients.shape @ (gradients.shape.T @ true)) < 0.01
    found = noise_by_gradients(free, csm, gradients, **known)
    outside = ~gradients.used
    np.testing.assert_array_equal(found.noise_psd[outside], free.noise_psd[outside])
    for band in (1, 2):
        inside = band == BAND
        means = found.noise_psd[inside].mean(axis=0)
        # c.o.v. 7 % of one frequency at most, and a quarter for the fit
        assert np.sqrt(np.mean((means - 1) ** 2)) < 1.25 * 0.07 / np.sqrt(FREQUENCIES) + 0.005
        assert found.noise_psd[inside].std() < 0.8 * free.noise_psd[inside].std()
        covered = (found.low < 1) & (found.high > 1)
        assert 0.90 < covered[inside].mean() < 0.99
        assert chosen[band].cov < choices[band].cov


def test_known_loadings_test_has_its_level_and_their_maximum_its_error() -> None:
    rng = np.random.default_rng(3)
    n, n_draws = 120, 100
    loadings = rng.standard_normal((3 * N, 9)).astype(np.complex128)
    power = np.diag(np.geomspace(1e4, 10.0, 9))
    noise = np.geomspace(0.5, 2.0, 3 * N)
    csm = wishart(loadings @ power @ loadings.T + np.diag(noise), n, rng, n_draws=n_draws)
    found = maximise_known(
        csm,
        np.broadcast_to(loadings, (n_draws, *loadings.shape)),
        np.ones((n_draws, 3 * N)),
        kind=np.arange(3 * N),  # all unlike: no prior
        n_effective=n,
    )
    assert found.converged.all()
    assert (found.n_active == 9).all()
    error = found.standard_error(n)
    scores = (found.psi - noise) / error
    assert abs(np.std(scores) - 1) < 0.1
    test = known_loadings_test(found, n_factors=9, n_effective=n)
    assert 0.01 < np.mean(test.p_value < 0.05) < 0.12  # 5 % of 100, three standard errors
    whole = pool(test, np.ones(n_draws, np.bool_), neighbours=np.zeros(0))
    assert whole.p_value > 0.01


@pytest.mark.parametrize(("n_channels", "dims"), [(9, (3,) * 3), (14, (3, 3, 3, 3, 2))])
def test_three_sensors_and_unequal_ones_have_no_gradients(
    n_channels: int, dims: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(4)
    csm = wishart(turned_bench(rng), 200, rng)[0][:, :n_channels, :n_channels]
    choices = tuple(choice(band, usual=band == 0, n_sensors=len(dims)) for band in range(3))
    gradients, same = with_gradients(csm, FREQUENCY, choices, dims=dims, n_effective=200)
    assert gradients is None
    assert same == choices


def test_one_band_that_fails_by_chance_is_no_sign_of_gradients() -> None:
    """Positions would be fitted to noise, and hold the noise of some sensors."""
    rng = np.random.default_rng(1)
    csm = wishart(turned_bench(rng), 1080, rng)[0]
    choices = tuple(choice(band, usual=band == 0) for band in range(len(CENTRES)))
    weak = replace(choices[1].tried[3], p_value=0.02)
    doubtful = tuple(
        each if n == 0 else replace(each, tried=(*each.tried[:3], weak))
        for n, each in enumerate(choices)
    )
    known: dict[str, Any] = {"dims": (3,) * N, "n_effective": 1080.0}
    assert with_gradients(csm, FREQUENCY, doubtful, **known) == (None, doubtful)
    # nor where free factors cost less
    cheap = tuple(replace(each, cov=0.01) for each in choices)
    assert not any(each.gradients for each in with_gradients(csm, FREQUENCY, cheap, **known)[1][1:])
