"""Directions from neighbouring frequencies, where motion or noise varies much between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.studies.draws import averaged
from estimator.levels.bands import BandLevels, band_levels
from estimator.levels.pooled import LEAST_BINS, blocks_of
from estimator.methods import self_noise
from estimator.types import ComplexArray
from tests.estimator.csm_models import white


def _turned(rng: np.random.Generator, n_sensors: int = 3) -> np.ndarray:
    return np.concatenate([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(n_sensors)])


def _averaged(x: ComplexArray) -> ComplexArray:
    return np.asarray(np.einsum("fnp,fnq->fpq", x, x.conj()) / x.shape[1])


def _levels(
    csm: ComplexArray,
    n: float,
    edges: Sequence[int] | np.ndarray,
    blocks: np.ndarray,
    method: str = "maximum-likelihood",
) -> BandLevels:
    """Return the levels of triaxial sensors in bands, from directions that blocks share."""
    dims = (3,) * (csm.shape[1] // 3)
    found = self_noise(method, csm, dims=dims, n_effective=float(n), blocks=blocks)
    return band_levels(found.noise_psd, found.cumulants, np.array(edges), np.ones(1))


@pytest.mark.parametrize("steep", ["motion", "noise"])
def test_neighbours_count_rightly_where_levels_fall_within_a_block(steep: str) -> None:
    """In units of each bin's own power the noise is up to 8 dB too high where the motion ends."""
    rng = np.random.default_rng(31)
    n, n_freqs = 74.0, 240
    frequency = 0.1 * np.arange(1, n_freqs + 1, dtype=np.float64)
    if steep == "motion":  # ends within a tenth of an octave
        edge = np.clip((frequency - 10.0) / 0.7, 0.0, 1.0)
        level, noise = 1e4 * np.cos(np.pi / 2 * edge) ** 2, np.ones(n_freqs)
    else:  # from below the motion to above it
        level, noise = np.full(n_freqs, 0.3), (frequency / 8.0) ** -3.0
    turned = _turned(rng)
    means, edges = [], np.array([40, 60, 75, 90, 110, 140, 180, 239])
    for _ in range(6):
        motion = np.sqrt(level / 2)[:, None, None] * white(rng, n_freqs, int(n), 3)
        own = np.sqrt(noise / 2)[:, None, None] * white(rng, n_freqs, int(n), 9)
        csm = _averaged(motion @ turned.T + own)
        held = _levels(csm, n, edges, blocks_of(frequency), "three-sensor")
        low, high = held.interval()
        true = (np.add.reduceat(noise[:-1], edges[:-1]) / np.diff(edges))[:, None]
        means.append((held.mean / true, (low <= true) & (high >= true)))
    found_over_true, covered = (np.array(each) for each in zip(*means, strict=True))
    np.testing.assert_allclose(np.median(found_over_true, axis=(0, 2)), 1.0, atol=0.08)
    assert covered.mean() > 0.9


def test_blocks_are_thirds_of_an_octave_with_bins_enough() -> None:
    """The last one takes what is left, if that is less than a block."""
    frequency = 0.1 * np.arange(1200, dtype=np.float64)
    block = blocks_of(frequency)
    first = np.flatnonzero(np.diff(block, prepend=-1))
    sizes = np.diff(first, append=len(block))
    assert set(np.diff(block).tolist()) == {0, 1}
    assert sizes.min() == sizes[0] == LEAST_BINS
    ends = frequency[first[:-1]] * 2 ** (1 / 3)
    assert (frequency[first[1:]] >= ends).all()
    wide = sizes[:-1] > LEAST_BINS
    assert wide.any()
    assert (frequency[first[1:] - 1] < ends)[wide].all()
    assert sizes[-1] < 2 * sizes[-2]


