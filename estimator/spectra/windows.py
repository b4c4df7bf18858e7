"""Windows, and the number of independent averages of overlapping segments."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from estimator.errors import EstimatorError

if TYPE_CHECKING:
    from estimator.types import FloatArray

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
