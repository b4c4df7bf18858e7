"""Recordings and files of other programs, open for reading, as scripts and notebooks use them."""

from __future__ import annotations

import os
import shutil
from abc import abstractmethod
from bisect import bisect_left
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING, Self, Unpack
from weakref import finalize

import numpy as np

from daq.bench.durations import format_duration
from daq.bench.units import cf_unit
from daq.errors import WrongSettingError
from daq.formats.importer import ImportResult, open_files
from daq.formats.sources import Selection
from daq.protocols.block import BlockFlag, Event
from daq.recording.interface import ReadableRecording, ReadableSensor, absences
from daq.recording.reader import Recording
from estimator.wording import several
from tui.notebook.estimates import PathLike, Response, estimate, response_sources, self_noise
from tui.notebook.options import EstimateOptions, Time, moment
from tui.output.extras import load
from tui.wording.formatting import utc

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import pandas as pd
    import xarray as xr
    from numpy.typing import NDArray

    from daq.bench.channel import Channel
    from daq.bench.model import Bench
    from daq.formats.assembly import Overlap
    from daq.formats.memory import RecordingInMemory
    from estimator.types import FloatArray, IntArray
    from tui.notebook.result import Result

_NS_PER_S = 1_000_000_000


class SampledSensors:
    """Sensors whose samples are read when they are asked for.

    Attributes
    ----------
    created : datetime
        Start of the recording, UTC.
    sensors : tuple of str
        Names of the sensors.
    """

    def __init__(self, recording: ReadableRecording) -> None:
        ns = recording.created_at.utc_ns
        self._created_ns = ns
        self.created = datetime.fromtimestamp(ns / _NS_PER_S, tz=UTC)
        self.sensors = tuple(sensor.name for sensor in recording.sensors)
        self._channels = {sensor.name: sensor.channels for sensor in recording.sensors}
        self._rates = {sensor.name: sensor.sampling_rate for sensor in recording.sensors}

    @abstractmethod
    @contextmanager
    def _opened(self) -> Iterator[ReadableRecording]:
        """Yield the recording, open."""

    def channels(self, sensor: str) -> tuple[str, ...]:
        """Return the names of a sensor's channels."""
        return tuple(channel.name for channel in self._of(sensor))

    def units(self, sensor: str) -> tuple[str, ...]:
        """Return the unit of each channel of a sensor."""
        return tuple(channel.unit for channel in self._of(sensor))

    def sampling_rate(self, sensor: str) -> float:
        """Return the sampling rate of a sensor in Hz."""
        self._of(sensor)
        return self._rates[sensor]

    def samples(
        self, sensor: str, *, start: Time | None = None, end: Time | None = None
    ) -> FloatArray:
        """Return samples of a sensor, NaN in its gaps. Only the span is read.

        Parameters
        ----------
        sensor : str
        start, end : str, float or datetime, optional
            From when, and before when, as `huddle.estimate` takes them.

        Returns
        -------
        float64, shape (n_samples, n_channels)
            Counts over sensitivity, in the unit of each channel.
        """
        return self._span(sensor, start, end)[0]

    def to_frame(
        self, sensor: str, *, start: Time | None = None, end: Time | None = None
    ) -> pd.DataFrame:
        """Return samples of a sensor with a DatetimeIndex, a column for each channel.

        Times are those of the file where it states UTC; else they follow from the arrival of the
        first block and the nominal rate. Needs pandas.
        """
        samples, times = self._span(sensor, start, end)
        pandas = load("pandas")
        index = pandas.DatetimeIndex(times.view("datetime64[ns]"), name="time")
        frame: pd.DataFrame = pandas.DataFrame(samples, index, list(self.channels(sensor)))
        frame.attrs["units"] = self._common_unit(sensor)
        return frame

    def to_xarray(
        self, sensor: str, *, start: Time | None = None, end: Time | None = None
    ) -> xr.DataArray:
        """Return samples of a sensor with the dimensions time and channel; needs xarray.

        Times are those of `to_frame`, the unit is in the spelling of the CF conventions.
        """
        samples, times = self._span(sensor, start, end)
        coords = {"time": times.view("datetime64[ns]"), "channel": list(self.channels(sensor))}
        found: xr.DataArray = load("xarray").DataArray(
            samples,
            coords,
            ("time", "channel"),
            name=sensor,
            attrs={"units": self._common_unit(sensor)},
        )
        return found

    def _common_unit(self, sensor: str) -> str:
        return " / ".join(map(cf_unit, dict.fromkeys(self.units(sensor))))

    def _span(
        self, sensor: str, start: Time | None, end: Time | None
    ) -> tuple[FloatArray, NDArray[np.int64]]:
        """Return samples of a span and their times, UTC in ns."""
        channels = self._of(sensor)
        limits = [
            None if at is None else round(at.timestamp() * 1e6) * 1000
            for at in (moment("start", start, self.created), moment("end", end, self.created))
        ]
        with self._opened() as recording:
            record = next(each for each in recording.sensors if each.name == sensor)
            blocks = record.blocks[:]
            first, n_samples = blocks["first_sample"], blocks["n_samples"]
            end_sample = int((first + n_samples).max(initial=0))
            clock = _Clock(blocks, record.sampling_rate)
            low, high = (
                otherwise if at is None else clock.sample_at(at, end_sample)
                for at, otherwise in zip(limits, (0, end_sample), strict=True)
            )
            samples = np.full((max(0, high - low), len(channels)), np.nan)
            chosen = blocks[(first < high) & (first + n_samples > low)]
            if len(chosen) and len(samples):
                begin = int(chosen["first_row"][0])
                last = int(chosen["first_row"][-1] + chosen["n_samples"][-1])
                ahead = np.repeat(chosen["first_sample"] - chosen["first_row"], chosen["n_samples"])
                at = np.arange(begin, last) + ahead - low
                inside = (at >= 0) & (at < len(samples))
                row, last = begin + int(np.argmax(inside)), begin + int(np.flatnonzero(inside)[-1])
                sensitivity = np.array([channel.sensitivity for channel in channels])
                places = at[row - begin : last + 1 - begin]
                samples[places] = record.counts(row, last + 1) / sensitivity
                for column, rows in absences(record.absent, row, last + 1):
                    samples[places[rows], column] = np.nan
        return samples, clock.times(np.arange(low, max(low, high)))

    def _of(self, sensor: str) -> tuple[Channel, ...]:
        if sensor not in self.sensors:
            raise WrongSettingError(f"sensor={sensor!r}: expected one of {', '.join(self.sensors)}")
        return self._channels[sensor]


