"""Filters that equalise the measured responses of sensors.

One sensor is the reference, and the channels of the others are filtered towards it. In theory any
sensor can be the reference; one with short filters is chosen: removing a resonance takes a few
samples, imitating it takes many.

Averages say nothing of a response where there is no coherent motion. A filter keeps its nearest
known value there, in size and phase: an extrapolated curve amplified noise by 44 dB. What is found
from data is used only where other segments prove it (`lowers_noise`).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from estimator.checks.advice import Rank
from estimator.checks.advice_on_sensors import UnequalResponses
from estimator.likelihood.dimension import bands
from estimator.responses.edge_leakage import ChannelResponses, band_shares
from estimator.self_noise.coherency import own_channels
from estimator.spectra import equaliser
from estimator.types import BoolArray, ComplexArray, FloatArray

THRESHOLD = 0.01
"""Leakage from which channels are filtered, as a share of the noise in a third of an octave."""
PER_AVERAGE = 1.0
"""Addition to `THRESHOLD`, divided by the number of averages, for the noise of the prediction."""
LARGE = 0.3
"""Leakage from which an estimate is wrong, as a share of the noise."""
WITH_MOST = 0.1
"""Share of the largest leakage from which a sensor is reported with the one that leaks most."""
SIGNIFICANCE = 4.5
"""Standard deviations by which leakage must exceed the threshold; it scatters as powers do."""
_EQUAL_ENOUGH = 0.5  # fraction of the threshold below which a channel is not filtered
_STIFFNESS = 1.0
_MORE_CHANNELS = 0.02  # cost of each filtered channel, in units of `tail_leakage`
_COHERENT = 20.0  # times 1 / averages, the coherence of independent noise: exceeded by e^-20
_MIN_KNOWN = 8  # frequencies with coherent motion, below which a response is not known
_BY_CHANCE = 1e-3  # probability that a useless filter is proven, and a harmless one rejected


def leakage_threshold(n_effective: float) -> float:
    """Return the share of the noise from which leakage is equalised."""
    return THRESHOLD + PER_AVERAGE / max(n_effective, 1.0)


def significant_minimum(
    share: FloatArray, deviation: FloatArray, frequency: FloatArray
) -> FloatArray:
    """Return the significant minimum of a share, given its standard deviation.

    The minimum is 0 above `estimator.spectra.equaliser.USABLE` of the largest frequency (Hz, shape
    (n_freqs,)), where responses are not equalised.
    """
    least = np.maximum(share - SIGNIFICANCE * deviation, 0.0)
    return np.where((frequency <= equaliser.USABLE * frequency[-1])[:, None], least, 0.0)


def leakage_advice(
    frequency: FloatArray,
    share: FloatArray,
    share_without: FloatArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    equalised_by: tuple[str, ...],
    unproven: tuple[int, ...] = (),
) -> Iterator[UnequalResponses]:
    """Yield advice on leakage at the edges of segments, with or without equalisation.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz.
    share, share_without : float64, shape (n_freqs, n_channels)
        As from `significant_minimum`, with and without equalisation.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
    equalised_by : tuple of str
    unproven : tuple of int
        Sensors whose filters are not used.
    """
    least = leakage_threshold(n_effective)
    most = np.maximum(share, share_without)
    where = most.max(axis=1, initial=0.0) > least
    if not where.any():
        return
    of_channels = most.max(axis=0)
    channel = int(np.argmax(of_channels))
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    left = float(share.max())
    rank = Rank.TO_KNOW
    if left > LARGE:
        rank = Rank.INVALIDATES
    elif left > least:
        rank = Rank.DELAYS
    yield UnequalResponses(
        rank=rank,
        sensors=tuple(
            np.unique(sensor_of[of_channels > WITH_MOST * of_channels[channel]]).tolist()
        ),
        band=(float(frequency[where][0]), float(frequency[where][-1])),
        channel=channel,
        share=left,
        share_without=float(share_without.max()),
        equalised_by=equalised_by,
        unproven=unproven,
    )


def correction(
    responses: ChannelResponses,
    grid: FloatArray,
    *,
    dims: tuple[int, ...],
    motion_psd: FloatArray,
    noise_psd: FloatArray,
    n_effective: float,
    factor: float,
    reference: int | None = None,
) -> tuple[ComplexArray, int]:
    """Return the responses of filters that equalise channels to those of one sensor.

    Parameters
    ----------
    responses : ChannelResponses
    grid : float64, shape (n_grid,)
        Output frequencies, evenly spaced from 0 Hz to half the sampling rate.
    dims : tuple of int
    motion_psd, noise_psd : float64, shape (n_freqs, n_channels)
    n_effective : float
    factor : float
        `estimator.responses.edge_leakage.slope_factor`.
    reference : int, optional
        The unfiltered sensor; default: the one with the shortest filters.

    Returns
    -------
    wanted : complex128, shape (n_grid, n_channels)
        1 at all frequencies for unfiltered channels.
    reference : int
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = np.maximum(motion_psd, 0.0) / np.abs(noise_psd)
    snr = np.where(np.isfinite(snr), snr, 0.0)
    on_grid = np.stack([np.interp(grid, responses.frequency, each) for each in snr.T], axis=1)
    best: tuple[float, int, ComplexArray] | None = None
    for sensor in range(len(dims)) if reference is None else (reference,):
        wanted = _towards(
            sensor, responses, grid, dims=dims, snr=snr, n_effective=n_effective, factor=factor
        )
        tails = equaliser.tail_leakage(wanted, 2 * float(grid[-1]), snr=on_grid, factor=factor)
        n_filtered = int((wanted != 1).any(axis=0).sum())
        cost = float(tails.max()) + _MORE_CHANNELS * n_filtered
        if best is None or cost < best[0]:
            best = cost, sensor, wanted
    if best is None:  # no sensors
        return np.ones((len(grid), 0), dtype=np.complex128), 0
    return best[2], best[1]