@pytest.mark.parametrize(("ratio", "slopes"), [(0.01, 0.0), (0.03, 0.0), (0.02, 1.0)])
def test_motion_too_weak_for_one_third_of_an_octave_is_found_with_others(
    ratio: float, slopes: float
) -> None:
    """It was in the noise of all: means of five octaves were 1 % too high, or known to ± 2.5 %."""
    rng = np.random.default_rng(53)
    n, n_freqs = 100.0, 400
    frequency = 0.1 * np.arange(1, n_freqs + 1, dtype=np.float64)
    noise = (frequency[:, None] / 6.0) ** rng.uniform(-slopes, slopes, 9)
    turned = _turned(rng)
    errors, spreads = [], []
    for _ in range(6):
        motion = np.sqrt(ratio / 2) * white(rng, n_freqs, int(n), 3)
        own = np.sqrt(noise / 2)[:, None] * white(rng, n_freqs, int(n), 9)
        held = _levels(_averaged(motion @ turned.T + own), n, (10, 398), blocks_of(frequency))
        true = noise[10:398].mean(axis=0)
        errors.append(held.mean[0] / true - 1)
        spreads.append(held.spread[0] / true)
    spread = np.sqrt(np.square(spreads).mean(axis=(0, 1)))
    assert abs(np.mean(errors)) < 3 * spread / np.sqrt(54) + 0.001
    assert (np.abs(np.array(errors) / spreads) < 1.96).mean() > 0.9
    assert np.median(spreads) < 0.0125  # 0.008 with strong motion


def test_motion_that_a_third_of_an_octave_resolves_is_not_looked_for_with_others() -> None:
    """One sensor is 40 dB noisier, responses vary by 20 %: the noise was 4 times too high."""
    rng = np.random.default_rng(54)
    n, n_freqs = 30, 400
    frequency = 0.1 * np.arange(1, n_freqs + 1, dtype=np.float64)
    octaves = np.arange(10)
    response = _turned(rng)
    course = np.log2(frequency / frequency[0])
    varying = np.array(
        [np.interp(course, octaves, 0.2 * rng.standard_normal(10)) for _ in range(18)]
    )
    response = response * np.exp(varying[:9] + 1j * varying[9:]).T[:, :, None]
    noise = np.repeat([1.0, 1.0, 1e4], 3)
    motion = np.sqrt(21 / 2) * white(rng, n_freqs, n, 3)
    x = np.einsum("fpq,fnq->fnp", response, motion)
    x += np.sqrt(noise / 2) * white(rng, n_freqs, n, 9)
    held = _levels(_averaged(x), n, (10, 398), blocks_of(frequency))
    low, high = held.interval()
    assert ((low[0] <= noise) & (noise <= high[0])).mean() > 0.7
    assert np.median(held.mean[0] / noise) < 1.5


def test_directions_of_motion_near_the_noise_take_more_of_it() -> None:
    """A mean of ten bands was too low by 0.76 standard deviations."""
    rng = np.random.default_rng(54)
    n, n_freqs = 200, 400
    z = []
    for _ in range(8):
        A = _turned(rng, 4) * np.sqrt([1.0, 1.4, 0.7])
        drawn = averaged(np.broadcast_to(A @ A.T + np.eye(12), (n_freqs, 12, 12)), n, rng)
        held = _levels(drawn, n, (0, n_freqs), np.arange(n_freqs) // 40)
        z.append((held.mean[0] - 1) / held.spread[0])
    assert abs(np.mean(z)) < 0.35


def test_an_axis_that_is_dead_in_all_sensors_feels_no_dimension_of_the_motion() -> None:
    """There were more dimensions than live channels of a sensor, and neighbours were not used."""
    rng = np.random.default_rng(55)
    n = 40
    x = white(rng, 60, n, 12) + 0.5 * np.tile(white(rng, 60, n, 3), 4)
    csm = _averaged(x)
    live = np.arange(12) % 3 < 2
    csm[:, ~live] = csm[:, :, ~live] = 0
    blocks = blocks_of(np.linspace(0.1, 6.0, 60))
    found = self_noise(
        "maximum-likelihood", csm, dims=(3,) * 4, n_effective=40.0, blocks=blocks, n_factors=3
    )
    alone = csm[:, live][:, :, live]
    expected = self_noise(
        "maximum-likelihood", alone, dims=(2,) * 4, n_effective=40.0, blocks=blocks
    )
    np.testing.assert_allclose(found.noise_psd[:, live], expected.noise_psd, rtol=1e-6)
