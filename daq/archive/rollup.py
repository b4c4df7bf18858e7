"""What answers are made of, in parts that add: of a stretch, a day, a month.

Whoever has the cross-spectral matrices of a recording makes its summaries, one a month: the noise
and the recorded PSD of every stretch on a `Grid` of 1/24 octaves; of every day also the cumulants
of the noise, what widens its interval, and its bound; and the sum of the matrices. Summaries of one
month make a roll-up: days in several recordings become one, and densities count stretches.

Levels of independent spectra add: the mean by segments, the cumulant T_k with the k-th power of the
shares (`estimator.levels.interval`). So do those of neighbouring bands, but for the correlation of
neighbouring bins.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, tzinfo
from itertools import groupby
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from daq.archive.averages import Average, Estimator
from daq.archive.density import Density, counted
from daq.archive.spectra_file import DAY_NS, Described, Summary
from daq.results.band_summary import Levels, Spectrum, band_within, correlation_of
from estimator.errors import BandError
from estimator.levels.bands import BandLevels, band_edges
from estimator.levels.contributions import Contribution, Source, deviation
from estimator.levels.interval import NORMAL_95, like_psd

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    import h5py
    from numpy.typing import NDArray

    from daq.archive.plan import Plan
    from daq.estimation.settings import Settings

    FloatArray = NDArray[np.float64]
    SmallArray = NDArray[np.float32]
    IntArray = NDArray[np.int64]
    ComplexArray = NDArray[np.complex128]

PER_OCTAVE = 24
_LEAST = 1e-4
"""Correlation of bins that counts."""
WORK, EARLY, LATE = range(3)
"""Parts of a local day: 8 to 18 h, 0 to 6 h, 22 to 24 h. The mean of the two nights has the middle
of the working hours, so that a drift does not enter their difference."""
_PART_OF_HOUR = dict.fromkeys(range(8, 18), WORK) | dict.fromkeys(range(6), EARLY) | {22: 2, 23: 2}
(MEAN, DEVIATION, SKEWNESS, TAIL, BELOW, ABOVE, SHARE, BOUND, BOUND_DEVIATION, RECORDED) = range(10)
"""Of a day: mean noise, √T₂, T₃/T₂^1.5 and T₄/T₂², what widens its interval, what the other sensors
leave unpredicted, and the recorded PSD."""
N_FIELDS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Bands of 1/24 octave, or of one bin where bins are wider; further edges where bands end.

    Attributes
    ----------
    frequency : float64, shape (n_freqs,)
    edges : int64, shape (n_fine + 1,)
        Band b has bins ``edges[b]`` to ``edges[b + 1]``, excluded.
    correlation : float64, shape (n_lags,)
        Of bins.
    """

    frequency: FloatArray
    edges: IntArray
    correlation: FloatArray
    _known: list[FloatArray] = field(default_factory=list)
    """Correlations of fine bands, once they are needed."""
    _parts: dict[tuple[int, int], Grid] = field(default_factory=dict)
    """Grids of some of the bands, by first and last: a year after another asks for the same."""

    @classmethod
    def of(cls, estimator: Estimator) -> Self:
        """Return the grid of an estimator's spectra."""
        frequency = estimator.welch.frequencies
        known = estimator.welch.lowest, np.inf
        first, last = np.log2(frequency[[1, -1]]) * PER_OCTAVE
        nominal = 2.0 ** (np.arange(np.floor(first), np.ceil(last) + 1) / PER_OCTAVE)
        edges = set(np.searchsorted(frequency, nominal).tolist())
        usual = replace(estimator.settings, band=None)
        for band in {band_within(each, frequency, known) for each in (estimator.settings, usual)}:
            try:
                edges |= set(band_edges(frequency, band).tolist())
            except BandError:
                continue
        end = len(frequency) - 1
        inside = sorted({1, end} | {edge for edge in edges if 1 < edge < end})
        return cls(frequency, np.array(inside, np.int64), correlation_of(estimator.settings))

    @property
    def n_bins(self) -> IntArray:
        """Bins of each band."""
        return np.diff(self.edges)

    @property
    def middle(self) -> FloatArray:
        """Geometric middle of each band in Hz."""
        low, high = self.frequency[self.edges[:-1]], self.frequency[self.edges[1:] - 1]
        return np.asarray(np.sqrt(low * high))

    def mean(self, psd: FloatArray) -> FloatArray:
        """Return means over the known bins of each band, of shape (n_freqs, n_channels)."""
        known = np.isfinite(psd)
        starts, inside = self.edges[:-1] - 1, slice(1, int(self.edges[-1]))
        total = np.add.reduceat(np.where(known, psd, 0.0)[inside], starts, axis=0)
        number = np.add.reduceat(known[inside].astype(float), starts, axis=0)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.where(number > 0, total / number, np.nan))

    def more(self, noise: FloatArray, alone: FloatArray) -> FloatArray:
        """Return what noise has over that of spectra estimated alone, by octave.

        All of shape (n_fine, n_channels); where either is not known, none.
        """
        known = np.isfinite(noise) & np.isfinite(alone)
        noise, apart = np.where(known, noise, 0.0), np.where(known, noise - alone, 0.0)
        spans = [slice(k, k + PER_OCTAVE) for k in range(0, len(noise), PER_OCTAVE)]
        with np.errstate(invalid="ignore", divide="ignore"):
            share = self.average(apart, spans) / self.average(noise, spans)
        return np.nan_to_num(share).repeat(PER_OCTAVE, axis=0)[: len(noise)] * noise

    def at_bins(self, fine: FloatArray) -> FloatArray:
        """Return values of bands, of shape (n_fine, n_channels), at all frequencies."""
        place = np.searchsorted(self.edges, np.arange(len(self.frequency)), side="right") - 1
        return np.asarray(fine[np.clip(place, 0, len(fine) - 1)])

    def span(self, band: tuple[float, float]) -> slice:
        """Return the bands within a band in Hz, whose ends move to the nearest edges.

        Raises
        ------
        BandError
            If the band has no frequency.
        """
        first, last = band_edges(self.frequency, band)
        at = np.abs(self.edges[:, None] - np.array([first, last])).argmin(axis=0)
        begin = min(int(at[0]), len(self.edges) - 2)
        return slice(begin, max(int(at[1]), begin + 1))

    def within(self, fine: slice) -> Grid:
        """Return some of the bands."""
        ends = fine.start, fine.stop
        if ends not in self._parts:
            edges = self.edges[fine.start : fine.stop + 1]
            self._parts[ends] = replace(self, edges=edges, _known=[], _parts={})
        return self._parts[ends]

    def has(self, band: tuple[float, float]) -> bool:
        """Return whether the ends of a band are edges."""
        return bool(np.isin(band_edges(self.frequency, band), self.edges).all())

    def average(self, psd: FloatArray | SmallArray, spans: Sequence[slice]) -> FloatArray:
        """Return means over the known bands of `spans`, of (…, n_fine, n_channels)."""
        known = np.isfinite(psd)
        weight = known * self.n_bins[:, None].astype(np.float64)
        weighted = np.where(known, psd, 0.0) * weight
        total, weight = (_sums(each, spans) for each in (weighted, weight))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(total / weight)

    def ends(self, span: slice) -> tuple[float, float]:
        """Return the first and the last frequency of a `span`, in Hz."""
        first, last = int(self.edges[span.start]), int(self.edges[span.stop]) - 1
        return float(self.frequency[first]), float(self.frequency[last])

    def levels(self, days: FloatArray | SmallArray, spans: Sequence[slice]) -> Levels:
        """Return levels of bands from those of days.

        Parameters
        ----------
        days : float, shape (N_FIELDS, …, n_fine, n_channels)
        spans : sequence of slice
            Bands: they take the place of the fine ones.
        """
        own = np.asarray(days, np.float64)
        known = np.isfinite(own[MEAN]) & np.isfinite(own[DEVIATION])
        if not known.all():
            own = np.where(known, own, 0.0)
        unbounded = ~(own[BOUND] > 0)
        bins = self.n_bins[:, None].astype(np.float64)
        deviation = own[DEVIATION] * bins
        of_bound = np.where(unbounded, 0.0, own[BOUND_DEVIATION]) * bins
        mean, square = own[MEAN] * bins, deviation**2
        size = np.abs(mean)
        with np.errstate(invalid="ignore"):
            below, above, share = (
                np.where(by > 0, own[field] * by, 0.0) if own[field].any() else np.zeros(by.shape)
                for field, by in ((BELOW, known * bins), (ABOVE, known * bins), (SHARE, size))
            )
        parts = (
            *(known * bins, mean, square, own[SKEWNESS] * (square * deviation)),
            *(own[TAIL] * square**2, below, above, size, share),
            *(np.where(unbounded, 0.0, own[BOUND]) * bins, of_bound**2, ~known, unbounded),
        )
        total, mean, t2, t3, t4, below, above, size, share, bound, spread, n_unknown, n_open = (
            _sums(np.asarray(part, np.float64), spans) for part in parts
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            more = self._pairs(deviation, spans)
            excess = 1 + np.where(t2 > 0, more / t2, 0.0)
            cumulants = np.stack(
                [t * excess ** (k - 1) / total**k for k, t in ((2, t2), (3, t3), (4, t4))]
            )
            widening = Contribution(
                Source.MISFIT, below / total, above / total, np.where(size > 0, share / size, 0.0)
            )
            mean = np.where(total > 0, mean / total, np.nan)
            bounded = (n_open == 0) & (n_unknown == 0)
            bound = np.where(bounded, bound / total, np.nan)
            spread = np.sqrt(spread + self._pairs(of_bound, spans)) / total
        scatter = like_psd(np.where(bounded, bound, 1.0), np.where(bounded, spread, 0.0))
        return Levels(
            BandLevels(mean, np.where(total > 0, cumulants, np.nan), n_unknown == 0),
            (widening,),
            BandLevels(bound, scatter, bounded),
            np.zeros(mean.shape, np.bool_),
        )

    def _pairs(self, deviation: FloatArray, spans: Sequence[slice]) -> FloatArray:
        """Return what the correlation of bins adds to the variance of sums over fine bands."""
        total = np.zeros((*deviation.shape[:-2], len(spans), deviation.shape[-1]))
        for lag, factor in enumerate(self._factors(), 1):
            pairs = deviation[..., lag:, :] * deviation[..., :-lag, :] * factor[:, None]
            total += _sums(pairs, [slice(s.start, max(s.stop - lag, s.start)) for s in spans])
        return total

    def _factors(self) -> list[FloatArray]:
        """Return twice the correlation of fine bands 1, 2, … bands apart."""
        if not self._known:
            begin, rho = self.edges[:-1].tolist(), self.correlation
            n_bins = self.n_bins.tolist()
            inner = np.array([_within(n, rho) for n in n_bins])
            for lag in range(1, min(len(rho), len(n_bins))):
                shared = np.array(
                    [
                        _between(begin[b + lag] - begin[b], n_bins[b], n_bins[b + lag], rho)
                        for b in range(len(n_bins) - lag)
                    ]
                )
                if not np.any(shared > _LEAST):
                    break
                self._known.append(2 * shared / np.sqrt(inner[lag:] * inner[:-lag]))
        return self._known


def _sums(values: FloatArray, spans: Sequence[slice]) -> FloatArray:
    """Return sums over fine bands, of shape (…, n_spans, n_channels)."""
    if not np.isfinite(values).all():  # infinite in one span, and in no other
        return np.stack([values[..., span, :].sum(axis=-2) for span in spans], axis=-2)
    inside = np.zeros((len(spans), values.shape[-2]))
    for row, span in zip(inside, spans, strict=True):
        row[span] = 1.0
    return np.asarray(inside @ values)


def _within(n: int, rho: FloatArray) -> float:
    """Return the sum of the correlations of n neighbouring bins."""
    lag = np.arange(1, min(n, len(rho)))
    return float(n + 2 * np.sum((n - lag) * rho[lag]))


def _between(apart: int, n: int, other: int, rho: FloatArray) -> float:
    """Return the sum of the correlations of n bins with `other` bins that begin `apart` later."""
    first = np.arange(max(0, n - len(rho)), n)
    second = apart + np.arange(min(other, len(rho)))
    lags = second[None, :] - first[:, None]
    return float(np.sum(np.where(lags < len(rho), rho[np.minimum(lags, len(rho) - 1)], 0.0)))


def month_of(utc_ns: int) -> str:
    """Return the month of an instant, as in ``2026-07``."""
    return f"{datetime.fromtimestamp(utc_ns / 1e9, UTC):%Y-%m}"


def summaries(
    rows: Iterable[tuple[int, int, ComplexArray]],
    described: Described,
    plan: Plan,
    settings: Settings,
    changed: Mapping[int, FloatArray],
) -> Iterator[tuple[str, Summary]]:
    """Yield the summaries of a recording, each with its month.

    Parameters
    ----------
    rows : iterable of (int, int, complex128 array)
        Beginning, segments and mean matrix of each stretch, in order.
    described : Described
    plan : Plan
    settings : Settings
        Of the noise; its first method counts.
    changed : mapping of int to float64 array, shape (n_fine, n_channels)
        `Summary.changed` of stretches, by their beginning; where it is known.
    """
    estimator = Estimator(plan, settings, described.channels)
    for month, some in groupby(rows, lambda row: month_of(row[0])):
        making = _Making(estimator, described, changed)
        for row in some:
            making.take(*row)
        yield month, making.made()


class _Making:
    """A summary, while stretches come."""

    def __init__(
        self, estimator: Estimator, described: Described, changed: Mapping[int, FloatArray]
    ) -> None:
        self._estimator, self._described, self._changed = estimator, described, changed
        self._grid = Grid.of(estimator)
        self._stretches: list[tuple[int, int, FloatArray, FloatArray, FloatArray]] = []
        self._days: list[tuple[int, int, FloatArray]] = []
        self._day, self._begin = Average(), 0
        self._total: ComplexArray = np.zeros(1, np.complex128)

    def take(self, start: int, n_segments: int, csm: ComplexArray) -> None:
        day = start // DAY_NS * DAY_NS
        if self._day.n_segments and day != self._begin:
            self._end_day()
        self._begin = day
        self._day.add(self._described, start, n_segments, csm)
        self._total = self._total + csm * n_segments
        alone = Average()
        alone.add(self._described, start, n_segments, csm)
        snapshot = self._estimator.snapshot(alone, curves_only=True)
        result = next(iter(snapshot.results.values()), None)
        recorded = self._grid.mean(snapshot.data_psd)
        noise = np.full(recorded.shape, np.nan)
        if result is not None:
            noise = self._grid.mean(result.noise_psd)
        changed = self._changed.get(start, np.full(recorded.shape, np.nan))
        self._stretches.append((start, n_segments, noise, recorded, changed))

    def _end_day(self) -> None:
        snapshot = self._estimator.snapshot(self._day)
        grid, shape = self._grid, (len(self._grid.n_bins), len(snapshot.channels))
        row = np.full((N_FIELDS, *shape), np.nan)
        row[RECORDED] = grid.mean(snapshot.data_psd)
        result = next(iter(snapshot.results.values()), None)
        if result is not None:
            found = Spectrum(result, snapshot, self._estimator.settings).levels(grid.edges)
            t2, t3, t4 = found.of_scatter.cumulants
            with np.errstate(invalid="ignore", divide="ignore"):
                row[DEVIATION] = np.sqrt(np.maximum(t2, 0.0))
                row[SKEWNESS] = np.where(t2 > 0, t3 / t2**1.5, 0.0)
                row[TAIL] = np.where(t2 > 0, t4 / t2**2, 0.0)
            row[MEAN] = found.mean
            row[BELOW] = sum((each.below for each in found.contributions), np.zeros(shape))
            row[ABOVE] = sum((each.above for each in found.contributions), np.zeros(shape))
            row[SHARE] = sum((each.share for each in found.contributions), np.zeros(shape))
            row[SHARE] += NORMAL_95 * deviation(found.contributions)
            more = self._more_than_alone(grid.mean(result.noise_psd))
            row[BELOW] += np.maximum(more, 0.0)
            row[ABOVE] += np.maximum(-more, 0.0)
            row[BOUND] = np.where(found.bound.complete, found.bound.mean, np.nan)
            row[BOUND_DEVIATION] = np.where(found.bound.complete, found.bound.spread, np.nan)
        self._days.append((self._begin, self._day.n_segments, row))
        self._day = Average()

    def _more_than_alone(self, noise: FloatArray) -> FloatArray:
        """Return what the noise of the day has over that of its stretches, each estimated alone."""
        own = [each for each in self._stretches if each[0] >= self._begin]
        alone = [noise_alone(noise, changed) for _, _, noise, _, changed in own]
        total, count = summed(np.stack(alone), np.array([o[1] for o in own]))
        with np.errstate(invalid="ignore"):
            return self._grid.more(noise, total / count)

    def made(self) -> Summary:
        """Return the summary."""
        self._end_day()
        starts, n_segments, noise, recorded, changed = zip(*self._stretches, strict=True)
        days, day_segments, rows = zip(*self._days, strict=True)
        return Summary(
            np.array(starts, np.int64),
            np.array(n_segments, np.int64),
            np.array(noise, np.float32),
            np.array(recorded, np.float32),
            np.array(changed, np.float32),
            np.array(days, np.int64),
            np.array(day_segments, np.int64),
            np.stack(rows, axis=1).astype(np.float32),
            self._total,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Rollup:
    """Ingredients of all recordings in one month; arrays as in `Summary`.

    Attributes
    ----------
    days, day_segments, levels
        Each day once, in order.
    local_days : int64, shape (n_local,)
        Ordinals (`datetime.date.toordinal`) in the time zone of the answer.
    part_segments : int64, shape (n_local, 3)
        Segments of each part of the day (`WORK`, `EARLY`, `LATE`).
    part_noise : float32, shape (n_local, 3, n_fine, n_channels)
    noise, recorded : Density
    alone, alone_segments : float64, shape (n_fine, n_channels)
        Noise of stretches, each estimated alone, without what changes of responses within it may
        leave of the motion, times their segments; and these segments.
    untested : int64, shape (1,)
        Segments of stretches in which such changes are not tested.
    total : complex128
        In the units of the archive's first recording.
    n_segments : int
        In `total`.
    """

    days: IntArray
    day_segments: IntArray
    levels: SmallArray
    local_days: IntArray
    part_segments: IntArray
    part_noise: SmallArray
    noise: Density
    recorded: Density
    alone: FloatArray
    alone_segments: FloatArray
    untested: IntArray
    total: ComplexArray
    n_segments: int


@dataclass(frozen=True, slots=True, eq=False)
class DailyLevels:
    """Levels of bands by day: what most answers show.

    Attributes
    ----------
    days, day_segments : int64, shape (n_days,)
    mean, spread, low, high : float64, shape (n_days, n_bands, n_channels)
        Noise in unit²/Hz, its standard deviation, and its 95 % interval.
    noise : float32, shape (n_days, n_fine, n_channels)
        In fine bands.
    local_days : int64, shape (n_local,)
        A day that two months share is there twice.
    part_segments : int64, shape (n_local, 3)
    part_noise : float64, shape (n_local, 3, n_bands, n_channels)
    """

    days: IntArray
    day_segments: IntArray
    mean: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray
    noise: SmallArray
    local_days: IntArray
    part_segments: IntArray
    part_noise: FloatArray


def series_of(months: Sequence[h5py.Group], grid: Grid, spans: Sequence[slice]) -> DailyLevels:
    """Return the series of bands.

    Parameters
    ----------
    months : sequence of h5py.Group
        In order of time, with the arrays of a `Rollup` by their names; one at least.
    grid : Grid
    spans : sequence of slice
        Of each band (`Grid.span`).
    """
    names = ("days", "day_segments", "local_days", "part_segments")
    made: dict[str, Any] = {
        name: np.concatenate([month[name][...] for month in months]) for name in names
    }
    made["noise"] = np.concatenate([month["levels"][MEAN] for month in months])
    return DailyLevels(**made, **levels_of(months, grid, spans))


def levels_of(months: Sequence[h5py.Group], grid: Grid, spans: Sequence[slice]) -> dict[str, Any]:
    """Return the fields of `DailyLevels` that are of bands; no other fine bands are read."""
    fine = slice(min(each.start for each in spans), max(each.stop for each in spans))
    spans = [slice(each.start - fine.start, each.stop - fine.start) for each in spans]
    grid = grid.within(fine)
    found = []
    for month in months:
        own = grid.levels(month["levels"][:, :, fine], spans)
        parts = grid.average(month["part_noise"][:, :, fine], spans)
        found.append((own.mean, own.of_scatter.spread, *own.ends(), parts))
    names = ("mean", "spread", "low", "high", "part_noise")
    return {
        name: np.concatenate(each)
        for name, each in zip(names, zip(*found, strict=True), strict=True)
    }


def rolled_up(
    found: Sequence[Summary], grid: Grid, *, zone: tzinfo, whole: float, hours: bool
) -> Rollup:
    """Return the roll-up of one month.

    Parameters
    ----------
    found : sequence of Summary
        In order of time; their totals in the units of the archive.
    grid : Grid
    zone : tzinfo
        Of local days.
    whole : float
        Segments of a stretch without gaps: densities count stretches with half of them or more.
    hours : bool
        Whether stretches are hours, so that days have parts.
    """
    days, day_segments, rows = _merged_days(found)
    local: dict[int, tuple[IntArray, FloatArray]] = {}
    noise = recorded = None
    for each in found:
        enough = each.n_segments >= whole / 2
        estimated = enough & np.isfinite(each.noise).any(axis=(1, 2))
        noise = _counted_too(noise, each.noise, estimated, grid)
        recorded = _counted_too(recorded, each.recorded, enough, grid)
        if hours:
            _count_parts(local, each, zone)
    if noise is None or recorded is None:
        raise ValueError("a month without recordings")
    ordinals = sorted(local)
    shape = (len(ordinals), 3, *rows.shape[2:])
    parts = np.zeros(shape)
    segments = np.zeros(shape[:2], np.int64)
    for row, ordinal in enumerate(ordinals):
        segments[row] = local[ordinal][0]
        with np.errstate(invalid="ignore", divide="ignore"):
            parts[row] = local[ordinal][1] / segments[row][:, None, None]
    alone = [
        summed(noise_alone(each.noise, each.changed), each.n_segments)
        if len(each.starts)
        else summed(each.levels[MEAN], each.day_segments)
        for each in found
    ]
    tested = sum(
        int(each.n_segments[np.isfinite(each.changed).any(axis=(1, 2))].sum()) for each in found
    )
    n_segments = int(sum(each.day_segments.sum() for each in found))
    return Rollup(
        days=days,
        day_segments=day_segments,
        levels=rows,
        local_days=np.array(ordinals, np.int64),
        part_segments=segments,
        part_noise=parts.astype(np.float32),
        noise=noise,
        recorded=recorded,
        alone=np.sum([noise for noise, _ in alone], axis=0),
        alone_segments=np.sum([count for _, count in alone], axis=0),
        untested=np.array([n_segments - tested]),
        total=np.sum([each.total for each in found], axis=0),
        n_segments=n_segments,
    )


def noise_alone(noise: FloatArray | SmallArray, changed: FloatArray | SmallArray) -> FloatArray:
    """Return noise without what changes of responses may leave in it; all where not tested."""
    return np.asarray(noise * (1 - np.minimum(np.nan_to_num(changed), 1.0)), np.float64)


def summed(noise: FloatArray | SmallArray, n_segments: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return noise of several spectra times their segments, summed, and the segments of the known.

    Both of shape (n_fine, n_channels), from (n, n_fine, n_channels).
    """
    weight = np.isfinite(noise) * n_segments[:, None, None].astype(np.float64)
    return (np.nan_to_num(noise) * weight).sum(axis=0), weight.sum(axis=0)


def _counted_too(
    sum_: Density | None, psd: SmallArray, some: NDArray[np.bool_], grid: Grid
) -> Density:
    """Return the sum with these stretches of a recording; the others are too short for it."""
    own = np.asarray(psd[some], np.float64)
    found = counted(own, grid.frequency, grid.edges, n_short=int(np.sum(~some)))
    return found if sum_ is None else sum_ + found


def _count_parts(
    local: dict[int, tuple[IntArray, FloatArray]], found: Summary, zone: tzinfo
) -> None:
    """Add the hours of a recording to the parts of local days."""
    for start, n, noise in zip(found.starts, found.n_segments, found.noise, strict=True):
        if not np.isfinite(noise).any():
            continue
        middle = datetime.fromtimestamp(int(start) // 10**9 + 1800, zone)
        part = _PART_OF_HOUR.get(middle.hour)
        if part is not None:
            zeros = np.zeros(3, np.int64), np.zeros((3, *noise.shape))
            segments, total = local.setdefault(middle.toordinal(), zeros)
            segments[part] += n
            total[part] += int(n) * noise.astype(np.float64)


def _merged_days(found: Sequence[Summary]) -> tuple[IntArray, IntArray, SmallArray]:
    """Return days, segments and levels; days that several recordings share become one."""
    days = np.concatenate([each.days for each in found])
    segments = np.concatenate([each.day_segments for each in found])
    rows = np.concatenate([each.levels for each in found], axis=1)
    unique, place = np.unique(days, return_inverse=True)
    if len(unique) == len(days):
        order = np.argsort(days)
        return days[order], segments[order], rows[:, order]
    merged = [merged_levels(rows[:, place == k], segments[place == k]) for k in range(len(unique))]
    summed = np.bincount(place, weights=segments).astype(np.int64)
    return unique, summed, np.stack(merged, axis=1).astype(np.float32)


def merged_levels(rows: SmallArray, n_segments: IntArray) -> FloatArray:
    """Return the levels of several spectra as one, shape (N_FIELDS, n_fine, n_channels).

    Parameters
    ----------
    rows : float32, shape (N_FIELDS, n, n_fine, n_channels)
    n_segments : int64, shape (n,)
    """
    own = np.asarray(rows, np.float64)
    if own.shape[1] == 1:
        return own[:, 0]
    known = np.isfinite(own[MEAN]) & np.isfinite(own[DEVIATION])
    count = np.broadcast_to(n_segments[:, None, None], known.shape)

    def mean(name: int, some: NDArray[np.bool_]) -> FloatArray:
        weight = np.where(some, count, 0.0)
        with np.errstate(invalid="ignore"):
            weighted = np.where(weight > 0, own[name] * weight, 0.0).sum(axis=0)
            return np.asarray(weighted / weight.sum(axis=0))

    found = np.full(own[:, 0].shape, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(known, count, 0.0)
        share /= share.sum(axis=0)
        deviation = np.where(known, share * own[DEVIATION], 0.0)
        t2 = (deviation**2).sum(axis=0)
        found[DEVIATION] = np.where(known.any(axis=0), np.sqrt(t2), np.nan)
        for name, power in ((SKEWNESS, 3), (TAIL, 4)):
            total = np.where(known, own[name] * deviation**power, 0.0).sum(axis=0)
            found[name] = np.where(t2 > 0, total / t2 ** (power / 2), 0.0)
        for name in (MEAN, BELOW, ABOVE):
            found[name] = mean(name, known)
        size = np.where(known, share * np.abs(own[MEAN]), 0.0)
        shares = np.where(size > 0, size * own[SHARE], 0.0).sum(axis=0)
        found[SHARE] = np.where(size.sum(axis=0) > 0, shares / size.sum(axis=0), 0.0)
        found[RECORDED] = mean(RECORDED, np.isfinite(own[RECORDED]))
        bounded = np.isfinite(own[BOUND])
        found[BOUND] = np.where(bounded.all(axis=0), mean(BOUND, bounded), np.nan)
        part = np.where(bounded, share * own[BOUND_DEVIATION], 0.0)
        found[BOUND_DEVIATION] = np.sqrt((part**2).sum(axis=0))
    return found
