"""A recording that is open for reading, as scripts and notebooks use it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Self, Unpack

import numpy as np

from daq.bench.durations import format_duration
from daq.errors import WrongSettingError
from daq.recording.reader import Recording
from tui.notebook.estimates import PathLike, estimate
from tui.wording.formatting import several, utc

if TYPE_CHECKING:
    from datetime import datetime

    from daq.bench.model import Bench
    from daq.protocols.block import Event
    from daq.recording.reader import SensorRecord
    from estimator.types import FloatArray
    from tui.notebook.options import EstimateOptions, Time
    from tui.notebook.result import Result


class RecordingFile:
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
            self.created: datetime = recording.created
            self.closed = recording.closed
            self.sensors = tuple(sensor.name for sensor in recording.sensors)
            self._channels = {sensor.name: sensor.channels for sensor in recording.sensors}
            self._rates = {sensor.name: sensor.sampling_rate for sensor in recording.sensors}

    def channels(self, sensor: str) -> tuple[str, ...]:
        """Return the names of a sensor's channels."""
        return tuple(channel.name for channel in self._channels[self._known(sensor)])

    def sampling_rate(self, sensor: str) -> float:
        """Return the sampling rate of a sensor in Hz."""
        return self._rates[self._known(sensor)]

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened while recording, and when."""
        with Recording.open(self.path) as recording:
            return recording.events

    def samples(self, sensor: str) -> FloatArray:
        """Return all samples of a sensor, NaN in its gaps.

        Returns
        -------
        float64, shape (n_samples, n_channels)
            Counts over sensitivity, in the unit of each channel.
        """
        with Recording.open(self.path) as recording:
            record = recording.sensor(self._known(sensor))
            blocks = record.blocks[:]
            counts = record.counts()
        first = blocks["first_sample"]
        n_samples = int((first + blocks["n_samples"]).max(initial=0))
        samples = np.full((n_samples, counts.shape[1]), np.nan)
        at = np.repeat(first - blocks["first_row"], blocks["n_samples"]) + np.arange(len(counts))
        sensitivity = np.array([channel.sensitivity for channel in record.channels])
        samples[at] = counts / sensitivity
        return samples

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
            return "\n".join([head, *map(_line, recording.sensors)])

    def _known(self, sensor: str) -> str:
        if sensor not in self.sensors:
            raise WrongSettingError(f"sensor={sensor!r}: expected one of {', '.join(self.sensors)}")
        return sensor


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


def _line(sensor: SensorRecord) -> str:
    names = " ".join(channel.name for channel in sensor.channels)
    length = format_duration(round(sensor.n_samples / sensor.sampling_rate, 1))
    gaps = several(len(sensor.gaps), "gap") if len(sensor.gaps) else "no gaps"
    return (
        f"  {sensor.name}: {names} at {sensor.sampling_rate:g} Hz,"
        f" {sensor.n_samples} samples ({length}), {gaps}"
    )
