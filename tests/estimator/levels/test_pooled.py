"""Noise from directions that neighbouring bins share: unbiased, and covered by its interval."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from estimator.levels.bands import band_levels
from estimator.levels.interval import worth
from estimator.levels.pooled import Pooled, pooled_noise
from estimator.methods import Flag, SelfNoise, self_noise
from estimator.self_noise.three_sensor import three_sensor
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import wishart

N_BINS = 61
ONE = np.ones(1)
EDGES = np.array([0, N_BINS])


def scene(
    rng: np.random.Generator, snr: tuple[float, ...], noise: FloatArray, *, sensors: int = 3
) -> ComplexArray:
    """Return the true matrix of each bin; responses vary by 10 % and 6 degrees over the band."""
    d = len(snr)
    turned = [np.linalg.qr(rng.standard_normal((d, d)))[0] for _ in range(sensors)]
    loadings = np.concatenate(turned) * np.sqrt(snr)
    f = np.linspace(-1, 1, N_BINS)[:, None]
    size = 1 + 0.1 * rng.uniform(-1, 1, len(noise)) * f
    phase = np.exp(1j * np.deg2rad(6) * rng.uniform(-1, 1, len(noise)) * f)
    A = (size * phase)[:, :, None] * loadings
    return np.asarray(A @ A.conj().swapaxes(1, 2) + np.diag(noise))


def drawn(rng: np.random.Generator, csm: ComplexArray, n: int) -> ComplexArray:
    return np.asarray(wishart(csm, n, rng)[0], np.complex128)


def pooled(csm: ComplexArray, n: int, block: int = 1) -> Pooled:
    """Return the noise of triaxial sensors, from blocks of as many bins."""
    bins, p = csm.shape[:2]
    return pooled_noise(
        csm,
        np.arange(bins) * block // bins,
        np.full(bins, 3),
        dims=(3,) * (p // 3),
        n_effective=n,
        correlation=ONE,
    )


def beside(
    csm: ComplexArray,
    n: int,
    d: int = 3,
    method: str = "three-sensor",
    **options: Any,  # noqa: ANN401 - those of self_noise
) -> SelfNoise:
    """Return the noise of sensors of d channels, with all bins as neighbours."""
    options.setdefault("blocks", np.zeros(len(csm), np.int64))
    return self_noise(method, csm, dims=(d,) * (csm.shape[1] // d), n_effective=n, **options)


def judged(
    found: Pooled | SelfNoise, noise: FloatArray
) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Return whether the band's intervals hold the noise, its means over it, and their scores."""
    psd = found.noise if isinstance(found, Pooled) else found.noise_psd
    level = band_levels(psd, found.cumulants, np.array([0, len(psd)]), ONE)
    low, high = level.interval()
    held = (low[0] <= noise) & (noise <= high[0])
    return held, level.mean[0] / noise, (level.mean[0] - noise) / level.spread[0]


def least(n: int) -> float:
    """Return how many of n intervals hold the noise: 95 % less four standard errors."""
    return 0.95 - 4 * float(np.sqrt(0.05 * 0.95 / n))


def coverage(
    snr: tuple[float, ...], noise: FloatArray, *, n: int, draws: int, sensors: int = 3
) -> tuple[float, float, float]:
    """Return coverage of bands and of bins, and the mean over the truth."""
    bands, bins, means = [], [], []
    for seed in range(draws):
        rng = np.random.default_rng([n, seed, sensors])
        sample = drawn(rng, scene(rng, snr, noise, sensors=sensors), n)
        found = beside(sample, n, len(snr))
        held, mean, _ = judged(found, noise)
        bands.append(held)
        bins.append((found.low <= noise) & (noise <= found.high))
        means.append(mean)
    return float(np.mean(bands)), float(np.mean(bins)), float(np.mean(means))


@pytest.mark.parametrize(
    "snr",
    [(0.1, 0.1, 0.1), (1.0, 1.0, 1.0), (1e3, 1.0, 1.0), (1e5, 1.0, 0.5)],
    ids=["weak", "equal to the noise", "one strong axis", "one very strong axis"],
)
def test_levels_of_bands_and_bins_are_covered(snr: tuple[float, ...]) -> None:
    noise = np.ones(9)
    bands, bins, mean = coverage(snr, noise, n=189, draws=12)
    assert bands > least(108)  # levels of correlated channels
    assert 0.93 < bins < 0.97
    assert mean == pytest.approx(1, abs=0.015)


