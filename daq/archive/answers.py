"""What an archive says of the self-noise over years, from the roll-ups of these.

The whole is the average of all spectra, a day that of its own; densities count stretches.

The roll-ups of an archive are a file a year, with the totals of every year.
A file is one of settings and a time zone, which are in its name. It is made again of what has
changed: each month has the hash of what it was made of. So the file can be deleted at any time.
Beside its months it has the series of the archive's usual bands.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, tzinfo
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from daq.archive import spectra_file
from daq.archive.averages import Average, Estimator, converted
from daq.archive.changes import Course, courses, of_loudness
from daq.archive.density import MIN_BINS, Density
from daq.archive.index import ROLLUP, IndexEntry
from daq.archive.plan import settings_document
from daq.archive.rollup import (
    DailyLevels,
    Grid,
    Rollup,
    levels_of,
    month_of,
    rolled_up,
    series_of,
    summaries,
)
from daq.archive.store import Store
from daq.errors import ArchiveError, HuddleError
from daq.estimation.blas_threads import one_blas_thread
from daq.estimation.contributions import beside_stretches
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.recording.storage.refusals import check_all
from daq.recording.storage.whole_hdf5 import WholeHdf5
from daq.results.band_summary import band_within, judged_method
from daq.results.result import Result
from daq.whole_file import hidden, put_in_place, remove

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


_LOGGER = logging.getLogger(__name__)
_READ_ONLY = {errno.EACCES, errno.EPERM, errno.EROFS}
SERIES = "series"
"""Group of a year's file: levels of the usual bands, so that most answers read no fine bands."""


