"""Sensors that waves cross: the noise by gradients of the motion, in random layouts.

Rayleigh and Love waves of 150 m/s from all directions cross sensors within 12 cm of a point, at
least 8 cm apart and turned at random, at an SNR of 1000. Every band has 24 frequencies of their own
averages.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.studies.draws import averaged
from estimator.likelihood.dimension import choose_dimension
from estimator.likelihood.gradients import noise_by_gradients, with_gradients
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from sim_devices.world.plane_waves import field
from sim_devices.world.spectrum import White
from sim_devices.world.tables import PlaneWaves
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SNR, SPEED, RADIUS, NEAREST = 1e3, 150.0, 0.12, 0.08
CENTRES = (1.0, 3.5, 7.0, 14.0, 20.0, 30.0, 50.0)
N_FREQUENCIES = 24
N_LAYOUTS = 10
CASES: tuple[tuple[int, int, tuple[float, ...]], ...] = (
    (5, 1080, (0.02, 0.016, 0.009, 0.013, 0.020, 0.046, 0.20)),
    (5, 100, (0.06, 0.09, 0.046, 0.048, 0.049, 0.12, 0.27)),
    (4, 1080, (0.02, 0.19, 0.16, 0.14, 0.19, 0.25, 0.59)),
)
"""Sensors, averages, and the rms error of a channel's band mean that item 14 states: what a
prototype reached; at 1 Hz what the averages leave."""
INDEPENDENT = np.zeros(0)
_COVERS = 0.04


def layout(rng: np.random.Generator, n_sensors: int) -> FloatArray:
    """Return positions in metres, shape (n_sensors, 3)."""
    while True:
        radius = RADIUS * np.sqrt(rng.uniform(size=n_sensors))
        bearing = rng.uniform(0, 2 * np.pi, n_sensors)
        found = radius[:, None] * np.stack([np.cos(bearing), np.sin(bearing), 0 * bearing], axis=1)
        apart = np.linalg.norm(found[:, None] - found, axis=2) + np.eye(n_sensors)
        if apart.min() > NEAREST:
            return np.asarray(found)


def scene(rng: np.random.Generator, frequency: FloatArray, n_sensors: int) -> ComplexArray:
    """Return true cross-spectra of triaxial sensors with a noise PSD of 1."""
    waves = PlaneWaves(spectrum=White(level=1.0), speed=SPEED, from_below=0.0, n_directions=180)
    parts = []
    for position in layout(rng, n_sensors):
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        x, y, z = position.tolist()
        parts.append(turn @ field(waves, (x, y, z), frequency))
    amplitude = np.concatenate(parts, axis=1)
    motion = SNR * amplitude @ amplitude.conj().swapaxes(1, 2)
    return np.asarray(motion + np.eye(3 * n_sensors))


def gradients(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Estimate the noise of sensors that waves cross.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of `N_LAYOUTS` to simulate.
    """
    n_layouts = max(2, round(N_LAYOUTS * length))
    frequency = np.outer(CENTRES, np.linspace(0.95, 1.05, N_FREQUENCIES)).ravel()
    band = np.repeat(np.arange(len(CENTRES)), N_FREQUENCIES)
    panels: list[Panel] = []
    for case, (n_sensors, n, stated) in enumerate(CASES):
        rng = np.random.default_rng([27, case])
        dims = (3,) * n_sensors
        ratios, covered = [], []
        for number in range(n_layouts):
            progress(f"gradients: {n_sensors} sensors, {n} averages", number / n_layouts)
            csm = averaged(scene(rng, frequency, n_sensors), n, rng)
            n_factors, choices = choose_dimension(
                csm, frequency, dims=dims, n_effective=n, band=band, neighbours=INDEPENDENT
            )
            found = maximum_likelihood(csm, dims=dims, n_effective=n, n_factors=n_factors)
            of_motion, _ = with_gradients(
                csm, frequency, choices, dims=dims, n_effective=n, neighbours=INDEPENDENT
            )
            if of_motion is not None:
                found = noise_by_gradients(found, csm, of_motion, dims=dims, n_effective=n)
            ratios.append(found.noise_psd)
            covered.append((found.low < 1) & (found.high > 1))
        split = (n_layouts, len(CENTRES), N_FREQUENCIES, 3 * n_sensors)
        means = np.reshape(ratios, split).mean(axis=2)
        errors = np.sqrt(np.mean((means - 1) ** 2, axis=(0, 2)))
        shares = np.reshape(covered, split).mean(axis=(0, 2, 3))
        # channels of one sensor, and sensors of one layout, share part of their errors
        count = n_layouts * n_sensors
        panels += _panels(case, errors, shares, stated, count=count)
    return Study("gradients", f"Gradients of the motion, {n_layouts} random layouts", tuple(panels))


def _panels(
    case: int, errors: FloatArray, shares: FloatArray, stated: tuple[float, ...], *, count: int
) -> tuple[Panel, Panel]:
    n_sensors, n, _ = CASES[case]
    what = f"{n_sensors} sensors, {n} averages"
    error = tuple(
        Point(f, e, 0.0, e / np.sqrt(2 * count), most)
        for f, e, most in zip(CENTRES, errors.tolist(), stated, strict=True)
    )
    # intervals by free factors are wider than need be
    coverage = tuple(
        Point(f, s, 0.97, float(np.sqrt(0.95 * 0.05 / count / 3)), _COVERS)
        for f, s in zip(CENTRES, shares.tolist(), strict=True)
    )
    first, second = tuple("abcdef")[2 * case : 2 * case + 2]
    return (
        Panel(
            f"({first}) rms error of band means, {what}",
            "frequency (Hz)",
            "fraction of the noise (1)",
            (Series(what, "maximum-likelihood", "bias", error),),
            log="x",
        ),
        Panel(
            f"({second}) coverage, {what}",
            "frequency (Hz)",
            "share of intervals with the true noise (1)",
            (Series(what, "maximum-likelihood", "share", coverage),),
            log="x",
        ),
    )
