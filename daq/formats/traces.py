"""Samples of one channel, as files hold them, read when they are needed.

Theory of operation
-------------------
A reader divides a file into parts (:class:`TracePart`): a megabyte of miniSEED, or a whole file of
another format. A part is loaded as traces, one for each channel and contiguous stretch. Every part
is loaded once to learn what it holds; that leaves a :class:`Piece` for each run of finite samples,
without the samples. They are loaded again when a row is read. :class:`PartCache` keeps the parts
that were loaded last, so small files are loaded once, and months of files need no more memory than
a day.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import NS_PER_S, ForeignCalibration, ForeignSensor

Samples: TypeAlias = NDArray[Any]

CACHE_BYTES = 48 << 20
MOST_CACHE_BYTES = 256 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Contiguous samples of one channel.

    Attributes
    ----------
    sensor, channel : str
    start_ns : int
        UTC of the first sample, in ns since 1970; 0 where the file has no date.
    sampling_rate : float
        In Hz, as the file states it.
    samples : ndarray, shape (n_samples,)
    unit : str
        Of the samples; empty where they are counts, or the format does not say.
    end_ns : int, optional
        UTC of the last sample, if the file states that too; its clock may run off its rate.
    fdsn : bool
        Whether the channel has a code of the FDSN, which tells what it measures.
    calibration : ForeignCalibration, optional
        What the file says a count is.
    """

    sensor: str
    channel: str
    start_ns: int
    sampling_rate: float
    samples: Samples
    unit: str = ""
    end_ns: int | None = None
    fdsn: bool = False
    calibration: ForeignCalibration | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TracePart:
    """Some traces of a file; `path` is what messages call it."""

    path: Path

    def load(self) -> Sequence[Trace]:
        """Return its traces, every time the same."""
        raise NotImplementedError

    def reaches(self, start_ns: int | None, end_ns: int | None) -> bool:
        """Whether it may have samples between two instants of UTC; it is not loaded for that."""
        del start_ns, end_ns
        return True

    def split(self) -> Sequence[TracePart]:
        """Return smaller parts, of which some may be sound; nothing if there are none."""
        return ()


@dataclass(frozen=True, slots=True, eq=False)
class ReadPart(TracePart):
    """What `read` returns of a file; it is read as a whole."""

    read: Callable[[Path], Sequence[Trace]]

    def load(self) -> Sequence[Trace]:
        """Read the file."""
        return self.read(self.path)


def traces_of(sensors: Iterable[ForeignSensor]) -> list[Trace]:
    """Return a trace for each channel and stretch of sensors.

    Raises
    ------
    ImportFormatError
        If a sensor has what no recording can hold.
    """
    found = []
    for sensor in sensors:
        sensor.check()
        units = sensor.units or ("",) * len(sensor.channels)
        calibrations = sensor.calibrations or (None,) * len(sensor.channels)
        found += [
            Trace(
                sensor.name,
                channel,
                stretch.start_utc_ns,
                sensor.sampling_rate,
                stretch.counts[:, number],
                unit,
                calibration=calibration,
            )
            for stretch in sensor.stretches
            for number, (channel, unit, calibration) in enumerate(
                zip(sensor.channels, units, calibrations, strict=True)
            )
        ]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Finite samples of one channel in one part; `order` is that of the files as given."""

    part: TracePart
    number: int
    first: int
    n_samples: int
    start_ns: int
    end_ns: int
    sampling_rate: float
    dtype: np.dtype[Any]
    order: int

    @property
    def interval_ns(self) -> float:
        """Time from one sample to the next."""
        if self.n_samples == 1:
            return NS_PER_S / self.sampling_rate
        return (self.end_ns - self.start_ns) / (self.n_samples - 1)

    def cut(self, first: int, end: int) -> Piece:
        """Return the samples from `first` to `end`, exclusive."""
        interval = self.interval_ns
        return replace(
            self,
            first=self.first + first,
            n_samples=end - first,
            start_ns=self.start_ns + round(first * interval),
            end_ns=self.start_ns + round((end - 1) * interval),
        )


class PartCache:
    """The parts that were loaded last, up to a number of bytes; the last one in any case.

    Threads that read ahead may share it.
    """

    def __init__(self, n_bytes: int = CACHE_BYTES) -> None:
        self._n_bytes = n_bytes
        self._held = 0
        self._lock = threading.Lock()
        self._parts: OrderedDict[int, tuple[TracePart, Sequence[Trace], int]] = OrderedDict()

    def traces(self, part: TracePart) -> Sequence[Trace]:
        """Return the traces of a part.

        Raises
        ------
        ImportFormatError
            It cannot be read.
        """
        with self._lock:
            return self._traces(part)

    def make_room(self, n_bytes: int) -> None:
        """Hold at least so many bytes: what is read together, or every row would load it again."""
        self._n_bytes = max(self._n_bytes, min(n_bytes, MOST_CACHE_BYTES))

    def _traces(self, part: TracePart) -> Sequence[Trace]:
        known = self._parts.get(id(part))
        if known is not None:
            self._parts.move_to_end(id(part))
            return known[1]
        while self._parts and self._held > self._n_bytes // 2:
            self._held -= self._parts.popitem(last=False)[1][2]
        traces = part.load()
        size = sum(trace.samples.nbytes for trace in traces)
        self._parts[id(part)] = part, traces, size
        self._held += size
        while len(self._parts) > 1 and self._held > self._n_bytes:
            self._held -= self._parts.popitem(last=False)[1][2]
        return traces

    def samples(self, piece: Piece, first: int, end: int) -> Samples:
        """Return the samples of a piece from `first` to `end`, exclusive.

        Raises
        ------
        ImportFormatError
            If the file has changed since it was first read.
        """
        traces = self.traces(piece.part)
        if piece.number < len(traces):
            found = traces[piece.number].samples[piece.first + first : piece.first + end]
            if len(found) == end - first:
                return found
        raise ImportFormatError(
            f"{piece.part.path}: changed while it was read; import it when it is complete"
        )


def pieces_of(
    part: TracePart, traces: Sequence[Trace], order: int
) -> Iterator[tuple[Trace, Piece]]:
    """Yield each trace with each of its runs of finite samples."""
    for number, trace in enumerate(traces):
        n_samples = len(trace.samples)
        if n_samples == 0:
            continue
        end_ns = trace.end_ns
        if end_ns is None:
            end_ns = trace.start_ns + round((n_samples - 1) * NS_PER_S / trace.sampling_rate)
        whole = Piece(
            part=part,
            number=number,
            first=0,
            n_samples=n_samples,
            start_ns=trace.start_ns,
            end_ns=end_ns,
            sampling_rate=trace.sampling_rate,
            dtype=trace.samples.dtype,
            order=order,
        )
        for first, end in _finite_runs(trace.samples):
            yield trace, whole if end - first == n_samples else whole.cut(first, end)


def _finite_runs(samples: Samples) -> list[tuple[int, int]]:
    """Return (first, last + 1) of each run of samples that are finite."""
    if samples.dtype.kind != "f" or np.isfinite(samples).all():
        return [(0, len(samples))]
    edges = np.flatnonzero(np.diff(np.isfinite(samples), prepend=False, append=False))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