class Years:
    """Roll-ups of an archive by one set of settings.

    Parameters
    ----------
    store : Store
    entries : sequence of IndexEntry
        In order of time; the units of the first are those of all totals.
    settings : Settings
        Of the noise.
    zone : tzinfo
        Of local days.
    progress : callable or None
        Receives how many recordings are read, and of how many.
    """

    def __init__(
        self,
        store: Store,
        entries: Sequence[IndexEntry],
        settings: Settings,
        *,
        zone: tzinfo,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        plan = store.plan
        settings = plan.noise_settings(settings)
        self._folder, self._plan, self._settings, self._zone = store.folder, plan, settings, zone
        self._own = settings == plan.noise_settings(plan.settings)
        self._estimator = Estimator(plan, settings, entries[0].described.channels)
        self.grid = Grid.of(self._estimator)
        self._progress = progress or (lambda _, __: None)
        self.problems: list[str] = []
        self.damaged: set[str] = set()
        """Runs of which a month is left out."""
        self._months: dict[str, list[IndexEntry]] = {}
        for entry in entries:
            for month in entry.months:
                self._months.setdefault(month, []).append(entry)
        about = json.dumps([settings_document(settings), str(zone)])
        self._key = hashlib.sha256(about.encode()).hexdigest()[:12]
        reference = repr(entries[0].described.channels)
        self._reference = hashlib.sha256(reference.encode()).hexdigest()
        self._n_read = self._n_all = 0

    def each(self, usual: Sequence[slice]) -> Iterator[h5py.File]:
        """Yield the open file of every year, in order.

        `usual` are the bands that most answers are about: files that are made have their series.
        """
        wanted = {month: self._digest(month) for month in sorted(self._months)}
        years = sorted({month[:4] for month in wanted})
        current = {year: self._current(year) for year in years}
        missing = [month for month in wanted if current[month[:4]].get(month) != wanted[month]]
        self._n_all = sum(len(self._months[month]) for month in missing)
        for year in years:
            own = {month: digest for month, digest in wanted.items() if month[:4] == year}
            with contextlib.ExitStack() as closing:
                if current[year] != own:
                    file = self._opened(closing, year, own, current[year], usual)
                else:
                    file = closing.enter_context(h5py.File(self._path(year)))
                if "months" in file:
                    yield file

    def _path(self, year: str) -> Path:
        return self._folder / year / f"{ROLLUP}{self._key}.h5"

    def _digest(self, month: str) -> str:
        parts = [(e.described.origin.run_id, e.months[month]) for e in self._months[month]]
        text = json.dumps([spectra_file.SUMMARY_VERSION, self._reference, parts])
        return hashlib.sha256(text.encode()).hexdigest()

    def _current(self, year: str) -> dict[str, str]:
        """Return the months of a file, with what they were made of; none where it is damaged."""
        damage = (HuddleError, OSError, RuntimeError, KeyError)
        with contextlib.suppress(*damage), h5py.File(self._path(year)) as f:
            check_all(f)
            return {str(m): str(group.attrs["digest"]) for m, group in f["months"].items()}
        return {}

    def _opened(
        self,
        closing: contextlib.ExitStack,
        year: str,
        wanted: Mapping[str, str],
        current: Mapping[str, str],
        usual: Sequence[slice],
    ) -> h5py.File:
        """Make the file of a year, of months that it has and of recordings; it is then kept.

        Where it cannot be written, it is made in memory.
        """
        path, n_problems, n_read = self._path(year), len(self.problems), self._n_read
        part = hidden(path)
        closing.callback(remove, part)
        try:
            path.parent.mkdir(exist_ok=True)
            with WholeHdf5(part) as hdf5:
                self._fill(hdf5, path, wanted, current, usual)
            if len(self.problems) == n_problems:
                put_in_place(part, path)
                part = path
            return closing.enter_context(h5py.File(part))
        except OSError as error:
            if error.errno not in _READ_ONLY:
                _LOGGER.warning("%s: not kept: %s", path, error.strerror or error)
        del self.problems[n_problems:]
        self._n_read = n_read
        hdf5 = WholeHdf5(None)
        closing.callback(hdf5.close)
        self._fill(hdf5, path, wanted, current, usual)
        return hdf5.file

    def _fill(
        self,
        hdf5: WholeHdf5,
        path: Path,
        wanted: Mapping[str, str],
        current: Mapping[str, str],
        usual: Sequence[slice],
    ) -> None:
        for month, digest in wanted.items():
            name = f"months/{month}"
            if current.get(month) == digest:
                with h5py.File(path) as old:
                    hdf5.copy(old, name)
            elif (rollup := self._rolled_up(month)) is not None:
                _write(hdf5, name, rollup)
                hdf5.file[name].attrs["digest"] = digest
        if "months" not in hdf5.file:
            return
        _write_totals(hdf5)
        made = series_of(_months_of(hdf5.file), self.grid, usual)
        for each in fields(made):
            values = getattr(made, each.name)
            hdf5.create(f"{SERIES}/{each.name}", values, chunks=True, fletcher32=True)
        hdf5.file[SERIES].attrs["spans"] = _text_of(usual)

    def _rolled_up(self, month: str) -> Rollup | None:
        found = []
        for entry in self._months[month]:
            try:
                found.append(self._summary(entry, month))
            except ArchiveError as error:
                self.damaged.add(entry.described.origin.run_id)
                self.problems.append(
                    f"{error} ({month}): left out. Delete the file and run again with"
                    f" {entry.described.origin.path}"
                )
            self._n_read += 1
            self._progress(self._n_read, self._n_all)
        welch, plan = self._estimator.welch, self._plan
        if not found:
            return None
        return rolled_up(
            found,
            self.grid,
            zone=self._zone,
            whole=plan.stretch_s * welch.sampling_rate / welch.hop,
            hours=plan.stretch == "hour",
        )

    def is_rounded(self, entry: IndexEntry) -> bool:
        """Whether the sum of a recording's matrices is one of single precision."""
        return entry.daily or (entry.single and not self._own)

    def _summary(self, entry: IndexEntry, month: str) -> spectra_file.Summary:
        """Return the summary of a recording, its total in the units of the archive."""
        described = entry.described
        with spectra_file.SpectraFile(entry.path) as file:
            if self._own and month in file.months:
                found = file.summary(month)
            else:
                rows = (row for row in file.rows() if month_of(row[0]) == month)
                about = replace(described, rounded=file.is_single)
                changed: dict[int, FloatArray] = {}
                if month in file.months:
                    kept = file.summary(month)
                    changed = dict(zip(kept.starts.tolist(), kept.changed, strict=True))
                made = summaries(rows, about, self._plan, self._settings, changed)
                found = next(summary for _, summary in made)
                if file.is_daily:
                    found = found.of_days
        response = self._estimator.responses(described.channels)
        return replace(found, total=converted(found.total, response))


def read_series(file: h5py.File, grid: Grid, spans: Sequence[slice]) -> DailyLevels:
    """Return the series of bands in a year: those that the file has, or made of its months."""
    if SERIES not in file:  # of an older version
        return series_of(_months_of(file), grid, spans)
    kept: dict[str, Any] = {name: values[...] for name, values in file[SERIES].items()}
    if file[SERIES].attrs["spans"] != _text_of(spans):
        kept |= levels_of(_months_of(file), grid, spans)
    return DailyLevels(**kept)


def _months_of(file: h5py.File) -> list[h5py.Group]:
    return [file["months"][month] for month in sorted(file["months"])]


def _text_of(spans: Sequence[slice]) -> str:
    return json.dumps([(span.start, span.stop) for span in spans])


def density_of(group: h5py.Group) -> Density:
    """Return a density that `Years` wrote."""
    frequency, counts, below = (group[n][...] for n in ("frequency", "counts", "not_positive"))
    n_stretches, n_short = (int(group.attrs[name]) for name in ("n_stretches", "n_short"))
    return Density(frequency, counts.astype(np.int64), below.astype(np.int64), n_stretches, n_short)


def _write(hdf5: WholeHdf5, group: str, rollup: Rollup) -> None:
    for each in fields(rollup):
        value, path = getattr(rollup, each.name), f"{group}/{each.name}"
        if each.name in {"noise", "recorded"}:
            _write_density(hdf5, path, value)
        elif each.name == "levels":
            made = hdf5.file.create_dataset(
                path, value.shape, value.dtype, chunks=(1, *value.shape[1:]), fletcher32=True
            )
            for row, some in enumerate(value):
                if some.any():  # what is zero everywhere takes no room
                    made[row] = some
            hdf5.expect(made, value)
        elif each.name != "n_segments":
            hdf5.create(path, spectra_file.packed(value) if each.name == "total" else value)
    hdf5.file[group].attrs["n_segments"] = rollup.n_segments


def _write_density(hdf5: WholeHdf5, group: str, density: Density) -> None:
    hdf5.create(f"{group}/frequency", density.frequency)
    for name in ("counts", "not_positive"):
        value = getattr(density, name).astype(np.int32)
        hdf5.create(f"{group}/{name}", value, compression="gzip", compression_opts=1, shuffle=True)
    attributes = hdf5.file[group].attrs
    attributes.update(n_stretches=density.n_stretches, n_short=density.n_short)


def _write_totals(hdf5: WholeHdf5) -> None:
    """Add the months of a year up."""
    months = _months_of(hdf5.file)
    for name in ("noise", "recorded"):
        total = reduce(add, (density_of(month[name]) for month in months))
        _write_density(hdf5, name, total)
    for name in ("total", "alone", "alone_segments", "untested"):
        hdf5.create(name, reduce(add, (month[name][...] for month in months)))
    hdf5.file.attrs["n_segments"] = sum(int(month.attrs["n_segments"]) for month in months)


FALSE_ALARM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class AnsweredLevels:
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
    between : float64, shape (n_channels,)
        Share of the noise of `result`, in its band, that stretches estimated alone do not have.
    bands : tuple of (float, float)
        In Hz: the band of the estimate, then octaves, unless a band was asked for.
    days_utc_ns : int64, shape (n_days,)
        Beginnings of days of UTC.
    n_segments : int64, shape (n_days,)
    levels : AnsweredLevels
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
    untested : int
        Segments of stretches in which changes of responses are not tested.
    doubted : tuple of Described
        Of recordings that are left out, because the clock of a sensor is not understood.
    lacking : mapping of str to int
        Segments that other channels have and a channel lacks, by its name: they are not used.
    """

    result: Result
    method: str
    between: FloatArray
    bands: tuple[tuple[float, float], ...]
    days_utc_ns: IntArray
    n_segments: IntArray
    levels: AnsweredLevels
    courses: tuple[Course, ...]
    false_alarm: float
    density: Density
    recorded: Density
    fine_hz: FloatArray
    spectrogram: NDArray[np.float32]
    problems: tuple[str, ...]
    untested: int
    doubted: tuple[spectra_file.Described, ...]
    lacking: Mapping[str, int]

    @property
    def pooled(self) -> Snapshot:
        """The snapshot of `result`."""
        return self.result.snapshot


@one_blas_thread()
def answer(
    store: Store,
    entries: Sequence[IndexEntry],
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
    entries : sequence of IndexEntry
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
    pooled, lacking, alone, untested = Average(), Counter[int](), np.zeros((2, 1, 1)), 0
    for file in years.each([years.grid.span(band) for band in usual]):
        pooled.add_sum(spectra_file.unpacked(file["total"][...]), int(file.attrs["n_segments"]))
        alone = alone + np.stack([file["alone"][...], file["alone_segments"][...]])
        untested += int(file["untested"][0])
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
    method = judged_method(snapshot, plan.noise_settings(settings))
    more = np.zeros(len(snapshot.channels))
    if method in snapshot.results:
        noise = years.grid.mean(snapshot.results[method].noise_psd)
        with np.errstate(invalid="ignore", divide="ignore"):
            between = years.grid.more(noise, alone[0] / alone[1])
            span = years.grid.span(tally.bands[0])
            more = years.grid.average(between, [span])[0] / years.grid.average(noise, [span])[0]
        mean, spread = (tally.of_all(name)[:, 0].T for name in ("mean", "spread"))
        n_segments = tally.of_all("day_segments")
        each = zip(mean, spread, strict=True)
        of_days = [of_loudness(y, deviation, n_segments) for y, deviation in each]
        between = years.grid.at_bins(between)
        snapshot = beside_stretches(snapshot, between, np.array(of_days))
    days = tally.of_all("days")
    levels = AnsweredLevels(*(tally.of_all(each.name) for each in fields(AnsweredLevels)))
    n_series = levels.mean.shape[1] * levels.mean.shape[2]
    mean, spread = (each.reshape(-1, n_series) for each in (levels.mean, levels.spread))
    parts = {day: (n, total.reshape(3, n_series)) for day, (n, total) in tally.local.items()}
    return Answer(
        result=Result(snapshot, settings),
        method=method,
        between=more,
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
        untested=untested,
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
        self.series: list[DailyLevels] = []
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
        """Return a field of `DailyLevels` of all years."""
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
