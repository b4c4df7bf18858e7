"""What widens the interval of a level beyond the scatter of the estimate, by name.

Every cause enters once, here: table, plot, report, JSON, budget and verdict have the same two ends.

One cause is motion across the axes of sensors with one or two channels. Channel i feels motion
outside of its axis through its lean a (a vector across the axis, in radians; in two-channel sensors
out of the plane). Beside channels j and k, motion of PSD S there changes its noise by

    ``S (a_i - a_j) . (a_i - a_k)``,

too high or too low. The model test of three sensors cannot see it. For leans of rms θ its mean is
``S θ**2`` and its standard deviation ``1.6 S θ**2``.
"""

from __future__ import annotations

import enum
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.levels.interval import NORMAL_95
from estimator.records import dataclass
from estimator.types import BoolArray, FloatArray


class Source(enum.StrEnum):
    """Causes of a wider interval."""

    CLOCKS = "clocks"
    """The residual between the clocks adds noise, or takes it away."""
    EDGES = "edges"
    """Unequal responses, or drifts of the noise, leak at the edges of segments."""
    GAPS = "gaps"
    """The windows of segments with gaps leak from other frequencies."""
    MISFIT = "misfit"
    """One common motion does not explain the averages."""
    UNTESTED = "untested"
    """Whether one common motion explains the averages cannot be tested with so few."""
    SHARED_NOISE = "shared-noise"
    """Two channels share noise."""
    AXES = "axes"
    """Sensors of one or two channels lean, and feel motion across their axes."""
    DIMENSIONS = "dimensions"
    """The number of dimensions of the motion is in doubt."""
    ROUNDING = "rounding"
    """Cross-spectra were kept in single precision, as fine as their largest part: the motion."""
    GAINS = "gains"
    """Gains or noise may follow the loudness of the motion, which tells noise from motion."""
    STEADY_MOTION = "steady-motion"
    """Motion that changes does not identify the noise of two sensors: it is below a bound."""
    PARTS = "parts"
    """Parts of the recording between which the motion changes contradict the method."""
    LINEARITY = "linearity"
    """The channel is not linear: squares and cubes of the motion add to its noise."""
    OF_MOTION = "of-motion"
    """The noise of the channel depends on its motion at the same instant."""
    COUNTS = "counts"
    """Like channels are rounded to counts alike, and share a part of that."""
    CHANGES = "changes"
    """The gain or the direction of the sensor changed: motion is left in its noise."""
    GUSTS = "gusts"
    """The loudness of the noise changes at all frequencies: a mean over these scatters with it."""
    FAULTY = "faulty"
    """The channel is clipped, dead for a while, or disturbed: its noise is below the estimate."""
    SENSITIVITY = "sensitivity"
    """The sensitivity is as certain as its certificate, or its tolerance, states."""
    TEMPERATURE = "temperature"
    """The sensitivity follows the temperature, within the coefficient of the data sheet."""


