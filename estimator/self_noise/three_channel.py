"""The three-channel method of Sleeman and co-workers."""

from __future__ import annotations

import numpy as np

from estimator.errors import InsufficientDataError
from estimator.self_noise.coherency import check_dims, coherency
from estimator.self_noise.result import Flag, SelfNoise
from estimator.self_noise.three_sensor import estimate
from estimator.types import ComplexArray


def three_channel(
    csm: ComplexArray, *, dims: tuple[int, ...], n_effective: float, correct: bool = True
) -> SelfNoise:
    """Return the self-noise PSD from three or more parallel channels.

    Channel r of a sensor is compared only with channels r of all other sensors.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    dims : tuple of int
        Number of channels of each sensor. If fewer than two other sensors have a channel r,
        channel r is flagged NO_COUNTERPART.
    n_effective : float
        Number of independent averages in `csm`.
    correct : bool
        Divide by ``1 - 1 / n_effective``, which removes the small-sample bias.

    Returns
    -------
    SelfNoise

    Raises
    ------
    InvalidMatrixError
        If `csm` is not a cross-spectral matrix of these sensors.
    InsufficientDataError
        With fewer than three sensors, or ``n_effective <= 1``.

    Notes
    -----
    The real part of Eq. (6) of Zhu, Au and Wang; the unweighted mean over all pairs of other
    channels, also with poor sensors, as published.
    Biased if the channels are not parallel: see `estimator.self_noise.bias`.
    """
    check_dims(dims)
    given = coherency(csm, dims)
    first = np.cumsum([0, *dims[:-1]])
    parts = [
        [int(start) + r for start, n in zip(first, dims, strict=True) if n > r]
        for r in range(max(dims))
    ]
    compared = [part for part in parts if len(part) >= 3]
    if not compared:
        raise InsufficientDataError(f"sensors of {dims} channels: no three of them share a channel")
    values = np.full((4, *given.psd.shape), np.nan)  # noise, and its cumulants
    flags = given.flags | Flag.NO_COUNTERPART
    for part in compared:
        result = estimate(
            given.part(part),
            dims=(1,) * len(part),
            n_effective=n_effective,
            correct=correct,
            weighted=False,
        )
        values[:, :, part] = result.noise_psd, *result.cumulants
        flags[:, part] = result.flags
    return SelfNoise.of("three-channel", values[0], values[1:], flags)
