"""Noise of every channel in bands: its level, its interval, and what the interval consists of.

The noise of some channels cannot be told from motion, because a sensor records another motion: they
are named here, too.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Collection, Mapping
from dataclasses import field
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.estimation.contributions import by_two, contributions, may_share, shared_parts
from daq.estimation.noise_estimates import ALL_METHODS
from daq.estimation.settings import Settings
from daq.estimation.snapshot import ChannelLabel, Snapshot, once
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.levels.bands import (
    BandLevels,
    band_edges,
    band_levels,
    bin_correlation,
    third_octaves,
    widths,
)
from estimator.levels.contributions import (
    Contribution,
    Source,
    by_chance,
    deviation,
    up_to,
    widened,
)
from estimator.levels.interval import (
    NORMAL_95,
    interval,
    like_psd,
    unpredicted,
    unpredicted_by_one,
)
from estimator.median import median_of_columns
from estimator.records import dataclass
from estimator.self_noise.result import Flag, SelfNoise
from estimator.spectra.windows import get_window
from estimator.types import BoolArray, FloatArray

CONSTANT = frozenset({Source.SENSITIVITY})
"""What is the same in all tests of a sensor, and no part of the difference of two."""
MUCH_SHARED = 0.01
"""Share of its noise that a channel is rounded alike with others, from which they predict it."""
_SHAPE_LENGTH = 512  # only the window's shape and overlap matter to the correlation of bins


def held(mean: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return estimates, NaN where their intervals exclude them: nothing exports those."""
    return np.where((mean < low) | (mean > high), np.nan, mean)


