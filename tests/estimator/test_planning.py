"""Planned recording lengths, against known answers and against simulated recordings."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.likelihood.fisher import cramer_rao_cov
from estimator.methods import METHODS, self_noise
from estimator.planning import BOUND, plan, planned_csm, segments_needed
from estimator.spectra.welch import WelchSettings
from estimator.spectra.windows import effective_averages, get_window
from tests.estimator.csm_models import planar_sensors, rotation, wishart

PAPER = WelchSettings(200.0, 2000, 0.0, "rectangular")
DIMS = (2, 2, 2)


def test_the_plan_gives_the_three_hours_of_the_paper() -> None:
    csm, noise_psd = planned_csm(planar_sensors(10), snr=1e4, motion=np.diag([1, 1.5]))
    plans = {p.method: p for p in plan(csm, noise_psd, dims=DIMS, settings=PAPER, cov=0.0481)}
    assert list(plans) == [*METHODS, BOUND]
    three_sensor = plans["three-sensor"]
    assert three_sensor.n_effective[0, 0] == pytest.approx(1080, rel=0.005)
    np.testing.assert_allclose(three_sensor.duration, 10 * three_sensor.n_segments)
    assert three_sensor.duration[0, 0] == pytest.approx(3 * 3600, rel=0.005)
    np.testing.assert_allclose(three_sensor.bias, 0, atol=1e-8)
    assert plans["three-channel"].bias[0, 0] > 100
    # orthogonal channels, three sensors: maximum likelihood cannot do better
    needed = plans["maximum-likelihood"].n_effective
    np.testing.assert_allclose(needed, three_sensor.n_effective, rtol=0.01)
    np.testing.assert_allclose(plans[BOUND].n_effective, three_sensor.n_effective, rtol=0.01)


def test_three_sensors_are_near_the_bound_of_matrices_of_noise() -> None:
    """With noise known to be independent, channels at 30 degrees would take a 4.6th as long."""
    directions = planar_sensors(60, channel_angle_deg=30)
    csm, noise_psd = planned_csm(directions, snr=1e4, motion=np.diag([1, 1.5]))
    plans = {p.method: p for p in plan(csm, noise_psd, dims=DIMS, settings=PAPER, cov=0.05)}
    known = cramer_rao_cov(csm, noise_psd, n_effective=1.0) ** 2 / 0.05**2
    ratio = plans["three-sensor"].n_effective / known
    assert ratio[0, 0] == pytest.approx((0.173 / 0.0804) ** 2, rel=0.02)
    efficiency = plans["three-sensor"].efficiency[0]
    np.testing.assert_allclose(efficiency[:2], 1, rtol=0.01)
    assert efficiency.min() > 0.55
    np.testing.assert_allclose(plans["maximum-likelihood"].efficiency, 1, rtol=1e-3)
    np.testing.assert_array_equal(plans[BOUND].efficiency, 1)


@pytest.mark.parametrize("method", ["two-channel", "three-sensor", "maximum-likelihood"])
def test_estimates_have_the_planned_precision(method: str) -> None:
    rng = np.random.default_rng(0)
    directions = np.tile(rotation(rng, 3), (3, 1))
    csm, noise_psd = planned_csm(directions, snr=100, noise_psd=np.linspace(0.5, 2, 9))
    plans = {p.method: p for p in plan(csm, noise_psd, dims=(3, 3, 3), settings=PAPER, cov=0.2)}
    n_draws = 200 if method == "maximum-likelihood" else 500
    for channel in (0, 8):
        n = round(plans[method].n_effective[0, channel])
        sample = wishart(csm[0], n, rng, n_draws=n_draws)
        found = self_noise(method, sample, dims=(3, 3, 3), n_effective=n)
        relative = found.noise_psd[:, channel] / noise_psd[0, channel]
        # 3.7 standard errors of the deviation; the delta method itself is good to order 1/n
        assert relative.std() == pytest.approx(0.2, rel=3.7 / np.sqrt(2 * n_draws))


@pytest.mark.long
@pytest.mark.parametrize("method", ["three-channel", "three-sensor", "maximum-likelihood"])
@pytest.mark.parametrize(("snr", "cov"), [(0.1, 0.05), (1, 0.2)])
def test_estimates_of_weak_motion_have_the_planned_precision(
    method: str, snr: float, cov: float
) -> None:
    # with the averages that the precision alone would need, c.o.v. of 0.06 to 0.15, and 0.22
    rng = np.random.default_rng(0)
    directions = np.tile(np.eye(3), (3, 1))
    csm, noise_psd = planned_csm(directions, snr=snr)
    plans = {p.method: p for p in plan(csm, noise_psd, dims=(3, 3, 3), settings=PAPER, cov=cov)}
    planned = plans[method]
    assert planned.weak.all()
    n = round(planned.n_effective.max())
    sample = wishart(csm[0], n, rng, n_draws=1000)
    found = self_noise(method, sample, dims=(3, 3, 3), n_effective=n)
    assert found.noise_psd.std(axis=0).max() < 1.05 * cov
    # 1000 estimates, nine channels
    np.testing.assert_allclose(
        found.noise_psd.mean(axis=0), 1, atol=3 * cov / np.sqrt(1000) + 0.005
    )
    np.testing.assert_allclose(
        planned.efficiency, plans[BOUND].n_effective / planned.n_effective, rtol=0.05
    )


def test_maximum_likelihood_resolves_the_motion_by_the_best_sensors() -> None:
    noise = np.repeat([1.0, 1.0, 1.0, 100.0, 100.0], 3)
    csm, noise_psd = planned_csm(np.tile(np.eye(3), (5, 1)), snr=0.1, noise_psd=noise)
    plans = {p.method: p for p in plan(csm, noise_psd, dims=(3,) * 5, settings=PAPER, cov=0.05)}
    assert plans["maximum-likelihood"].n_effective.max() < 3000
    assert plans["three-sensor"].n_effective.max() > 1e6


def test_two_channel_has_no_efficiency() -> None:
    csm, noise_psd = planned_csm(np.tile(np.eye(2), (3, 1)), snr=0.1)
    found = plan(csm, noise_psd, dims=DIMS, settings=PAPER, cov=0.05)
    assert (found[0].n_effective < found[-1].n_effective).all()
    assert np.isnan(found[0].efficiency).all()


def test_methods_that_do_not_apply_have_no_plan() -> None:
    directions = np.vstack([np.eye(3), np.eye(3)[:1], np.eye(3)[:1]])
    csm, noise_psd = planned_csm(directions, snr=10)
    plans = {p.method: p for p in plan(csm, noise_psd, dims=(3, 1, 1), settings=PAPER, cov=0.05)}
    assert np.isnan(plans["maximum-likelihood"].n_effective).all()
    assert np.isfinite(plans["three-channel"].n_effective[0, [0, 3, 4]]).all()


def test_motion_that_lacks_a_dimension_is_never_resolved() -> None:
    csm, noise_psd = planned_csm(planar_sensors(10), snr=100, motion=np.diag([1.0, 0.0]))
    plans = {p.method: p for p in plan(csm, noise_psd, dims=DIMS, settings=PAPER, cov=0.05)}
    for method in ("three-sensor", "maximum-likelihood"):
        assert np.isnan(plans[method].duration).all()
    assert np.isfinite(plans["three-channel"].duration[0, [0, 2, 4]]).all()


@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.75])
def test_segments_needed_is_the_smallest_sufficient_number(overlap: float) -> None:
    window = get_window("hann", 200)
    hop = round(200 * (1 - overlap))
    for wanted in (0.5, 1.0, 7.3, 1080.0):
        n = segments_needed(window, hop, wanted)
        assert effective_averages(window, hop, n) >= wanted
        assert n == 1 or effective_averages(window, hop, n - 1) < wanted


def test_the_mean_snr_is_the_requested_one() -> None:
    csm, noise_psd = planned_csm(planar_sensors(10), snr=50, noise_psd=np.arange(1.0, 7.0))
    snr = (np.diag(csm[0]).real - noise_psd[0]) / noise_psd[0]
    assert snr.mean() == pytest.approx(50)


def test_two_sensors_need_motion_that_changes_and_longer() -> None:
    csm, noise_psd = planned_csm(np.vstack([np.eye(3)] * 2), snr=30)
    plans = plan(csm, noise_psd, dims=(3, 3), settings=PAPER, cov=0.05)
    assert [each.method for each in plans] == ["multi-part, 3 dB", "multi-part, 6 dB"]
    little, much = (each.duration.max() for each in plans)
    assert little > 2 * much
    three, three_noise = planned_csm(np.vstack([np.eye(3)] * 3), snr=30)
    least = plan(three, three_noise, dims=(3, 3, 3), settings=PAPER, cov=0.05)[-1]
    assert much > least.duration.max()


def test_invalid_plans_are_refused() -> None:
    directions = planar_sensors(10)
    csm, noise_psd = planned_csm(directions, snr=10)
    with pytest.raises(EstimatorError, match=r"c\.o\.v\."):
        plan(csm, noise_psd, dims=DIMS, settings=PAPER, cov=0)
    with pytest.raises(InsufficientDataError, match="sensors"):
        plan(csm[:, :2, :2], noise_psd[:, :2], dims=(2,), settings=PAPER, cov=0.1)
    for arguments in (
        {"snr": 0.0},
        {"snr": np.inf},
        {"snr": np.nan},
        {"snr": 1.0, "motion": np.full((2, 2), np.nan)},
        {"snr": 1.0, "noise_psd": np.zeros(6)},
        {"snr": 1.0, "noise_psd": np.ones(5)},
        {"snr": 1.0, "motion": np.eye(3)},
        {"snr": 1.0, "motion": np.zeros((2, 2))},
    ):
        with pytest.raises(EstimatorError):
            planned_csm(directions, **arguments)
