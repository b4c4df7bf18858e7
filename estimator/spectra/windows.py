"""Windows, and the number of independent averages of overlapping segments.

Segments with short gaps have a common window that is zero in the gaps. All channels of all sensors
are multiplied by one function of time: 0 in every gap of any sensor, 1 elsewhere, with cosine ramps
between. Common motion remains common with any window, and so is removed as before. After division
by the energy of the window, the noise keeps its PSD if its spectrum is smooth. At frequencies with
much lower noise than elsewhere, the side lobes of the window add noise from other frequencies:
`WindowLeakage` computes this bias.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from estimator.errors import EstimatorError
from estimator.types import BoolArray, FloatArray

Window: TypeAlias = "str | tuple[str | float, ...] | FloatArray"


def get_window(window: Window, length: int) -> FloatArray:
    """Return a window of `length` samples, periodic (for spectra, not for filters).

    Parameters
    ----------
    window : str, tuple or float64 array of shape (length,)
        ``"hann"``, ``"rectangular"``, anything ``scipy.signal.get_window`` knows, with
        parameters as in ``"kaiser,8"`` or ``("kaiser", 8.0)``, or the samples themselves.
    length : int
        Number of samples.

    Returns
    -------
    float64, shape (length,)

    Raises
    ------
    EstimatorError
        If the window is unknown, has another length, is not finite or has no energy.
    """
    if length < 1:
        raise EstimatorError(f"window length {length}: expected at least one sample")
    if isinstance(window, str) and window in {"rectangular", "boxcar"}:
        return np.ones(length)
    if isinstance(window, str) and window in {"hann", "hanning"}:
        return np.asarray(0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length))
    if isinstance(window, (str, tuple)):
        from scipy import signal  # noqa: PLC0415 - takes a second to import; Hann needs none of it

        try:
            known: str | tuple[str | float, ...] = window
            if isinstance(window, str) and "," in window:
                name, *parameters = window.split(",")
                known = (name, *map(float, parameters))
            with np.errstate(all="ignore"):  # non-finite windows are refused below
                taps = np.asarray(signal.get_window(known, length), dtype=np.float64)  # type: ignore[arg-type]  # any name; unknown ones raise below
        except (ValueError, TypeError) as error:
            raise EstimatorError(f"window {window!r}: {error}") from error
    else:
        taps = np.array(window, dtype=np.float64)
    if taps.shape != (length,):
        raise EstimatorError(f"window of shape {taps.shape}, expected ({length},)")
    if not np.all(np.isfinite(taps)) or not np.any(taps):
        name = f"window {window!r}" if isinstance(window, (str, tuple)) else "window"
        raise EstimatorError(f"{name}: expected finite samples that are not all zero")
    return taps


def effective_averages(window: FloatArray, hop: int, n_segments: int) -> float:
    """Return the number of independent averages equivalent to overlapping segments.

    Parameters
    ----------
    window : float64, shape (length,)
        The window that multiplies each segment.
    hop : int
        Number of samples between the starts of consecutive segments.
    n_segments : int
        Number of averaged segments, contiguous without gaps.

    Returns
    -------
    float
        ``n_eff``, from 1 to `n_segments`; 0 for no segment.

    Notes
    -----
    Eq. (16) of Welch [1]_: the variance of the average is that of one segment times
    ``(1 + 2 sum_k (1 - k/n) rho_k) / n``, with ``rho_k`` the squared autocorrelation of the
    window at a lag of `k` hops.

    References
    ----------
    .. [1] P. D. Welch, "The use of fast Fourier transform for the estimation of power
       spectra", IEEE Trans. Audio Electroacoust. AU-15 (1967) 70-73.
    """
    if hop < 1:
        raise EstimatorError(f"hop {hop}: expected at least one sample")
    if n_segments < 0:
        raise EstimatorError(f"{n_segments} segments: expected 0 or more")
    if n_segments == 0:
        return 0.0
    energy = float(window @ window)
    lags = np.arange(1, min(n_segments, -(-len(window) // hop)))
    rho = np.array([(window[: -lag * hop] @ window[lag * hop :] / energy) ** 2 for lag in lags])
    return float(n_segments / (1 + 2 * np.sum((1 - lags / n_segments) * rho)))


RAMPS = 200
"""Length of a segment over the length of a ramp."""
SHORTEST_RAMP = 4
ITERATIONS = 8
"""Number of iterations for the PSD without leakage."""
MIN_OWN_SHARE = 0.02
"""Minimum share of the PSD that is attributed to its own frequency."""


def gap_window(usable: BoolArray, segment_length: int) -> FloatArray:
    """Return the window of a stretch of samples.

    Parameters
    ----------
    usable : bool, shape (n_samples,)
        False in gaps.
    segment_length : int

    Returns
    -------
    float64, shape (n_samples,)
        0 to 1.
    """
    ramp = max(SHORTEST_RAMP, segment_length // RAMPS)
    place = np.arange(len(usable))
    last = np.maximum.accumulate(np.where(usable, -ramp - 1, place))
    following = np.minimum.accumulate(np.where(usable, len(usable) + ramp, place)[::-1])[::-1]
    distance = np.minimum(np.minimum(place - last, following - place), ramp + 1)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * distance / (ramp + 1)))


def without_trend(segment: FloatArray, weight: FloatArray, detrend: str) -> FloatArray:
    """Return a segment without its trend, zero where it has no weight.

    Parameters
    ----------
    segment : float64, shape (n_samples, n_channels)
        Samples of zero weight have no effect.
    weight : float64, shape (n_samples,)
    detrend : {"none", "constant", "linear"}
    """
    kept = np.where(weight[:, None] > 0, segment, 0.0)
    if detrend != "none":
        degree = 1 if detrend == "linear" else 0
        line = np.linspace(-1.0, 1.0, len(segment))
        basis = np.stack([line**power for power in range(degree + 1)], axis=1)
        weighted = basis * weight[:, None]
        kept = kept - basis @ np.linalg.solve(weighted.T @ basis, weighted.T @ kept)
    return np.asarray(kept * weight[:, None])


class WindowLeakage:
    """Leakage of noise from other frequencies by the windows of segments with gaps.

    Parameters
    ----------
    window : float64, shape (length,)
        Window of complete segments.
    """

    def __init__(self, window: FloatArray) -> None:
        self._window = window
        self._whole = self._kernel(window)
        self._sum = np.zeros_like(self._whole)
        self.n_segments = 0
        self._lost = 0.0

    def add(self, weight: FloatArray) -> float:
        """Add the window of one segment; return its energy as a fraction of a complete one's."""
        window = self._window * weight
        self._sum += self._kernel(window)
        self.n_segments += 1
        energy = float(window @ window / (self._window @ self._window))
        self._lost += 1 - energy
        return energy

    @property
    def lost(self) -> float:
        """Mean fraction of the windows' energy lost to gaps."""
        return self._lost / max(1, self.n_segments)

    def bias(self, noise_psd: FloatArray) -> FloatArray:
        """Return the leakage as a fraction of the noise.

        Parameters
        ----------
        noise_psd : float64, shape (n_freqs, n_channels)
            At all frequencies of a segment; unknown values are taken from their neighbours.

        Returns
        -------
        float64, shape (n_freqs, n_channels)
            Fraction of the estimated PSD. Negative if noise leaks to other frequencies; 0 without
            segments.
        """
        if not self.n_segments:
            return np.zeros_like(noise_psd)
        length = len(self._window)
        two = np.arange(length + 1) / 2  # of zero-padded segments
        whole = np.fft.irfft(self._whole, 2 * length)
        with_gaps = np.fft.irfft(self._sum / self.n_segments, 2 * length)
        found = np.empty_like(noise_psd)
        for column, psd in enumerate(np.abs(noise_psd).T):
            known = np.flatnonzero(np.isfinite(psd) & (psd > 0))
            if not len(known):
                found[:, column] = 0.0
                continue
            seen = np.interp(two, known, psd[known])
            true = seen
            for _ in range(ITERATIONS):
                lags = np.fft.irfft(true, 2 * length)
                brought_in = np.fft.rfft(lags * (with_gaps - whole)).real
                true = np.maximum(seen - brought_in, MIN_OWN_SHARE * seen)
            found[:, column] = (brought_in / seen)[::2][: len(psd)]
        return found

    def _kernel(self, window: FloatArray) -> FloatArray:
        """Return the power of the window by frequency, normalised to autocorrelation 1 at lag 0."""
        power = np.abs(np.fft.rfft(window, 2 * len(window))) ** 2
        return np.asarray(power / np.fft.irfft(power, 2 * len(window))[0])
