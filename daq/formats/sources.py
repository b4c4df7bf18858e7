"""Files of other programs, opened as sensors whose samples are read when they are needed.

A file or channel that cannot be used is kept as a problem, and the others are opened. Channels that
hold the state of the instrument, and those that were not asked for, are left aside.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TypeAlias

from daq.errors import ImportFormatError
from daq.formats.assembly import SAME_RATE, Overlap, assembled
from daq.formats.foreign_sensor import NS_PER_S, ForeignCalibration, ForeignSensor
from daq.formats.readers.delimited import read_delimited
from daq.formats.readers.miniseed import is_miniseed, miniseed_parts
from daq.formats.readers.npz import read_mat, read_npz
from daq.formats.readers.vibration import read_uff, read_wav, tdms_parts
from daq.formats.readers.waveforms import waveform_part
from daq.formats.traces import PartCache, Piece, ReadPart, TracePart, pieces_of, traces_of
from daq.recording.interface import FIRST_DATE_NS

Progress: TypeAlias = Callable[[str], None]
WholeFile: TypeAlias = Callable[[Path, float | None], Sequence[ForeignSensor]]

SCHEME = "sds://"
_N_FIELDS = 7


def sds_days(url: str, codes: Selection) -> list[tuple[str, datetime, Path]]:
    """Return channel, as ``NET.STA.LOC.CHA``, day and file of an archive, by channel and day.

    The files of the day before `codes.start_ns` are among them: their last record may reach it.

    Raises
    ------
    ImportFormatError
        There is no such folder.
    """
    root = Path(url.removeprefix(SCHEME)).expanduser()
    if not root.is_dir():
        raise ImportFormatError(f"{url}: no such folder; expected sds://ROOT, with a folder a year")
    first = None if codes.start_ns is None else _day(codes.start_ns) - timedelta(days=1)
    last = None if codes.end_ns is None else _day(codes.end_ns - 1)
    pattern = f"[0-9][0-9][0-9][0-9]/{codes.networks}/{codes.stations}/*.D/*"
    found: list[tuple[str, datetime, Path]] = []
    for path in root.glob(pattern):
        fields = path.name.split(".")
        if len(fields) != _N_FIELDS or not (fields[5].isdigit() and fields[6].isdigit()):
            continue
        if codes.locations != "*" and not Path(fields[2] or "--").match(codes.locations):
            continue
        day = datetime(int(fields[5]), 1, 1, tzinfo=UTC) + timedelta(days=int(fields[6]) - 1)
        if (first is None or day >= first) and (last is None or day <= last):
            found.append((".".join(fields[:4]), day, path))
    return sorted(found)


def _day(instant_ns: int) -> datetime:
    when = datetime.fromtimestamp(instant_ns // NS_PER_S, tz=UTC)
    return when.replace(hour=0, minute=0, second=0)


_UNIVERSAL = frozenset({".uff", ".unv", ".uf58", ".58"})
_BY_SUFFIX: dict[str, WholeFile] = {".wav": read_wav, ".npz": read_npz, ".mat": read_mat}
_DELIMITED = frozenset({".csv", ".tsv", ".txt", ".lvm"})
_ASCII = b"TIMESERIES "
"""With which the texts of data centres begin, SLIST and TSPAIR."""


def parts_of(path: Path, sampling_rate: float | None, columns: str) -> Iterator[TracePart]:
    """Yield the parts of a file.

    Parameters
    ----------
    path : Path
    sampling_rate : float, optional
        In Hz, where the file has none.
    columns : str
        Names of the columns of a CSV file, in place of its header.

    Raises
    ------
    ImportFormatError
        It is no file, or cannot be read.
    """
    if path.is_dir():
        raise ImportFormatError(
            f"{path}: a folder; expected files, or sds://{path} for an archive of day files"
        )
    if not path.is_file():
        raise ImportFormatError(f"{path}: no such file")
    with path.open("rb") as file:
        is_ascii = file.read(len(_ASCII)) == _ASCII
    whole = _BY_SUFFIX.get(path.suffix.lower())
    if path.suffix.lower() in _DELIMITED and not is_ascii:
        whole = partial(read_delimited, columns=columns)
    if whole is not None:
        yield ReadPart(path, lambda path: traces_of(whole(path, sampling_rate)))
    elif path.suffix.lower() in _UNIVERSAL:
        yield ReadPart(path, read_uff)
    elif path.suffix.lower() == ".tdms":
        yield from tdms_parts(path, sampling_rate)
    elif is_miniseed(path):
        yield from miniseed_parts(path)
    else:
        yield waveform_part(path)


_LOGGER = logging.getLogger(__name__)
_STATE_BANDS = "AO"
"""Administrative and opaque channels (SEED manual, appendix A)."""
_STATE_INSTRUMENTS = "CEKM"
"""Calibration input, electronic test point, temperature, mass position."""
_CODE_LENGTH = 3


@dataclass(frozen=True, slots=True)
class Selection:
    """What is taken from files.

    Attributes
    ----------
    channels : sequence of str
        Patterns such as ``HH?`` or ``XX.ABC.*.HHZ``; all that measure motion, if there are none.
    start_ns, end_ns : int, optional
        UTC from which, and before which, samples are taken.
    overlap : {"refuse", "first", "last"}
        Which samples are taken where files overlap and differ.
    networks, stations, locations : str, optional
        Patterns of codes in SDS folders.
    columns : str, optional
        Names of the columns of CSV files, in place of their headers: ``time [s],X [g],-``.
    unit : str, optional
        Unit of the samples, where the files have none.
    """

    channels: Sequence[str] = ()
    start_ns: int | None = None
    end_ns: int | None = None
    overlap: Overlap = "refuse"
    networks: str = "*"
    stations: str = "*"
    locations: str = "*"
    columns: str = ""
    unit: str = ""

    def reason_against(self, sensor: str, channel: str, *, fdsn: bool) -> str:
        """Return why a channel is left aside; empty if it is taken."""
        if self.channels:
            names = (channel, f"{sensor}.{channel}")
            if any(fnmatchcase(each, pattern) for each in names for pattern in self.channels):
                return ""
            return "not in --channels"
        if not fdsn or len(channel) != _CODE_LENGTH:
            return ""
        if channel[0] in _STATE_BANDS or channel[1] in _STATE_INSTRUMENTS:
            return "state of health"
        return ""


@dataclass(frozen=True, slots=True)
class OpenedSources:
    """Sensors by name, and what is not in them.

    Attributes
    ----------
    sensors : dict of str to ForeignSensor
    problems : tuple of str
        One sentence for each file or channel that could not be used.
    left_aside : dict of str to str
        Channels that are not imported, with the reason.
    """

    sensors: dict[str, ForeignSensor]
    problems: tuple[str, ...] = ()
    left_aside: dict[str, str] = field(default_factory=dict)


def open_sources(
    sources: Sequence[str | Path],
    selection: Selection | None = None,
    *,
    sampling_rate: float | None = None,
    logged: bool = True,
    cache: PartCache | None = None,
) -> OpenedSources:
    """Open files of other programs; every sensor may be in several of them.

    Parameters
    ----------
    sources : sequence of str or Path
        Files, or folders ``sds://ROOT`` of the SeisComP Data Structure.
    selection : Selection, optional
    sampling_rate : float, optional
        In Hz, where a file does not say.
    logged : bool
        Whether each file that is read has a log line.
    cache : PartCache, optional
        Grows to what is read together.

    Raises
    ------
    ImportFormatError
        Nothing could be opened; with the reason for each file.
    """
    selection = selection or Selection()
    cache = PartCache() if cache is None else cache
    index = _Index(selection, cache)
    problems, n_files = index.problems, 0
    for path in _files(sources, selection):
        n_files += 1
        try:
            n_problems = len(problems)
            for part in parts_of(path, sampling_rate, selection.columns):
                if part.reaches(selection.start_ns, selection.end_ns):
                    index.add(part, n_files)
        except (ImportFormatError, OSError) as error:
            problems.append(_message(path, error))
            continue
        if logged and len(problems) == n_problems:
            _LOGGER.info("%s read", path, extra={"file": str(path)})
    cache.make_room(index.n_bytes_together)
    sensors: dict[str, ForeignSensor] = {}
    for name in index.names:
        try:
            sensor = index.sensor(name)
            sensor.check()
        except ImportFormatError as error:
            problems.append(str(error))
        else:
            sensors[name] = sensor
    if not sensors:
        raise ImportFormatError("\n".join(problems) or _nothing(index, n_files, selection))
    return OpenedSources(sensors, tuple(problems), index.left_aside)


def _files(sources: Sequence[str | Path], selection: Selection) -> Iterable[Path]:
    for source in sources:
        if str(source).startswith(SCHEME):
            yield from (path for *_, path in sds_days(str(source), selection))
        else:
            yield Path(source)


def _message(path: Path, error: Exception) -> str:
    text = str(error)
    return text if str(path) in text else f"{path}: {text}"


def _nothing(index: _Index, n_files: int, selection: Selection) -> str:
    if not n_files:
        return "no files found for these codes and times; check the folder, --start and --end"
    aside = "; ".join(f"{name} ({reason})" for name, reason in index.left_aside.items())
    wanted = ", ".join(selection.channels)
    chosen = f" of --channels {wanted}" if wanted else ""
    return f"no samples{chosen} in {n_files} files; they hold {aside or 'nothing'}"


class _Index:
    """The pieces that files hold, by sensor and channel; `problems` are what cannot be used."""

    def __init__(self, selection: Selection, cache: PartCache) -> None:
        self._selection, self._cache = selection, cache
        self.problems: list[str] = []
        self._pieces: dict[str, dict[str, list[Piece]]] = {}
        self._units: dict[tuple[str, str], str] = {}
        self._calibrations: dict[tuple[str, str], ForeignCalibration | None] = {}
        self._coded: set[str] = set()
        self.left_aside: dict[str, str] = {}

    @property
    def names(self) -> list[str]:
        """Sensors, in the order in which files were given; those with codes in that of codes."""
        return sorted(
            self._pieces, key=lambda name: (name in self._coded, name * (name in self._coded))
        )

    @property
    def n_bytes_together(self) -> int:
        """Bytes of the largest parts of all channels, twice: the cache lets go of half."""
        largest = (
            max(piece.n_samples * piece.dtype.itemsize for piece in pieces)
            for channels in self._pieces.values()
            for pieces in channels.values()
        )
        return 2 * sum(largest)

    def add(self, part: TracePart, order: int) -> None:
        """Take a part; what cannot be read of it is a problem."""
        try:
            traces = self._cache.traces(part)
        except ImportFormatError as error:
            smaller = part.split()
            if not smaller:
                self.problems.append(str(error))
            for each in smaller:
                self.add(each, order)
            return
        for trace, piece in pieces_of(part, traces, order):
            name = f"{trace.sensor}.{trace.channel}"
            reason = self._selection.reason_against(trace.sensor, trace.channel, fdsn=trace.fdsn)
            if not (reason or trace.sampling_rate):
                reason = "no sampling rate"
            if reason:
                self.left_aside[name] = reason
                continue
            cut = self._within_span(piece)
            if cut is None:
                continue
            key = trace.sensor, trace.channel
            unit = trace.unit
            if self._selection.unit and unit in {"", "counts"} and trace.calibration is None:
                unit = self._selection.unit
            if self._units.setdefault(key, unit) != unit:
                self.problems.append(
                    f"{part.path}: {name} in {unit or 'counts'}, in another file in"
                    f" {self._units[key] or 'counts'}; expected one unit"
                )
                continue
            known = self._calibrations.setdefault(key, trace.calibration)
            if trace.calibration != known:
                self.problems.append(
                    f"{part.path}: {name} has {_calibrated(trace.calibration)}, in another file"
                    f" {_calibrated(known)}; expected one: import what has the same together"
                )
                continue
            if trace.fdsn:
                self._coded.add(trace.sensor)
            self._pieces.setdefault(trace.sensor, {}).setdefault(trace.channel, []).append(cut)

    def sensor(self, name: str) -> ForeignSensor:
        """Return a sensor; a channel that contradicts itself is a problem, the others are taken.

        Raises
        ------
        ImportFormatError
            No channel is left, or they do not fit together.
        """
        channels = self._pieces[name]
        if name in self._coded:
            channels = self._fastest(name, dict(sorted(channels.items())))
        if len(channels) > 1:
            for channel in list(channels):
                try:
                    self._assembled(name, {channel: channels[channel]})
                except ImportFormatError as error:
                    self.problems.append(str(error))
                    channels = {key: channels[key] for key in channels if key != channel}
        if not channels:
            raise ImportFormatError(f"sensor {name!r}: none of its channels can be used")
        return self._assembled(name, channels)

    def _fastest(self, name: str, channels: dict[str, list[Piece]]) -> dict[str, list[Piece]]:
        """Leave aside what is there at a higher rate too: BHZ beside HHZ, of one sensor."""
        rates = {code: max(p.sampling_rate for p in channels[code]) for code in channels}
        kept = {}
        for code, pieces in channels.items():
            alike = [c for c in channels if c[1:] == code[1:] and len(code) == _CODE_LENGTH]
            best = max(alike, key=lambda each: rates[each], default=code)
            if rates[best] > rates[code] * (1 + SAME_RATE):
                reason = f"{rates[code]:g} Hz, where {best[0]}{code[1]} has {rates[best]:g} Hz"
                self.left_aside[f"{name}.{code}"] = reason
            else:
                kept[code] = pieces
        return kept

    def _assembled(self, name: str, channels: dict[str, list[Piece]]) -> ForeignSensor:
        units = [self._units[name, channel] for channel in channels]
        known = [unit or "counts" for unit in units] if any(units) else []
        found = assembled(name, channels, known, self._selection.overlap, self._cache)
        calibrations = tuple(self._calibrations[name, channel] for channel in channels)
        return replace(found, calibrations=calibrations) if any(calibrations) else found

    def _within_span(self, piece: Piece) -> Piece | None:
        """Return the samples within the span of time asked for, if there are any."""
        start, end = self._selection.start_ns, self._selection.end_ns
        if (start is None and end is None) or piece.start_ns < FIRST_DATE_NS:
            return piece
        interval = piece.interval_ns
        first = 0 if start is None else max(0, -int((piece.start_ns - start) // interval))
        last = piece.n_samples
        if end is not None:
            last = min(last, -int((piece.start_ns - end) // interval))
        if first >= last:
            return None
        return piece if last - first == piece.n_samples else piece.cut(first, last)


def _calibrated(calibration: ForeignCalibration | None) -> str:
    if calibration is None:
        return "no calibration"
    return f"{calibration.sensitivity:g} counts per {calibration.unit}"


def sensors_of_parts(parts: Iterable[TracePart]) -> tuple[ForeignSensor, ...]:
    """Return the sensors of parts that are in memory.

    Raises
    ------
    ImportFormatError
        With what is wrong.
    """
    index = _Index(Selection(channels=("*",)), PartCache())
    for order, part in enumerate(parts):
        index.add(part, order)
    sensors = tuple(map(index.sensor, index.names))
    if index.problems:
        raise ImportFormatError(index.problems[0])
    return sensors
