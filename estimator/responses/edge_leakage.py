"""Leakage at the edges of segments by unequal transfer functions, and measured responses.

Theory of operation
-------------------
Let a channel have the response D to the motion m. Its windowed spectrum is to first order
``D M + D' M'``, with D' the slope of D per Hz and M' the transform of m under the slope of the
window. M' is independent of M, and its PSD is `slope_factor` times that of M: 1 / (3 T²) for a Hann
window of length T. The part of ``D' M'`` that is equal in all channels is common motion; the rest
is noise of the channels that differ.

The responses follow from the averages. A constant real combination of the channels of sensor j
predicts channel c up to one complex factor, ``D_cj = S_cz / S_yz``, where y is the prediction by j,
and z that by a third sensor. No channel's noise biases it. Of several third sensors the weighted
mean is taken, with weights ``|S_yz|² / S_zz``: their predictions may have any sign and phase.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from estimator.likelihood.dimension import bands
from estimator.self_noise.coherency import check_dims, other_channels, own_channels

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray

MIN_COHERENCE = 0.3
"""Minimum coherence between a channel and its prediction at a used frequency."""
_TWO_FREQUENCIES = 1.67  # 2 (1 - 1/6): variance of a difference two bins apart under Hann
_CORRELATED = 2.0  # variance of a sum over that of independent frequencies
_MAX_FREQUENCIES = 256  # maximum number of frequencies for the directions
_RIDGE = 1e-9  # fraction of the mean power: keeps matrices regular with a dead direction


def slope_factor(window: FloatArray, sampling_rate: float) -> float:
    """Return the PSD of motion under the slope of a window over that of the motion, in Hz².

    ``sum (dw/dt)² / (4 pi² sum w²)``, including the jumps at both ends.

    Parameters
    ----------
    window : float64, shape (length,)
    sampling_rate : float
        Hz.
    """
    steps = np.diff(window, prepend=0.0, append=0.0) * sampling_rate
    return float(steps @ steps / (4 * np.pi**2 * (window @ window)))


def scatter_of_slopes(window: FloatArray, sampling_rate: float) -> float:
    """Return the leakage that the noise of one average feigns, as a share of the noise.

    Both predictions of a channel have its own noise in common, so the product of their slopes has a
    mean of ``slope_factor 2 (1 - ρ²) / (2 / T)²`` over the number of averages, with the correlation
    ρ of spectra two bins apart. It is 0.16 for a Hann window, and 25 for a rectangular one of 1000
    samples, whose slope is two jumps.

    Parameters
    ----------
    window : float64, shape (length,)
    sampling_rate : float
        Hz.
    """
    power = window**2
    turn = np.exp(4j * np.pi * np.arange(len(window)) / len(window))
    rho = abs(power @ turn) / power.sum()
    width = 2 * sampling_rate / len(window)
    return float(slope_factor(window, sampling_rate) * 2 * (1 - rho**2) / width**2)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelResponses:
    """Responses of every channel relative to each other sensor.

    Attributes
    ----------
    frequency : float64, shape (n_freqs,)
        Hz.
    ratio : complex128, shape (n_freqs, n_channels, n_sensors)
        D: response of the channel over that of the sensor's channels in its direction, up to a
        constant factor. NaN for the channel's own sensor and for sensors that cannot predict it.
    coherence : float64, shape (n_freqs, n_channels, n_sensors)
        Magnitude squared coherence of the channel and its prediction.
    """

    frequency: FloatArray
    ratio: ComplexArray
    coherence: FloatArray

    def slopes(self) -> ComplexArray:
        """Return ``D' / D`` per Hz, by central differences, with the shape of `ratio`."""
        f, ratio = self.frequency, self.ratio
        slopes = np.full_like(ratio, np.nan)
        width = (f[2:] - f[:-2])[:, None, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            slopes[1:-1] = (ratio[2:] - ratio[:-2]) / width / ratio[1:-1]
        return slopes

    def leakage(
        self, motion_psd: FloatArray, factor: float, *, n_effective: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return the leakage into the noise of every channel, and its standard deviation.

        Parameters
        ----------
        motion_psd : float64, shape (n_freqs, n_channels)
            PSD of the motion in each channel.
        factor : float
            `slope_factor` of the window.
        n_effective : float

        Returns
        -------
        leakage, deviation : float64, shape (n_freqs, n_channels)
            Excess PSD of estimates by triads of sensors; 0 if unknown.

        Notes
        -----
        ``factor Re[(D_cj'/D_cj) conj(D_ck'/D_ck)] P_c``, averaged over the pairs of sensors j, k:
        the product of the errors of the two predictions of channel c in a triad. Their common noise
        is in it: `scatter_of_slopes`; the variance of ``D'/D`` is that of a ratio of
        averages, ``(1 / g - 1) / n`` at coherence g, at two frequencies.
        """
        slopes, f = self.slopes(), self.frequency
        variance = np.full(slopes.shape, np.inf)
        width = (f[2:] - f[:-2])[:, None, None]
        with np.errstate(divide="ignore"):
            own = (1 / self.coherence[1:-1] - 1) / max(n_effective, 1.0)
        own[self.coherence[1:-1] < MIN_COHERENCE] = np.inf
        variance[1:-1] = _TWO_FREQUENCIES * own / width**2
        count = np.zeros(slopes.shape[:2], np.int64)
        total, deviation = np.zeros((2, *slopes.shape[:2]))
        for j, k in combinations(range(slopes.shape[2]), 2):  # one by one, to bound memory
            product = (slopes[:, :, j] * slopes[:, :, k].conj()).real
            with np.errstate(invalid="ignore"):
                spread = np.sqrt(variance[:, :, j] * variance[:, :, k])
            known = np.isfinite(product) & np.isfinite(spread)
            count += known
            total += np.where(known, product, 0.0)
            deviation += np.where(known, spread, 0.0)
        count = np.maximum(count, 1)
        power = np.where(np.isfinite(motion_psd), np.maximum(motion_psd, 0.0), 0.0) * factor
        return np.asarray(power * (total / count)), np.asarray(power * (deviation / count))


def band_shares(
    leakage: FloatArray, deviation: FloatArray, noise_psd: FloatArray, frequency: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return leakage over noise in third-octave bands, at each frequency of the bands.

    Parameters
    ----------
    leakage, deviation, noise_psd : float64, shape (n_freqs, n_channels)
        As from `ChannelResponses.leakage`.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.

    Returns
    -------
    share, deviation : float64, shape (n_freqs, n_channels)
        0 if the noise is unknown.
    """
    number = bands(frequency)
    known = np.isfinite(leakage) & np.isfinite(noise_psd)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    noise = np.add.reduceat(np.where(known, noise_psd, 0.0), starts)
    total = np.add.reduceat(np.where(known, leakage, 0.0), starts)
    squares = np.add.reduceat(np.where(known, deviation**2, 0.0), starts)
    scale = np.where(noise > 0, 1 / np.where(noise > 0, noise, 1.0), 0.0)
    return (total * scale)[number], (np.sqrt(_CORRELATED * squares) * scale)[number]


def channel_responses(
    csm: ComplexArray, frequency: FloatArray, *, dims: tuple[int, ...]
) -> ChannelResponses:
    """Return the responses of every channel relative to each other sensor.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
        Channels of each sensor.

    Returns
    -------
    ChannelResponses
    """
    check_dims(dims)
    n_freqs, n_channels = csm.shape[:2]
    n_sensors = len(dims)
    usable = np.isfinite(csm).all(axis=(1, 2)) & (frequency > 0)
    csm = np.where(usable[:, None, None], csm, 0.0)
    own = [np.array(own_channels(dims, sensor)) for sensor in range(n_sensors)]
    ratio = np.full((n_freqs, n_channels, n_sensors), np.nan, dtype=np.complex128)
    coherence = np.zeros((n_freqs, n_channels, n_sensors))
    directions = _directions(csm, dims, own)
    for c in range(n_channels):
        around = [j for j in range(n_sensors) if (c, j) in directions]
        if len(around) < 2:
            continue
        # Predictions of channel c by each sensor, and their cross-spectra.
        to = np.zeros((len(around), n_channels))
        for row, j in enumerate(around):
            to[row, own[j]] = directions[c, j]
        predicted = csm @ to.T
        crossed = predicted[:, c]  # S_c,y
        among = to @ predicted  # S_y,y'
        power = np.maximum(csm[:, c, c].real, 0.0)
        for row, j in enumerate(around):
            others = [n for n in range(len(around)) if n != row]
            S_cz, S_yz = crossed[:, others], among[:, row, others]
            S_zz = np.array([among[:, n, n].real for n in others]).T
            with np.errstate(invalid="ignore", divide="ignore"):
                weight = np.where(S_zz > 0, S_yz.conj() / S_zz, 0.0)
                sizes = (weight * S_yz).sum(axis=1)
                mean = (weight * S_cz).sum(axis=1) / sizes
                ratio[:, c, j] = np.where(usable & (sizes != 0), mean, np.nan)
                found = np.abs(crossed[:, row]) ** 2 / (power * among[:, row, row].real)
            coherence[:, c, j] = np.where(np.isfinite(found), np.clip(found, 0.0, 1.0), 0.0)
    return ChannelResponses(frequency, ratio, coherence)


def _directions(
    csm: ComplexArray, dims: tuple[int, ...], own: list[np.ndarray]
) -> dict[tuple[int, int], FloatArray]:
    """Return the real combinations of a sensor's channels that predict a channel, up to a factor.

    This is the main direction of the rows ``S_ck S_jk^-1`` of the relative response over all
    frequencies, weighted by signal-to-noise ratio; complex factors do not change it.
    """
    power = np.einsum("fpp->fp", csm).real
    alive = (power > 0).all(axis=1)
    some = np.flatnonzero(alive)
    some = some[:: max(1, len(some) // _MAX_FREQUENCIES)]
    found: dict[tuple[int, int], FloatArray] = {}
    if not len(some):
        return found
    scale = np.sqrt(power[some])
    part = csm[some] / (scale[:, :, None] * scale[:, None, :])
    for j in range(len(dims)):
        for i in range(len(dims)):
            rest = other_channels(dims, i, j)
            if i == j or len(rest) < dims[j]:
                continue
            S_jk = part[:, own[j][:, None], rest]
            S_ck = part[:, own[i][:, None], rest]
            adjoint = S_jk.conj().swapaxes(1, 2)
            normal = S_jk @ adjoint
            ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2).real / dims[j] + 1e-300
            rows = np.linalg.solve(
                (normal + ridge[:, None, None] * np.eye(dims[j])).swapaxes(1, 2),
                (S_ck @ adjoint).swapaxes(1, 2),
            ).swapaxes(1, 2)  # in units of the channels' own amplitudes
            own_csm = part[:, own[j][:, None], own[j]]
            predicted = np.einsum("fcj,fjk,fck->fc", rows, own_csm, rows.conj()).real
            with np.errstate(invalid="ignore", divide="ignore"):
                cross = np.einsum(
                    "fcj,fcj->fc", rows, part[:, own[j][:, None], own[i]].swapaxes(1, 2)
                )
                g = np.clip(np.abs(cross) ** 2 / predicted, 0.0, 1 - 1e-9)
            g = np.where(np.isfinite(g) & (g > MIN_COHERENCE), g, 0.0)
            rows = rows * scale[:, own[i]][:, :, None] / scale[:, None, own[j]]
            size = np.einsum("fcj,fcj->fc", rows, rows.conj()).real
            weight = g / (1 - g) / np.where(size > 0, size, np.inf)
            moment = np.einsum("fc,fcj,fck->cjk", weight, rows, rows.conj()).real
            for row, c in enumerate(own[i].tolist()):
                if weight[:, row].any():
                    found[c, j] = np.linalg.eigh(moment[row])[1][:, -1]
    return found