@dataclass(frozen=True, slots=True, eq=False)
class Contribution:
    """What one cause adds to an interval; arrays of shape (n, n_channels), n bins or bands.

    Attributes
    ----------
    source : Source
    below, above : float64
        By how much the lower end is lower, the upper end higher, in unit**2/Hz.
    share : float64
        Part of the level by which both ends are farther; infinite where nothing is known.
    deviation : float64, shape (n_channels,), or float
        Standard deviation of the logarithm of the level, common to all frequencies. Its effect is
        added to the interval by squares (`by_chance`), where the others are bounds, which add.
    """

    source: Source
    below: FloatArray
    above: FloatArray
    share: FloatArray
    deviation: FloatArray | float = 0.0

    def adds(
        self, column: int, level: FloatArray, quantile: float = NORMAL_95
    ) -> tuple[FloatArray, FloatArray]:
        """Return what it alone adds below and above a channel's level, shape (n,), in unit**2/Hz.

        What a deviation adds depends on the quantile, in standard deviations to either end.
        """
        with np.errstate(invalid="ignore"):
            of_share = np.where(
                self.share[:, column] > 0, self.share[:, column] * np.abs(level), 0.0
            )
        reach = quantile * np.broadcast_to(self.deviation, self.share.shape[1:])[column]
        below, above = (np.abs(level * np.expm1(side * reach)) for side in (-1, 1))
        return (
            self.below[:, column] + of_share + below,
            self.above[:, column] + of_share + above,
        )

    def at(self, bins: slice) -> Contribution:
        """Return the contribution at some bins."""
        return replace(self, below=self.below[bins], above=self.above[bins], share=self.share[bins])

    def in_bands(
        self, edges: NDArray[np.int64], weight: FloatArray, psd: FloatArray
    ) -> Contribution:
        """Return the contribution to the means of bands.

        Bins err together, so that offsets are averaged with weights, and shares with these and the
        noise; of arrays of shape (n_freqs, n_channels). The weight is 0 where the noise is not
        known. Where nothing is known of a part of a band, nothing is known of the band, but by
        `up_to`.
        """
        first, last, starts = int(edges[0]), int(edges[-1]), edges[:-1] - edges[0]

        def mean(part: FloatArray, by: FloatArray) -> FloatArray:
            used = by[first:last] > 0
            amount = np.where(used, part[first:last], 0.0)
            weights = np.where(used, by[first:last], 0.0)
            with np.errstate(invalid="ignore"):
                product = np.where(weights > 0, amount * weights, 0.0)
            total = np.add.reduceat(weights, starts, axis=0)
            summed = np.add.reduceat(product, starts, axis=0)
            return np.asarray(summed / np.where(total > 0, total, 1.0))

        share = mean(self.share, weight * np.nan_to_num(np.abs(psd)))
        unknown = np.logical_or.reduceat(np.isinf(self.share[first:last]), starts, axis=0)
        return Contribution(
            self.source,
            mean(self.below, weight),
            mean(self.above, weight),
            np.where(unknown, np.inf, share),
            self.deviation,
        )


def up_to(
    parts: Iterable[Contribution],
    bound: FloatArray,
    where: BoolArray,
    level: FloatArray,
    inside: BoolArray,
) -> Iterator[Contribution]:
    """Yield contributions from zero to a bound `where` any is infinite, and no other there.

    Parameters
    ----------
    parts : iterable of Contribution
    bound, where : float64, bool, shape (n_freqs, n_channels)
    level : float64, shape (n_freqs, n_channels)
        The noise, at the bound at most.
    inside : bool, shape (n_freqs, n_channels)
        Bins of the bands with such bins. Their other shares become offsets: a share of the mean
        would be one of what the bound allows, too.
    """
    taken = np.zeros(where.shape, np.bool_)
    for each in parts:
        anything = where & np.isinf(each.share + each.above) & ~taken
        taken |= anything
        finite = inside & ~where & np.isfinite(each.share)
        offset = np.where(finite, each.share, 0.0) * np.nan_to_num(np.abs(level))
        yield replace(
            each,
            below=np.where(
                where, np.where(anything, np.maximum(level, 0.0), 0.0), each.below + offset
            ),
            above=np.where(where, np.where(anything, bound - level, 0.0), each.above + offset),
            share=np.where(where | finite, 0.0, each.share),
        )


def contribution(
    source: Source,
    shape: tuple[int, int],
    *,
    below: FloatArray | float = 0.0,
    above: FloatArray | float = 0.0,
    share: FloatArray | float = 0.0,
    deviation: FloatArray | float = 0.0,
) -> Contribution:
    """Return a contribution; what is not given is zero."""
    arrays = [
        np.broadcast_to(np.asarray(part, np.float64), shape) for part in (below, above, share)
    ]
    return Contribution(source, arrays[0], arrays[1], arrays[2], deviation)


