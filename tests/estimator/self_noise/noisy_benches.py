"""Cross-spectral matrices of benches whose noise is known."""

from __future__ import annotations

import numpy as np

from estimator.types import ComplexArray
from tests.estimator.csm_models import random_bench

BENCHES = [(1, 1, 1), (2, 2, 2), (3, 3, 3), (2, 2, 2, 2), (3, 3, 3, 3, 3)]


def bench(dims: tuple[int, ...], snr: float, seed: int = 0) -> tuple[ComplexArray, np.ndarray]:
    rng = np.random.default_rng(seed)
    noise_psd = rng.uniform(0.5, 2, sum(dims))
    return random_bench(rng, dims=dims, snr=snr, noise_psd=noise_psd), noise_psd
