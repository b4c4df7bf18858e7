"""All self-noise methods, with a common signature."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from estimator.errors import EstimatorError, UnknownMethodError
from estimator.levels.interval import unpredicted
from estimator.levels.lags import phases
from estimator.levels.noise_matrices import together
from estimator.levels.pooled import EQUATIONS, most_pooled, pooled_noise
from estimator.likelihood.maximum_likelihood import maximum_likelihood
from estimator.median import median
from estimator.self_noise.coherency import Coherency, check_averages, coherency
from estimator.self_noise.result import Flag, SelfNoise
from estimator.self_noise.three_channel import three_channel
from estimator.self_noise.three_sensor import three_sensor
from estimator.self_noise.two_channel import two_channel
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

__all__ = ["METHODS", "Flag", "Method", "SelfNoise", "self_noise"]


SMOOTH = 400.0
"""Averages on which the course of the noise in a block rests."""
BENT = 1.5
"""Mean of the channels over their median, above which one of them bends their course."""

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
    blocks: IntArray | None = None,
    correlation: FloatArray | None = None,
    groups: IntArray | None = None,
    known: SelfNoise | None = None,
    inflation: FloatArray | float = 1.0,
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
    blocks : int64, shape (n_freqs,), optional
        Block of neighbours of every frequency (`estimator.levels.pooled.blocks_of`). With it,
        `three-sensor` and `maximum-likelihood` give the levels of the engine
        (`estimator.levels.pooled`), with the flag POOLED where a bin does not resolve the motion.
    correlation : float64, shape (n_lags,), optional
        Of the power of neighbouring frequencies (`estimator.levels.bands.bin_correlation`);
        default: independent.
    groups : int64, shape (n_freqs, n_sensors), optional
        Group of every sensor: sensors of one group may share noise. Default: none do.
    known : SelfNoise, optional
        What the method gives without `blocks`, if that is estimated already.
    inflation : float64, shape (n_freqs,), or float
        Variance of the averages over that of steady noise, by which those of `blocks` are fewer.
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
    is_real = np.zeros(len(csm), np.bool_) if real is None else np.asarray(real)
    if is_real.shape != (len(csm),) or is_real.dtype != np.bool_:
        raise EstimatorError(
            f"real of shape {is_real.shape} and type {is_real.dtype}, expected bool of"
            f" ({len(csm)},)"
        )
    by_engine = blocks is not None and method in {"three-sensor", "maximum-likelihood"}
    n_dims = np.zeros(0, np.int64)
    if by_engine:
        check_averages(n_effective)
        n_dims = _dimensions(options.get("n_factors"), dims, len(csm))
    found, last = known, False
    given = coherency(csm, dims) if by_engine else None
    if found is None and given is not None and method == "maximum-likelihood":
        options["matrices"] = False  # the engine has them
        last = _only_where_asked(given, dims, n_dims)
    if given is not None and method == "three-sensor":
        options["given"] = given
    if last:
        unknown = np.full((4, *csm.shape[:2]), np.nan)
        found = SelfNoise.of(method, unknown[0], unknown[1:], np.zeros(csm.shape[:2], np.int64))

    def by_method() -> SelfNoise:
        itself = METHODS[method](
            csm, dims=dims, n_effective=n_effective, correct=correct, **options
        )
        # half the degrees of freedom: a coefficient of a real series has no imaginary part
        scale = np.where(is_real, np.array([[2.0], [4.0], [8.0]]), 1.0)[:, :, None]
        return SelfNoise.of(method, itself.noise_psd, scale * itself.cumulants, itself.flags)

    found = found or by_method()
    if given is not None:
        every = np.arange(len(dims))[None] if groups is None else groups
        # With counts, for without them NumPy imports its masked arrays.
        for group in np.unique(every, axis=0, return_counts=True)[0]:
            here = (every == group).all(axis=1) & ~is_real
            found = _with_neighbours(
                found,
                given,
                np.where(here, -1 if blocks is None else blocks, -1),
                n_dims,
                dims=dims,
                group=group,
                n_effective=n_effective,
                correct=correct,
                correlation=np.ones(1) if correlation is None else correlation,
                inflation=np.broadcast_to(inflation, (len(csm),)),
            )
    if last:
        options["where"] = ~np.isfinite(found.noise_psd).all(axis=1)
        here, itself = options["where"][:, None], by_method()
        found = SelfNoise.of(
            method,
            np.where(here, itself.noise_psd, found.noise_psd),
            np.where(here, itself.cumulants, found.cumulants),
            np.where(here, itself.flags, found.flags),
        )
    return found


def _only_where_asked(given: Coherency, dims: tuple[int, ...], n_dims: IntArray) -> bool:
    """Whether the likelihood of a frequency says nothing of others, nor of what the engine needs.

    It finds channels without a counterpart, and fits of usual dimensions are the prior of further
    ones.
    """
    if len(set(dims)) > 1 or n_dims.max(initial=0) > max(dims):
        return False
    faults = Flag.DEAD_CHANNEL | Flag.DUPLICATE
    return not (given.flags & faults).any()


def _dimensions(n_factors: int | IntArray | None, dims: tuple[int, ...], n_freqs: int) -> IntArray:
    wanted = np.asarray(_shared(dims) if n_factors is None else n_factors, np.int64)
    if wanted.shape not in {(), (n_freqs,)}:
        raise EstimatorError(f"n_factors of shape {wanted.shape}, expected () or ({n_freqs},)")
    return np.broadcast_to(wanted, (n_freqs,))


def _shared(dims: tuple[int, ...]) -> int:
    """Return the largest number of channels that three sensors have; 0 with fewer sensors."""
    return sorted(dims)[-3] if len(dims) > 2 else 0


def _scale(psd: FloatArray, rest: FloatArray, block: IntArray, n_effective: float) -> FloatArray:
    """Return the unit of every channel at every bin, shape (n_bins, n_channels).

    The mean of the channel in its block, times the course of the noise in the block, common to all
    channels: their ratios stay, so that directions do not turn. In units of a bin's own power,
    noise would vary where motion does, and would be too high with few averages. `rest` is what the
    other sensors do not predict, of which `SMOOTH` averages are taken together.
    """
    first = np.flatnonzero(np.diff(block, prepend=-1))
    count = np.diff(first, append=len(block))

    def mean(each: FloatArray) -> FloatArray:
        return np.asarray((np.add.reduceat(each, first) / count[:, None])[block])

    each = rest / mean(rest)
    course, usual = each.mean(axis=1), median(each.T)
    course = np.where(course > BENT * usual, usual, course)
    half = int(SMOOTH / n_effective / 2)
    begin = np.maximum(np.arange(len(psd)) - half, first[block])
    end = np.minimum(np.arange(len(psd)) + half + 1, (first + count)[block])
    total = np.concatenate([[0.0], np.cumsum(course)])
    smooth = (total[end] - total[begin]) / (end - begin)
    smooth = np.where(np.isfinite(smooth) & (smooth > 0), smooth, 1.0)
    return mean(psd) * smooth[:, None]


def _with_neighbours(
    found: SelfNoise,
    given: Coherency,
    blocks: IntArray,
    n_dims: IntArray,
    *,
    dims: tuple[int, ...],
    group: IntArray,
    n_effective: float,
    correct: bool,
    correlation: FloatArray,
    inflation: FloatArray,
) -> SelfNoise:
    """Return a result with the levels of the engine, `estimator.levels.pooled`.

    All do, unless motion has more dimensions than sensors have channels and the sensors are too
    few to divide the noise well among channels. `blocks` is negative at bins without neighbours;
    sensors of one `group` may share noise.
    """
    missing = Flag.DEAD_CHANNEL | Flag.DUPLICATE | Flag.NO_COUNTERPART
    good = given.valid & (blocks >= 0)
    if not good.any():
        return found
    columns = np.flatnonzero(~((found.flags[good] & missing) != 0).any(axis=0))
    sensor = np.repeat(np.arange(len(dims)), dims)
    left = np.bincount(sensor[columns], minlength=len(dims))
    live = tuple(int(n) for n in left if n)
    usual = _shared(live)
    n_dims = np.where(n_dims > _shared(dims), n_dims, np.minimum(n_dims, usual))
    fits = bool(usual) and max(live) == usual
    # parallel sensors give one problem for each channel, with its share of the dimensions
    alike = len(live) - -(-n_dims // max(usual, 1))
    further = (n_dims > usual) & (alike > 0) & (alike**2 >= EQUATIONS * len(live))
    rows = np.flatnonzero(good & ((n_dims <= usual) | further) & fits)
    if not len(rows):
        return found
    steps = [np.diff(each[rows], prepend=-1) != 0 for each in (blocks, n_dims)]
    number = np.cumsum(steps[0] | steps[1]) - 1
    order, live = together(live, group[left > 0])
    most = most_pooled((usual,) * len(live))  # sensors that share noise count as one
    columns = columns[order]
    psd = given.psd[rows[:, None], columns]
    matrix = given.matrix[rows[0] : rows[-1] + 1]  # nobody else needs it: it is as large as csm
    if len(rows) < len(matrix) or not np.array_equal(columns, np.arange(len(sensor))):
        matrix = given.matrix[rows[:, None, None], columns[:, None], columns]
    turn = phases(matrix, rows, live, n_effective, number)
    if turn is not None:
        matrix *= turn[:, :, None]
        matrix *= turn[:, None, :].conj()
    rest, _ = unpredicted(
        matrix,
        dims=live,
        n_effective=np.full(len(rows), n_effective),
    )
    scale = _scale(psd, rest * psd, number, n_effective)
    amplitude = np.sqrt(psd / scale)
    matrix *= amplitude[:, :, None]
    matrix *= amplitude[:, None, :]
    pooled = pooled_noise(
        matrix,
        number,
        n_dims[rows],
        most=most if further[rows].any() else 0,
        dims=live,
        n_effective=n_effective,
        correlation=correlation,
        inflation=inflation[rows],
        unit=scale,
    )
    known = np.isfinite(pooled.noise).all(axis=1)
    here = rows[known]
    at = np.ix_(here, columns)
    gain = 1.0 if correct else (1 - n_dims[here] / n_effective)[:, None]
    noise, cumulants, flags = found.noise_psd.copy(), found.cumulants.copy(), found.flags.copy()
    unit = scale[known] * gain
    noise[at] = pooled.noise[known] * unit
    for m in range(3):
        cumulants[m][at] = pooled.cumulants[m, known] * unit ** (m + 2)
    flags[at] = np.where(noise[at] <= 0, int(Flag.NEGATIVE), 0)
    shared = pooled.shared[known] | further[here]  # bins alone do not divide the noise then
    flags[at] |= np.where(shared[:, None], int(Flag.POOLED), 0)
    return SelfNoise.of(found.method, noise, cumulants, flags)
