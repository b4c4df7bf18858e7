"""The roll-ups of an archive, a file a year, and the totals of every year.

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
from dataclasses import fields, replace
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from daq.archive.averages import Estimator, converted
from daq.archive.density import Density
from daq.archive.index import ROLLUP
from daq.archive.plan import settings_document
from daq.archive.rollup import (
    Grid,
    Rollup,
    Series,
    levels_of,
    month_of,
    rolled_up,
    series_of,
    summaries,
)
from daq.archive.spectra_file import SUMMARY_VERSION, SpectraFile, packed
from daq.errors import ArchiveError, HuddleError
from daq.recording.storage.refusals import check_all
from daq.recording.storage.whole_hdf5 import WholeHdf5
from daq.whole_file import hidden, put_in_place, remove

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from datetime import tzinfo
    from pathlib import Path

    from daq.archive.index import Entry
    from daq.archive.spectra_file import Summary
    from daq.archive.store import Store
    from daq.estimation.settings import Settings

_LOGGER = logging.getLogger(__name__)
_READ_ONLY = {errno.EACCES, errno.EPERM, errno.EROFS}
SERIES = "series"
"""Group of a year's file: levels of the usual bands, so that most answers read no fine bands."""


class Years:
    """Roll-ups of an archive by one set of settings.

    Parameters
    ----------
    store : Store
    entries : sequence of Entry
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
        entries: Sequence[Entry],
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
        self._months: dict[str, list[Entry]] = {}
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
        text = json.dumps([SUMMARY_VERSION, self._reference, parts])
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

    def is_rounded(self, entry: Entry) -> bool:
        """Whether the sum of a recording's matrices is one of single precision."""
        return entry.daily or (entry.single and not self._own)

    def _summary(self, entry: Entry, month: str) -> Summary:
        """Return the summary of a recording, its total in the units of the archive."""
        described = entry.described
        with SpectraFile(entry.path) as file:
            if self._own and month in file.months:
                found = file.summary(month)
            else:
                rows = (row for row in file.rows() if month_of(row[0]) == month)
                about = replace(described, rounded=file.is_single)
                made = summaries(rows, about, self._plan, self._settings)
                found = next(summary for _, summary in made)
                if file.is_daily:
                    found = found.of_days
        response = self._estimator.responses(described.channels)
        return replace(found, total=converted(found.total, response))


def read_series(file: h5py.File, grid: Grid, spans: Sequence[slice]) -> Series:
    """Return the series of bands in a year: those that the file has, or made of its months."""
    if SERIES not in file:  # of an older version
        return series_of(_months_of(file), grid, spans)
    kept: dict[str, Any] = {name: values[...] for name, values in file[SERIES].items()}
    if file[SERIES].attrs["spans"] != _text_of(spans):
        kept |= levels_of(_months_of(file), grid, spans)
    return Series(**kept)


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
            hdf5.create(path, packed(value) if each.name == "total" else value)
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
    hdf5.create("total", reduce(add, (month["total"][...] for month in months)))
    hdf5.file.attrs["n_segments"] = sum(int(month.attrs["n_segments"]) for month in months)
