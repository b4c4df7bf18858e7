"""A recording against time: waveforms of all channels, what happened, and spectra by time.

Every front end draws the same views: `Signal.view` has the extremes of each channel in as many
columns as there is room for, and the marks of this span, those of one column joined. A spectrogram
is made of the averages in parts of time, which the estimate keeps; of a span of few parts, of the
samples.

Times are UTC in seconds since 1970, by the arrivals of blocks, the times that a device states, or
the instants of polls: clocks are not refined by the motion here. They can be off by what a block
takes to arrive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby, pairwise

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.bench.durations import stretch
from daq.bench.units import levels_db
from daq.clocks.arrival_times import ArrivalTimes
from daq.clocks.clock_model import Clock
from daq.clocks.sensor_reader import SensorSource
from daq.estimation.noise_estimates import responses
from daq.estimation.snapshot import Snapshot
from daq.protocols.block import EventKind
from daq.recording.extremes import Extremes, extremes_of
from daq.recording.interface import ReadableRecording, ReadableSensor, created_at
from daq.results.vocabulary import REASONS
from estimator.errors import EstimatorError
from estimator.levels.bands import log_edges
from estimator.median import median
from estimator.methods import self_noise
from estimator.spectra.parts import grouped
from estimator.spectra.segment_rejection import Reason
from estimator.spectra.welch import CrossSpectra, WelchSettings

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

GAP, CLIPPED, EXCLUDED = "gap", "clipped", "excluded"
"""Kinds of marks beside those of events."""
LEAST_PARTS = 6
"""Parts of time in a span, from which a spectrogram is made of them."""
STANDS_OUT = 6.0
"""Decibels."""
MOST_SAMPLES = 1 << 19
"""Of a channel, of which a spectrogram is made: more take longer than a key may."""
MOST_ARRIVALS = 1000
"""Arrivals by which the clock of a long recording is known here."""
AVERAGES = 6
"""Averages that the noise of a part needs for each channel of a sensor."""
_TOUCHING = 1e-6  # seconds
_SHORTEST, _LONGEST = 16, 1024
"""Samples of a segment of a spectrogram made of samples."""


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """A channel in columns of equal time.

    Attributes
    ----------
    sensor, channel, unit : str
    is_auxiliary : bool
        Whether it is no channel of the estimate.
    least, most : float64, shape (n_columns,)
        Extremes in the unit of the channel, responses not taken out; NaN without a sample.
    """

    sensor: str
    channel: str
    unit: str
    is_auxiliary: bool
    least: FloatArray
    most: FloatArray

    @property
    def name(self) -> str:
        """Sensor and channel, as in ``A.X``."""
        return f"{self.sensor}.{self.channel}"

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest sample of all columns; NaN without one."""
        known = np.isfinite(self.least)
        if not known.any():
            return float("nan"), float("nan")
        return float(self.least[known].min()), float(self.most[known].max())

    @property
    def scaled(self) -> tuple[FloatArray, FloatArray]:
        """Extremes from −1 to 1 over the range; 0 where all samples are equal."""
        low, high = self.range
        half = (high - low) / 2 or 1.0
        middle = low + (high - low) / 2
        return (self.least - middle) / half, (self.most - middle) / half


@dataclass(frozen=True, slots=True)
class Mark:
    """Something that happened, from `begin` to `end`, to a sensor or, if empty, to all.

    `kind` is `GAP`, `CLIPPED`, `EXCLUDED` or that of an event; `count` is how many are joined.
    """

    begin: float
    end: float
    kind: str
    sensor: str = ""
    text: str = ""
    count: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class Waveforms:
    """A span of a recording; `marks` are in the order of their beginnings."""

    begin: float
    end: float
    traces: tuple[Trace, ...]
    marks: tuple[Mark, ...]

    @property
    def n_columns(self) -> int:
        """Columns of each trace."""
        return len(self.traces[0].least) if self.traces else 0

    def column_of(self, time: float) -> int:
        """Return the column of a time, which may lie outside."""
        return int(np.floor((time - self.begin) / (self.end - self.begin) * self.n_columns))

    def near(self, time: float) -> list[Mark]:
        """Return the marks in the column of a time."""
        column = self.column_of(time)
        return [m for m in self.marks if self.column_of(m.begin) <= column <= self.column_of(m.end)]


