"""Motion of a floor by plane waves: coherence decreases with distance.

Rayleigh waves (horizontal along their direction, vertical with a delay of a quarter period) and
Love waves (horizontal across their direction) propagate in all directions at one speed; shear and
pressure waves arrive from below. All waves are independent, and each reaches a sensor at its own
time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sim_devices.arrays import ComplexArray, FloatArray
    from sim_devices.world.tables import PlaneWaves


def n_sources(waves: PlaneWaves) -> int:
    """Return the number of waves in the field."""
    return 2 * waves.n_directions + 3


def field(
    waves: PlaneWaves, position: tuple[float, float, float], frequency: FloatArray
) -> ComplexArray:
    """Return the amplitude of each wave at one position, for a unit spectrum in each direction.

    Parameters
    ----------
    waves
        The field.
    position
        In metres.
    frequency
        In Hz, shape (n_freqs,).

    Returns
    -------
    complex128, shape (n_freqs, 3, n_sources)
        Amplitude A with ``A(f, x) A(f, y)^H`` the coherency between positions x and y: the unit
        matrix for x = y.
    """
    n = waves.n_directions
    bearing = 2 * np.pi * (np.arange(n) + 0.5) / n
    along = np.array([np.cos(bearing), np.sin(bearing), np.zeros(n)])
    across = np.array([-np.sin(bearing), np.cos(bearing), np.zeros(n)])
    up = np.array([[0.0], [0.0], [1.0]])

    surface = 1 - waves.from_below  # share of Rayleigh waves in the vertical motion
    rayleigh = surface * waves.ellipticity**2 / 2  # and in each horizontal direction
    shape = np.concatenate(
        [
            np.sqrt(surface / n) * (waves.ellipticity * along - 1j * up),
            np.sqrt(2 * (surface - rayleigh) / n) * across,
            np.sqrt(waves.from_below) * np.eye(3),
        ],
        axis=1,
    )
    shape = np.where(frequency[:, None, None] > 0, shape, shape.real)  # real at 0 Hz
    slowness = np.concatenate([along, along, np.tile(up, 3)], axis=1) / waves.speed
    delay = np.asarray(position) @ slowness
    return np.asarray(shape * np.exp(-2j * np.pi * frequency[:, None, None] * delay))
