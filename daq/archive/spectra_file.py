"""Spectra of one recording: an HDF5 file of an archive, one row a stretch, and its summaries.

A file has its name when it is complete and on the disk; before, it is hidden and ends in ``.part``.
Rows hold cross-spectral matrices in unit²/Hz, packed: real parts on and below the diagonal,
imaginary parts of the elements above the diagonal. The matrices are Hermitian, so nothing is lost.
`thin` stores them in single precision, as they are or as means of days, and leaves summaries
(`daq.archive.rollup`) as they are.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.bench.sensitivity import Sensitivities, as_document, sensitivities_from
from daq.caveats import NO_CAVEATS, Caveats
from daq.errors import ArchiveError, RecordingError, WrongArchiveError
from daq.estimation.snapshot import Overlap
from daq.recording.file_format import channel_attributes, channels_of, plain
from daq.recording.storage.opening import open_file
from daq.recording.storage.packing import check_chunks
from daq.recording.storage.refusals import dataset, member, number, text
from daq.recording.storage.whole_hdf5 import WholeHdf5, little_endian
from daq.whole_file import replaced
from estimator.checks.count_limits import CountLimits
from estimator.spectra.segment_rejection import Reason

ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
SmallArray = NDArray[np.float32]

FORMAT = "huddle-archive-spectra"
FORMAT_VERSION = 2
"""1: without summaries."""
SUMMARY_VERSION = 4
"""Summaries of another version are made again."""
DAY_NS = 86400 * 10**9
STRETCH_DTYPE = np.dtype([("start_utc_ns", "<i8"), ("n_segments", "<i8")])
_SUMMED = {"fletcher32": True, "chunks": True}
_DAMAGE = (AttributeError, IndexError, KeyError, MemoryError, OSError, RuntimeError, TypeError)


@dataclass(frozen=True, slots=True)
class Origin:
    """The recording that spectra come from, as it was then.

    Attributes
    ----------
    run_id : str
    path : str
    n_bytes, modified_ns : int
    n_samples : int
        Of all sensors.
    closed : bool
    files : str
        SHA-256 of names, sizes and times of its files, if it is a day of several.
    responses : str
        SHA-256 of what files of responses said of its channels on this day; empty without such
        files.
    begin_ns, end_ns : int
        Of a recording, UTC; 0 if an earlier version took it.
    """

    run_id: str
    path: str
    n_bytes: int
    modified_ns: int
    n_samples: int
    closed: bool
    files: str = ""
    responses: str = ""
    begin_ns: int = 0
    end_ns: int = 0


_ORIGIN: dict[str, tuple[str, type]] = {
    "run_id": ("run_id", str),
    "path": ("source", str),
    "n_bytes": ("source_bytes", int),
    "modified_ns": ("source_modified_ns", int),
    "n_samples": ("source_samples", int),
    "closed": ("source_closed", bool),
    "files": ("source_files", str),
    "responses": ("source_responses", str),
    "begin_ns": ("source_begin_ns", int),
    "end_ns": ("source_end_ns", int),
}
"""Key in a document and type of each field of an origin."""
_TEXTS = {"format", *(key for key, kind in _ORIGIN.values() if kind is str)}
"""Attributes that are text, and not JSON."""


@dataclass(frozen=True, slots=True)
class Described:
    """What spectra of a recording rest on.

    Attributes
    ----------
    origin : Origin
    channels : tuple of (str, Channel)
        Each with the name of its sensor.
    usable : float
        Frequency in Hz up to which samples are what sensors read.
    elapsed : float
        Seconds looked at.
    left_out : mapping of Reason to int
    residual : mapping of str to float
        What is left between clocks, in seconds rms, by sensor.
    not_understood : tuple of str
        Sensors whose clock is not understood.
    counts : CountLimits
        What counts show of their limits; earlier versions kept `clipped` only.
    stood_still : mapping of int to float
        As in `daq.estimation.snapshot.SnapshotDiagnostics`.
    lacking : mapping of int to int
        Segments that other channels have and a channel lacks, by its column: they are not kept.
    shortened, sensitivities : mapping
        As in `daq.estimation.snapshot.Snapshot`.
    rounded : bool
        Whether estimates are made of matrices that were kept in single precision.
    caveats : Caveats
        Earlier versions did not keep them.
    overlaps : tuple of Overlap
        With recordings whose segments count there.
    """

    origin: Origin
    channels: tuple[tuple[str, Channel], ...]
    usable: float
    elapsed: float
    left_out: Mapping[Reason, int] = field(default_factory=dict)
    residual: Mapping[str, float] = field(default_factory=dict)
    not_understood: tuple[str, ...] = ()
    counts: CountLimits = field(default_factory=CountLimits)
    stood_still: Mapping[int, float] = field(default_factory=dict)
    lacking: Mapping[int, int] = field(default_factory=dict)
    shortened: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sensitivities: Sensitivities = field(default_factory=dict)
    rounded: bool = False
    caveats: Caveats = NO_CAVEATS
    overlaps: tuple[Overlap, ...] = ()

    @classmethod
    def of(
        cls, document: Mapping[str, Any], channels: tuple[tuple[str, Channel], ...]
    ) -> Described:
        """Return what a document says; those of earlier versions lack some keys."""
        origin = {
            name: kind(document[key]) for name, (key, kind) in _ORIGIN.items() if key in document
        }
        of_counts = {each.name: document.get(each.name, {}) for each in fields(CountLimits)}
        shortened = document.get("shortened", {}).items()
        return cls(
            origin=Origin(**origin),
            channels=channels,
            usable=float(document["usable"]),
            elapsed=float(document["elapsed"]),
            left_out={Reason(k): int(v) for k, v in document["left_out"].items()},
            residual={k: float(v) for k, v in document["residual"].items()},
            not_understood=tuple(document.get("not_understood", ())),
            counts=CountLimits.from_tables(of_counts),
            stood_still={int(k): float(v) for k, v in document["stood_still"].items()},
            lacking={int(k): int(v) for k, v in document.get("lacking", {}).items()},
            shortened={sensor: (float(late), float(early)) for sensor, (late, early) in shortened},
            sensitivities=sensitivities_from(document.get("sensitivities", ())),
            caveats=Caveats.of(document),
            overlaps=tuple(Overlap(*each) for each in document.get("overlaps", ())),
        )

    @property
    def document(self) -> dict[str, Any]:
        """All but the channels and the precision of matrices, as JSON has it."""
        return {
            **{key: getattr(self.origin, name) for name, (key, _) in _ORIGIN.items()},
            "usable": self.usable,
            "elapsed": self.elapsed,
            "left_out": {str(k): v for k, v in self.left_out.items()},
            "residual": dict(self.residual),
            "not_understood": dict.fromkeys(self.not_understood, True),
            **asdict(self.counts),
            "stood_still": dict(self.stood_still),
            **self.caveats.keys,
            "lacking": dict(self.lacking),
            "shortened": dict(self.shortened),
            "sensitivities": as_document(self.sensitivities),
            "overlaps": self.overlaps,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Summary:
    """Ingredients of answers, of one recording in one month of UTC (`daq.archive.rollup`).

    Attributes
    ----------
    starts, n_segments : int64, shape (n_stretches,)
        Beginning in ns of UTC.
    noise, recorded : float32, shape (n_stretches, n_fine, n_channels)
        NaN where a stretch gives no estimate.
    changed : float32, shape (n_stretches, n_fine, n_channels)
        Share of the noise that changes of responses within a stretch may leave of the motion;
        NaN where that is not tested, or not kept by an earlier version.
    days, day_segments : int64, shape (n_days,)
    levels : float32, shape (N_FIELDS, n_days, n_fine, n_channels)
    total : complex128, shape (n_freqs, n_channels, n_channels)
        Sum of the matrices, in the units of the recording's channels.
    """

    starts: IntArray
    n_segments: IntArray
    noise: SmallArray
    recorded: SmallArray
    changed: SmallArray
    days: IntArray
    day_segments: IntArray
    levels: SmallArray
    total: ComplexArray

    @property
    def of_days(self) -> Summary:
        """Without stretches: where these are days, hours are not known."""
        none = slice(0, 0)
        return replace(
            self,
            starts=self.starts[none],
            n_segments=self.n_segments[none],
            noise=self.noise[none],
            recorded=self.recorded[none],
            changed=self.changed[none],
        )

    @property
    def sha256(self) -> str:
        """Of all of it."""
        digest = hashlib.sha256(str(SUMMARY_VERSION).encode())
        for each in fields(self):
            digest.update(np.ascontiguousarray(getattr(self, each.name)).tobytes())
        return digest.hexdigest()


class SpectraWriter:
    """Writes the file of one recording; a context manager.

    Nothing is left behind unless `commit` is called.

    Parameters
    ----------
    path : Path
    n_freqs, n_channels : int
    daily : bool
        Whether stretches are days of spectra that were finer; always in single precision.
    single : bool
        Whether matrices are in single precision.
    """

    def __init__(
        self,
        path: Path,
        *,
        n_freqs: int,
        n_channels: int,
        daily: bool = False,
        single: bool = False,
    ) -> None:
        self._daily, self._single = daily, daily or single
        self._unfinished = contextlib.ExitStack()
        part = self._unfinished.enter_context(replaced(path))
        self._hdf5 = self._unfinished.enter_context(WholeHdf5(part))
        shape = (n_freqs, n_channels, n_channels)
        self._csm = self._hdf5.file.create_dataset(
            "csm",
            shape=(0, *shape),
            maxshape=(None, *shape),
            chunks=(1, *shape),
            dtype="<f4" if self._single else "<f8",
            fletcher32=True,
        )
        self.restart()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, trace: TracebackType | None) -> None:
        error = GeneratorExit() if error is None else error  # for a file without commit
        self._unfinished.__exit__(type(error), error, trace)

    def restart(self) -> None:
        """Drop all stretches."""
        self._stretches: list[tuple[int, int]] = []
        self._contents = hashlib.sha256()

    def append(self, start_utc_ns: int, n_segments: int, csm: ComplexArray) -> None:
        """Add a stretch; `csm` of shape (n_freqs, n_channels, n_channels), Hermitian."""
        row = len(self._stretches)
        if row >= len(self._csm):
            self._csm.resize(row + 1, axis=0)
        rows = packed(csm).astype(self._csm.dtype, copy=False)
        self._csm[row] = rows
        self._contents.update(little_endian(rows))
        self._stretches.append((start_utc_ns, n_segments))
        self._hdf5.check()

    def rows(self) -> Iterator[tuple[int, int, ComplexArray]]:
        """Yield beginning, segments and matrix of each stretch so far."""
        for row, (start, n_segments) in enumerate(self._stretches):
            yield start, n_segments, unpacked(self._csm[row])

    def commit(self, described: Described, found: Iterable[tuple[str, Summary]]) -> None:
        """Complete the file: it has its name, and is on the disk, when this returns.

        `found` are the summaries with their months.
        """
        hdf5, file = self._hdf5, self._hdf5.file
        for month, summary in found:
            _write_summary(hdf5, f"months/{month}", summary, total=not self._daily)
        self._csm.resize(len(self._stretches), axis=0)
        hdf5.contents[self._csm.name] = self._contents.digest()
        stretches = np.array(self._stretches, STRETCH_DTYPE)
        hdf5.create("stretches", stretches, **_SUMMED if self._stretches else {})
        groups = file.create_group("sensors", track_order=True)
        for name in dict.fromkeys(sensor for sensor, _ in described.channels):
            own = [channel for sensor, channel in described.channels if sensor == name]
            groups.create_group(name).attrs.update(channel_attributes(own))
        document = described.document | {"daily": self._daily, "single": self._single}
        file.attrs.update(
            {
                "format": FORMAT,
                "format_version": FORMAT_VERSION,
                "sensors": list(groups),
                **{name: _attribute(value) for name, value in document.items()},
            }
        )
        self._unfinished.close()


class SpectraFile:
    """The spectra of one recording, open for reading; a context manager.

    Parameters
    ----------
    path : Path

    Raises
    ------
    WrongArchiveError
        If the file is of a newer format, or something else.
    ArchiveError
        If it is damaged or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _damage_named(path):
            self._file = open_file(path)
            try:
                self._read()
            except BaseException:
                self._file.close()
                raise

    def _read(self) -> None:
        file, attributes = self._file, self._file.attrs
        if attributes.get("format") != FORMAT:
            raise WrongArchiveError(f"{self.path}: not a file of an archive of huddle")
        version = int(number(attributes, "format_version"))
        if version > FORMAT_VERSION:
            raise WrongArchiveError(
                f"{self.path}: format version {version} is newer than {FORMAT_VERSION}, which this"
                " version of huddle reads; update huddle"
            )
        groups = member(file, "sensors")
        channels = tuple(
            (str(name), channel)
            for name in attributes["sensors"]
            for channel in channels_of(member(groups, str(name)).attrs)
        )
        document = {name: _value(name, plain(each)) for name, each in attributes.items()}
        self.described = Described.of(document, channels)
        self.stretches: NDArray[np.void] = dataset(file, "stretches", STRETCH_DTYPE)[...]
        self.is_daily = bool(attributes.get("daily", 0))
        """Whether the matrices of stretches have become those of days."""
        self.is_single = bool(attributes.get("single", self.is_daily))
        """Whether the matrices are in single precision."""
        csm_type = np.dtype("<f4" if self.is_single else "<f8")
        self._csm = dataset(file, "csm", csm_type, in_parts=True)
        self.months: dict[str, str] = {}
        """SHA-256 of the summary of each month; empty in files of format version 1."""
        if version > 1 and "months" in file:
            months = member(file, "months")
            self.months = {str(m): text(member(months, str(m)).attrs, "sha256") for m in months}
        n_channels = len(channels)
        shape = (len(self.stretches), self._csm.shape[1], n_channels, n_channels)
        if self._csm.shape != shape or np.any(self.stretches["n_segments"] < 1):
            raise ValueError(f"csm of shape {self._csm.shape}; expected {shape}")

    @property
    def n_freqs(self) -> int:
        """Number of frequencies."""
        return int(self._csm.shape[1])

    def csm(self, row: int) -> ComplexArray:
        """Return the cross-spectral matrix of a stretch.

        Returns
        -------
        complex128, shape (n_freqs, n_channels, n_channels)
            In unit²/Hz of the channels.

        Raises
        ------
        ArchiveError
            If it is damaged.
        """
        with _damage_named(self.path):
            if self._csm.chunks:
                check_chunks(self._csm, row, row + 1)
            found = self._csm[row]
        return unpacked(found)

    def rows(self) -> Iterator[tuple[int, int, ComplexArray]]:
        """Yield beginning, segments and matrix of each stretch."""
        for row, (start, n_segments) in enumerate(self.stretches.tolist()):
            yield start, n_segments, self.csm(row)

    def summary(self, month: str) -> Summary:
        """Return what is kept of a month.

        Raises
        ------
        ArchiveError
            If it is damaged.
        """
        with _damage_named(self.path):
            group = member(member(self._file, "months"), month)
            names = (each.name for each in fields(Summary) if each.name not in {"total", "changed"})
            arrays = {name: dataset(group, name)[...] for name in names}
            arrays["changed"] = np.full_like(arrays["noise"], np.nan)
            if "changed" in group:  # since it is tested
                arrays["changed"] = dataset(group, "changed")[...]
            total = None if self.is_daily else unpacked(dataset(group, "total")[...])
        if total is None:
            days = set(arrays["days"].tolist())
            total = np.sum([n * csm for day, n, csm in self.rows() if day in days], axis=0)
        return Summary(**arrays, total=total)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def thin(path: Path, *, single: bool = False) -> bool:
    """Replace the matrices of a file by the means of days, in single precision; whether it did.

    The estimate of other settings than the archive's is then one of days. Where `single`, matrices
    of all stretches are kept, in single precision. Files without summaries, or that are as small
    already, stay as they are.

    Raises
    ------
    ArchiveError
        If the file is damaged: it stays as it is.
    """
    with SpectraFile(path) as file:
        if file.is_daily or not file.months or (single and file.is_single):
            return False
        n_channels = len(file.described.channels)
        with SpectraWriter(
            path, n_freqs=file.n_freqs, n_channels=n_channels, daily=not single, single=True
        ) as writer:
            for row in file.rows() if single else _of_days(file.rows()):
                writer.append(*row)
            writer.commit(file.described, ((m, file.summary(m)) for m in file.months))
    return True


