"""What an archive says of the self-noise over years, from the roll-ups of these.

The whole is the average of all spectra, a day that of its own; densities count stretches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC
from functools import reduce
from operator import add
from typing import TYPE_CHECKING

import numpy as np

from daq.archive.averages import Average, Estimator
from daq.archive.changes import MIN_CONTRAST_DAYS, MIN_DAYS, courses
from daq.archive.density import MIN_BINS
from daq.archive.rollup import MEAN
from daq.archive.spectra_file import unpacked
from daq.archive.years import Years, density_of
from daq.errors import ArchiveError
from daq.results.band_summary import band_within, judged_method
from daq.results.facts import (
    ChangesUndecided,
    NightsNotCompared,
    Rank,
    RecordingsLeftOut,
    SpectraUnreadable,
    StretchesLeftOut,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from datetime import tzinfo

    import h5py
    from numpy.typing import NDArray

    from daq.archive.changes import Course
    from daq.archive.density import Density
    from daq.archive.index import Entry
    from daq.archive.rollup import Grid
    from daq.archive.spectra_file import Described
    from daq.archive.store import Store
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.facts import Fact

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

FALSE_ALARM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Levels:
    """Mean noise PSD in bands, in unit²/Hz, each array of shape (…, n_bands, n_channels)."""

    mean: FloatArray
    spread: FloatArray
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
    courses : tuple of Course
        Changes, drift and contrasts of each series: bands times channels, a band after another.
    false_alarm : float
        Of changes, in all series together.
    density, recorded : Density
        Of the noise, and of the recorded PSD.
    fine_hz : float64, shape (n_fine + 1,)
        Edges of bands of 1/24 octave.
    spectrogram : float32, shape (n_days, n_fine, n_channels)
        Noise of every day in these, in unit²/Hz.
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
    courses: tuple[Course, ...]
    false_alarm: float
    density: Density
    recorded: Density
    fine_hz: FloatArray
    spectrogram: NDArray[np.float32]
    problems: tuple[str, ...]
    doubted: tuple[Described, ...]


def answer(
    store: Store,
    entries: Sequence[Entry],
    settings: Settings,
    *,
    zone: tzinfo = UTC,
    false_alarm: float = FALSE_ALARM,
    progress: Callable[[int, int], None] | None = None,
) -> Answer:
    """Answer from an archive.

    Parameters
    ----------
    store : Store
    entries : sequence of Entry
        In order of time.
    settings : Settings
        Those of the archive's plan, but for what does not shape spectra. Where they change the
        noise itself (method, unit, …), it is estimated again from the matrices.
    zone : tzinfo
        Of working hours and nights.
    false_alarm : float
        See `daq.archive.changes.courses`.
    progress : callable, optional
        Receives how many recordings are read, and of how many.

    Raises
    ------
    ArchiveError
        If there is no spectrum that could be read.
    WrongSettingError
        If a unit or gain does not fit the sensors.
    """
    plan = store.plan
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
    every = Estimator(plan, settings, known[0].described.channels)
    years = Years(store, known, settings, zone=zone, progress=progress)
    usable = min(entry.described.usable for entry in known)
    tally = _Tally(years.grid, _bands(settings, years.grid.frequency, usable))
    pooled = Average()
    for file in years.each():
        pooled.add_sum(unpacked(file["total"][...]), int(file.attrs["n_segments"]))
        tally.take(file)
    for entry in known:
        if entry.described.origin.run_id not in years.damaged:
            about = replace(entry.described, rounded=years.is_rounded(entry))
            pooled.add_segments(about, entry.start_utc_ns or 0, entry.n_segments)
            pooled.add_totals(entry.described)
    if not tally.days:
        raise ArchiveError("\n".join(years.problems))
    snapshot = every.snapshot(pooled, diagnose=True)
    days, levels = np.concatenate(tally.days), tally.levels()
    n_series = levels.mean.shape[1] * levels.mean.shape[2]
    mean, spread = (each.reshape(-1, n_series) for each in (levels.mean, levels.spread))
    parts = {day: (n, total.reshape(3, n_series)) for day, (n, total) in tally.local.items()}
    return Answer(
        pooled=snapshot,
        settings=settings,
        method=judged_method(snapshot, plan.noise_settings(settings)),
        bands=tally.bands,
        days_utc_ns=days,
        n_segments=np.concatenate(tally.segments),
        levels=levels,
        courses=courses(days, mean, spread, parts, false_alarm=false_alarm),
        false_alarm=false_alarm,
        density=reduce(add, tally.noise),
        recorded=reduce(add, tally.recorded),
        fine_hz=years.grid.frequency[years.grid.edges],
        spectrogram=np.concatenate(tally.noise_of_days),
        problems=tuple(years.problems),
        doubted=doubted,
    )


def facts_of_archive(found: Answer) -> Iterator[Fact]:
    """Yield what is known of an archive beside the facts of its pooled estimate, worst first."""
    if found.problems:
        yield SpectraUnreadable(rank=Rank.DELAYS, files=found.problems)
    if found.doubted:
        yield RecordingsLeftOut(
            rank=Rank.DELAYS,
            sensors=tuple(sorted({one for each in found.doubted for one in each.not_understood})),
            recordings=tuple(each.origin.path for each in found.doubted),
        )
    if not any(each.decided for each in found.courses):
        n_days = len(found.days_utc_ns)
        yield ChangesUndecided(rank=Rank.DELAYS, n_days=n_days, needed=MIN_DAYS)
    if n_short := found.density.n_short:
        yield StretchesLeftOut(rank=Rank.TO_KNOW, n_stretches=n_short)
    segments = [segment for course in found.courses for segment in course.segments]
    if all(each.contrast_days < MIN_CONTRAST_DAYS for each in segments):
        yield NightsNotCompared(rank=Rank.TO_KNOW, needed=MIN_CONTRAST_DAYS)


class _Tally:
    """What is gathered from the files of years: their fine bands would fill the memory."""

    def __init__(self, grid: Grid, bands: Sequence[tuple[float, float]]) -> None:
        self._grid, self._spans = grid, [grid.span(band) for band in bands]
        self.bands = tuple(
            band if grid.has(band) else grid.ends(span)
            for band, span in zip(bands, self._spans, strict=True)
        )
        self.days: list[IntArray] = []
        self.segments: list[IntArray] = []
        self._levels: list[Levels] = []
        self.noise_of_days: list[NDArray[np.float32]] = []
        self.noise: list[Density] = []
        self.recorded: list[Density] = []
        self.local: dict[int, tuple[FloatArray, FloatArray]] = {}
        """Of local days: segments of each part, and its noise times these."""

    def take(self, file: h5py.File) -> None:
        """Take a year."""
        self.noise.append(density_of(file["noise"]))
        self.recorded.append(density_of(file["recorded"]))
        for name in sorted(file["months"]):
            month = file["months"][name]
            self.days.append(month["days"][...])
            self.segments.append(month["day_segments"][...])
            rows = month["levels"][...]
            self.noise_of_days.append(rows[MEAN].copy())  # a view would keep all of the rows
            found = self._grid.levels(rows, self._spans)
            self._levels.append(Levels(found.mean, found.of_scatter.spread, *found.ends()))
            self._take_parts(month)

    def _take_parts(self, month: h5py.Group) -> None:
        noise, n_segments = month["part_noise"][...], month["part_segments"][...]
        bands = self._grid.average(noise, self._spans)
        weighted = np.where(n_segments[..., None, None] > 0, bands, 0.0)
        weighted *= n_segments[..., None, None]
        for row, day in enumerate(month["local_days"][...].tolist()):
            before, total = self.local.get(day, (0.0, 0.0))  # days that two months share
            self.local[day] = before + n_segments[row], total + weighted[row]

    def levels(self) -> Levels:
        """Return the levels of all days."""
        every = ((each.mean, each.spread, each.low, each.high) for each in self._levels)
        return Levels(*(np.concatenate(each) for each in zip(*every, strict=True)))


def _bands(
    settings: Settings, frequency: FloatArray, usable: float
) -> tuple[tuple[float, float], ...]:
    """Return the bands of the series; nothing is known above `usable` Hz."""
    whole = band_within(settings, frequency, float(frequency[frequency <= usable].max()))
    if settings.band is not None:
        return (whole,)
    octaves = []
    centre = 2.0 ** np.ceil(np.log2(whole[0]) + 0.5)
    while centre * np.sqrt(2) <= whole[1]:
        edges = (float(centre / np.sqrt(2)), float(centre * np.sqrt(2)))
        if np.count_nonzero((frequency >= edges[0]) & (frequency <= edges[1])) >= MIN_BINS:
            octaves.append(edges)
        centre *= 2
    return (whole, *octaves)
