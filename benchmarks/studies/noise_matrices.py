"""Levels of `auto` where the noise of a sensor is a matrix: coverage, and width over the bound.

``python -m benchmarks.studies.noise_matrices [DRAWS [SENSORS,CHANNELS [AVERAGES]]]`` prints the
table of ``docs/validation/noise-matrices.md``: Wishart matrices of ``A A* + N``, sensors in any
direction.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.studies.draws import averaged
from estimator.levels.bands import band_levels
from estimator.levels.interval import NORMAL_95
from estimator.likelihood.dimension import choose_dimension, noise_groups
from estimator.methods import self_noise

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

RATIOS = (0.0, 0.05, 0.3, 1.0, 10.0, 100.0, 1e4, 1e5)
LAYOUTS = tuple(product((3, 4, 6, 8, 12), (3, 2, 1)))
AVERAGES = (20, 60, 200)
N_BINS = 40
DRAWS = 40
SHARED = ((4.0, 2.0, 0.0), (0.0, 1.0, 3.0))
"""Amplitudes, over that of its own noise, of two sources in the channels of the second sensor."""
UVW = np.array([[2, 0, 2**0.5], [-1, 3**0.5, 2**0.5], [-1, -(3**0.5), 2**0.5]]) / 6**0.5
INDEPENDENT, WITHIN, RANK_TWO, ELEMENT = "none", "one sensor", "rank two", "one UVW element"
PAIR = "two sensors"
TURNING, STEEP, LINES = "turning motion", "steep motion", "lines"
"""Motion that differs between bins: in its polarisation, by 60 dB over the band, in three bins."""
WEAK, WEAK_BANDS, WEAKER = "weak motion, ten bands", 10, 0.1
"""The mean over so many bands, with so much of the motion: what no band shows by itself."""


@dataclass(frozen=True, slots=True)
class Cell:
    """What is drawn again and again: a layout, its motion over its noise, and shared noise."""

    n_sensors: int
    d: int
    ratio: float
    n: int
    shared: str = INDEPENDENT

    @property
    def n_bins(self) -> int:
        """Bins of which the level is the mean."""
        return N_BINS * (WEAK_BANDS if self.shared == WEAK else 1)


@dataclass(frozen=True, slots=True)
class Found:
    """Of the intervals of band levels: coverage, median width over the bound; pairs named."""

    coverage: float
    of_shared: float
    width: float
    named: float
    n: int


def scene(cell: Cell, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return loadings of the motion, shape (p, d), and the noise matrix, of sensors turned anyhow.

    Gains differ by 2 %, and so do the powers of the motion's dimensions, by a factor of two.
    """
    d = cell.d
    turned = [np.linalg.qr(rng.standard_normal((d, d)))[0] for _ in range(cell.n_sensors)]
    loadings = np.concatenate(turned) * np.sqrt(cell.ratio * np.array([1.0, 1.4, 0.7])[:d])
    loadings *= np.sqrt(WEAKER if cell.shared == WEAK else 1.0)
    loadings *= 1 + 0.02 * rng.standard_normal((len(loadings), 1))
    noise = np.eye(len(loadings))
    sources = np.array(SHARED)[: 2 if cell.shared == RANK_TWO else 1, :d]
    own, both = slice(d, 2 * d), slice(d, 3 * d)
    if cell.shared in {WITHIN, RANK_TWO}:
        noise[own, own] += sources.T @ sources
    elif cell.shared == ELEMENT:
        noise[own, own] += 3 * np.outer(UVW[0], UVW[0])
    elif cell.shared == PAIR:
        twice = np.append(sources[0], np.roll(sources[0], 1))
        noise[both, both] += np.outer(twice, twice)
    return loadings, noise


def path(cell: Cell, rng: np.random.Generator) -> ComplexArray:
    """Return how d sources move d axes at each bin, shape (n_bins, d, d)."""
    d = cell.d
    along = np.broadcast_to(np.eye(d, dtype=np.complex128), (cell.n_bins, d, d)).copy()
    if cell.shared == TURNING:
        taps = rng.standard_normal((24, d, d)) * np.exp(-np.arange(24) / 6)[:, None, None]
        delay = np.exp(-1j * np.linspace(0.2, 2.4, N_BINS)[:, None] * np.arange(24))
        along = np.einsum("fk,kab->fab", delay, taps)
        along /= np.linalg.norm(along) / np.sqrt(d * N_BINS)
    elif cell.shared == STEEP:
        along *= np.geomspace(30, 0.03, N_BINS)[:, None, None]
    elif cell.shared == LINES:
        along[[5, 20, 33], :, 0] += 40 * rng.standard_normal((3, d))
    return along


