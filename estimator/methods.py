"""All self-noise methods, with a common signature."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from estimator.errors import EstimatorError, UnknownMethodError
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from estimator.self_noise import uncertainty
from estimator.self_noise.result import Flag, SelfNoise
from estimator.self_noise.three_channel import three_channel
from estimator.self_noise.three_sensor import three_sensor
from estimator.self_noise.two_channel import two_channel

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from estimator.types import BoolArray, ComplexArray

__all__ = ["METHODS", "Flag", "Method", "SelfNoise", "self_noise"]


Method: TypeAlias = "Callable[..., SelfNoise]"
"""``method(csm, *, dims, n_effective, correct, **options)``."""

METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "two-channel": two_channel,
        "three-channel": three_channel,
        "three-sensor": three_sensor,
        "maximum-likelihood": maximum_likelihood,
    }
)


def self_noise(
    method: str,
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    correct: bool = True,
    real: BoolArray | None = None,
    **options: Any,  # noqa: ANN401 - each method's own
) -> SelfNoise:
    """Return the self-noise PSD of every channel by a named method.

    Parameters
    ----------
    method : str
        One of `METHODS`.
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
        Number of independent averages in `csm`.
    correct : bool
        Remove the small-sample bias.
    real : bool, shape (n_freqs,), optional
        Whether the spectra are real-valued, with twice the variance: at 0 Hz and at the Nyquist
        frequency (`estimator.spectra.welch.WelchSettings.real`). Default: nowhere.
    **options
        Options of the method.

    Returns
    -------
    SelfNoise

    Raises
    ------
    UnknownMethodError
        If no method has this name.
    EstimatorError
        As the method, or if `real` is not one bool per frequency.
    """
    if method not in METHODS:
        raise UnknownMethodError(f"method {method!r}: expected one of {', '.join(METHODS)}")
    found = METHODS[method](csm, dims=dims, n_effective=n_effective, correct=correct, **options)
    if real is None:
        return found
    real = np.asarray(real)
    if real.shape != (len(csm),) or real.dtype != np.bool_:
        raise EstimatorError(
            f"real of shape {real.shape} and type {real.dtype}, expected bool of ({len(csm)},)"
        )
    return uncertainty.widened(found, real)
