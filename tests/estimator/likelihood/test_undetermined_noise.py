"""Maximum likelihood where noise is not determined: frequencies, dead channels, no counterparts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from estimator.self_noise.result import Flag
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import (
    common_motion,
    random_bench,
    wishart,
)
from tests.estimator.likelihood.test_maximum_likelihood import equal_noise, tilted


def test_an_invalid_frequency_does_not_affect_the_others() -> None:
    rng = np.random.default_rng(20)
    csm = wishart(equal_noise(21, dims=(3, 3, 3), snr=1e2), 200, rng, n_draws=6)
    good = maximum_likelihood(csm, dims=(3, 3, 3), n_effective=200)
    csm[0, 2, 3] = np.nan
    csm[1] = np.ones((9, 9)) + 1e-15 * np.eye(9)
    bad = maximum_likelihood(csm, dims=(3, 3, 3), n_effective=200)
    assert np.isnan(bad.noise_psd[:2]).all()
    assert np.all(bad.flags[0] == Flag.NOT_FINITE)
    assert np.all(bad.flags[1] & Flag.DUPLICATE)
    np.testing.assert_allclose(bad.noise_psd[2:], good.noise_psd[2:], rtol=1e-9)
    assert not bad.flags[2:].any()


def test_a_singular_frequency_is_flagged() -> None:
    rng = np.random.default_rng(24)
    csm = wishart(equal_noise(21, dims=(3, 3, 3), snr=1e2), 200, rng, n_draws=3)
    segments = rng.standard_normal((5, 9)) + 1j * rng.standard_normal((5, 9))
    csm[1] = segments.T @ segments.conj() / 5
    found = maximum_likelihood(csm, dims=(3, 3, 3), n_effective=200)
    assert np.all(found.flags[1] == Flag.SINGULAR)
    assert np.isnan(found.noise_psd[1]).all()
    assert not found.flags[[0, 2]].any()


def test_dead_and_copied_channels_do_not_affect_the_others() -> None:
    rng = np.random.default_rng(23)
    csm = wishart(equal_noise(21, dims=(3, 3, 3), snr=1e2), 200, rng, n_draws=2)
    rest = [0, 1, 2, 3, 5, 6, 7, 8]
    without = maximise(csm[:, rest][:, :, rest], 3)
    dead, copied = csm.copy(), csm.copy()
    dead[:1, 4, :] = dead[:1, :, 4] = 0
    copied[:, 4], copied[:, :, 4] = copied[:, 1], copied[:, :, 1]
    copied[:, 4, 4] = copied[:, 1, 1]
    for bad, flag in ((dead, Flag.DEAD_CHANNEL), (copied, Flag.DUPLICATE)):
        found = maximum_likelihood(bad, dims=(3, 3, 3), n_effective=200, correct=False)
        assert found.flags[0, 4] == flag
        assert np.isnan(found.noise_psd[0, 4])
        known = [0, 2, 3, 5, 6, 7, 8]
        expected = without.psi[0, [rest.index(i) for i in known]]
        np.testing.assert_allclose(found.noise_psd[0, known], expected, rtol=1e-5)
    three = np.eye(3)[None] + 100.0
    three[0, 2, :] = three[0, :, 2] = 0
    lonely = np.concatenate([three, np.eye(3)[None] + 100.0])
    found = maximum_likelihood(lonely.astype(np.complex128), dims=(1, 1, 1), n_effective=200)
    assert found.flags[0].tolist() == [Flag.NO_COUNTERPART] * 2 + [Flag.DEAD_CHANNEL]


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_channel_without_counterpart_has_no_estimate(d: int) -> None:
    rng = np.random.default_rng(25)
    csm = wishart(equal_noise(21, dims=(d,) * 3, snr=1e2), 200, rng, n_draws=2)
    csm[:1, 1:] = csm[:1, :, 1:] = 0
    found = maximum_likelihood(csm, dims=(d,) * 3, n_effective=200)
    assert found.flags[0, 0] == Flag.NO_COUNTERPART
    assert np.isnan(found.noise_psd[0]).all()
    assert not found.flags[1].any()


@pytest.mark.parametrize(
    ("dims", "tilt", "alone"),
    [
        ((3, 2, 2), 0.0, [2]),
        ((3, 2, 2), 5.0, [2]),
        ((2, 1, 1), 0.0, [1]),
        ((1, 1, 1, 3), 0.0, [4, 5]),
        ((3, 2, 1), 2.0, [2]),
    ],
)
@pytest.mark.parametrize("n_averages", [100, pytest.param(1080, marks=pytest.mark.long)])
def test_motion_measured_by_one_channel_is_not_reported_as_its_noise(
    dims: tuple[int, ...], tilt: float, alone: list[int], n_averages: int
) -> None:
    """Aligned, or planes tilted a little: nothing else tells what that channel's noise is."""
    rng = np.random.default_rng(41)
    p = sum(dims)
    directions = np.concatenate([tilted(i * tilt)[:k] for i, k in enumerate(dims)])
    csm = common_motion(directions[:, : max(dims)], np.ones(p), snr=1e3)
    found = maximum_likelihood(
        wishart(csm, n_averages, rng, n_draws=200), dims=dims, n_effective=n_averages
    )
    assert np.all(found.flags[:, alone] == Flag.NO_COUNTERPART)
    others = np.delete(np.arange(p), alone)
    assert np.isfinite(found.noise_psd[:, others]).all()
    assert not np.any(found.flags[:, others] & (Flag.UNRESOLVED | Flag.NO_COUNTERPART))
    covered = (found.low <= 1) & (found.high >= 1)
    assert np.all(covered[:, others].mean(axis=0) > 0.9)