@pytest.mark.parametrize(
    ("sensors", "snr"), [(3, 0.3), (3, 30.0), (8, 0.1), (8, 0.0)], ids=["3", "3", "8", "8"]
)
def test_what_the_channels_of_one_sensor_share_is_its_noise(sensors: int, snr: float) -> None:
    """As by hum, or one noisy element of a symmetric triaxial sensor: no motion is removed."""
    rng, shared = np.random.default_rng(7), np.array([4.0, 2.0, 0.0])
    noise = np.eye(3 * sensors, dtype=np.complex128)
    noise[3:6, 3:6] += np.outer(shared, shared)
    true, held, ratios = np.diag(noise).real, [], []
    for _ in range(8):
        axes = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(sensors)]
        H = np.concatenate(axes)
        csm = np.broadcast_to(snr * H @ H.T + noise, (40, *noise.shape))
        inside, ratio, _ = judged(pooled(drawn(rng, csm, 189), 189), true)
        held.append(inside)
        ratios.append(ratio[3:5])
    assert np.mean(held) > least(24 * sensors)
    assert np.mean(held, axis=0)[3:5].mean() > 0.7  # a diagonal model holds none of these
    # eight draws of 7560 averages: 0.4 % standard error
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.02)


TURNING, STEEP, STEP, LINES = "turning", "steep", "a step", "lines"


def coloured(kind: str, rng: np.random.Generator) -> ComplexArray:
    """Return how three sources move three axes at each bin, shape (N_BINS, 3, 3)."""
    path = np.broadcast_to(np.eye(3, dtype=np.complex128), (N_BINS, 3, 3)).copy()
    if kind == TURNING:  # filters of a few taps
        taps = rng.standard_normal((24, 3, 3)) * np.exp(-np.arange(24) / 6)[:, None, None]
        turned = np.exp(-1j * np.linspace(0.2, 2.4, N_BINS)[:, None] * np.arange(24))
        path = np.einsum("fk,kab->fab", turned, taps)
    elif kind == STEEP:  # 60 dB over the band
        path *= np.geomspace(30, 0.03, N_BINS)[:, None, None]
    elif kind == STEP:
        path[30:] *= 0.01
    else:  # of machines, each along one axis of its own
        for place in (10, 33, 50):
            path[place, :, 0] += 40 * rng.standard_normal(3)
    return path / (np.linalg.norm(path) / np.sqrt(3 * N_BINS) if kind == TURNING else 1)


@pytest.mark.parametrize(
    ("kind", "ratio", "sensors"),
    [
        *((TURNING, 1.0, 3), (TURNING, 3.0, 3), (TURNING, 3.0, 5), (TURNING, 10.0, 3)),
        *((STEEP, 1.0, 3), (STEEP, 1.0, 5), (STEP, 3.0, 3), (LINES, 1.0, 3), (LINES, 1.0, 5)),
    ],
)
def test_motion_that_differs_between_bins_is_removed(kind: str, ratio: float, sensors: int) -> None:
    """Where a bin lacks a direction, neither its noise is taken off, nor is motion left in."""
    held, scores = [], []
    for seed in range(6):
        rng = np.random.default_rng([seed, sensors])
        axes = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(sensors)]
        A = np.sqrt(ratio) * np.concatenate(axes) @ coloured(kind, rng)
        sample = drawn(rng, A @ A.conj().swapaxes(1, 2) + np.eye(3 * sensors), 300)
        inside, _, score = judged(pooled(sample, 300), np.ones(3 * sensors))
        held.append(inside)
        scores.append(score)
    n = 18 * sensors
    assert np.mean(held) > least(n)
    # 6 draws of channels that hardly depend on one another
    assert np.square(scores).mean() < 1 + 4 * np.sqrt(2 / n)
    assert abs(np.mean(scores)) < 4 / np.sqrt(n)