def _towards(
    sensor: int,
    responses: ChannelResponses,
    grid: FloatArray,
    *,
    dims: tuple[int, ...],
    snr: FloatArray,
    n_effective: float,
    factor: float,
) -> ComplexArray:
    ratio, coherence = responses.ratio[:, :, sensor], responses.coherence[:, :, sensor]
    f = responses.frequency
    wanted = np.ones((len(grid), ratio.shape[1]), dtype=np.complex128)
    slopes = responses.slopes()[:, :, sensor]
    leakage = np.where(np.isfinite(slopes), factor * np.abs(slopes) ** 2 * snr, 0.0)
    share = significant_minimum(*band_shares(leakage, np.zeros_like(snr), np.ones_like(snr), f), f)
    least = _EQUAL_ENOUGH * leakage_threshold(n_effective)
    for channel in range(ratio.shape[1]):
        own = channel in own_channels(dims, sensor)
        if own or not share[:, channel].max(initial=0.0) > least:
            continue
        g = coherence[:, channel]
        usable = np.isfinite(ratio[:, channel]) & (ratio[:, channel] != 0) & (f > 0) & (g > 0)
        inverse = np.where(usable, 1 / np.where(usable, ratio[:, channel], 1.0), 0.0)
        weight = n_effective * g / np.maximum(1 - g, 1e-9)
        weight = np.where(usable, weight / np.maximum(np.abs(inverse), 1e-150) ** 2, 0.0)
        if usable.sum() < len(usable) // 2:
            continue
        known = usable & (g > _COHERENT / max(n_effective, 1.0)) & (f <= equaliser.USABLE * f[-1])
        if np.count_nonzero(known) < _MIN_KNOWN:
            continue
        even = _held(equaliser.smoothed(inverse, weight, stiffness=_STIFFNESS), known)
        if len(f) != len(grid) or not np.array_equal(f, grid):
            even = np.interp(grid, f, even.real) + 1j * np.interp(grid, f, even.imag)
        wanted[:, channel] = equaliser.bounded(even)
        wanted[:, [channel]] = equaliser.with_short_tails(wanted[:, [channel]])
    return wanted


def _held(response: ComplexArray, known: BoolArray) -> ComplexArray:
    """Return a response that is, where it is not known, between its nearest known values."""
    at, where = np.arange(len(response)), np.flatnonzero(known)
    size, angle = np.abs(response), np.unwrap(np.angle(response[where]))
    return np.asarray(np.interp(at, where, size[where]) * np.exp(1j * np.interp(at, where, angle)))


def lowers_noise(
    before: FloatArray, after: FloatArray, frequency: FloatArray, *, dims: tuple[int, ...]
) -> BoolArray:
    """Return for each sensor whether filters lower its noise by more than chance.

    And raise it by more than chance in no third of an octave.

    Parameters
    ----------
    before, after : float64, shape (n_groups, n_freqs, n_channels)
        Noise PSD of the same segments without and with filters, each without one of the groups of
        segments (jackknife). NaN where it is not known.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
        Channels of each sensor.

    Returns
    -------
    bool, shape (n_sensors,)

    Notes
    -----
    Both share their noise, so the scatter of the difference is that of the leakage alone. Its
    standard deviation is ``sqrt((G - 1) / G sum (d_g - d)²)`` with G groups.
    """
    from scipy.stats import t as student  # noqa: PLC0415 - only where something is equalised

    n_groups = len(before)
    starts = np.flatnonzero(np.diff(bands(frequency), prepend=-1))
    known = (np.isfinite(before) & np.isfinite(after)).all(axis=0)
    lowered, noise = (
        np.add.reduceat(np.where(known, part, 0.0), starts, axis=1)
        for part in (before - after, np.abs(after))
    )
    edges = np.cumsum([0, *dims[:-1]])
    lowered, noise = (np.add.reduceat(part, edges, axis=2) for part in (lowered, noise))
    total = noise.mean(axis=0)
    share = np.where(total > 0, lowered / np.where(total > 0, total, 1.0), 0.0)
    limit = float(student.isf(_BY_CHANCE, n_groups - 1))

    def exceeds(values: FloatArray, least: float) -> BoolArray:
        mean = values.mean(axis=0)
        squares = ((values - mean) ** 2).sum(axis=0)
        return np.asarray(mean > least + limit * np.sqrt((n_groups - 1) / n_groups * squares))

    return exceeds(share.mean(axis=1), 0.0) & ~exceeds(-share, THRESHOLD).any(axis=0)