@dataclass(frozen=True, slots=True, eq=False)
class Spectrogram:
    """The PSD of a channel by time.

    Attributes
    ----------
    times : float64, shape (n_times + 1,)
        Ends of parts of time, UTC.
    frequency : float64, shape (n_bands + 1,)
        Ends of bands, in Hz, of equal width on a logarithmic axis.
    psd : float64, shape (n_times, n_bands)
        Mean of the band in unit**2/Hz; NaN where it is not known. No more than zero where it is
        the estimate of a noise that drowns in chance.
    unit : str
    """

    times: FloatArray
    frequency: FloatArray
    psd: FloatArray
    unit: str

    @property
    def level_db(self) -> FloatArray:
        """Levels re 1 unit**2/Hz; NaN where the PSD is not above zero."""
        return levels_db(self.psd)

    @property
    def range_db(self) -> tuple[float, float]:
        """Levels between which most are: what a scale of colours shows."""
        known = self.level_db[np.isfinite(self.level_db)]
        if not known.size:
            return 0.0, 1.0
        low, high = (float(each) for each in np.percentile(known, (2, 99)))
        return low, max(high, low + 1.0)

    @property
    def loudest(self) -> float:
        """Frequency of the band that stands out on average, such as that of a hum, in Hz.

        NaN where none is `STANDS_OUT` above half of the others.
        """
        known = np.isfinite(self.psd)
        total = np.sum(self.psd, axis=0, where=known)
        level = levels_db(total / np.maximum(known.sum(axis=0), 1))
        some = np.isfinite(level)
        if not some.any() or level[some].max() - median(level[some]) < STANDS_OUT:
            return float("nan")
        band = int(np.flatnonzero(some)[np.argmax(level[some])])
        return float(np.sqrt(self.frequency[band] * self.frequency[band + 1]))

    def grid(
        self, begin: float, end: float, n_columns: int, n_rows: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return what a picture of a span shows.

        Returns
        -------
        frequency : float64, shape (n_rows,)
            Of the middle of each row, ascending.
        share : float64, shape (n_rows, n_columns)
            Level from 0 to 1 of `range_db`; NaN where it is not known.
        """
        times = begin + (np.arange(n_columns) + 0.5) * (end - begin) / n_columns
        edges = np.geomspace(self.frequency[0], self.frequency[-1], n_rows + 1)
        middle = np.sqrt(edges[1:] * edges[:-1])
        part = np.searchsorted(self.times, times, side="right") - 1
        band = np.searchsorted(self.frequency, middle, side="right") - 1
        inside = (part >= 0) & (part < len(self.psd))
        level = np.full((n_rows, n_columns), np.nan)
        level[:, inside] = self.level_db[part[inside]][:, np.minimum(band, self.psd.shape[1] - 1)].T
        low, high = self.range_db
        return middle, np.clip((level - low) / (high - low), 0, 1)


class _Sensor:
    """A sensor with its clock, and where its rows are in time."""

    def __init__(self, record: ReadableSensor, created: tuple[int, int]) -> None:
        self.record = record
        self._source = SensorSource.of(record, *created)
        self.clock: Clock | None = None
        """None before the first block."""

    def refresh(self) -> None:
        """Take new blocks."""
        source, before = self._source, self._source.n_blocks
        source.refresh()
        if source.n_blocks > before:
            if source.polled:
                self.clock = source.by_instants()
            else:
                arrivals = source.arrivals if source.device_utc else _thinned(source.arrivals)
                self.clock = arrivals.solve(self.record.name).extended(source.end_sample)
            runs = [(r.first_sample, r.first_row, r.n_samples) for r in source.runs]
            self._runs = np.array(runs)

    def breaks(self, first: int, last: int) -> IntArray:
        """Return the rows between two rows, before which samples are missing."""
        rows = self._runs[:, 1]
        return np.asarray(rows[(rows > first) & (rows < last)])

    def at(self, samples: FloatArray) -> FloatArray:
        """Return the times of samples, in s since the recording was created."""
        return np.zeros(len(samples)) if self.clock is None else self.clock.at(samples)

    def rows(self, seconds: FloatArray) -> IntArray:
        """Return the first row at or after each of ascending times."""
        if self.clock is None:
            return np.zeros(len(seconds), np.int64)
        starts, _ = self.clock.spans
        epoch = np.maximum(np.searchsorted(starts, seconds, side="right") - 1, 0)
        ends = np.array([each.end_sample for each in self.clock.epochs])[epoch]
        sample = np.minimum(np.ceil(self.clock.position(seconds) - 1e-6), ends).astype(np.int64)
        first, row, length = self._runs.T
        run = np.maximum(np.searchsorted(first, sample, side="right") - 1, 0)
        rows = row[run] + np.clip(sample - first[run], 0, length[run])
        return np.asarray(np.maximum.accumulate(rows))


def _thinned(arrivals: ArrivalTimes) -> ArrivalTimes:
    """Return the earliest arrivals of stretches of equal length, if there are very many.

    Clocks that are known by these follow what changes within minutes, and cost a tenth.
    """
    seconds, late = arrivals.lateness()
    if len(seconds) <= 2 * MOST_ARRIVALS:
        return arrivals
    late = late - np.polyfit(seconds, late, 1)[0] * seconds
    stretch = ((seconds - seconds[0]) * MOST_ARRIVALS / np.ptp(seconds)).astype(np.int64)
    order = np.lexsort((late, stretch))
    kept = np.zeros(len(seconds), dtype=np.bool_)
    kept[order[np.unique(stretch[order], return_index=True)[1]]] = True
    return arrivals.only(kept)


class Signal:
    """An open recording, growing or complete, as it is seen against time.

    Parameters
    ----------
    recording : ReadableRecording
    progress : callable
        Receives the number of rows after each piece that is read.
    """

    def __init__(
        self, recording: ReadableRecording, progress: Callable[[int], object] = lambda _: None
    ) -> None:
        self.recording = recording
        created = recording.created_at
        self._origin = created.utc_ns * 1e-9
        self._created = created.monotonic_ns, created.utc_ns
        self._sensors = [_Sensor(record, self._created) for record in recording.sensors]
        self._extremes: tuple[Extremes, ...] = extremes_of(recording, progress)
        self.marks: tuple[Mark, ...] = ()
        """Events, gaps, and stretches at the end of the range, in order."""
        self.refresh()

    def refresh(self) -> None:
        """Take what the recording has since it was read last."""
        for sensor, extremes in zip(self._sensors, self._extremes, strict=True):
            sensor.refresh()
            extremes.extend()
        self.marks = tuple(sorted(self._all_marks(), key=lambda mark: (mark.begin, mark.kind)))

    @property
    def span(self) -> tuple[float, float]:
        """Times of the first and the last sample of any sensor; the start, before there is one."""
        clocks = [sensor.clock for sensor in self._sensors if sensor.clock is not None]
        if not clocks:
            return self._origin, self._origin + 1.0
        begin, end = min(clock.start for clock in clocks), max(clock.end for clock in clocks)
        return self._origin + begin, self._origin + max(end, begin + 1e-3)

    def view(
        self, begin: float, end: float, n_columns: int, besides: Sequence[Mark] = ()
    ) -> Waveforms:
        """Return a span in columns, with the marks of the recording and those `besides`.

        Raises
        ------
        RecordingError
            If the file is damaged there.
        """
        edges = np.linspace(begin - self._origin, end - self._origin, n_columns + 1)
        traces = []
        for sensor, extremes in zip(self._sensors, self._extremes, strict=True):
            least, most = extremes.between(sensor.rows(edges))
            for column, channel in enumerate(sensor.record.channels):
                ends = np.array([least[:, column], most[:, column]]) / channel.sensitivity
                traces.append(
                    Trace(
                        sensor.record.name,
                        channel.name,
                        channel.unit,
                        channel.auxiliary,
                        ends.min(axis=0),
                        ends.max(axis=0),
                    )
                )
        here = [mark for mark in (*self.marks, *besides) if mark.begin < end and mark.end >= begin]
        return Waveforms(begin, end, tuple(traces), joined(here, (end - begin) / n_columns))

    def _all_marks(self) -> Iterable[Mark]:
        monotonic_ns, utc_ns = self._created
        for event in self.recording.events:
            at = (utc_ns + event.received.monotonic_ns - monotonic_ns) * 1e-9
            yield Mark(at, at, str(event.kind), event.sensor, event.text)
        for sensor in self._sensors:
            name, gaps = sensor.record.name, sensor.record.gaps
            first = gaps["first_sample"].astype(np.float64)
            begins = self._origin + sensor.at(first)
            ends = self._origin + sensor.at(first + gaps["missing"])
            for begin, end, reason in zip(begins, ends, gaps["reason"], strict=True):
                yield Mark(float(begin), float(end), GAP, name, reason.decode(errors="replace"))
            for each in sensor.record.blocks.clipped.astype(float):
                begin, end = self._origin + sensor.at(each)
                yield Mark(float(begin), float(end), CLIPPED, name, "at the end of its range")

    def excluded(self, snapshot: Snapshot | None, exclude: Iterable[str] = ()) -> list[Mark]:
        """Return what an estimate leaves out beside gaps and ends of ranges.

        Parameters
        ----------
        snapshot : Snapshot, optional
            Whose segments with transients are marked, those that overlap as one.
        exclude : iterable of str
            Stretches left out by choice, as in its settings.
        """
        text, created = REASONS[Reason.CHOSEN], created_at(self.recording)
        ends = (stretch(each, created) for each in exclude)
        chosen = [Mark(a.timestamp(), b.timestamp(), EXCLUDED, text=text) for a, b in ends]
        if snapshot is None:
            return chosen
        origin, text = snapshot.start_utc_ns * 1e-9, f"{REASONS[Reason.TRANSIENT]} (--reject)"
        rejected = (
            Mark(origin + each.begin, origin + each.end, EXCLUDED, channel.sensor, text)
            for each in snapshot.rejected
            for channel in [snapshot.channels[each.column]]
        )
        return [*chosen, *joined(rejected, _TOUCHING)]

    def channel(self, number: int) -> tuple[str, Channel]:
        """Return the sensor and the channel of a trace."""
        found = [(s.record.name, channel) for s in self._sensors for channel in s.record.channels]
        return found[number]

    def spectrogram(
        self,
        number: int,
        view: tuple[float, float],
        n_columns: int,
        n_bands: int,
        *,
        snapshot: Snapshot | None,
        noise: bool = False,
    ) -> Spectrogram | None:
        """Return what a channel recorded, or its noise, by time.

        Parameters
        ----------
        number : int
            Of its trace.
        view : (float, float)
            The span.
        n_columns, n_bands : int
            As many times and bands at most.
        snapshot : Snapshot, optional
            The estimate, which has averages in parts of time.
        noise : bool
            Whether it is that of the noise, which the averages in parts of time alone show.

        Returns
        -------
        Spectrogram or None
            None where neither parts of time nor samples show it.
        """
        sensor, channel = self.channel(number)
        whole = None
        labels = [] if snapshot is None else [(c.sensor, c.channel) for c in snapshot.channels]
        if snapshot is not None and (sensor, channel.name) in labels:
            whole = of_parts(snapshot, noise=noise)
            if whole is not None:
                own = labels.index((sensor, channel.name))
                whole = replace(whole, psd=whole.psd[:, :, own])
        inside = whole is not None and (
            np.count_nonzero((whole.times[1:] > view[0]) & (whole.times[:-1] < view[1]))
        )
        if whole is not None and (noise or inside >= LEAST_PARTS):
            return in_bands(whole, n_bands)
        found = None if noise else self._of_samples(number, view, n_columns, snapshot)
        found = whole if found is None else found
        return None if found is None else in_bands(found, n_bands)

    def _of_samples(
        self, number: int, view: tuple[float, float], n_columns: int, snapshot: Snapshot | None
    ) -> Spectrogram | None:
        """Return the PSD at single frequencies; None of too many samples, or too few."""
        name, channel = self.channel(number)
        sensor = next(each for each in self._sensors if each.record.name == name)
        edges = np.linspace(view[0], view[1], n_columns + 1)
        rows = sensor.rows(edges - self._origin)
        first, last = int(rows[0]), int(rows[-1])
        length = min(_LONGEST, (last - first) // (n_columns // 2))
        if channel.auxiliary or length < _SHORTEST or last - first > MOST_SAMPLES:
            return None
        unit = channel.unit if snapshot is None else snapshot.unit
        counts, damaged = sensor.record.intact_counts(first, last)
        column = sensor.record.channels.index(channel)
        samples = counts[:, column].astype(np.float64)[:, None] / channel.sensitivity
        settings = WelchSettings(sensor.record.sampling_rate, length)
        starts = np.clip(rows - first, 0, len(samples) - length)
        broken = np.zeros(len(samples) + 1, np.int64)  # steps between samples that are no signal
        broken[sensor.breaks(first, last) - first] += 1
        for begin, end in damaged:
            broken[begin:end] += 1
        n_broken = np.cumsum(broken)
        psd = np.full((n_columns, len(settings.frequencies)), np.nan)
        for at, (begin, end) in enumerate(pairwise(starts.tolist())):
            until = max(begin + 1, end)
            if rows[at] == rows[at + 1] or n_broken[begin] < n_broken[until + length - 2]:
                continue
            spectra = CrossSpectra(settings, 1)
            spectra.add(samples, np.arange(begin, until, settings.hop))
            psd[at] = spectra.csm()[:, 0, 0].real
        with np.errstate(divide="ignore", invalid="ignore"):
            response = responses(settings.frequencies, [(name, channel)], unit)
            psd /= np.abs(response.T) ** 2
        return Spectrogram(edges, settings.frequencies, psd, unit)


def joined(marks: Iterable[Mark], apart: float) -> tuple[Mark, ...]:
    """Return marks, those of one kind and sensor less than `apart` (s) after each other as one.

    Remarks of people stay apart.
    """
    found: list[Mark] = []

    def alike(mark: Mark) -> tuple[str, str]:
        return mark.kind, mark.sensor

    for (kind, _), some in groupby(sorted(marks, key=lambda m: (*alike(m), m.begin)), alike):
        last: Mark | None = None
        for mark in some:
            is_near = last is not None and mark.begin - last.end < apart
            if last is not None and is_near and kind != EventKind.MARK:
                end, count = max(last.end, mark.end), last.count + mark.count
                last = found[-1] = replace(last, end=end, count=count)
            else:
                found.append(last := mark)
    return tuple(sorted(found, key=lambda mark: mark.begin))


@lru_cache(maxsize=2)
def of_parts(snapshot: Snapshot, *, noise: bool) -> Spectrogram | None:
    """Return the PSD of all channels in parts of time at the frequencies that are kept in them.

    The noise is that of the three-sensor method, with parts joined until they have enough averages.
    None where the estimate has no parts, or fewer than three sensors, or too few averages.

    Returns
    -------
    Spectrogram
        With a PSD of shape (n_times, n_freqs, n_channels).
    """
    parts = snapshot.parts
    if parts is None:
        return None
    averages, each = parts.averages, parts.each
    groups = [np.array([number]) for number in range(len(each))]
    if noise:
        least = AVERAGES * max(snapshot.dims)
        groups = grouped(averages, least)
        divided = parts.joined(slice(None), groups)
        if divided.averages[0] < least:
            return None
        found = []
        for csm, n_effective in zip(divided.csm, divided.averages.tolist(), strict=True):
            try:
                of_part = self_noise(
                    "three-sensor", csm, dims=snapshot.dims, n_effective=n_effective
                )
            except EstimatorError:
                return None
            found.append(of_part.noise_psd)
        psd = np.array(found)
    else:
        psd = np.array([part.psd() for part in each])
        if parts.response is not None:
            psd = psd / np.abs(parts.response) ** 2
    times = np.array([*(each[int(some[0])].begin for some in groups), each[-1].end])
    times = times + snapshot.start_utc_ns * 1e-9
    return Spectrogram(times, snapshot.frequency[parts.bins], psd, snapshot.unit)


def in_bands(found: Spectrogram, n_bands: int) -> Spectrogram:
    """Return the levels of bands, from the PSD at single frequencies."""
    edges = log_edges(found.frequency, n_bands)
    with np.errstate(invalid="ignore"):
        inside = found.psd[:, : edges[-1]]
        psd = np.add.reduceat(inside, edges[:-1], axis=1) / np.diff(edges)
    return replace(found, frequency=found.frequency[edges], psd=psd)


SHORTEST = 0.02
"""Seconds that are shown at least."""


def zoomed(
    span: tuple[float, float], whole: tuple[float, float], factor: float, about: float | None = None
) -> tuple[float, float]:
    """Return a span this factor as long: closer about a time, no shorter than `SHORTEST`."""
    begin, end = span
    about = (begin + end) / 2 if about is None else min(max(about, begin), end)
    factor = max(factor, SHORTEST / (end - begin))
    return fitting((about - factor * (about - begin), about + factor * (end - about)), whole)


def fitting(span: tuple[float, float], whole: tuple[float, float]) -> tuple[float, float]:
    """Return a span moved into the whole, or else the whole."""
    length = span[1] - span[0]
    if length >= whole[1] - whole[0]:
        return whole
    begin = min(max(span[0], whole[0]), whole[1] - length)
    return begin, begin + length


def panned(
    span: tuple[float, float], whole: tuple[float, float], share: float
) -> tuple[float, float]:
    """Return a span moved by a share of its length."""
    shift = share * (span[1] - span[0])
    return fitting((span[0] + shift, span[1] + shift), whole)