@dataclass(frozen=True, slots=True)
class BandMeans:
    """Means of one channel's noise over bands, shape (n_bands,), in the unit of the spectrum.

    ``spread`` is the standard deviation of the mean by its scatter, ``low`` and ``high`` the ends
    of its interval with all that widens it; NaN for a band without estimates. ``scatter`` has the
    ends by scatter alone, ``parts`` what each contribution adds below and above. ``is_bound`` is
    true where the mean is no estimate, but a bound.
    """

    mean: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray
    scatter: tuple[FloatArray, FloatArray] | None = field(default=None, kw_only=True)
    parts: Mapping[Source, tuple[FloatArray, FloatArray]] = field(
        default_factory=dict, kw_only=True
    )
    is_bound: BoolArray = field(default_factory=lambda: np.zeros(1, np.bool_), kw_only=True)

    @property
    def estimate(self) -> FloatArray:
        """The mean, NaN where its interval excludes it."""
        return held(self.mean, self.low, self.high)

    @property
    def outside(self) -> BoolArray:
        """Where the estimate is a bound, not positive, or above its interval: `high` is known."""
        return (self.mean <= 0) | (self.mean > self.high) | self.is_bound


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Noise of every channel in some bands, by one method; arrays of shape (n_bands, n_channels).

    Attributes
    ----------
    of_scatter : BandLevels
        The levels, and their intervals by the scatter of the estimate alone.
    contributions : tuple of Contribution
        What widens these.
    bound : BandLevels
        What the other sensors do not predict: the noise is below it by any model; not known where
        a channel shares noise with others.
    is_bound : bool, shape (n_bands, n_channels)
        Whether the level of a bin is such a bound, and no estimate.
    """

    of_scatter: BandLevels
    contributions: tuple[Contribution, ...]
    bound: BandLevels
    is_bound: BoolArray

    @property
    def mean(self) -> FloatArray:
        """In unit**2/Hz; NaN for a band without estimates."""
        return self.of_scatter.mean

    def ends(
        self,
        quantile: float = NORMAL_95,
        *,
        without: Collection[Source] = (),
        factor: bool = True,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the interval.

        Parameters
        ----------
        quantile : float
            Standard deviations to either end.
        without : collection of Source
            Contributions that do not count.
        factor : bool
            Whether the factor counts that all levels of a channel have in common (`deviation`).

        Returns
        -------
        low, high : float64, shape (n_bands, n_channels)
            No upper end is above that of the bound. Where the whole interval is, or none of it is
            above zero, the estimate is withdrawn: the lower end is then minus infinity, and the
            upper one that of the bound. How far an estimate is below zero lowers no upper end: that
            is what an estimate of zero would have (Cowan et al., arXiv:1105.3166).
        """
        low, high = widened(
            *self.of_scatter.interval(quantile), self.contributions, without=without
        )
        most = self._most(quantile)
        low = np.where((low > most) | (high < 0), -np.inf, low)
        high = np.where(high < 0, np.inf, high - np.minimum(np.nan_to_num(self.mean), 0.0))
        high = np.where(np.isnan(high), high, np.fmin(high, most))
        if not factor:
            return low, high
        reach = quantile * deviation(self.contributions, without=without)
        return by_chance(self.mean, low, high, reach)

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of the logarithm of all levels of a channel, shape (n_channels,).

        By its sensitivity, and by the loudness of its noise.
        """
        return np.broadcast_to(deviation(self.contributions), self.mean.shape[1:])

    def withdrawn(self, quantile: float = NORMAL_95) -> BoolArray:
        """Whether the interval is above the bound or below zero: the model lacks dimensions."""
        low, high = widened(*self.of_scatter.interval(quantile), self.contributions)
        return np.asarray((low > self._most(quantile)) | (high < 0))

    def of_channel(
        self, column: int, quantile: float = NORMAL_95, *, without: Collection[Source] = ()
    ) -> BandMeans:
        """Return the means of one channel."""
        low, high = self.ends(quantile, without=without)
        mean, spread = self.mean[:, column], self.of_scatter.spread[:, column]
        scatter = self.of_scatter.interval(quantile)
        return BandMeans(
            *(mean, spread, low[:, column], high[:, column]),
            scatter=(scatter[0][:, column], scatter[1][:, column]),
            parts={each.source: each.adds(column, mean, quantile) for each in self.contributions},
            is_bound=self.is_bound[:, column],
        )

    def _most(self, quantile: float) -> FloatArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            _, most = interval(self.bound.mean, self.bound.cumulants, quantile)
        return np.where(self.bound.complete & np.isfinite(most), most, np.inf)


def correlation_of(settings: Settings) -> FloatArray:
    """Return the correlation of neighbouring frequencies under these settings."""
    window = get_window(settings.window, _SHAPE_LENGTH)
    return bin_correlation(window, max(1, round(_SHAPE_LENGTH * (1 - settings.overlap))))


def band_of(settings: Settings, snapshot: Snapshot) -> tuple[float, float]:
    """Return the band that was asked for, or all that is usable: up to 0.45 of the rate.

    It ends where nothing can be said any more, unless that is all of it.
    """
    return band_within(settings, snapshot.frequency, known_range(snapshot))


def band_within(
    settings: Settings, frequency: FloatArray, known: tuple[float, float]
) -> tuple[float, float]:
    """Return what `band_of` returns, from frequencies of which the `known` range is known."""
    low, high = settings.band or (max(known[0], frequency[1]), 0.9 * float(frequency[-1]))
    if low >= known[1] or high <= known[0]:
        return low, high
    return max(low, known[0]), min(high, known[1])


class Spectrum:
    """One method's noise at every frequency, from which levels of any bands are made.

    Every table, curve, verdict and budget takes its numbers from here.

    Parameters
    ----------
    noise : SelfNoise
        One of the snapshot's results.
    snapshot : Snapshot
    settings : Settings
    """

    def __init__(self, noise: SelfNoise, snapshot: Snapshot, settings: Settings) -> None:
        self._noise, self._snapshot = noise, snapshot
        self._width = np.gradient(snapshot.frequency)
        self._correlation = correlation_of(settings)
        self._contributions = contributions(snapshot, noise.method)
        self._shares = by_two(snapshot) | (shared_parts(snapshot) > 0)
        beside, names = snapshot.diagnostics.beside, snapshot.sensor_names
        paired = {name for pair in settings.shared_noise for name in pair}
        paired |= {names[n] for each in (beside.pairs if beside else ()) for n in each.pair}
        self._shares[:, [label.sensor in paired for label in snapshot.channels]] = True
        if (alike := snapshot.rounded_alike) is not None:
            self._shares |= alike.most > MUCH_SHARED * np.nan_to_num(np.abs(noise.noise_psd))
        self._doubtful = may_share(snapshot)
        self._shares &= ~self._doubtful[0][:, None]  # bounded by its own spectrum
        known = np.isfinite(noise.noise_psd)
        self._known = known
        self._anything = known & np.logical_or.reduce(
            [np.isinf(each.share + each.above) for each in self._contributions] or [~known]
        )
        self._bound: tuple[slice, FloatArray, FloatArray] = (slice(0, 0), np.empty(0), np.empty(0))

    def levels(self, edges: NDArray[np.int64]) -> Levels:
        """Return the noise of every channel in bands, with what its intervals consist of.

        Parameters
        ----------
        edges : int64, shape (n_bands + 1,)
            Band b has bins ``edges[b]`` to ``edges[b + 1]``, excluded; increasing.
        """
        noise, correlation = self._noise, self._correlation
        first, rest, scatter = self._unpredicted(int(edges[0]), int(edges[-1]))
        begin, end = int(edges[0]), int(edges[-1])
        weight = widths(self._snapshot.frequency, self._known, edges)[begin:end]
        here, edges = slice(begin, end), edges - begin
        rest, scatter = rest[begin - first : end - first], scatter[:, begin - first : end - first]
        rest = np.where(self._shares[here], np.nan, rest)  # others predict noise that they share
        width = self._width[here]
        levels = partial(band_levels, edges=edges, correlation=correlation)
        bound = levels(rest, scatter, weights=width)
        psd, cumulants = noise.noise_psd[here], noise.cumulants[:, here]
        parts = [each.at(here) for each in self._contributions]
        below = self._below_bound(edges, here, rest)
        if below.any():
            psd, cumulants = np.where(below, np.minimum(psd, rest), psd), cumulants.copy()
            cumulants[:, below] = scatter[:, below]
            inside = np.repeat(np.logical_or.reduceat(below, edges[:-1]), np.diff(edges), axis=0)
            parts = list(up_to(parts, rest, below, psd, inside))
        found = levels(psd, cumulants, weights=weight)
        widening = tuple(each.in_bands(edges, weight, psd) for each in parts)
        unknown = (noise.flags[here] & Flag.UNIDENTIFIED) != 0
        return Levels(found, widening, bound, np.logical_or.reduceat(unknown, edges[:-1]))

    def _below_bound(self, edges: NDArray[np.int64], here: slice, bound: FloatArray) -> BoolArray:
        """Return where nothing but the bound is known, in bands in which more is known elsewhere.

        These bins cost a band their own share: their noise is between zero and the bound.
        """
        anything, sizes = self._anything[here], np.diff(edges)
        known = np.logical_or.reduceat(self._known[here] & ~anything, edges[:-1])
        return np.asarray(anything & (bound > 0) & np.repeat(known, sizes, axis=0))

    def _unpredicted(self, begin: int, end: int) -> tuple[int, FloatArray, FloatArray]:
        """Return the bound at these bins or more, with the first of them."""
        inside, rest, scatter = self._bound
        if begin < inside.start or end > inside.stop:
            if inside.stop > inside.start:
                begin, end = min(begin, inside.start), max(end, inside.stop)
            inside, snapshot = slice(begin, end), self._snapshot
            frequency = snapshot.frequency[inside]
            averages = averages_at(snapshot, frequency)
            averages = averages / snapshot.diagnostics.inflation_at(frequency)
            rest, scatter = unpredicted(
                snapshot.csm[inside], dims=snapshot.dims, n_effective=averages
            )
            every, two = (np.flatnonzero(each[inside]) for each in self._doubtful)
            if len(two):
                rest[two], scatter[:, two] = unpredicted_by_one(
                    snapshot.csm[inside][two], dims=snapshot.dims, n_effective=averages[two]
                )
            if len(every):  # then no channel's noise exceeds its own spectrum
                rest[every] = np.einsum("fii->fi", snapshot.csm[inside][every]).real
                of_psd = rest[every] / np.sqrt(averages[every])[:, None]
                scatter[:, every] = like_psd(rest[every], of_psd)
            self._bound = (inside, rest, scatter)
        return inside.start, rest, scatter


@dataclass(frozen=True, slots=True)
class Precision:
    """Scatter of the noise, beside the scatter that is wanted.

    Attributes
    ----------
    cov : float
        In the worst third of an octave of the band, of the worst channel that has an estimate; NaN
        where there is none. See `Estimate.covs_of`.
    target : float or None
    seconds_left : float or None
        Until the target is reached, at the pace so far; None without a target or an estimate.
    total : float or None
        Length of the recording that reaches the target, in seconds.
    """

    cov: float
    target: float | None
    seconds_left: float | None
    total: float | None

    @property
    def is_reached(self) -> bool:
        """Whether there is a target, and it is reached."""
        return self.target is not None and self.cov <= self.target


@dataclass(frozen=True, eq=False)
class Estimate:
    """A snapshot with its settings, and what follows from both: each derived once, when wanted.

    Attributes
    ----------
    snapshot : Snapshot
    settings : Settings
    """

    snapshot: Snapshot
    settings: Settings
    derived: dict[tuple[object, ...], Any] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def band(self) -> tuple[float, float]:
        """The band of the tables, in Hz: `band_of`."""
        return band_of(self.settings, self.snapshot)

    @property
    def concern(self) -> tuple[float, float] | None:
        """Frequencies in Hz that matter to who asks: the band asked for; None for all."""
        return self.settings.band

    @cached_property
    def method(self) -> str:
        """The method that judges, also where it gives no result: `judged_method`."""
        return judged_method(self.snapshot, self.settings)

    @property
    def noise(self) -> SelfNoise | None:
        """The noise by the method that judges; None where it gives no result."""
        return self.snapshot.results.get(self.method)

    @cached_property
    def data(self) -> FloatArray:
        """Mean PSD of what each channel recorded in the band, shape (n_channels,)."""
        return data_means(self.snapshot, self.band)

    @cached_property
    def alone(self) -> dict[int, WithoutPartner]:
        """Channels, by column, whose noise cannot be told from motion in the band."""
        return without_partners(self.snapshot, self.band)

    @once
    def spectrum(self, method: str) -> Spectrum:
        """Return the noise by a method, from which levels of any bands are made."""
        return Spectrum(self.snapshot.results[method], self.snapshot, self.settings)

    def means(
        self,
        method: str,
        band: tuple[float, float] | None = None,
        *,
        without: frozenset[Source] = frozenset(),
    ) -> tuple[BandMeans, ...]:
        """Return the mean noise of every channel by a method in a band, with its interval.

        Parameters
        ----------
        method : str
            One of the snapshot's results.
        band : (float, float), optional
            In Hz; default: that of the tables.
        without : frozenset of Source
            Contributions that do not count.

        Raises
        ------
        BandError
            If no frequency lies in the band.
        """
        return self._means(method, self.band if band is None else band, without)

    @once
    def _means(
        self, method: str, band: tuple[float, float], without: frozenset[Source]
    ) -> tuple[BandMeans, ...]:
        found, columns = self.levels(method, band), range(len(self.snapshot.channels))
        return tuple(found.of_channel(n, without=without) for n in columns)

    @cached_property
    def covs(self) -> list[float]:
        """The c.o.v. of every channel by the method that judges: `covs_of`."""
        return self.covs_of(self.method)

    def covs_of(self, method: str) -> list[float]:
        """Return the c.o.v. of every channel in the worst third of an octave of the band.

        With `Settings.target_cov_bin` it is that of single frequencies, median in the band. NaN
        where there is none, or a bound.
        """
        snapshot, settings = self.snapshot, self.settings
        noise = snapshot.results.get(method)
        edges = third_octaves(snapshot.frequency, *self.band)
        if noise is None or edges.size < 2:
            return [math.nan] * len(snapshot.channels)
        if settings.target_cov_bin is not None:
            cov = noise.cov[edges[0] : edges[-1]]
            medians = median_of_columns(np.where(np.isfinite(cov), cov, np.nan))
            return [float(median) for median in medians]
        found = band_levels(
            *(noise.noise_psd, noise.cumulants, edges, correlation_of(settings)),
            weights=widths(snapshot.frequency, np.isfinite(noise.noise_psd), edges),
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            cov = np.where(np.isfinite(found.mean), found.spread / np.abs(found.mean), -np.inf)
        if (loudness := snapshot.diagnostics.loudness) is not None:
            cov = np.hypot(cov, loudness.deviation) * np.sign(cov)
        bounds = (noise.flags[edges[0] : edges[-1]] & Flag.UNIDENTIFIED) != 0
        worst = np.where(bounds.any(axis=0), -np.inf, cov.max(axis=0))  # no precision of a bound
        return [math.nan if each < 0 else each for each in worst.tolist()]

    def precision(self, target: float | None = None) -> Precision:
        """Return the c.o.v. of the method that judges, and when it reaches its target.

        Without `target` that of the settings. The c.o.v. falls with the root of the averages, and
        averages come at a steady pace. It is unknown where sensors are left out of a live estimate.
        """
        snapshot, settings = self.snapshot, self.settings
        known = [cov for cov in self.covs if math.isfinite(cov)]
        if snapshot.not_in_memory:
            known = []
        cov = max(known, default=math.nan)
        target = target or settings.target_cov_bin or settings.target_cov
        left = total = None
        if target is not None and known:
            hop = settings.segment * (1 - settings.overlap)
            taken = (snapshot.n_segments + snapshot.n_dropped) * hop
            left = taken * max(0.0, (cov / target) ** 2 - 1)
            total = snapshot.elapsed + left
        return Precision(cov=cov, target=target, seconds_left=left, total=total)

    @once
    def levels(self, method: str, band: tuple[float, float]) -> Levels:
        """Return the noise of every channel by a method in one band: `Spectrum.levels`."""
        return self.spectrum(method).levels(band_edges(self.snapshot.frequency, band))


def data_interval(estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the 95 % interval of `Estimate.data`, two arrays of shape (n_channels,)."""
    snapshot = estimate.snapshot
    psd = snapshot.data_psd
    averages = averages_at(snapshot, snapshot.frequency)[:, None]
    cumulants = np.stack([psd**k / averages ** (k - 1) for k in (2, 3, 4)])
    edges = band_edges(snapshot.frequency, estimate.band)
    width = widths(snapshot.frequency, np.isfinite(psd), edges)
    correlation = correlation_of(estimate.settings)
    low, high = band_levels(psd, cumulants, edges, correlation, weights=width).interval()
    return low[0], high[0]


