"""Maximum likelihood against known noise, the Cramér-Rao bound and its own stationarity."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import EstimatorError, InsufficientDataError, InvalidMatrixError
from estimator.likelihood import factor_analysis, fisher
from estimator.likelihood.factor_analysis import DECREMENT, max_factors, maximise
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from estimator.self_noise.result import Flag
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import (
    common_motion,
    pentagon,
    planar_sensors,
    plane_waves,
    random_bench,
    rotation,
    wishart,
)


def tilted(degrees: float) -> FloatArray:
    """Rotation about x."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def equal_noise(seed: int, *, dims: tuple[int, ...], snr: float) -> ComplexArray:
    rng = np.random.default_rng(seed)
    return random_bench(rng, dims=dims, snr=snr, noise_psd=np.ones(sum(dims)))


@pytest.mark.parametrize("snr", [1e-2, 1e-1, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("dims", [(1, 1, 1), (2, 2, 2), (3, 3, 3), (3, 3, 3, 3), (3, 2, 3)])
def test_the_true_matrix_gives_the_true_noise(dims: tuple[int, ...], snr: float) -> None:
    rng = np.random.default_rng(3)
    noise_psd = np.exp(rng.uniform(-2, 2, sum(dims)))
    csm = random_bench(rng, dims=dims, snr=snr, noise_psd=noise_psd)
    found = maximise(csm[None], max(dims))
    assert found.converged.all()
    if snr >= 1:
        np.testing.assert_allclose(found.psi[0], noise_psd, rtol=1e-6)
    assert found.discrepancy[0] < 1e-7


def test_scaling_the_channels_scales_the_noise_and_nothing_else() -> None:
    rng = np.random.default_rng(5)
    csm = wishart(equal_noise(5, dims=(3, 3, 3), snr=100), 60, rng, n_draws=20)
    gain = 10.0 ** rng.uniform(-9, 3, 9) * np.exp(1j * rng.uniform(0, 6, 9))
    scaled = gain[:, None] * csm * gain.conj()
    one, other = maximise(csm, 3), maximise(scaled, 3)
    np.testing.assert_allclose(other.psi, one.psi * np.abs(gain) ** 2, rtol=1e-4)
    np.testing.assert_allclose(other.discrepancy, one.discrepancy, rtol=1e-6)


def test_permuting_the_channels_permutes_the_noise() -> None:
    rng = np.random.default_rng(6)
    csm = wishart(equal_noise(6, dims=(3, 3, 3), snr=100), 60, rng, n_draws=20)
    order = rng.permutation(9)
    permuted = csm[:, order][:, :, order]
    np.testing.assert_allclose(maximise(permuted, 3).psi, maximise(csm, 3).psi[:, order], rtol=1e-5)


def test_the_likelihood_has_a_local_maximum() -> None:
    rng = np.random.default_rng(7)
    csm = wishart(equal_noise(7, dims=(2, 2, 2), snr=10), 30, rng)
    found = maximise(csm, 2)

    def discrepancy(x: FloatArray) -> float:
        scale = np.exp(-x / 2)
        w = np.linalg.eigvalsh(scale[:, None] * csm[0] * scale)[:-2]
        return float(np.sum(w - np.log(w) - 1))

    x = np.log(found.psi[0])
    least = discrepancy(x)
    np.testing.assert_allclose(found.discrepancy[0], least, rtol=1e-6)
    for _ in range(50):
        assert discrepancy(x + 1e-3 * rng.standard_normal(6)) > least


@pytest.mark.parametrize(
    ("csm", "n_factors"),
    [
        (equal_noise(8, dims=(3, 3, 3), snr=1e-2), 3),
        (equal_noise(8, dims=(3, 3, 3), snr=1e6), 3),
        (common_motion(planar_sensors(10), np.array([1.0, 1, 1e2, 1e2, 1e4, 1e4]), snr=1e5), 2),
        (common_motion(planar_sensors(10), np.array([1.0, 1, 1e4, 1e4, 1e4, 1e4]), snr=1e5), 2),
        (plane_waves(np.array([50.0]), pentagon())[0], 11),
    ],
    ids=["SNR 0.01", "SNR 1e6", "noise 100x and 100x", "one quiet sensor", "11 of 15 factors"],
)
def test_newton_converges_where_fixed_point_iterations_are_slow(
    csm: ComplexArray, n_factors: int
) -> None:
    draws = wishart(csm, 1080, np.random.default_rng(8), n_draws=50)
    found = maximise(draws, n_factors)
    assert found.converged.all()
    assert np.median(found.iterations) < 80
    assert found.decrement.max() <= DECREMENT


def test_newton_converges_from_any_start() -> None:
    """Three to five sensors, SNR 0.01 to 1e6, noise 1e4 apart, few averages, any factors."""
    rng = np.random.default_rng(5)
    for _ in range(40):
        n_sensors, d = int(rng.integers(3, 6)), int(rng.integers(1, 4))
        p = n_sensors * d
        n_averages = int(rng.choice([p + 1, 2 * p, 100, 1080, 100_000]))
        n_factors = d if rng.random() < 0.5 else int(rng.integers(0, max_factors(p) + 1))
        csm = random_bench(
            rng,
            dims=(d,) * n_sensors,
            snr=10 ** rng.uniform(-2, 6),
            noise_psd=10 ** rng.uniform(-2, 2, p),
        )
        found = maximise(wishart(csm, n_averages, rng, n_draws=10), n_factors)
        assert found.converged.all()
        assert found.iterations.max() < 150


def test_newton_takes_few_iterations() -> None:
    draws = wishart(
        equal_noise(9, dims=(3, 3, 3), snr=1e3), 1080, np.random.default_rng(9), n_draws=100
    )
    found = maximise(draws, 3)
    assert found.iterations.max() <= 3


def test_the_last_step_does_not_leave_the_maximum() -> None:
    """As many factors as can be told: the likelihood is nearly flat, its parabola far too wide."""
    draws = wishart(
        equal_noise(2, dims=(3, 3, 3), snr=1), 100_000, np.random.default_rng(2), n_draws=100
    )
    found = maximise(draws, 6)
    scale = 1 / np.sqrt(found.psi)
    w = np.linalg.eigvalsh(draws * scale[:, :, None] * scale[:, None, :])[:, :3]
    worse = np.sum(w - np.log(w) - 1, axis=1) - found.discrepancy
    assert found.converged.all()
    assert worse.max() < 10 * DECREMENT


@pytest.mark.parametrize(("n_factors", "most"), [(0, 1), (1, 15), (3, 19)])
def test_noise_that_tends_to_zero_takes_few_iterations(n_factors: int, most: int) -> None:
    """Weak motion and few averages: nearly every frequency has such a channel, or several."""
    draws = wishart(
        equal_noise(9, dims=(3, 3, 3), snr=0.1), 20, np.random.default_rng(9), n_draws=200
    )
    found = maximise(draws, n_factors)
    assert found.converged.all()
    assert found.iterations.mean() <= most
    if n_factors == 3:
        assert found.boundary.any(axis=1).mean() > 0.8
        assert found.psi[found.boundary].max() < 1e-5
        assert found.decrement.max() <= DECREMENT


def test_a_maximum_at_zero_noise_is_reported_as_such() -> None:
    csm = common_motion(np.ones((3, 1)), np.array([1.0, 1e4, 1e4]), snr=1e4)
    draws = wishart(csm, 1080, np.random.default_rng(10), n_draws=200)
    found = maximum_likelihood(draws, dims=(1, 1, 1), n_effective=1080)
    zero = (found.flags & Flag.BOUNDARY) > 0
    assert 0.05 < zero[:, 0].mean() < 0.95
    assert not zero[:, 1:].any()
    assert np.all(found.noise_psd[zero] == 0)
    assert np.all(np.isnan(found.cov[zero]))
    assert np.all(found.low[zero] <= 0)
    assert np.mean(found.high[zero] > 1) > 0.9
    assert np.isfinite(found.cov[~zero]).all()


def test_a_sensor_without_noise_in_some_direction_keeps_its_intervals() -> None:
    noise_psd = np.array([1.0, 1, 1e3, 1e3, 1e3, 1e3])
    csm = common_motion(planar_sensors(10), noise_psd, snr=1e4)
    draws = wishart(csm, 1080, np.random.default_rng(10), n_draws=200)
    found = maximum_likelihood(draws, dims=(2, 2, 2), n_effective=1080)
    zero = (found.flags & Flag.BOUNDARY) > 0
    assert zero[:, :2].mean() > 0.5
    covered = (found.low <= noise_psd) & (noise_psd <= found.high)
    assert covered[zero].mean() > 0.93
    assert np.all(found.noise_psd > 0)


@pytest.mark.parametrize("snr", [0.3, 3.0, 1e4])
def test_noise_that_the_channels_of_a_sensor_share_is_no_motion(snr: float) -> None:
    """Taken for motion, it left 30 to 43 % of the intervals with the noise in them."""
    rng = np.random.default_rng(46)
    csm = equal_noise(46, dims=(3, 3, 3), snr=snr)
    shared = np.array([4.0, 2.0, 0.0])
    csm[3:6, 3:6] += np.outer(shared, shared)
    noise_psd = np.ones(9) + np.concatenate([np.zeros(3), shared**2, np.zeros(3)])
    found = maximum_likelihood(wishart(csm, 200, rng, n_draws=100), dims=(3, 3, 3), n_effective=200)
    covered = (found.low <= noise_psd) & (noise_psd <= found.high)
    assert covered.mean() > 0.93
    assert found.noise_psd.mean(axis=0) == pytest.approx(noise_psd, rel=0.1)


def test_sensors_whose_matrices_are_not_determined_have_independent_noise() -> None:
    rng = np.random.default_rng(8)
    draws = wishart(equal_noise(8, dims=(3, 3, 1), snr=30.0), 300, rng, n_draws=20)
    found = maximum_likelihood(draws, dims=(3, 3, 1), n_effective=300)
    alone = maximum_likelihood(draws, dims=(3, 3, 1), n_effective=300, matrices=False)
    np.testing.assert_array_equal(found.noise_psd, alone.noise_psd)


GEOMETRIES = {
    "orthogonal": (common_motion(planar_sensors(10), np.ones(6), snr=1e3), np.ones(6), (2,) * 3),
    "30 and 60 degrees": (
        common_motion(planar_sensors(60, channel_angle_deg=30), np.ones(6), snr=1e2),
        np.ones(6),
        (2,) * 3,
    ),
    **{
        f"{name} 100x noisier": (
            common_motion(planar_sensors(10), noise_psd, snr=1e3),
            noise_psd,
            (2,) * 3,
        )
        for name, noise_psd in (
            ("two", np.array([1.0, 1, 100, 100, 100, 100])),
            ("one", np.array([1.0, 1, 1, 1, 100, 100])),
        )
    },
    "five triaxial": (equal_noise(12, dims=(3,) * 5, snr=1e3), np.ones(15), (3,) * 5),
    "three triaxial": (equal_noise(13, dims=(3,) * 3, snr=1e3), np.ones(9), (3,) * 3),
    "three uniaxial": (equal_noise(14, dims=(1,) * 3, snr=1e3), np.ones(3), (1,) * 3),
}


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("n_averages", [100, pytest.param(1080, marks=pytest.mark.long)])
def test_the_estimate_is_unbiased_with_the_scatter_of_the_bound(
    geometry: str, n_averages: int
) -> None:
    """The three claims in one draw: c.o.v. against Cramér-Rao, bias, coverage, per channel.

    Where a neighbour's bound exceeds 1 its likelihood often ends at zero noise, and this
    truncation pulls the others by up to a quarter of their own c.o.v.

    A sample c.o.v. of m draws scatters by 1/sqrt(2 m) (more for the skewed: 1.5 allows it),
    the mean by cov/sqrt(m), coverage by sqrt(.05 .95/m).
    """
    n_draws = 200 if n_averages == 100 else 600
    csm, noise_psd, dims = GEOMETRIES[geometry]
    bound = fisher.cramer_rao_cov(csm[None], noise_psd[None], n_effective=n_averages, dims=dims)[0]
    draws = wishart(csm, n_averages, np.random.default_rng(n_averages), n_draws=n_draws)
    found = maximum_likelihood(draws, dims=dims, n_effective=n_averages)
    ratio = found.noise_psd / noise_psd
    sharp = bound < (0.5 if n_averages == 1080 else 0.4)
    limit = 1.05 if n_averages == 1080 else 1 / np.sqrt(1 - max(dims) / n_averages) * 1.05
    scatter = 1 + 4 * 1.5 / np.sqrt(2 * n_draws)
    assert np.all(ratio.std(axis=0)[sharp] <= limit * scatter * bound[sharp])
    assert ratio.std(axis=0)[sharp].mean() <= limit * bound[sharp].mean()
    error = 4 * ratio.std(axis=0) / np.sqrt(n_draws)
    pulled = 0.25 * bound if bound.max() > 1 else 0.0 * bound
    assert np.all(np.abs(ratio.mean(axis=0) - 1)[sharp] < (error + pulled)[sharp])
    covered = ((found.low < noise_psd) & (noise_psd < found.high)).mean(axis=0)
    allowed = 4 * np.sqrt(0.05 * 0.95 / n_draws)
    assert np.all(np.abs(covered[sharp] - 0.95) < 0.01 + allowed)
    assert 0.93 < covered[sharp].mean() < 0.97


@pytest.mark.long
@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("snr", [10.0, 1e6])
def test_the_estimate_is_unbiased_from_twenty_averages_on(d: int, snr: float) -> None:
    n_draws = 1000
    rng = np.random.default_rng(16)
    csm = equal_noise(17, dims=(d,) * 3, snr=snr)
    found = maximum_likelihood(
        wishart(csm, 20, rng, n_draws=n_draws), dims=(d,) * 3, n_effective=20
    )
    mean = found.noise_psd.mean(axis=1)  # over channels, within each draw
    high = (d / 20) ** 2 * (d > 1)  # the correction is of first order; one channel has no second
    assert abs(mean.mean() - 1) < high + 4 * mean.std() / np.sqrt(n_draws)
    raw = maximum_likelihood(
        wishart(csm, 20, rng, n_draws=n_draws), dims=(d,) * 3, n_effective=20, correct=False
    )
    assert raw.noise_psd.mean() == pytest.approx(1 - d / 20, abs=0.02)


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize(
    "snr",
    [1e-1, pytest.param(1.0, marks=pytest.mark.long), pytest.param(1e6, marks=pytest.mark.long)],
)
def test_bias_under_one_percent_at_any_snr(d: int, snr: float) -> None:
    n_draws = 600
    csm = equal_noise(18, dims=(d,) * 3, snr=snr)
    draws = wishart(csm, 1080, np.random.default_rng(19), n_draws=n_draws)
    found = maximum_likelihood(draws, dims=(d,) * 3, n_effective=1080)
    mean = found.noise_psd.mean(axis=1)
    assert abs(mean.mean() - 1) < (0.01 if d == 1 else 0.015)
    if d == 1:
        assert abs(mean.mean() - 1) < 4 * mean.std() / np.sqrt(n_draws) + 0.002


@pytest.mark.parametrize("dims", [(1,) * 3, (3,) * 3, (2,) * 4])
@pytest.mark.parametrize(
    "snr",
    [pytest.param(0.1, marks=pytest.mark.long), 0.3, pytest.param(1.0, marks=pytest.mark.long)],
)
def test_unresolved_motion_causes_a_bias_of_a_few_percent(
    dims: tuple[int, ...], snr: float
) -> None:
    """No estimate is unbiased there (decision 10); factors fitted to scatter cost 16 to 23 %."""
    n_draws = 400 if sum(dims) == 3 else 150
    draws = wishart(
        equal_noise(18, dims=dims, snr=snr), 20, np.random.default_rng(27), n_draws=n_draws
    )
    found = maximum_likelihood(draws, dims=dims, n_effective=20)
    mean = found.noise_psd.mean(axis=1)
    limit = 0.05 if max(dims) == 1 else 0.1  # a matrix leaves more motion in the noise
    assert abs(mean.mean() - 1) < limit + 4 * mean.std() / np.sqrt(n_draws)
    covered = (found.low < 1) & (found.high > 1)
    assert 0.92 < covered.mean() < 0.995  # of single frequencies, without their neighbours
    unresolved = (found.flags & Flag.UNRESOLVED) != 0
    assert np.all(unresolved.any(axis=1) == unresolved.all(axis=1))
    assert unresolved.mean() > (0.5 if snr == 0.1 else -1)


def test_a_missing_dimension_does_not_remove_noise() -> None:
    """Three sensors upside down and askew, motion in a plane: a third factor finds scatter only."""
    rng = np.random.default_rng(28)
    directions = np.concatenate([rotation(rng, 3) for _ in range(3)])[:, :2]
    csm = (1e3 * directions @ directions.T + np.eye(9)).astype(np.complex128)
    for n, n_draws, bias in ((20, 100, 0.07), (1080, 80, 0.04)):
        draws = wishart(csm, n, rng, n_draws=n_draws)
        found = maximum_likelihood(draws, dims=(3, 3, 3), n_effective=n)
        raw = maximum_likelihood(draws, dims=(3, 3, 3), n_effective=n, correct=False)
        error = found.noise_psd.mean(axis=1).std() / np.sqrt(n_draws)
        assert abs(found.noise_psd.mean() - 1) < bias + 4 * error
        assert raw.noise_psd.mean() / (1 - 3 / n) < 1 - 1.5 * bias
        assert found.noise_psd.std() < 1.05 * raw.noise_psd.std() / (1 - 3 / n)


def test_resolved_factors_are_not_excluded() -> None:
    csm = equal_noise(18, dims=(3, 3, 3), snr=10.0)
    draws = wishart(csm, 100, np.random.default_rng(29), n_draws=100)
    found = maximum_likelihood(draws, dims=(3, 3, 3), n_effective=100)
    assert not found.flags.any()
    raw = maximum_likelihood(draws, dims=(3, 3, 3), n_effective=100, correct=False)
    np.testing.assert_allclose(found.noise_psd, raw.noise_psd / (1 - 3 / 100), rtol=0.02)


def test_invalid_arguments_are_refused() -> None:
    csm = np.eye(9)[None].astype(np.complex128)
    with pytest.raises(InsufficientDataError, match="at most 6"):
        maximise(csm, 7)
    with pytest.raises(InsufficientDataError, match="at most 6"):
        maximum_likelihood(csm, dims=(3, 3, 3), n_effective=100, n_factors=7)
    with pytest.raises(InsufficientDataError, match="averages"):
        maximum_likelihood(csm, dims=(3, 3, 3), n_effective=8)
    with pytest.raises(InsufficientDataError, match="at least 3"):
        maximum_likelihood(csm, dims=(5, 4), n_effective=100)
    with pytest.raises(InvalidMatrixError, match=r"\(1, 9, 9\)"):
        maximum_likelihood(csm, dims=(3, 3, 2), n_effective=100)
    with pytest.raises(InvalidMatrixError, match="expected"):
        maximise(csm[0], 3)
    for options in (
        {"n_factors": 2.5},
        {"n_factors": np.array([3, 3])},
        {"n_factors": 3, "noise_spread": 0.0},
        {"noise_spread": np.nan},
    ):
        with pytest.raises(EstimatorError, match="expected"):
            maximum_likelihood(csm, dims=(3, 3, 3), n_effective=100, **options)


def test_a_matrix_that_is_not_hermitian_has_no_maximum() -> None:
    csm = np.tile(np.eye(9, dtype=np.complex128), (2, 1, 1))
    csm[1, 0, 4] = 0.1
    found = maximise(csm, 3)
    np.testing.assert_array_equal(found.singular, [False, True])


@pytest.mark.parametrize(("n_channels", "most"), [(3, 1), (6, 3), (9, 6), (12, 8), (15, 11)])
def test_the_number_of_identifiable_factors_is_known(n_channels: int, most: int) -> None:
    assert max_factors(n_channels) == most


def test_dimension_may_differ_from_frequency_to_frequency() -> None:
    rng = np.random.default_rng(22)
    turned = rotation(rng, 3)
    flat = np.concatenate([turned, np.eye(3), turned.T])
    csm = wishart(common_motion(flat, np.ones(9), snr=100), 200, rng, n_draws=4)
    mixed = maximum_likelihood(
        csm, dims=(3, 3, 3), n_effective=200, n_factors=np.array([3, 2, 3, 2])
    )
    for q, rows in ((3, [0, 2]), (2, [1, 3])):
        alone = maximum_likelihood(csm[rows], dims=(3, 3, 3), n_effective=200, n_factors=q)
        np.testing.assert_array_equal(mixed.noise_psd[rows], alone.noise_psd)


def test_the_same_matrices_are_fitted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    csm = wishart(equal_noise(1, dims=(1,) * 4, snr=10.0), 50, rng, n_draws=6)
    maxima, fitted = factor_analysis.Maxima(), []

    def counted(some: ComplexArray, n_factors: int, **_: None) -> factor_analysis.Maximum:
        fitted.append(len(some))
        return maximise(some, n_factors)

    monkeypatch.setattr(factor_analysis, "maximise", counted)
    maxima.maximise(csm[::2], 1)
    found = maxima.maximise(csm[::-1], 1)
    assert fitted == [3, 3]
    assert maxima.maximise(csm[:0], 1).psi.shape == (0, 4)
    np.testing.assert_allclose(found.psi, maximise(csm, 1).psi[::-1], rtol=1e-12)
    whole = maxima.joined([maxima.maximise(csm[:3], 1), maxima.maximise(csm[3:], 1)])
    np.testing.assert_array_equal(whole.psi, maxima.maximise(csm, 1).psi)
    assert len(fitted) == 3  # but for none
    maxima.clear()
    maxima.maximise(csm, 1)
    assert fitted[3:] == [6]


def test_many_channels_are_fitted_as_few_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """By subspace iteration, or by all eigenvalues: strong, weak and missing motion."""
    rng = np.random.default_rng(6)
    draws = np.concatenate(
        [
            wishart(equal_noise(2, dims=(2,) * 9, snr=snr), 60, rng, n_draws=2)
            for snr in (1e6, 3.0, 1e-3)
        ]
    )
    found = maximise(draws, 2)
    monkeypatch.setattr(factor_analysis, "WHOLE", 18)
    whole = maximise(draws, 2)
    np.testing.assert_allclose(found.psi, whole.psi, rtol=1e-6)
    np.testing.assert_allclose(found.discrepancy, whole.discrepancy, rtol=1e-6)
