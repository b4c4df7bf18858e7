"""What an archive says of the self-noise over years, from the roll-ups of these.

The whole is the average of all spectra, a day that of its own; densities count stretches.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields, replace
from datetime import UTC
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.archive.averages import Average, Estimator
from daq.archive.changes import courses
from daq.archive.density import MIN_BINS
from daq.archive.spectra_file import unpacked
from daq.archive.years import Years, density_of, read_series
from daq.errors import ArchiveError
from daq.estimation.blas_threads import one_blas_thread
from daq.results.band_summary import band_within, judged_method
from daq.results.result import Result

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from datetime import tzinfo

    import h5py
    from numpy.typing import NDArray

    from daq.archive.changes import Course
    from daq.archive.density import Density
    from daq.archive.index import Entry
    from daq.archive.rollup import Grid, Series
    from daq.archive.spectra_file import Described
    from daq.archive.store import Store
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot

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
    result : Result
        The estimate from all recordings together.
    method : str
        That of all but `result`.
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
    lacking : mapping of str to int
        Segments that other channels have and a channel lacks, by its name: they are not used.
    """

    result: Result
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
    lacking: Mapping[str, int]

    @property
    def pooled(self) -> Snapshot:
        """The snapshot of `result`."""
        return self.result.snapshot


@one_blas_thread()
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
    ends = every.welch.lowest, usable
    tally = _Tally(years.grid, _bands(settings, years.grid.frequency, *ends))
    usual = _bands(plan.noise_settings(settings), years.grid.frequency, *ends)
    pooled, lacking = Average(), Counter[int]()
    for file in years.each([years.grid.span(band) for band in usual]):
        pooled.add_sum(unpacked(file["total"][...]), int(file.attrs["n_segments"]))
        tally.take(file)
    for entry in known:
        if entry.described.origin.run_id not in years.damaged:
            about = entry.described
            if about.rounded != years.is_rounded(entry):
                about = replace(about, rounded=not about.rounded)
            pooled.add_segments(about, entry.start_utc_ns or 0, entry.n_segments)
            pooled.add_totals(entry.described)
            lacking.update(entry.described.lacking)
    if not tally.series:
        raise ArchiveError("\n".join(years.problems))
    snapshot = every.snapshot(pooled, diagnose=True)
    days = tally.of_all("days")
    levels = Levels(*(tally.of_all(each.name) for each in fields(Levels)))
    n_series = levels.mean.shape[1] * levels.mean.shape[2]
    mean, spread = (each.reshape(-1, n_series) for each in (levels.mean, levels.spread))
    parts = {day: (n, total.reshape(3, n_series)) for day, (n, total) in tally.local.items()}
    return Answer(
        result=Result(snapshot, settings),
        method=judged_method(snapshot, plan.noise_settings(settings)),
        bands=tally.bands,
        days_utc_ns=days,
        n_segments=tally.of_all("day_segments"),
        levels=levels,
        courses=courses(days, mean, spread, parts, false_alarm=false_alarm),
        false_alarm=false_alarm,
        density=reduce(add, tally.noise),
        recorded=reduce(add, tally.recorded),
        fine_hz=years.grid.frequency[years.grid.edges],
        spectrogram=tally.of_all("noise"),
        problems=tuple(years.problems),
        doubted=doubted,
        lacking={snapshot.channels[column].name: lacking[column] for column in sorted(lacking)},
    )


class _Tally:
    """What is gathered from the files of years: their fine bands would fill the memory."""

    def __init__(self, grid: Grid, bands: Sequence[tuple[float, float]]) -> None:
        self._grid, self.spans = grid, [grid.span(band) for band in bands]
        self.bands = tuple(
            band if grid.has(band) else grid.ends(span)
            for band, span in zip(bands, self.spans, strict=True)
        )
        self.series: list[Series] = []
        self.noise: list[Density] = []
        self.recorded: list[Density] = []
        self.local: dict[int, tuple[FloatArray, FloatArray]] = {}
        """Of local days: segments of each part, and its noise times these."""

    def take(self, file: h5py.File) -> None:
        """Take a year."""
        self.noise.append(density_of(file["noise"]))
        self.recorded.append(density_of(file["recorded"]))
        found = read_series(file, self._grid, self.spans)
        self.series.append(found)
        n_segments = found.part_segments
        weighted = np.where(n_segments[..., None, None] > 0, found.part_noise, 0.0)
        weighted *= n_segments[..., None, None]
        for row, day in enumerate(found.local_days.tolist()):
            before, total = self.local.get(day, (0.0, 0.0))  # days that two months share
            self.local[day] = before + n_segments[row], total + weighted[row]

    def of_all(self, name: str) -> NDArray[Any]:
        """Return a field of `Series` of all years."""
        return np.concatenate([getattr(each, name) for each in self.series])


def _bands(
    settings: Settings, frequency: FloatArray, lowest: float, usable: float
) -> tuple[tuple[float, float], ...]:
    """Return the bands of the series; nothing is known below `lowest` and above `usable` Hz."""
    known = lowest, float(frequency[frequency <= usable].max())
    whole = band_within(settings, frequency, known)
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