def data_means(snapshot: Snapshot, band: tuple[float, float]) -> FloatArray:
    """Return the mean PSD of what each channel recorded in a band, shape (n_channels,)."""
    edges, psd = band_edges(snapshot.frequency, band), snapshot.data_psd
    width = widths(snapshot.frequency, np.isfinite(psd), edges)[slice(*edges)]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nansum(psd[slice(*edges)] * width, axis=0) / width.sum(axis=0))


def judged_method(snapshot: Snapshot, settings: Settings) -> str:
    """Return the method by which limits, c.o.v. and clocks are judged.

    It is the first of the settings, also where it gives no result: never one that is only shown.
    """
    wanted = next(iter(settings.for_sensors(snapshot.dims).methods), "all")
    return wanted if wanted != "all" else next(iter(snapshot.results), ALL_METHODS[0])


def averages_at(snapshot: Snapshot, frequency: FloatArray) -> FloatArray:
    """Return the independent averages behind each frequency (Hz)."""
    if not snapshot.octaves:
        return np.full(frequency.shape, snapshot.n_effective)
    edges = np.array([octave.low for octave in snapshot.octaves[1:]])
    averages = np.array([octave.n_effective for octave in snapshot.octaves])
    return np.asarray(averages[np.searchsorted(edges, frequency, side="right")])


