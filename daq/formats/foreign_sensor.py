"""What every reader of a foreign format returns, before it becomes a recording."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel, check_name
from daq.bench.units import canonical
from daq.errors import ImportFormatError
from daq.protocols.block import CountsArray
from daq.recording.interface import FIRST_DATE_NS

NS_PER_S = 1_000_000_000
MAX_CHANNELS = 1000
MIN_RATE, MAX_RATE = 1e-6, 1e7
"""In Hz."""


class RowSource(Protocol):
    """Samples that are read when they are sliced."""

    shape: tuple[int, int]
    dtype: np.dtype[Any]

    def __getitem__(self, rows: Any) -> NDArray[Any]:  # noqa: ANN401 - as arrays take it
        """Return rows, shape (n_rows, n_channels)."""

    def __len__(self) -> int: ...


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Contiguous samples of one sensor.

    Attributes
    ----------
    start_utc_ns : int
        UTC of the first sample, in ns since 1970.
    counts : ndarray, shape (n_samples, n_channels)
        Raw values, integers or floats; or what gives them when it is sliced.
    knot_rows, knot_times_ns : float64, shape (n_knots,), optional
        Rows and their times after the first row, where the clock runs off the nominal rate;
        linear between and beyond them.
    continues : bool
        Whether no sample is missing between the stretch before and this one.
    """

    start_utc_ns: int
    counts: CountsArray | RowSource
    knot_rows: NDArray[np.float64] | None = None
    knot_times_ns: NDArray[np.float64] | None = None
    continues: bool = False

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.counts.shape[0])

    def times_ns(self, rows: Sequence[int], sampling_rate: float) -> list[int]:
        """Return UTC of rows, in ns; `sampling_rate` is nominal, in Hz."""
        if self.knot_rows is None or self.knot_times_ns is None:
            after = [round(row * NS_PER_S / sampling_rate) for row in rows]
        else:
            at = np.asarray(rows, dtype=np.float64)
            exact = piecewise_linear(at, self.knot_rows, self.knot_times_ns)
            after = [round(each) for each in exact.tolist()]
        return [self.start_utc_ns + each for each in after]


@dataclass(frozen=True, slots=True)
class ForeignCalibration:
    """What a file says of one of its channels.

    Attributes
    ----------
    sensitivity : float
        In counts per `unit`; the samples stay counts.
    unit : str
    origin : str
        Where in the file it is, for people: ``scale factor of K-NET``.
    model, serial_number : str
        Of the instrument, as far as the file says.
    """

    sensitivity: float
    unit: str
    origin: str
    model: str = ""
    serial_number: str = ""

    @classmethod
    def of_count(
        cls, size: float, unit: str, origin: str, **rest: str
    ) -> ForeignCalibration | None:
        """Return the calibration by which a count is `size` units; None if that is no number."""
        if not math.isfinite(size) or size == 0 or not math.isfinite(1 / size):
            return None
        return cls(1 / size, unit, origin, **rest)