def _of_days(
    rows: Iterable[tuple[int, int, ComplexArray]],
) -> Iterator[tuple[int, int, ComplexArray]]:
    """Yield the means of days."""
    for day, some in itertools.groupby(rows, lambda row: row[0] // DAY_NS * DAY_NS):
        total, count = np.zeros(1, np.complex128), 0
        for _, n_segments, csm in some:
            total, count = total + n_segments * csm, count + n_segments
        yield day, count, total / count


def packed(csm: ComplexArray) -> NDArray[np.float64]:
    """Return Hermitian matrices as real ones."""
    return np.asarray(np.tril(csm.real) + np.triu(csm.imag, 1))


def unpacked(found: NDArray[np.floating[Any]]) -> ComplexArray:
    """Return what was `packed`."""
    upper = np.triu(found, 1)
    csm = np.empty(found.shape, dtype=np.complex128)
    csm.real = np.tril(found) + np.tril(found, -1).swapaxes(-1, -2)
    csm.imag = upper - upper.swapaxes(-1, -2)
    return csm


def _write_summary(hdf5: WholeHdf5, group: str, summary: Summary, *, total: bool) -> None:
    for each in fields(summary):
        array = getattr(summary, each.name)
        if each.name == "total" and not total:
            continue
        array = packed(array) if each.name == "total" else array
        hdf5.create(
            f"{group}/{each.name}", array, compression="gzip", compression_opts=1, shuffle=True,
            fletcher32=True, chunks=(1, *array.shape[1:]) if array.ndim > 2 else True,
        )  # fmt: skip
    hdf5.file[group].attrs["sha256"] = summary.sha256


@contextlib.contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    """Convert whatever h5py raises on a damaged file to ArchiveError."""
    try:
        yield
    except ArchiveError:
        raise
    except (RecordingError, *_DAMAGE, ValueError, OverflowError, RecursionError) as error:
        reason = (str(error) or type(error).__name__).removeprefix(f"{path}: ")
        raise ArchiveError(f"{path}: damaged: {reason}") from error


def _attribute(value: object) -> object:
    """Return a value of a document as an attribute has it."""
    if isinstance(value, bool):
        return int(value)
    return value if isinstance(value, (str, int, float)) else json.dumps(value)


def _value(name: str, attribute: Any) -> Any:  # noqa: ANN401 - any value of JSON
    """Return what was written as an attribute."""
    if name in _TEXTS or not isinstance(attribute, str) or attribute[:1] not in {"{", "["}:
        return attribute
    return json.loads(attribute)
