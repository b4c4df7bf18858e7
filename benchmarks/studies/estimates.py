"""Bias, scatter and coverage of the estimates.

Every point has averages of its own, drawn from known matrices of sensors that point anyhow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from benchmarks.studies.draws import averaged, bench
from estimator.levels.bands import band_levels
from estimator.likelihood.fisher import cramer_rao_cov
from estimator.methods import self_noise
from estimator.noise_parameters.fit import fit, terms_at
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study

FloatArray = NDArray[np.float64]

METHODS = ("three-sensor", "maximum-likelihood")
NOMINAL = 0.95
COVERAGE_TOLERANCE = 0.02
"""By which the coverage of an interval of 95 % may be off."""
WIDER = 0.05
"""The same below an SNR of 1, where intervals are wider than they need be."""
SNR_LABEL, AVERAGES_LABEL = "SNR (1)", "averages (1)"
COVERAGE_LABEL, BIAS_LABEL, COV_LABEL = (
    "share of intervals with the true noise (1)",
    "fractional bias (1)",
    "coefficient of variation (1)",
)
INDEPENDENT = np.eye(1, 8)[0]
"""Correlation of neighbouring frequencies: none."""
_STUDY: TypeAlias = "Callable[[ProgressCallback, float], Study]"


def share(x: float, hits: float, n: float, expected: float, allowed: float) -> Point:
    """Return a share of n independent outcomes beside what is expected of it."""
    error = float(np.sqrt(max(expected * (1 - expected), 0.25 / n) / n))
    return Point(x, hits, expected, error, allowed)


def coverage(progress: ProgressCallback, length: float) -> Study:
    """Intervals of 95 % at single frequencies, by SNR and by averages."""
    n_draws = max(40, round(1000 * length))
    by_snr: dict[str, list[Point]] = {method: [] for method in METHODS}
    by_averages: dict[str, list[Point]] = {method: [] for method in METHODS}
    snrs, averages = (0.1, 1.0, 10.0, 1e3, 1e5), (20, 50, 100, 300, 1000)
    points = [(snr, 100, snr, by_snr) for snr in snrs]
    points += [(100.0, n, float(n), by_averages) for n in averages]
    for number, (snr, n, x, series) in enumerate(points):
        progress("coverage", number / len(points))
        rng = np.random.default_rng([20, number])
        csm = averaged(np.stack([bench(rng, snr=snr) for _ in range(n_draws)]), n, rng)
        for method in METHODS:
            found = self_noise(method, csm, dims=(3, 3, 3), n_effective=n)
            known = np.isfinite(found.high)
            covers = ((found.low < 1) & (found.high > 1))[known].mean()
            # Channels of a sensor share little, those of three sensors half of their scatter.
            allowed = COVERAGE_TOLERANCE if snr >= 1 else WIDER
            series[method].append(share(x, float(covers), 3 * n_draws, NOMINAL, allowed))
    return Study(
        "coverage",
        f"Coverage of the intervals of 95 %, {n_draws} draws a point",
        tuple(
            Panel(
                title,
                label,
                COVERAGE_LABEL,
                tuple(Series(m, m, "share", tuple(points[m])) for m in METHODS),
                log="x",
            )
            for title, label, points in (
                ("(a) 100 averages", SNR_LABEL, by_snr),
                ("(b) SNR 100", AVERAGES_LABEL, by_averages),
            )
        ),
    )


def small_samples(progress: ProgressCallback, length: float) -> Study:
    """Bias of few averages, with and without the correction."""
    n_draws = max(100, round(4000 * length))
    panels = []
    for number, d in enumerate((1, 2, 3)):
        progress("small samples", number / 3)
        series: dict[bool, list[Point]] = {True: [], False: []}
        for n in (12, 20, 40, 100, 400):
            rng = np.random.default_rng([21, d, n])
            csm = averaged(np.stack([bench(rng, d=d, snr=1e3) for _ in range(n_draws)]), n, rng)
            for correct, points in series.items():
                noise = self_noise(
                    "three-sensor", csm, dims=(d,) * 3, n_effective=n, correct=correct
                ).noise_psd
                each = noise.mean(axis=1)
                error = float(each.std() / np.sqrt(n_draws))
                points.append(Point(n, float(each.mean() - 1), 0.0 if correct else -d / n, error))
        panels.append(
            Panel(
                f"({'abc'[number]}) {d} channel{'s' if d > 1 else ''}",
                AVERAGES_LABEL,
                BIAS_LABEL,
                (
                    Series("corrected", "three-sensor", "bias", tuple(series[True])),
                    Series("uncorrected", "three-sensor", "bias", tuple(series[False])),
                ),
                log="x",
            )
        )
    return Study("small-samples", "Bias of few averages", tuple(panels))


def many_sensors(progress: ProgressCallback, length: float) -> Study:
    """Scatter of three to six sensors, beside the least that is possible."""
    n_draws, n = max(40, round(1000 * length)), 200
    series: dict[str, list[Point]] = {method: [] for method in METHODS}
    for number, n_sensors in enumerate((3, 4, 5, 6)):
        progress("many sensors", number / 4)
        rng = np.random.default_rng([22, n_sensors])
        dims, p = (3,) * n_sensors, 3 * n_sensors
        true = np.stack([bench(rng, n_sensors=n_sensors, snr=100.0) for _ in range(n_draws)])
        csm = averaged(true, n, rng)
        least = cramer_rao_cov(true, np.ones((n_draws, p)), n_effective=n - 3)
        for method in METHODS:
            noise = self_noise(method, csm, dims=dims, n_effective=n).noise_psd
            ratio = (noise - 1) / least
            scatter = float(np.sqrt(np.mean(ratio**2)))
            # Of sensors at right angles no estimate loses much.
            error = scatter / np.sqrt(2 * n_draws * p / 2)
            series[method].append(Point(n_sensors, scatter, 1.0, error, allowed=0.05))
    return Study(
        "many-sensors",
        "Scatter of the noise of three to six sensors",
        (
            Panel(
                "scatter over the Cramér-Rao bound",
                "sensors (1)",
                "ratio (1)",
                tuple(Series(m, m, "c.o.v.", tuple(series[m])) for m in METHODS),
            ),
        ),
    )


def quiet(progress: ProgressCallback, length: float) -> Study:
    """Measure the noise of a quiet sensor among sensors 30 dB louder, over a band."""
    n_draws, n, n_freqs, ratio = max(20, round(200 * length)), 226, 64, 1000.0
    noise_psd = np.array([1.0] * 3 + [ratio] * 6)
    points, biases = [], []
    snrs = (0.03, 0.1, 0.3, 1.0, 3.0)
    for number, snr in enumerate(snrs):
        progress("quiet among noisy", number / len(snrs))
        rng = np.random.default_rng([23, number])
        found = []
        for _ in range(n_draws):
            true = bench(rng, snr=snr * ratio, noise_psd=noise_psd)
            csm = averaged(np.broadcast_to(true, (n_freqs, 9, 9)), n, rng)
            noise = self_noise(
                "three-sensor",
                csm,
                dims=(3, 3, 3),
                n_effective=n,
                blocks=np.zeros(n_freqs, np.int64),
                correlation=INDEPENDENT,
            )
            band = band_levels(
                noise.noise_psd, noise.cumulants, np.array([0, n_freqs]), INDEPENDENT
            )
            found.append([each[0, :3] for each in (band.mean, *band.interval())])
        means, low, high = np.array(found).swapaxes(0, 1)
        covers = float(((low < 1) & (high > 1)).mean())
        points.append(share(snr, covers, 3 * n_draws, NOMINAL, COVERAGE_TOLERANCE))
        below = float((means < 1).mean())
        biases.append(share(snr, below, 3 * n_draws, 0.5, 0.0))
    return Study(
        "quiet",
        f"A quiet sensor among noisy ones, {n_draws} draws a point",
        (
            Panel(
                "(a) coverage",
                "SNR of the noisy sensors (1)",
                COVERAGE_LABEL,
                (Series("band mean", "three-sensor", "share", tuple(points)),),
                log="x",
            ),
            Panel(
                "(b) estimates below the true noise",
                "SNR of the noisy sensors (1)",
                "share (1)",
                (Series("below", "three-sensor", "share", tuple(biases)),),
                log="x",
            ),
        ),
    )


def unequal(progress: ProgressCallback, length: float) -> Study:
    """Three good sensors and two poor ones: the scatter of the good ones' noise."""
    n_draws, n = max(100, round(2000 * length)), 200
    points = []
    for number, ratio in enumerate((10.0, 100.0, 1000.0)):
        progress("unequal sensors", number / 3)
        rng = np.random.default_rng([24, number])
        noise_psd = np.array([1.0] * 9 + [ratio] * 6)
        true = bench(rng, n_sensors=5, snr=max(1e3, 10 * ratio), noise_psd=noise_psd)
        csm = averaged(np.broadcast_to(true, (n_draws, 15, 15)), n, rng)
        scatter = [
            self_noise(m, csm, dims=(3,) * 5, n_effective=n).noise_psd[:, :9].std(axis=0).mean()
            for m in METHODS
        ]
        error = 1 / np.sqrt(9 * n_draws)
        points.append(Point(ratio, float(scatter[0] / scatter[1]), 1.0, float(error), 0.1))
    return Study(
        "unequal",
        "Two poor sensors among five",
        (
            Panel(
                "scatter over that of maximum likelihood",
                "noise of the poor sensors over that of the good ones (1)",
                "ratio (1)",
                (Series("weighted pairs", "three-sensor", "c.o.v.", tuple(points)),),
                log="x",
            ),
        ),
    )