@pytest.mark.parametrize("sensors", [3, 5])
@pytest.mark.parametrize("powers", [(1.0, 1.0, 1.0), (1e5, 1e3, 10.0)])
@pytest.mark.parametrize("kind", ["resonance", "notch", "line"])
def test_what_differs_in_a_few_bins_of_one_sensor(
    kind: str, powers: tuple[float, float, float], sensors: int
) -> None:
    """Its response, by up to 5 or 1/30, or its noise, by up to 58, which channels share."""
    held, scores = [], []
    for seed in range(4):
        rng = np.random.default_rng([seed, 9])
        axes = [np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(sensors)]
        A = np.concatenate(axes) * np.sqrt(powers) * np.ones((N_BINS, 1, 1), np.complex128)
        noise = np.eye(3 * sensors) * np.ones((N_BINS, 1, 1))
        if kind == "line":
            noise[28:31, :3, :3] += np.outer([7.0, 3.0, 0.0], [7.0, 3.0, 0.0])
        else:
            gain = np.array([2.0, 3.0, 5.0, 3.0, 2.0]) ** (1 if kind == "resonance" else -2)
            A[28:33, :3] *= (gain * np.exp(1j * np.linspace(0, 3, 5)))[:, None, None]
        method = "three-sensor" if sensors == 3 else "maximum-likelihood"
        found = beside(drawn(rng, A @ A.conj().swapaxes(1, 2) + noise, 300), 300, method=method)
        inside, _, score = judged(found, np.einsum("fcc->fc", noise).mean(axis=0))
        held.append(inside)
        scores.append(score)
    n = 12 * sensors
    assert np.mean(held) > least(n)
    assert np.square(scores).mean() < 1 + 4 * np.sqrt(2 / n)


def test_each_block_has_the_dimensions_of_its_own_motion() -> None:
    """Strong motion, none, and motion again: none of it is in the noise of its neighbours."""
    rng = np.random.default_rng(3)
    true = np.concatenate([scene(rng, (snr,) * 3, np.ones(9)) for snr in (1e3, 0.0, 30.0)])
    found = pooled(drawn(rng, true, 189), 189, block=3)
    level = band_levels(found.noise, found.cumulants, np.arange(4) * N_BINS, ONE)
    # 61 bins of 189 averages: standard error 0.9 % of a channel, 0.3 % of the mean of nine
    np.testing.assert_allclose(level.mean.mean(axis=1), 1.0, atol=0.015)


def test_a_line_of_one_sensor_is_not_taken_for_motion() -> None:
    """50 times its noise, in three of 61 bins, shared by two channels: it stands out in these."""
    noise = np.ones((N_BINS, 9))
    line = np.zeros((N_BINS, 9, 9))
    line[30:33, 3:5, 3:5] = np.array([10.0, 50.0, 10.0])[:, None, None] * [[1.0, 0.5], [0.5, 0.25]]
    noise += np.einsum("fcc->fc", line)
    ratios, held, levels = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        sample = drawn(rng, scene(rng, (10.0,) * 3, np.ones(9)) + line, 189)
        found = pooled(sample, 189)
        ratios.append((found.noise / noise)[30:33])
        inside, level, _ = judged(found, noise.mean(axis=0))
        held.append(inside)
        levels.append(level)
    # three bins of twelve draws of 189 averages: standard error 1.5 %; motion leaks a little
    np.testing.assert_allclose(np.mean(ratios, axis=(0, 1)), 1.0, atol=0.1)
    np.testing.assert_allclose(np.mean(levels, axis=0), 1.0, atol=0.02)
    assert np.mean(held) > least(108)


def test_motion_shows_beside_strong_noise_of_one_sensor() -> None:
    """Whitened channel by channel, a third of the draws took this motion for noise: 0.87 held."""
    held, within = [], np.zeros((9, 9))
    within[3:6, 3:6] = np.outer([4.0, 2.0, 0.0], [4.0, 2.0, 0.0])
    noise = np.ones(9) + np.diag(within)
    for seed in range(24):
        rng = np.random.default_rng([46, seed])
        axes = np.concatenate([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(3)])
        csm = (axes * [0.1, 0.14, 0.07]) @ axes.T + np.eye(9) + within
        sample = drawn(rng, np.broadcast_to(csm, (40, 9, 9)).astype(np.complex128), 60)
        held.append(judged(beside(sample, 60), noise)[0])
    assert np.mean(held) > least(216)


@pytest.mark.parametrize("snr", [0.0, 0.02, 0.05])
def test_motion_that_hardly_shows_is_in_the_interval(snr: float) -> None:
    bands, _, _ = coverage((snr,) * 3, np.ones(9), n=189, draws=8)
    assert bands > least(72)


def test_few_averages_are_covered() -> None:
    bands, bins, _ = coverage((0.3, 0.3), np.ones(6), n=12, draws=20)
    assert bands > least(120)
    assert 0.93 < bins < 0.985


