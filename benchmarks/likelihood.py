"""Maximum likelihood against the three-sensor estimate: time, and precision against the bound."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.row import Row, least_work
from estimator.likelihood import fisher
from estimator.likelihood.dimension import choose_dimension
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from estimator.self_noise.three_sensor import three_sensor
from tests.estimator.csm_models import (
    common_motion,
    pentagon,
    planar_sensors,
    plane_waves,
    random_bench,
    wishart,
)

N_AVERAGES = 1080


def run(*, smallest: bool = False) -> list[Row]:
    """Measure."""
    n_freqs, n_draws = (20, 200) if smallest else (1001, 4000)
    return [*_time(n_freqs), *_precision(n_draws), *_incoherence()]


def _time(n_freqs: int) -> list[Row]:
    rows = []
    for n_sensors in (3, 5):
        rng = np.random.default_rng(1)
        dims = (3,) * n_sensors
        csm = random_bench(rng, dims=dims, snr=1e3, noise_psd=np.ones(3 * n_sensors))
        averages = wishart(csm, N_AVERAGES, rng, n_draws=n_freqs)
        simple, likely = least_work(
            partial(three_sensor, averages, dims=dims, n_effective=N_AVERAGES),
            partial(maximum_likelihood, averages, dims=dims, n_effective=N_AVERAGES),
        )
        rows.append(
            Row(
                f"maximum likelihood over three-sensor with c.o.v., {n_freqs} × {3 * n_sensors}",
                likely / simple,
                "×",
                at_most=10.0 if n_sensors == 3 else None,
                note=f"{likely * 1e3:.0f} ms; eigendecompositions are two thirds of it",
            )
        )
    return rows


def _precision(n_draws: int) -> list[Row]:
    rng = np.random.default_rng(2)
    ones = np.ones(6)
    geometries = {
        "orthogonal, equal noise": (planar_sensors(10), ones, (2,) * 3),
        "30° channels turned by 60°": (planar_sensors(60, channel_angle_deg=30), ones, (2,) * 3),
        "two sensors 10× noisier": (planar_sensors(10), np.repeat([1.0, 10, 10], 2), (2,) * 3),
        "one sensor 100× noisier": (planar_sensors(10), np.repeat([1.0, 1, 100], 2), (2,) * 3),
        "five triaxial": (np.tile(np.eye(3), (5, 1)), np.ones(15), (3,) * 5),
    }
    rows = []
    for name, (directions, noise_psd, dims) in geometries.items():
        csm = common_motion(directions, noise_psd, snr=1e3)
        bound = fisher.cramer_rao_cov(
            csm[None], noise_psd[None], n_effective=N_AVERAGES, dims=dims
        )[0]
        averages = wishart(csm, N_AVERAGES, rng, n_draws=n_draws)
        found = maximum_likelihood(averages, dims=dims, n_effective=N_AVERAGES)
        cov = found.noise_psd.std(axis=0) / noise_psd
        rows.append(
            Row(
                f"c.o.v. of maximum likelihood over Cramér–Rao bound: {name}",
                float(np.sqrt(np.mean((cov / bound) ** 2))),
                "×",
                at_most=1.05,
                note=f"c.o.v. {cov.min():.3g} to {cov.max():.3g}, n = {N_AVERAGES}",
            )
        )
    return rows


def _incoherence() -> list[Row]:
    """Item 9 of method.md, at 20 and 50 Hz."""
    dims = (3,) * 5
    rows = []
    for centre, limit in ((20.0, 0.05), (50.0, 0.20)):
        frequency = centre * np.linspace(0.95, 1.05, 64)
        band = np.zeros(64, np.int64)
        csm = plane_waves(frequency, pentagon(), snr=400.0)
        averages = wishart(csm, N_AVERAGES, np.random.default_rng(3))[0]
        n_factors, (choice,) = choose_dimension(
            averages, frequency, dims=dims, n_effective=N_AVERAGES, band=band
        )
        found = maximum_likelihood(averages, dims=dims, n_effective=N_AVERAGES, n_factors=n_factors)
        plain = three_sensor(averages, dims=dims, n_effective=N_AVERAGES)
        rows.append(
            Row(
                f"bias in plane waves at {centre:g} Hz, dimension auto",
                float(abs(found.noise_psd.mean() - 1)) * 100,
                "%",
                at_most=limit * 100,
                note=f"three-sensor {(plain.noise_psd.mean() - 1) * 100:+.0f} %; "
                f"{choice.n_factors} dimensions, c.o.v. of one bin {choice.cov:.2g}",
            )
        )
    return rows