class _Clock:
    """Times of samples: as stated by blocks, else by the nominal rate after the first of them."""

    def __init__(self, blocks: NDArray[np.void], rate: float) -> None:
        self._interval = _NS_PER_S / rate
        if len(blocks) and blocks["flags"][0] & int(BlockFlag.DEVICE_UTC):
            self._first, self._at = blocks["first_sample"], blocks["device_counter"]
        else:
            some = blocks[:1]
            self._first = some["first_sample"]
            self._at = some["utc_ns"] - np.round(some["n_samples"] * self._interval).astype(int)

    def times(self, samples: IntArray) -> NDArray[np.int64]:
        """Return the times of samples, UTC in ns."""
        if not len(self._first):
            return np.zeros(len(samples), np.int64)
        block = np.maximum(np.searchsorted(self._first, samples, side="right") - 1, 0)
        after = np.round((samples - self._first[block]) * self._interval).astype(np.int64)
        return np.asarray(self._at[block] + after, np.int64)

    def sample_at(self, utc_ns: int, end_sample: int) -> int:
        """Return the first sample that is not before a time, at most `end_sample`."""
        every = range(end_sample)
        return bisect_left(every, utc_ns, key=lambda at: self.times(np.array([at]))[0])


class RecordingFile(SampledSensors):
    """A recording, growing or closed, as `huddle.open` returns it.

    The file is opened and closed again by each method that reads it: two readers of a growing file
    in one process would disturb each other. So nothing has to be closed; as a context manager it
    does nothing.

    Attributes
    ----------
    path : Path
    bench : Bench or None
        The bench that was recorded; None for a recording without one.
    created : datetime
        Start of the recording, UTC.
    closed : bool
        Whether the recording was complete when it was opened.
    sensors : tuple of str
        Names of the sensors.
    """

    def __init__(self, path: PathLike) -> None:
        self.path = Path(path)
        with Recording.open(self.path) as recording:
            self.bench: Bench | None = recording.bench
            self.closed = recording.closed
            super().__init__(recording)
            self.created = recording.created

    @contextmanager
    def _opened(self) -> Iterator[ReadableRecording]:
        with Recording.open(self.path) as recording:
            yield recording

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened while recording, and when."""
        with Recording.open(self.path) as recording:
            return recording.events

    def estimate(
        self,
        *,
        start: Time | None = None,
        end: Time | None = None,
        **options: Unpack[EstimateOptions],
    ) -> Result:
        """Estimate the self-noise of every channel, as `huddle.estimate` does."""
        return estimate(self.path, start=start, end=end, **options)

    def __fspath__(self) -> str:
        return str(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def __repr__(self) -> str:
        with Recording.open(self.path) as recording:
            state = "" if recording.closed else ", not closed"
            head = f"Recording {self.path}, {utc(recording.created_at.utc_ns)}{state}"
            return "\n".join([recording.caveats.nouns(head), *map(_line, recording.sensors)])


class Waveforms(SampledSensors):
    """Files of other programs as `huddle.read` returns them; pass it to `huddle.self_noise`.

    Attributes
    ----------
    created : datetime
        First sample of all, UTC.
    sensors : tuple of str
        Names of the sensors.
    calibrations : tuple of str
        What every channel's counts are taken to be, and from where.
    problems : tuple of str
        Files and channels that could not be used, with the reason.
    """

    def __init__(self, recording: RecordingInMemory, result: ImportResult) -> None:
        super().__init__(recording)
        self.recording = recording
        self._imported = result.sensors
        self.problems = result.problems
        self.calibrations = tuple(
            f"{each.channel}: {each.sensitivity:.6g} counts per {each.unit}"
            f" ({', '.join((each.origin, *each.notes))})"
            for each in result.calibrations
        )

    @contextmanager
    def _opened(self) -> Iterator[ReadableRecording]:
        yield self.recording

    def estimate(self, **options: Unpack[EstimateOptions]) -> Result:
        """Estimate the self-noise of every channel, as `huddle.self_noise` does."""
        return self_noise(self, **options)

    def __repr__(self) -> str:
        head = f"Waveforms of {self.recording.path}, {utc(self._created_ns)}"
        lines = [self.recording.caveats.nouns(head)]
        lines += map(_line, self.recording.sensors)
        for each in self._imported:
            lines += [
                f"  {each.sensor}.{channel}: no samples in {n} rows that other channels have"
                for channel, n, _ in each.absent
            ]
        return "\n".join((*lines, *(f"  not used: {each}" for each in self.problems)))


def read(
    *paths: PathLike,
    response: Response | Sequence[Response] | Mapping[str, Response | Sequence[Response]] = None,
    fs: float | None = None,
    channels: Sequence[str] = (),
    start: str | datetime | None = None,
    end: str | datetime | None = None,
    overlap: Overlap = "refuse",
    columns: str = "",
    sample_unit: str = "",
) -> Waveforms:
    """Open files of other programs; nothing but their outlines is read until it is needed.

    An estimate has the numbers of ``huddle import`` followed by ``huddle estimate``, to the bit.

    Parameters
    ----------
    *paths : path
        Files of all formats that ``huddle import`` takes, packed ones, ``sds://ROOT``, or
        ``fdsn://CENTRE/NET.STA.LOC.CHA``.
    response : path, Inventory, sequence or mapping of them, optional
        As `huddle.self_noise` takes it. Without it, the calibration of the file counts, if it has
        one.
    fs : float, optional
        Sampling rate in Hz, where a file does not say.
    channels : sequence of str, optional
        Patterns of channels to take, such as ``"HH?"``.
    start, end : str or datetime, optional
        UTC.
    overlap : str
        Which samples count where files overlap and differ: ``"first"`` or ``"last"``; refused by
        default.
    columns : str
        Names of the columns of CSV files in place of their headers, ``"time [s],X [g],-"``; ``-``
        leaves one out.
    sample_unit : str
        Unit of the samples, where files have none and no `response`.

    Returns
    -------
    Waveforms

    Raises
    ------
    HuddleError
        If no file is understood, or a response does not fit.

    Examples
    --------
    >>> import huddle
    >>> import numpy as np
    >>> rng = np.random.default_rng(2)
    >>> counts = {name: rng.integers(-99, 99, (6000, 3)) for name in "ABC"}
    >>> np.savez("floor.npz", sampling_rate=100.0, **counts)
    >>> waveforms = huddle.read("floor.npz")
    >>> waveforms.sensors, waveforms.samples("A", start="10s", end="20s").shape
    (('A', 'B', 'C'), (1000, 3))
    >>> huddle.self_noise(waveforms, segment="1s").n_segments
    119
    """
    if not paths:
        raise WrongSettingError("paths: none given; expected at least one file")
    for path in paths:
        if Path(path).suffix.lower() in {".h5", ".hdf5"}:
            raise WrongSettingError(
                f"{os.fspath(path)}: a recording; huddle.open reads it, huddle.estimate estimates"
                " its noise"
            )
    some, assigned = response_sources(response)
    began, ended = nanoseconds("start", start), nanoseconds("end", end)
    folder = mkdtemp(prefix="huddle-")
    try:
        recording, result = open_files(
            [os.fspath(path) for path in paths],
            Path(folder),
            response=some,
            response_for=assigned,
            sampling_rate=fs,
            selection=Selection(
                tuple(channels), began, ended, overlap, columns=columns, unit=sample_unit
            ),
        )
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    # What was fetched or unpacked goes with the recording that reads it.
    finalize(recording, shutil.rmtree, folder, ignore_errors=True)
    return Waveforms(recording, result)


def nanoseconds(key: str, given: str | datetime | None) -> int | None:
    """Return an instant of UTC in ns since 1970.

    Raises
    ------
    WrongSettingError
        With the key and what was expected.
    """
    at = moment(key, given, datetime.fromtimestamp(0, tz=UTC))
    return None if at is None else round(at.timestamp() * 1e6) * 1000


def open(path: PathLike) -> RecordingFile:  # noqa: A001 - of huddle.open
    """Look into a recording: growing, closed, or left open by a crash.

    Parameters
    ----------
    path : path

    Returns
    -------
    RecordingFile
        Sensors, samples and events. Nothing stays open.

    Raises
    ------
    HuddleError
        If the file is no recording or cannot be read. Also an `OSError`.

    Examples
    --------
    >>> import huddle
    >>> huddle.simulate("fig9", duration="30s").write("pair.h5")
    >>> recording = huddle.open("pair.h5")
    >>> {name: recording.samples(name).shape for name in recording.sensors}
    {'i': (6000, 2), 'j': (6000, 2), 'k': (6000, 2)}
    """
    return RecordingFile(path)


def _line(sensor: ReadableSensor) -> str:
    names = " ".join(channel.name for channel in sensor.channels)
    length = format_duration(round(sensor.n_samples / sensor.sampling_rate, 1))
    gaps = several(len(sensor.gaps), "gap") if len(sensor.gaps) else "no gaps"
    return (
        f"  {sensor.name}: {names} at {sensor.sampling_rate:g} Hz,"
        f" {sensor.n_samples} samples ({length}), {gaps}"
    )