def test_a_quiet_sensor_is_known_to_a_few_times_its_noise() -> None:
    """30 dB below the others, SNR 0.3 in them: single bins know it to 60 times its noise."""
    noise = np.array([1e-3] * 3 + [1.0] * 6)
    reach = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        sample = drawn(rng, scene(rng, (0.3,) * 3, noise), 189)
        found = beside(sample, 189)
        _, high = band_levels(found.noise_psd, found.cumulants, EDGES, ONE).interval()
        reach.append(high[0, :3] / noise[:3])
    assert np.median(reach) < 20


@pytest.mark.parametrize(("n", "snr", "own"), [(189, 1e4, 1), (20, 1e4, 1), (189, 0.3, 0)])
def test_by_name_three_sensor_is_the_paper_s_formula(n: int, snr: float, own: int) -> None:
    rng = np.random.default_rng(1)
    sample = drawn(rng, scene(rng, (snr,) * 3, np.ones(9)), n)
    by_name = self_noise("three-sensor", sample, dims=(3,) * 3, n_effective=n)
    plain = three_sensor(sample, dims=(3,) * 3, n_effective=n)
    np.testing.assert_array_equal(by_name.noise_psd, plain.noise_psd)
    assert not (by_name.flags & Flag.POOLED).any()
    levels = beside(sample, n, known=by_name)
    assert not np.array_equal(levels.noise_psd, plain.noise_psd)
    assert ((levels.flags & Flag.POOLED) == (0 if own else Flag.POOLED)).all()


def test_too_few_averages_for_a_block_give_nothing() -> None:
    found = pooled(np.broadcast_to(np.eye(9, dtype=np.complex128), (2, 9, 9)), 4)
    assert np.isnan(found.noise).all()


def test_a_channel_that_is_the_sum_of_two_others_stops_nothing() -> None:
    rng = np.random.default_rng(3)
    sample = drawn(rng, scene(rng, (1e3,) * 3, np.ones(9)), 40)
    sum_of = np.eye(9)
    sum_of[6] = sum_of[0] + sum_of[3]
    found = beside(np.asarray(sum_of @ sample @ sum_of.T, np.complex128), 40)
    assert np.isfinite(found.noise_psd).all()


def test_correlated_neighbours_are_worth_fewer_bins() -> None:
    hann = np.array([1.0, 4 / 9, 1 / 36])
    table = worth(100, hann)
    assert table[1] == 1
    assert table[2] == pytest.approx(2 / (1 + 4 / 9))
    assert table[100] == pytest.approx(100 / (1 + 2 * (4 / 9 * 0.99 + 1 / 36 * 0.98)))
    np.testing.assert_allclose(worth(9, ONE), np.arange(10))


@pytest.mark.parametrize("p", [8, 12])
def test_sensors_off_plumb_are_known_although_motion_has_more_dimensions(p: int) -> None:
    """One channel each, 1 degree (rms) off plumb; single bins give 0 or twice the noise to some."""
    held, ratios, noise = [], [], np.ones(p)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        axes = np.column_stack([np.ones(p), 0.0123 * rng.standard_normal((p, 2))])
        csm = 5e4 * axes @ axes.T + np.eye(p)
        sample = drawn(rng, np.broadcast_to(csm, (N_BINS, p, p)).astype(np.complex128), 200)
        found = beside(sample, 200, 1, "maximum-likelihood", n_factors=3)
        assert (found.flags & Flag.POOLED).all()
        inside, ratio, _ = judged(found, noise)
        held.append(inside)
        ratios.append(ratio)
    assert np.mean(held) > least(8 * p)
    assert np.mean(ratios) == pytest.approx(1, abs=0.02)


def test_more_dimensions_than_were_chosen_do_not_narrow_the_intervals() -> None:
    """Twelve sensors; the lower half has four weak dimensions more, which bins show together."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(np.column_stack([np.ones(12), rng.standard_normal((12, 4))]))[0] * 12**0.5
    strengths = np.repeat([[100, 0.3, 0.3, 0.3, 0.3], [100, 30, 0, 0, 0]], 40, axis=0)
    csm = (axes * strengths[:, None, :]) @ axes.T + np.eye(12)
    held = []
    for _ in range(8):
        sample, both = drawn(rng, csm.astype(np.complex128), 100), np.repeat([0, 1], 40)
        found = beside(sample, 100, 1, "maximum-likelihood", n_factors=1 + both, blocks=both)
        held.append((found.low[:40] <= 1) & (found.high[:40] >= 1))
    assert np.mean(held) == pytest.approx(0.95, abs=0.02)
