"""Spectra of one recording: an HDF5 file of an archive, one row a stretch.

A file has its name when it is complete and on the disk; before, it is hidden and ends in ``.part``.
Rows hold cross-spectral matrices in unit²/Hz, packed: real parts on and below the diagonal,
imaginary parts of the elements above the diagonal. The matrices are Hermitian, so nothing is lost.
"""

from __future__ import annotations

import contextlib
import json
import os
import uuid
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

import h5py
import numpy as np

from daq.errors import ArchiveError, RecordingError, WrongArchiveError
from daq.recording.file_format import channel_attributes, channels_of
from daq.recording.storage.opening import open_file
from daq.recording.storage.refusals import dataset, member, number, text
from estimator.spectra.segment_rejection import Reason

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from daq.bench.channel import Channel

    ComplexArray = NDArray[np.complex128]

FORMAT = "huddle-archive-spectra"
FORMAT_VERSION = 1
STRETCH_DTYPE = np.dtype([("start_utc_ns", "<i8"), ("n_segments", "<i8")])
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
    """

    run_id: str
    path: str
    n_bytes: int
    modified_ns: int
    n_samples: int
    closed: bool


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
    clipped, stood_still : mapping of int to float
        As in `daq.estimation.snapshot.SnapshotDiagnostics`.
    """

    origin: Origin
    channels: tuple[tuple[str, Channel], ...]
    usable: float
    elapsed: float
    left_out: Mapping[Reason, int] = field(default_factory=dict)
    residual: Mapping[str, float] = field(default_factory=dict)
    not_understood: tuple[str, ...] = ()
    clipped: Mapping[int, float] = field(default_factory=dict)
    stood_still: Mapping[int, float] = field(default_factory=dict)


class SpectraWriter:
    """Writes the file of one recording; a context manager.

    Nothing is left behind unless `commit` is called.

    Parameters
    ----------
    path : Path
    n_freqs, n_channels : int
    """

    def __init__(self, path: Path, *, n_freqs: int, n_channels: int) -> None:
        self._path = path
        self._part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
        self._file = h5py.File(self._part, "w")
        shape = (n_freqs, n_channels, n_channels)
        self._csm = self._file.create_dataset(
            "csm",
            shape=(0, *shape),
            maxshape=(None, *shape),
            chunks=(1, *shape),
            dtype="<f8",
            fletcher32=True,
        )
        self._stretches: list[tuple[int, int]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._part.unlink(missing_ok=True)

    def restart(self) -> None:
        """Drop all stretches."""
        self._stretches.clear()

    def append(self, start_utc_ns: int, n_segments: int, csm: ComplexArray) -> None:
        """Add a stretch; `csm` of shape (n_freqs, n_channels, n_channels), Hermitian."""
        row = len(self._stretches)
        if row >= len(self._csm):
            self._csm.resize(row + 1, axis=0)
        self._csm[row] = np.tril(csm.real) + np.triu(csm.imag, 1)
        self._stretches.append((start_utc_ns, n_segments))

    def commit(self, described: Described) -> None:
        """Complete the file: it has its name, and is on the disk, when this returns."""
        file, origin = self._file, described.origin
        self._csm.resize(len(self._stretches), axis=0)
        file.create_dataset(
            "stretches", data=np.array(self._stretches, STRETCH_DTYPE), fletcher32=True, chunks=True
        ) if self._stretches else file.create_dataset("stretches", (0,), STRETCH_DTYPE)
        groups = file.create_group("sensors", track_order=True)
        for name in dict.fromkeys(sensor for sensor, _ in described.channels):
            own = [channel for sensor, channel in described.channels if sensor == name]
            groups.create_group(name).attrs.update(channel_attributes(own))
        file.attrs.update(
            {
                "format": FORMAT,
                "format_version": FORMAT_VERSION,
                "run_id": origin.run_id,
                "source": origin.path,
                "source_bytes": origin.n_bytes,
                "source_modified_ns": origin.modified_ns,
                "source_samples": origin.n_samples,
                "source_closed": int(origin.closed),
                "sensors": list(groups),
                "usable": described.usable,
                "elapsed": described.elapsed,
                "left_out": json.dumps({str(k): v for k, v in described.left_out.items()}),
                "residual": json.dumps(dict(described.residual)),
                "not_understood": json.dumps(dict.fromkeys(described.not_understood, True)),
                "clipped": json.dumps(dict(described.clipped)),
                "stood_still": json.dumps(dict(described.stood_still)),
            }
        )
        file.close()
        _to_disk(self._part)
        self._part.replace(self._path)
        _to_disk(self._path.parent)


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
        self.described = Described(
            origin=Origin(
                run_id=text(attributes, "run_id"),
                path=text(attributes, "source"),
                n_bytes=int(number(attributes, "source_bytes")),
                modified_ns=int(number(attributes, "source_modified_ns")),
                n_samples=int(number(attributes, "source_samples")),
                closed=bool(number(attributes, "source_closed")),
            ),
            channels=channels,
            usable=float(number(attributes, "usable")),
            elapsed=float(number(attributes, "elapsed")),
            left_out={Reason(k): int(v) for k, v in _table(attributes, "left_out").items()},
            residual={k: float(v) for k, v in _table(attributes, "residual").items()},
            not_understood=tuple(_table(attributes, "not_understood", optional=True)),
            clipped={int(k): float(v) for k, v in _table(attributes, "clipped").items()},
            stood_still={int(k): float(v) for k, v in _table(attributes, "stood_still").items()},
        )
        self.stretches: NDArray[np.void] = dataset(file, "stretches", STRETCH_DTYPE)[...]
        self._csm = dataset(file, "csm", np.dtype("<f8"))
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
            packed = self._csm[row]
        lower, upper = np.tril(packed), np.triu(packed, 1)
        csm = np.empty(packed.shape, dtype=np.complex128)
        csm.real = lower + np.tril(packed, -1).swapaxes(1, 2)
        csm.imag = upper - upper.swapaxes(1, 2)
        return csm

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


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


def _table(
    attributes: h5py.AttributeManager, name: str, *, optional: bool = False
) -> dict[str, Any]:
    if optional and name not in attributes:  # of files of before
        return {}
    found = json.loads(text(attributes, name))
    if not isinstance(found, dict):
        raise TypeError(f"attribute {name}; expected a table")
    return found


def _to_disk(path: Path) -> None:
    """Write a file, or the names in a folder, to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        if path.is_file():
            raise  # some file systems have no fsync of folders
    finally:
        os.close(handle)
