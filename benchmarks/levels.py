"""Levels of 30 bands of nine channels: time of all that is between averages and intervals."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.row import Row, least_work
from estimator.levels.bands import band_levels, log_edges
from estimator.levels.pooled import blocks_of
from estimator.methods import self_noise
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import wishart

N_BANDS, N_AVERAGES, DIMS = 30, 190, (3, 3, 3)
SCENES = {
    "no axis resolved": (0.3, 0.3, 0.3),
    "one axis resolved": (1e3, 1.0, 1.0),
    "all axes resolved": (1e4, 1e4, 1e4),
}
"""SNR of each axis."""


def run(*, smallest: bool = False) -> list[Row]:
    """Measure."""
    frequency = 0.2 * np.arange(101 if smallest else 501, dtype=np.float64)
    rows = []
    for name, snr in SCENES.items():
        rng = np.random.default_rng(1)
        axes = np.concatenate([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in DIMS])
        csm = (axes * snr) @ axes.T + np.eye(len(axes))
        averages = wishart(csm, N_AVERAGES, rng, n_draws=len(frequency))
        whole, method = least_work(
            partial(_levels, averages, frequency),
            partial(self_noise, "three-sensor", averages, dims=DIMS, n_effective=N_AVERAGES),
        )
        rows.append(
            Row(
                f"levels and intervals of 30 bands × 9 channels, {name}, without the method",
                (whole - method) / (9 * N_BANDS) * 1e6,
                "µs a channel-band",
                at_most=50.0,
                note=f"{len(frequency)} frequencies; with the method {whole / method:.2f} times it",
            )
        )
    return rows


def _levels(averages: ComplexArray, frequency: FloatArray) -> None:
    found = self_noise(
        "three-sensor",
        averages,
        dims=DIMS,
        n_effective=N_AVERAGES,
        blocks=blocks_of(frequency),
    )
    edges = log_edges(frequency, N_BANDS)
    band_levels(found.noise_psd, found.cumulants, edges, np.ones(1)).interval()
