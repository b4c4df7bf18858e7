"""Averages drawn from known matrices: sensors of any direction that share one motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOTION = (1.0, 1.5, 0.8)
"""PSD along three axes, in units of the SNR."""


def averaged(csm: ComplexArray, n_averages: int, rng: np.random.Generator) -> ComplexArray:
    """Draw cross-spectral matrices averaged over independent segments: complex Wishart matrices.

    Parameters
    ----------
    csm : complex128, shape (..., n_channels, n_channels)
        True matrices, positive definite.
    n_averages : int
        At least as many as channels.
    rng : Generator
    """
    p = csm.shape[-1]
    i = np.arange(p)
    # Bartlett's decomposition
    lower = np.tril(rng.standard_normal(csm.shape) + 1j * rng.standard_normal(csm.shape), -1)
    lower /= np.sqrt(2)
    lower[..., i, i] = np.sqrt(rng.gamma(n_averages - i, size=(*csm.shape[:-2], p)))
    factor = np.linalg.cholesky(csm) @ lower
    return np.asarray(factor @ factor.conj().swapaxes(-1, -2) / n_averages)


def bench(
    rng: np.random.Generator,
    *,
    n_sensors: int = 3,
    d: int = 3,
    snr: float,
    noise_psd: FloatArray | None = None,
    shared: Sequence[tuple[int, int]] = (),
    coherency: float = 0.0,
) -> ComplexArray:
    """Return the true matrix of sensors of d channels each, turned at random.

    Parameters
    ----------
    rng : Generator
    n_sensors, d : int
    snr : float
        Motion over a noise PSD of 1.
    noise_psd : float64, shape (n_sensors * d,), optional
        1 by default.
    shared : sequence of (int, int)
        Pairs of channels whose noise has this `coherency`.

    Returns
    -------
    complex128, shape (n_sensors * d, n_sensors * d)
    """
    p = n_sensors * d
    directions = np.vstack([np.linalg.qr(rng.standard_normal((d, d)))[0] for _ in range(n_sensors)])
    root = np.ones(p) if noise_psd is None else np.sqrt(noise_psd)
    noise = np.eye(p)
    for one, other in shared:
        noise[one, other] = noise[other, one] = coherency
    motion = directions @ np.diag(MOTION[:d]) @ directions.T
    return np.asarray(snr * motion + noise * np.outer(root, root), dtype=np.complex128)
