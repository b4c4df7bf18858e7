"""True cross-spectral matrices with known noise, and sample matrices drawn from them."""

from __future__ import annotations

import numpy as np

from estimator.types import ComplexArray, FloatArray

MOTION_PSD = {1: (1.0,), 2: (1.0, 1.5), 3: (1.0, 1.5, 0.8)}
"""White motion by dimension, along x, y, z; two dimensions as in section 2.3 of the paper."""


def wishart(
    csm: ComplexArray, n_averages: int, rng: np.random.Generator, *, n_draws: int = 1
) -> ComplexArray:
    """Sample cross-spectral matrices, averaged over independent segments.

    Parameters
    ----------
    csm : complex128, shape (..., n_channels, n_channels)
        True matrices; positive definite.
    n_averages : int
        Independent segments averaged, at least ``n_channels``.
    rng : numpy.random.Generator
    n_draws : int
        Draws of each matrix.

    Returns
    -------
    complex128, shape (n_draws, ..., n_channels, n_channels)
        Complex Wishart matrices over ``n_averages``, by Bartlett's decomposition.
    """
    p = csm.shape[-1]
    shape = (n_draws, *csm.shape)
    lower = np.tril(rng.standard_normal(shape) + 1j * rng.standard_normal(shape), -1) / np.sqrt(2)
    i = np.arange(p)
    lower[..., i, i] = np.sqrt(rng.gamma(n_averages - i, size=(*shape[:-2], p)))
    factor = np.linalg.cholesky(csm) @ lower
    return np.asarray(factor @ factor.conj().swapaxes(-1, -2) / n_averages, np.complex128)


def white(rng: np.random.Generator, *shape: int) -> ComplexArray:
    """Complex white noise of variance 2."""
    return np.asarray(rng.standard_normal(shape) + 1j * rng.standard_normal(shape))


def rotation(rng: np.random.Generator, dims: int) -> FloatArray:
    """Rotation uniform over all of them, shape (dims, dims)."""
    q, r = np.linalg.qr(rng.standard_normal((dims, dims)))
    return np.asarray(q * np.sign(np.diag(r)))


def planar_sensors(theta_deg: float, *, channel_angle_deg: float = 90.0) -> FloatArray:
    """Three biaxial sensors of section 3.5, Fig. 11: the second and third turned by theta.

    Returns
    -------
    float64, shape (6, 2)
        Direction cosines of the channels along x and y.
    """
    alpha, theta = np.deg2rad([channel_angle_deg, theta_deg])
    angles = np.array([0, alpha, theta, theta + alpha, theta, theta + alpha])
    return np.column_stack([np.cos(angles), np.sin(angles)])


def common_motion(directions: FloatArray, noise_psd: FloatArray, *, snr: float) -> ComplexArray:
    """Cross-spectral matrix of collocated sensors that feel one motion, shape (p, p).

    ``directions`` has shape (p, d); ``snr`` is the motion's PSD along x over a noise PSD of 1.
    """
    motion = np.diag(MOTION_PSD[directions.shape[1]]) * snr
    return np.asarray(directions @ motion @ directions.T + np.diag(noise_psd), np.complex128)


def random_bench(
    rng: np.random.Generator, *, dims: tuple[int, ...], snr: float, noise_psd: FloatArray
) -> ComplexArray:
    """`common_motion` of sensors with random orientations, triaxial motion projected on each."""
    d = max(dims)
    directions = np.concatenate([rotation(rng, d)[:k] for k in dims])
    return common_motion(directions, noise_psd, snr=snr)


PENTAGON_M = 0.12
"""Side of the regular pentagon on which five sensors stand, metres."""


def pentagon(side: float = PENTAGON_M) -> FloatArray:
    """Positions of five sensors, neighbours ``side`` metres apart, shape (5, 2)."""
    angles = 2 * np.pi * np.arange(5) / 5
    radius = side / (2 * np.sin(np.pi / 5))
    return np.asarray(radius * np.column_stack([np.cos(angles), np.sin(angles)]))


def plane_waves(
    frequency: FloatArray,
    positions: FloatArray,
    *,
    snr: float = 1e3,
    speed: float = 150.0,
    n_directions: int = 360,
) -> ComplexArray:
    """Item 9's scene: Rayleigh, Love and vertical plane waves from all directions, noise PSD 1.

    Three independent isotropic fields of horizontally travelling waves: Rayleigh (radial, with
    the vertical a quarter period behind), Love (transverse) and vertical. The integral over
    directions is a sum; it is exact to rounding while the aperture stays far below
    ``n_directions`` wavelengths.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz.
    positions : float64, shape (n_sensors, 2)
        Metres; the sensors are triaxial and aligned with x, y, z.
    snr : float
        PSD of each horizontal component over the noise's.

    Returns
    -------
    complex128, shape (n_freqs, 3 * n_sensors, 3 * n_sensors)
    """
    azimuth = 2 * np.pi * np.arange(n_directions) / n_directions
    heading = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    c, s = heading.T
    zero, one = np.zeros_like(c), np.ones_like(c)
    polarisation = np.stack(
        [np.stack([c, s, -1j * one]), np.stack([-s, c, zero]), np.stack([zero, zero, one])]
    )
    delay = positions @ heading.T / speed
    phase = np.exp(-2j * np.pi * frequency[:, None, None] * delay)
    waves = polarisation[None, :, None] * phase[:, None, :, None, :]
    waves = waves.transpose(0, 2, 3, 1, 4).reshape(len(frequency), 3 * len(positions), -1)
    csm = snr / n_directions * waves @ waves.conj().swapaxes(-1, -2)
    return np.asarray(csm + np.eye(3 * len(positions)), np.complex128)