TERMS = np.array([2e-13, 5e-12, 1e-12, 2e-16])
"""Random walk, flicker, white and f² at 1 Hz."""


def noise_terms(progress: ProgressCallback, length: float) -> Study:
    """Noise parameters: bias, and coverage of their errors."""
    n_draws = max(30, round(400 * length))
    frequency: FloatArray = np.arange(1001, dtype=np.float64) * 0.1
    true = np.zeros(len(frequency))
    true[1:] = terms_at(frequency[1:], 0.1) @ TERMS
    panels = []
    for number, n in enumerate((50, 400)):
        progress("noise parameters", number / 2)
        rng = np.random.default_rng([26, n])
        cov: FloatArray = np.full(len(frequency), 1 / np.sqrt(n), dtype=np.float64)
        found = [
            fit(frequency, true * rng.gamma(n, 1 / n, len(true)), cov, INDEPENDENT)
            for _ in range(n_draws)
        ]
        values = np.array([each.values for each in found])
        errors = np.array([each.errors for each in found])
        covers = (np.abs(values - TERMS) < 1.96 * errors).mean(axis=0)
        relative = values / TERMS
        scatter = relative.std(axis=0) / np.sqrt(n_draws)
        panels += [
            Panel(
                f"({'ac'[number]}) coverage, {n} averages",
                "term: random walk, flicker, white, f²",
                COVERAGE_LABEL,
                (
                    Series(
                        f"{n} averages",
                        "terms",
                        "share",
                        tuple(
                            share(k, float(c), n_draws, NOMINAL, COVERAGE_TOLERANCE)
                            for k, c in enumerate(covers)
                        ),
                    ),
                ),
            ),
            Panel(
                f"({'bd'[number]}) bias, {n} averages",
                "term: random walk, flicker, white, f²",
                BIAS_LABEL,
                (
                    Series(
                        f"{n} averages",
                        "terms",
                        "bias",
                        tuple(
                            # weights follow from the estimate: a bias of order 1 / n
                            Point(k, float(m), 0.0, float(s), 0.3 / n)
                            for k, (m, s) in enumerate(
                                zip(relative.mean(axis=0) - 1, scatter, strict=True)
                            )
                        ),
                    ),
                ),
            ),
        ]
    return Study("noise-terms", f"Noise parameters, {n_draws} draws", tuple(panels))


ESTIMATES: Mapping[str, _STUDY] = {
    "coverage": coverage,
    "small-samples": small_samples,
    "many-sensors": many_sensors,
    "quiet": quiet,
    "unequal": unequal,
    "noise-terms": noise_terms,
}