def widened(
    low: FloatArray,
    high: FloatArray,
    contributions: Iterable[Contribution],
    *,
    without: Collection[Source] = (),
) -> tuple[FloatArray, FloatArray]:
    """Return the ends of an interval with all contributions but some.

    Offsets are bounds, so they add. A share moves the upper end up, and a positive lower end down
    to zero at most, unless nothing is known.
    """
    share = np.zeros(low.shape)
    for each in contributions:
        if each.source in without:
            continue
        low = low - each.below
        high = high + each.above
        share = share + each.share
    with np.errstate(invalid="ignore"):
        lower = np.where(low > 0, low * np.maximum(1 - share, 0.0), low)
        upper = np.where(high > 0, high * (1 + share), high)
    unknown = np.isinf(share) & ~np.isnan(low)
    return np.where(unknown, -np.inf, lower), np.where(unknown, np.inf, upper)


def deviation(
    contributions: Iterable[Contribution], *, without: Collection[Source] = ()
) -> FloatArray:
    """Return the standard deviation of the logarithm of levels by all contributions but some.

    Shape (n_channels,), or () where there is none.
    """
    squares = [np.square(e.deviation) for e in contributions if e.source not in without]
    total = np.sum(np.broadcast_arrays(*squares), axis=0) if squares else 0.0
    return np.asarray(np.sqrt(total))


def by_chance(
    level: FloatArray, low: FloatArray, high: FloatArray, reach: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return the ends of an interval of levels that are known but for a factor.

    Parameters
    ----------
    level, low, high : float64, shape (..., n_channels)
        Levels with their intervals as if the factor were 1.
    reach : float64, shape (n_channels,), or float
        How far the logarithm of the factor reaches: its standard deviation times the quantile of
        the interval.

    Returns
    -------
    low, high : float64, shape (..., n_channels)
        The distances from the level to either end, and the reach, are added by squares in
        logarithms, where the factor is normal whatever its size (JCGM 100, 5.1.2, and within
        1 % of the distances of JCGM 101). An end without a logarithm, or on the other side of
        the level, is multiplied by the whole reach.
    """
    if not np.any(reach):
        return low, high
    with np.errstate(invalid="ignore", divide="ignore"):
        up, down = np.log(high / level), np.log(level / low)
        upper = np.where(
            (level > 0) & (high >= level),
            level * np.exp(np.hypot(up, reach)),
            high * np.exp(np.where(high > 0, reach, -np.asarray(reach))),
        )
        lower = np.where(
            (low > 0) & (low <= level),
            level * np.exp(-np.hypot(down, reach)),
            low * np.exp(np.where(low > 0, -np.asarray(reach), reach)),
        )
    # no shorter by rounding
    return np.minimum(lower, low), np.maximum(upper, high)


_OWN, _OTHERS = 3.5, 1.79
"""What 97 % of leans do not exceed, over the square of their rms: of a lean's own square, and of
the product of two others. The sum of both is exceeded by 2.5 % of equal leans."""


def across(tolerances: FloatArray, leans: FloatArray | None = None) -> FloatArray:
    """Return the share of the motion's PSD by which the noise of each sensor may be off.

    Parameters
    ----------
    tolerances : float64, shape (n_sensors,)
        Lean of each sensor, or what of it is not known, rms, in radians.
    leans : float64, shape (n_sensors, 2), optional
        Known leans, in radians, towards two directions across that all sensors have in common.

    Returns
    -------
    float64, shape (n_sensors,)
        ``(2.3 θ)**2`` for equal tolerances θ, which 97.5 % of normal leans do not exceed. The
        direction of the motion across is not known, so that known leans only bound its effect: by
        the product of the differences from the two sensors that lean otherwise the most.
    """
    square = np.square(tolerances)
    others = (np.sum(square) - square) / max(len(square) - 1, 1)
    residual = _OWN * square + _OTHERS * others
    if leans is None:
        return np.asarray(residual)
    apart = np.sort(np.linalg.norm(leans[:, None] - leans[None], axis=2), axis=1)
    reach = np.sqrt(residual)
    return np.asarray((apart[:, -1] + reach) * (apart[:, max(-2, -len(square))] + reach))