@dataclass(frozen=True, slots=True)
class ForeignSensor:
    """One sensor as a foreign file has it; between its stretches lie gaps.

    ``units`` holds one unit per channel, in which its samples are, or is empty where the format
    does not say. ``calibrations`` holds one for each channel whose samples are counts, or is empty.
    """

    name: str
    channels: tuple[str, ...]
    sampling_rate: float
    stretches: tuple[Stretch, ...]
    source: str
    units: tuple[str, ...] = ()
    calibrations: tuple[ForeignCalibration | None, ...] = ()

    @property
    def absent(self) -> NDArray[np.int64]:
        """Rows in which a channel has no sample: its number, the first, and one after the last."""
        found, row = [np.empty((0, 3), np.int64)], 0
        for stretch in self.stretches:
            absent = getattr(stretch.counts, "absent", [])
            if absent:
                found.append(np.array(absent, np.int64) + np.array([0, row, row]))
            row += stretch.n_samples
        return np.concatenate(found)

    def own_channels(self, unit: str = "") -> list[Channel]:
        """Return its channels as the file describes them, or with samples in `unit`, if given."""
        units = self.units or ("counts",) * len(self.channels)
        calibrations = self.calibrations or (None,) * len(self.channels)
        return [
            Channel(name=name, sensitivity=1.0, unit=canonical(unit or in_file))
            if own is None or unit
            else Channel(name=name, sensitivity=own.sensitivity, unit=canonical(own.unit))
            for name, in_file, own in zip(self.channels, units, calibrations, strict=True)
        ]

    def check(self) -> None:
        """Refuse what no recording can hold.

        Raises
        ------
        ImportFormatError
            Naming file, sensor, and what was expected.
        """
        where = f"{self.source}: sensor {self.name[:80]!r}"
        if len(self.channels) > MAX_CHANNELS:
            raise ImportFormatError(
                f"{where}: {len(self.channels)} channels; expected at most {MAX_CHANNELS}. Are rows"
                " and columns exchanged?"
            )
        repeated = {name for name in self.channels if self.channels.count(name) > 1}
        if repeated:
            raise ImportFormatError(
                f"{where}: several channels are named {min(repeated)!r}; expected different names"
            )
        if not (math.isfinite(self.sampling_rate) and MIN_RATE <= self.sampling_rate <= MAX_RATE):
            raise ImportFormatError(
                f"{where}: a sampling rate of {self.sampling_rate:g} Hz; expected {MIN_RATE:g} to"
                f" {MAX_RATE:g} Hz"
            )
        for what, name in (("sensor", self.name), *(("channel", n) for n in self.channels)):
            try:
                check_name(name)
            except ValueError as error:
                raise ImportFormatError(
                    f"{where}: {what} name {name[:80]!r}: {error}; rename it in the file"
                ) from None

    def first_samples(self) -> list[int]:
        """Return the index of the first sample of each stretch, counted from the first stretch.

        By the nominal rate. A clock that runs off it moves what follows; no gap is shorter than a
        sample.
        """
        begin = self.stretches[0].start_utc_ns
        found: list[int] = []
        moved = end = 0
        for stretch in self.stretches:
            elapsed_ns = stretch.start_utc_ns - begin
            first = round(elapsed_ns * self.sampling_rate / NS_PER_S) + moved
            least = end if stretch.continues else end + 1
            if found and (first < least or stretch.continues):
                moved, first = moved + least - first, least
            found.append(first)
            end = first + stretch.n_samples
            if stretch.knot_rows is not None:
                (last,) = stretch.times_ns([stretch.n_samples], self.sampling_rate)
                moved = end - round((last - begin) * self.sampling_rate / NS_PER_S)
        return found

    def dated_spans_ns(self) -> list[tuple[int, int]]:
        """Return UTC of the first and last sample of each stretch; nothing if there is no date."""
        return [
            (s.start_utc_ns, s.times_ns([s.n_samples - 1], self.sampling_rate)[0])
            for s in self.stretches
            if self.stretches[0].start_utc_ns >= FIRST_DATE_NS
        ]


def finite_stretches(
    counts: CountsArray, *, start_utc_ns: int, sampling_rate: float
) -> tuple[Stretch, ...]:
    """Cut samples at every row without any number; other values that are none become NaN.

    Parameters
    ----------
    counts : ndarray, shape (n_samples, n_channels)
    start_utc_ns : int
        UTC of the first row, in ns.
    sampling_rate : float
        In Hz.

    Returns
    -------
    tuple of Stretch
        None of them empty.
    """
    if not np.issubdtype(counts.dtype, np.floating):
        return (Stretch(start_utc_ns, counts),) if counts.shape[0] else ()
    finite = np.isfinite(counts)
    if not finite.all():
        counts = counts.copy()
        counts[~finite] = np.nan
    edges = np.flatnonzero(np.diff(finite.any(axis=1), prepend=False, append=False))
    return tuple(
        Stretch(start_utc_ns + round(int(first) * NS_PER_S / sampling_rate), counts[first:end])
        for first, end in edges.reshape(-1, 2)
    )


def piecewise_linear(
    at: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate linearly through knots, and extrapolate from the outer two at either end."""
    segment = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    slope = np.diff(y) / np.diff(x)
    return np.asarray(y[segment] + (at - x[segment]) * slope[segment])