@pytest.mark.long
def test_no_single_frequency_of_an_unchecked_channel_has_an_estimate() -> None:
    """By chance one in a thousand would look known."""
    csm = common_motion(np.concatenate([np.eye(3)[:k] for k in (3, 2, 2)]), np.ones(7), snr=1e3)
    drawn = wishart(csm, 20, np.random.default_rng(2), n_draws=2000)
    found = maximum_likelihood(drawn, dims=(3, 2, 2), n_effective=20)
    assert np.all(found.flags[:, 2] == Flag.NO_COUNTERPART)


@pytest.mark.parametrize("dims", [(3, 2, 2), (3, 2, 1), (3, 3, 3)])
def test_sensors_of_many_orientations_determine_a_channel_without_counterpart(
    dims: tuple[int, ...],
) -> None:
    csm = random_bench(np.random.default_rng(4), dims=dims, snr=1e3, noise_psd=np.ones(sum(dims)))
    drawn = wishart(csm, 1080, np.random.default_rng(42), n_draws=300)
    dead = [5, 8] if dims == (3, 3, 3) else []
    drawn[:, dead], drawn[:, :, dead] = 0, 0
    found = maximum_likelihood(drawn, dims=dims, n_effective=1080)
    alive = np.delete(np.arange(sum(dims)), dead)
    assert not found.flags[:, alive].any()
    covered = ((found.low <= 1) & (found.high >= 1))[:, alive].mean(axis=0)
    assert np.all(covered > 0.95 - 4 * np.sqrt(0.95 * 0.05 / 300))


def test_a_channel_has_estimates_at_frequencies_with_live_counterparts() -> None:
    rng = np.random.default_rng(43)
    csm = common_motion(np.tile(np.eye(3), (3, 1)), np.ones(9), snr=1e3)
    csm = wishart(csm, 200, rng, n_draws=2)
    csm[0, [5, 8]], csm[0, :, [5, 8]] = 0, 0
    found = maximum_likelihood(csm, dims=(3, 3, 3), n_effective=200)
    expected = [0, 0, Flag.NO_COUNTERPART, 0, 0, Flag.DEAD_CHANNEL, 0, 0, Flag.DEAD_CHANNEL]
    assert found.flags[0].tolist() == expected
    assert not found.flags[1].any()


def test_undetermined_noise_is_flagged() -> None:
    """Without any motion the factors may lie anywhere."""
    rng = np.random.default_rng(26)
    csm = wishart(equal_noise(21, dims=(2, 2, 2), snr=1e2), 200, rng, n_draws=2)
    csm[0] = np.eye(6)
    found = maximum_likelihood(csm, dims=(2, 2, 2), n_effective=200, correct=False)
    assert np.all(found.flags[0] == Flag.SINGULAR)
    assert np.isnan([found.noise_psd[0], found.cov[0], found.low[0], found.high[0]]).all()
    assert not found.flags[1].any()
    # which leaves nothing open once it is not looked for
    found = maximum_likelihood(csm, dims=(2, 2, 2), n_effective=200)
    assert np.all(found.flags[0] == Flag.UNRESOLVED)
    np.testing.assert_allclose(found.noise_psd[0], 1)


def test_the_maximum_is_none_the_worse_for_channels_without_noise() -> None:
    """Two in three of these are at zero noise in some channel; a general optimiser is no better."""
    directions = np.concatenate([tilted(i * 5.0)[:k] for i, k in enumerate((3, 2, 2))])
    csm = common_motion(directions, np.ones(7), snr=1e3)
    some = wishart(csm, 1080, np.random.default_rng(41), n_draws=20)
    some /= np.sqrt(np.einsum("fii,fjj->fij", some, some).real)

    def discrepancy(x: FloatArray, matrix: ComplexArray) -> float:
        scale = np.exp(-x / 2)
        w = np.linalg.eigvalsh(matrix * scale[:, None] * scale)[:4]
        return float((w - np.log(w) - 1).sum())

    def least(matrix: ComplexArray) -> float:
        begin = -np.log(np.diagonal(np.linalg.inv(matrix)).real)
        bounds = [(each - 14, 0.0) for each in begin]
        return float(minimize(discrepancy, begin, (matrix,), "L-BFGS-B", bounds=bounds).fun)

    found = maximise(some, 3)
    assert (found.discrepancy < np.array([least(each) for each in some]) + 1e-4).all()
    assert found.boundary.any(axis=1).mean() > 0.5