def bound(loadings: FloatArray, noise: FloatArray, d: int, averages: float) -> FloatArray:
    """Return the Cramér-Rao bound of the diagonal of the noise: standard deviations, shape (p,).

    The noise is any block-diagonal matrix, and the loadings are unknown, alike at all bins. By
    derivatives of the covariance along every real parameter, of which the information is
    ``n tr(C D C E)``, with C the inverse covariance.
    """
    p = len(noise)
    inverse = np.linalg.inv(loadings @ loadings.T + noise)
    basis: list[ComplexArray] = []
    for a, b in product(range(p), range(p)):
        if a // d == b // d and a <= b:
            for unit in (1.0,) if a == b else (1.0, 1j):
                D = np.zeros((p, p), np.complex128)
                D[a, b] += unit
                D[b, a] += np.conj(unit) if a != b else 0.0
                basis.append(D)
    n_noise = len(basis)
    for a, k, unit in product(range(p), range(loadings.shape[1]), (1.0, 1j)):
        D = np.zeros((p, p), np.complex128)
        D[a] = unit * loadings[:, k]
        basis.append(D + D.conj().T)
    along = np.array([inverse @ D for D in basis]).reshape(len(basis), -1)
    back = np.array([(inverse @ D).T for D in basis]).reshape(len(basis), -1)
    information = averages * (along @ back.T).real
    # loadings are known up to a rotation only: a pseudo-inverse
    covariance = np.linalg.pinv(information, rcond=1e-11, hermitian=True)
    diagonal = [i for i, D in enumerate(basis[:n_noise]) if np.count_nonzero(D) == 1]
    return np.asarray(np.sqrt(np.diag(covariance)[diagonal]))


def study(cell: Cell, n_draws: int, *, seed: int = 46) -> Found:
    """Return what the intervals of a band are, over all draws and channels."""
    held, widths, named = [], [], []
    for draw in range(n_draws):
        rng = np.random.default_rng([seed, draw, cell.n_sensors, cell.d, cell.n])
        loadings, noise = scene(cell, rng)
        A = loadings @ path(cell, rng)
        drawn = averaged(A @ A.conj().swapaxes(1, 2) + noise, cell.n, rng)
        dims, block = (cell.d,) * cell.n_sensors, np.arange(cell.n_bins) // N_BINS
        options: dict[str, Any] = {}
        reach = np.ones((2, len(noise)))
        if cell.shared == PAIR:
            frequency, n = np.arange(1.0, N_BINS + 1), float(cell.n)
            q, (choice,) = choose_dimension(drawn, frequency, dims=dims, n_effective=n, band=block)
            groups = noise_groups([choice], frequency, cell.n_sensors)
            options = {"n_factors": q, "groups": groups}
            reach = np.array([choice.least, choice.most]) if choice.pairs else reach
            named.append(bool(choice.pairs))
        found = self_noise(
            "three-sensor" if cell.n_sensors == 3 else "maximum-likelihood",
            drawn,
            dims=dims,
            n_effective=float(cell.n),
            blocks=block,
            **options,
        )
        level = band_levels(
            found.noise_psd, found.cumulants, np.array([0, cell.n_bins]), np.ones(1)
        )
        low, high = (end * by for end, by in zip(level.interval(), reach, strict=True))
        truth = np.diag(noise)
        held.append((low[0] <= truth) & (truth <= high[0]))
        if cell.shared == PAIR:  # no bound: that of one matrix for both
            continue
        least = NORMAL_95 * bound(loadings, noise, cell.d, cell.n * cell.n_bins)
        widths.append((high - low)[0] / 2 / least)
    second = np.array(held)[:, cell.d : 2 * cell.d]
    return Found(
        coverage=float(np.mean(held)),
        of_shared=float(np.mean(second)),
        width=float(np.median(widths)) if widths else np.nan,
        named=float(np.mean(named)) if named else np.nan,
        n=int(np.size(held)),
    )


def main(n_draws: int, layouts: tuple[tuple[int, int], ...], averages: tuple[int, ...]) -> None:
    """Print a row for each layout, number of averages and shared noise, a column for each ratio."""
    print("| sensors, channels | averages | shared noise | " + " | ".join(f"{r:g}" for r in RATIOS))
    print("|---|---|---|" + "---|" * len(RATIOS))
    for (s, d), n in product(layouts, averages):
        shared = (INDEPENDENT, WITHIN, RANK_TWO, ELEMENT)[: 1 if d == 1 else 2 if d == 2 else 4]
        kinds = *shared, *(() if s == 3 else (PAIR,)), TURNING, STEEP, LINES, WEAK
        for kind in kinds if n > s * d else ():
            draws = max(2, -(-n_draws * 9 // (s * d)))
            cells = [study(Cell(s, d, ratio, n, kind), draws) for ratio in RATIOS]
            row = [f"{c.coverage:.3f} {c.named if kind == PAIR else c.width:.2f}" for c in cells]
            print(f"| {s}, {d} | {n} | {kind} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    _, *given = sys.argv
    numbers = [tuple(map(int, each.split(","))) for each in given]
    main(
        numbers[0][0] if numbers else DRAWS,
        (numbers[1][:2],) if len(numbers) > 1 else LAYOUTS,  # type: ignore[arg-type]
        numbers[2] if len(numbers) > 2 else AVERAGES,
    )