def without_sensitivity(snapshot: Snapshot) -> list[ChannelLabel]:
    """Return the channels of whose sensitivity neither certificate nor tolerance is stated."""
    known = snapshot.sensitivities
    return [
        label
        for label in snapshot.channels
        if (found := known.get((label.sensor, label.channel))) is None or not found.is_stated
    ]


def known_range(snapshot: Snapshot) -> tuple[float, float]:
    """Return the frequencies in Hz between which anything is known; the second 0 if nothing is.

    Below, detrending bends the spectrum; above, clocks that ran freely leave nothing to be said.
    """
    frequency = snapshot.frequency
    known = frequency[1:][np.isfinite(snapshot.data_psd[1:]).any(axis=1)]
    return (float(known[0]), float(known[-1])) if len(known) else (float(frequency[1]), 0.0)


class WithoutPartner(enum.StrEnum):
    """Why the noise of a channel cannot be told from motion."""

    ALONE = "alone"
    """Its sensor records none of the motion that the others share."""
    ONE_PARTNER = "one-partner"
    """Only one other sensor records the same motion; it takes two."""


def without_partners(snapshot: Snapshot, band: tuple[float, float]) -> dict[int, WithoutPartner]:
    """Return the channels, by column, whose noise cannot be told from motion somewhere in a band.

    As far as the test has been diagnosed.
    """
    found: dict[int, WithoutPartner] = {}
    sensors = [number for number, n_channels in enumerate(snapshot.dims) for _ in range(n_channels)]
    for advice in snapshot.diagnostics.advice:
        if not isinstance(advice, NoSharedMotion):
            continue
        if advice.band is not None and (advice.band[1] < band[0] or advice.band[0] > band[1]):
            continue
        for column, sensor in enumerate(sensors):
            if sensor in advice.sensors:
                found[column] = WithoutPartner.ALONE
            elif sensor in advice.partners and len(advice.partners) < 3:
                found.setdefault(column, WithoutPartner.ONE_PARTNER)
    return found
