"""What an archive says of the self-noise over months.

One pass over the stretches in order of time: days and the whole are averages of spectra, so a day
with gaps weighs by its segments; the density counts stretch by stretch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from daq.archive.averages import Average, Estimator, converted
from daq.archive.changes import Changes, Drift, changes, drift
from daq.archive.density import MIN_BINS, DensityCounter
from daq.archive.spectra_file import SpectraFile
from daq.errors import ArchiveError
from daq.results.band_summary import band_within, channel_means, judged_method
from estimator.errors import BandError
from estimator.levels.interval import CERTAIN, NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from datetime import tzinfo

    from numpy.typing import NDArray

    from daq.archive.density import Density
    from daq.archive.plan import Plan
    from daq.archive.spectra_file import Described
    from daq.archive.store import Entry
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

DAY_NS = 86400 * 10**9
FALSE_ALARM = 0.01
WORKING_HOURS = range(8, 18)
NIGHT_HOURS = frozenset({22, 23, 0, 1, 2, 3, 4, 5})


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Mean noise PSD in bands, in unit²/Hz, each array of shape (…, n_bands, n_channels)."""

    mean: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Contrast:
    """Noise in working hours against that at night.

    Attributes
    ----------
    weekday, night : Levels
        Of shape (n_bands, n_channels).
    n_weekday, n_night : int
        Segments.
    difference, low, high : float64, shape (n_bands, n_channels)
        Weekday over night in dB, with its 95 % interval; NaN where it has none.
    """

    weekday: Levels
    night: Levels
    n_weekday: int
    n_night: int
    difference: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What an archive says.

    Attributes
    ----------
    pooled : Snapshot
        The estimate from all recordings together.
    settings : Settings
    method : str
        That of all but `pooled`.
    bands : tuple of (float, float)
        In Hz: the band of the estimate, then octaves, unless a band was asked for.
    days_utc_ns : int64, shape (n_days,)
        Beginnings of days of UTC.
    n_segments : int64, shape (n_days,)
    levels : Levels
        Of shape (n_days, n_bands, n_channels).
    drift, changes : Drift, Changes
        Series are bands times channels.
    density : Density
    contrast : Contrast or None
        None where stretches are longer than an hour, or one of the two has too few segments.
    problems : tuple of str
        What could not be read.
    doubted : tuple of Described
        Of recordings that are left out, because the clock of a sensor is not understood.
    """

    pooled: Snapshot
    settings: Settings
    method: str
    bands: tuple[tuple[float, float], ...]
    days_utc_ns: IntArray
    n_segments: IntArray
    levels: Levels
    drift: Drift
    changes: Changes
    density: Density
    contrast: Contrast | None
    problems: tuple[str, ...]
    doubted: tuple[Described, ...]


def answer(
    plan: Plan,
    entries: Sequence[Entry],
    settings: Settings,
    *,
    zone: tzinfo = UTC,
    false_alarm: float = FALSE_ALARM,
    progress: Callable[[int, int], None] | None = None,
) -> Answer:
    """Answer from the spectra of an archive.

    Parameters
    ----------
    plan : Plan
    entries : sequence of Entry
        In order of time.
    settings : Settings
        Those of `plan`, but for what does not shape spectra.
    zone : tzinfo
        Of working hours and nights.
    false_alarm : float
        See `daq.archive.changes.changes`.
    progress : callable, optional
        Receives how many recordings are done, and of how many.

    Raises
    ------
    ArchiveError
        If there is no spectrum that could be read.
    WrongSettingError
        If a unit or gain does not fit the sensors.
    """
    known = [entry for entry in entries if entry.start_utc_ns is not None]
    if not known:
        raise ArchiveError(
            "the archive has no spectra yet: no recording holds one whole segment of"
            f" {plan.settings.segment:g} s"
        )
    doubted = tuple(one.described for one in known if one.described.not_understood)
    known = [one for one in known if not one.described.not_understood]
    if not known:
        raise ArchiveError(
            "the archive has no recording in which all clocks are understood: check whether"
            " samples are lost or repeated without being counted, and the sampling rates"
        )
    channels = known[0].described.channels
    every = Estimator(plan, settings, channels)
    # Days and stretches go by the method that judges.
    first = settings.methods[:1] if settings.methods[:1] != ("all",) else ("auto",)
    one = Estimator(plan, replace(settings, methods=first), channels)
    usable = min(entry.described.usable for entry in known)
    bands = _bands(one, usable)
    tally = _Tally(plan, one, zone, bands)
    pooled = Average()
    problems: list[str] = []
    for number, entry in enumerate(known):
        if progress is not None:
            progress(number, len(known))
        pooled.add_totals(entry.described)
        problems += tally.take(entry, pooled)
    snapshot = every.snapshot(pooled, diagnose=True)
    tally.end()
    days = np.array(sorted(tally.days), dtype=np.int64)
    levels = Levels(*np.stack([tally.days[day].means for day in days.tolist()], axis=1))
    n_series = (-1, len(bands) * len(snapshot.channels))
    at = (days - days[0]) / DAY_NS
    mean, spread = levels.mean.reshape(n_series), levels.spread.reshape(n_series)
    return Answer(
        pooled=snapshot,
        settings=settings,
        method=judged_method(snapshot, one.settings),
        bands=bands,
        days_utc_ns=days,
        n_segments=np.array([tally.days[day].n_segments for day in days.tolist()]),
        levels=levels,
        drift=drift(at, mean, spread),
        changes=changes(mean, spread, false_alarm=false_alarm),
        density=tally.density.density(),
        contrast=tally.contrast(),
        problems=tuple(problems),
        doubted=doubted,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Day:
    """What is kept of a day: its spectra would fill the memory."""

    n_segments: int
    means: FloatArray
    """As `_Tally._means` returns them."""


class _Tally:
    """What is gathered from the stretches on the way through the archive."""

    def __init__(
        self,
        plan: Plan,
        one: Estimator,
        zone: tzinfo,
        bands: Sequence[tuple[float, float]],
    ) -> None:
        self._plan, self._one, self._zone, self._bands = plan, one, zone, bands
        self.density = DensityCounter(one.welch.frequencies, len(one.channels))
        self.days: dict[int, _Day] = {}
        self._open: dict[int, Average] = {}
        self._weekday, self._night = Average(), Average()

    def take(self, entry: Entry, pooled: Average) -> list[str]:
        """Take every stretch of a recording; returns a message for each that is damaged."""
        problems = []
        described = entry.described
        response = self._one.responses(described.channels)
        first = (entry.start_utc_ns or 0) // DAY_NS * DAY_NS
        self._end_days(before=first)
        with SpectraFile(entry.path) as file:
            for row, (start, n_segments) in enumerate(file.stretches.tolist()):
                try:
                    csm = converted(file.csm(row), response)
                except ArchiveError as error:
                    problems.append(
                        f"{error} (stretch from {_utc(start)}): left out. Delete the file and run"
                        f" again with {described.origin.path}"
                    )
                    continue
                day = start // DAY_NS * DAY_NS
                self._end_days(before=min(day, first))
                averages = [pooled, self._open.setdefault(day, Average())]
                if self._plan.stretch == "hour":
                    averages += self._times_of_day(start)
                for average in averages:
                    average.add(described, start, n_segments, csm)
                alone = Average()
                alone.add(described, start, n_segments, csm)
                self.density.add(self._noise_of(alone))
        return problems

    def _times_of_day(self, start_utc_ns: int) -> list[Average]:
        local = datetime.fromtimestamp(start_utc_ns / 1e9, self._zone)
        if local.hour in NIGHT_HOURS:
            return [self._night]
        working = local.weekday() < 5 and local.hour in WORKING_HOURS
        return [self._weekday] if working else []

    def _noise_of(self, alone: Average) -> FloatArray | None:
        """Return the noise PSD of one stretch; None with less than half of its segments."""
        whole = self._plan.stretch_s * self._one.welch.sampling_rate / self._one.welch.hop
        if alone.n_segments < whole / 2:
            return None
        results = self._one.snapshot(alone, curves_only=True).results
        return next(iter(results.values())).noise_psd if results else None

    def _end_days(self, before: float) -> None:
        for day in [day for day in self._open if day < before]:
            snapshot = self._one.snapshot(self._open.pop(day))
            self.days[day] = _Day(snapshot.n_segments, self._means(snapshot))

    def end(self) -> None:
        """End the last days."""
        self._end_days(np.inf)

    def contrast(self) -> Contrast | None:
        """Compare working hours and nights; None where one of them has too little."""
        both = (self._weekday, self._night)
        if not all(each.n_segments for each in both):
            return None
        snapshots = [self._one.snapshot(each) for each in both]
        if not all(each.results for each in snapshots):
            return None
        weekday, night = (Levels(*self._means(each)) for each in snapshots)
        with np.errstate(invalid="ignore", divide="ignore"):
            difference = 10 * np.log10(weekday.mean / night.mean)
            relative = np.hypot(weekday.spread / weekday.mean, night.spread / night.mean)
        half = NORMAL_95 * 10 / np.log(10) * relative
        sure = (weekday.mean > CERTAIN * weekday.spread) & (night.mean > CERTAIN * night.spread)
        difference = np.where(sure, difference, np.nan)
        return Contrast(
            weekday,
            night,
            self._weekday.n_segments,
            self._night.n_segments,
            difference,
            difference - half,
            difference + half,
        )

    def _means(self, snapshot: Snapshot) -> FloatArray:
        """Return mean, spread, low and high, shape (4, n_bands, n_channels)."""
        found = np.full((4, len(self._bands), len(snapshot.channels)), np.nan)
        noise = next(iter(snapshot.results.values()), None)
        for number, band in enumerate(self._bands):
            if noise is None:
                continue
            try:
                means = channel_means(noise, snapshot, self._one.settings, band)
            except BandError:
                continue
            found[:, number] = np.array(
                [[m.mean[0], m.spread[0], m.low[0], m.high[0]] for m in means]
            ).T
        return found


def _bands(one: Estimator, usable: float) -> tuple[tuple[float, float], ...]:
    """Return the bands of the series; nothing is known above `usable` Hz."""
    frequency = one.welch.frequencies
    whole = band_within(one.settings, frequency, float(frequency[frequency <= usable].max()))
    if one.settings.band is not None:
        return (whole,)
    octaves = []
    centre = 2.0 ** np.ceil(np.log2(whole[0]) + 0.5)
    while centre * np.sqrt(2) <= whole[1]:
        edges = (float(centre / np.sqrt(2)), float(centre * np.sqrt(2)))
        if np.count_nonzero((frequency >= edges[0]) & (frequency <= edges[1])) >= MIN_BINS:
            octaves.append(edges)
        centre *= 2
    return (whole, *octaves)


def _utc(ns: int) -> str:
    return f"{datetime.fromtimestamp(ns / 1e9, UTC):%Y-%m-%dT%H:%MZ}"
