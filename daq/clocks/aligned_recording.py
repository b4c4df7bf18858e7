"""A recording on one common grid, in physical units.

Theory of operation
-------------------
Within an *epoch* of its clock the sample indices of a sensor are exact; the clock gives the time of
each sample (:mod:`daq.clocks.clock_model`). The grid has one rate and begins when the last sensor
begins. Where no clock is measured from the motion, it does not wait for sensors that begin over a
minute after the third one, nor end, in a closed recording, with those that end so much earlier:
these have no samples there. Samples on the grid (sensors of one clock, recordings with exact times)
are copied; others are interpolated (:mod:`daq.clocks.resampling`).

A grid instant is valid if every sensor has all samples for it; gaps are never filled. Spans have
fixed positions on the grid and are filtered as a whole, so the result does not depend on the limits
of reads. Memory is proportional to the requested span.

Which of a recording's sensors lost samples without counting them, and when.

A slip of the reference shows in the delays of all others, at one time and by one amount. With two
sensors only arrival times can say which of them slipped; where they do not, it is the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.clocks.clock_model import ClockSource, ClockState, nominal
from daq.clocks.device_utc import UtcRate
from daq.clocks.grid import SNAP, CommonGrid, OwnSamples, grid_rate, joint_start, late_by, start_of
from daq.clocks.quantiles import median
from daq.clocks.resampling import USABLE
from daq.clocks.sensor_reader import SensorSource, main_columns
from daq.clocks.slips import Slip, Step, arrive_otherwise, lost_by_delays, steps
from daq.errors import CannotAlignError
from daq.recording.interface import ReadableRecording
from estimator.records import dataclass

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
FrameDelays = Callable[[], FloatArray]


_NODE = 10.0  # seconds of arrivals, the earliest of which counts, and
_BLOCKS = 4  # blocks at least
_SAME = 0.1  # share by which the sizes of one step may differ between sensors


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What delays show of one sensor; instants are by the reference's clock, in s."""

    source: SensorSource
    index: FloatArray
    seconds: FloatArray
    steps: list[Step]

    def at(self, before: float, after: float) -> tuple[float, float]:
        """Return the sensor's samples at two instants."""
        low, high = np.interp([before, after], self.seconds, self.index).tolist()
        return low, high


def find_by_motion(reference: SensorSource, others: Sequence[SensorSource]) -> None:
    """Add to each sensor the slips that measured delays show and that it does not have yet.

    Parameters
    ----------
    reference : SensorSource
    others : sequence of SensorSource
        With delays measured against it.
    """
    seen = [_seen(each, reference) for each in others if not (each.device_utc or each.polled)]
    if not seen:
        return

    def of_reference(before: float, after: float) -> tuple[float, float]:
        low, high = reference.known_clock.position(np.array([before, after])).tolist()
        return low, high

    def reference_slipped(step: Step) -> bool:
        if reference.device_utc or reference.polled:
            return False
        at = of_reference(step.before, step.after)
        return _slipped(reference, replace(step, size=-step.size), *at)

    shared = [
        step
        for step in seen[0].steps
        if all(any(_together(step, one) for one in each.steps) for each in seen)
    ]
    taken = [step for step in shared if len(seen) > 1 and reference_slipped(step)]
    for each in seen:
        for step in each.steps:
            if any(_together(step, one) for one in taken):
                continue
            own = _slipped(each.source, step, *each.at(step.before, step.after))
            if not own and len(seen) == 1:
                reference_slipped(step)


def find_by_arrivals(source: SensorSource) -> None:
    """Add to a sensor the slips from which on all its blocks arrive late.

    They arrive early for good where a gap was counted in which no sample was lost.
    """
    if source.device_utc or source.polled:
        return
    rate, counted = source.record.sampling_rate, source.heard.counting(source.slips)
    node = max(_NODE, _BLOCKS * source.arrivals.longest_block)
    for _, _, index, seconds in counted.earliest():
        for step in arrive_otherwise((index / rate, seconds - index / rate), node=node):
            # slips so far are in these indices, and not in those of the recording
            before, after = (source.slips.recorded(at * rate) for at in (step.before, step.after))
            n = round(step.size * rate)
            if n < 0 and not any(before < run.first_sample <= after for run in source.runs):
                continue
            source.slips = source.slips.added(Slip(math.ceil(before), int(after), n))


def _seen(source: SensorSource, reference: SensorSource) -> _Seen:
    index, seconds, std = source.delays(reference)
    at_reference = np.sort(source.learnt.values[:, 1])
    when = reference.known_clock.at(at_reference)
    known = source.slips.holds(index) | reference.slips.holds(at_reference)
    rate = source.record.sampling_rate
    if not (reference.device_utc or reference.polled):  # by counts: its clock follows its slips
        counted = at_reference + reference.slips.ahead(at_reference)
        seconds = seconds - when + counted / reference.record.sampling_rate
    late = seconds - (index + source.slips.ahead(index)) / rate
    restarts = source.arrivals.restarts
    epoch = np.searchsorted(restarts, index, side="right") + np.searchsorted(
        reference.arrivals.restarts, at_reference, side="right"
    )
    least = min(1 / rate, 1 / reference.record.sampling_rate)
    found: list[Step] = []
    for number in sorted(set(epoch.tolist())):  # np.unique loads numpy.ma
        mine = np.flatnonzero((epoch == number) & ~known)
        some = mine[np.isfinite(std[mine])]
        found += steps(when[some], late[some], std[some], least=least)
    return _Seen(source, index, when, found)


def _together(one: Step, other: Step) -> bool:
    """Whether two steps are at one time and of one size."""
    overlap = one.before < other.after and other.before < one.after
    return overlap and abs(one.size - other.size) < _SAME * abs(one.size)


def _slipped(source: SensorSource, step: Step, before: float, after: float) -> bool:
    """Add a slip between two samples, if the step is one of this sensor."""
    counted = source.heard.counting(source.slips)
    n = lost_by_delays(
        replace(step, before=_count(source, before), after=_count(source, after)),
        source.record.sampling_rate,
        counted.lateness(),
        known_to=counted.hidden,
    )
    if n:
        source.slips = source.slips.added(Slip(math.ceil(before), int(after), n))
    return n != 0


def _count(source: SensorSource, index: float) -> float:
    """Return the seconds that the sensor has counted at a sample."""
    lost = int(source.slips.ahead(np.array([index]))[0])
    return (index + lost) / source.record.sampling_rate


_LATEST = 5.0  # maximum delay in s of the blocks of a device with UTC
_OF_A_CLOCK = 2  # sensors that are compared: one may be broken


def undoubted(sources: Sequence[SensorSource], reference: int | None) -> tuple[int, ...]:
    """Return sensors whose stated UTC is not doubted, some of each clock; the reference first.

    Then those whose clocks were not set, and restart least often.
    """
    seen: dict[str, int] = {}
    found = [] if reference is None else [reference]

    def doubts(each: tuple[int, SensorSource]) -> tuple[bool, int]:
        return each[1].arrivals.stepped > 0, len(each[1].arrivals.restarts)

    for number, source in sorted(enumerate(sources), key=doubts):
        taken = seen.get(source.clock_name, 0)
        if source.device_utc and not source.doubted and taken < _OF_A_CLOCK:
            seen[source.clock_name] = taken + 1
            found += [number] if number != reference else []
    return tuple(found)


def take_drift(sources: Sequence[SensorSource], drift: Mapping[int, float], reference: int) -> None:
    """Set by how much stated UTC drifts: the most of any sensor on a clock, and NaN if none knows.

    The clock of the reference does not drift: what drifts beside it is a sensor.
    """
    for source in sources:
        if not source.device_utc or source.doubted:
            continue
        found = [each for n, each in drift.items() if sources[n].clock_name == source.clock_name]
        known = [each for each in found if not math.isnan(each)]
        if source.clock_name == sources[reference].clock_name:
            known = [0.0] * bool(known)
        if found:
            source.drift = max(known, default=math.nan)


def place_stated(sources: Sequence[SensorSource]) -> None:
    """Shift devices' UTC to the right one of their times, where their clocks were set.

    And to arrival times, if the computer's UTC, used by other sensors, is wrong. It is wrong if no
    device's blocks arrive at possible times. A block of all channels arrives with its slowest
    channel: if channels are not synchronised, up to twice its duration after its end.
    """
    stated = [source.arrivals for source in sources if source.device_utc]
    usual = [each.latency for each in stated if not each.stepped]
    for each in stated:
        most = _LATEST + 2 * each.longest_block
        each.moved = each.ahead(median(np.array(usual)) if usual else None, most=most)
    if 0 < len(stated) < len(sources):
        latency = [each.latency - each.moved for each in stated]
        most_of = [_LATEST + 2 * each.longest_block for each in stated]
        if all(not 0 <= one < most for one, most in zip(latency, most_of, strict=True)):
            for each in stated:
                each.moved += min(latency)


_GROWTH = 0.05  # fraction by which a recording grows before its clocks are set again
_FIRST_GROWTH = 0.25  # the same for a short recording, up to
MAX_PPM = 1000.0
"""Error of a sampling clock that is refused: quartz is good to 100 ppm, and the
estimate resamples by small errors only."""
_MIN_SECONDS = 30.0  # this time in s: three observations of the clock's filter


class AlignedRecording:
    """The sensors of a recording, complete or growing, on one grid.

    Parameters
    ----------
    recording : ReadableRecording
        Open; may be growing.
    sampling_rate : float, optional
        Sampling rate of the grid in Hz; default: the lowest rate of the sensors.
    start_utc_ns, end_utc_ns : int, optional
        Limits of the grid, UTC in ns since 1970.
    nominal_clocks : bool
        Whether to assume that every clock has its nominal rate, from the first sample to arrive.
    sensors : collection of str, optional
        Default: all.

    Raises
    ------
    CannotAlignError
        If there are no main channels, or `sampling_rate` is above that of a sensor.
    """

    def __init__(
        self,
        recording: ReadableRecording,
        *,
        sampling_rate: float | None = None,
        start_utc_ns: int | None = None,
        end_utc_ns: int | None = None,
        nominal_clocks: bool = False,
        sensors: Collection[str] | None = None,
    ) -> None:
        self._recording = recording
        self._wanted = (start_utc_ns, end_utc_ns)
        every = [record for record in recording.sensors if main_columns(record)]
        records = [one for one in every if sensors is None or one.name in sensors]
        if not records:
            raise CannotAlignError(
                f"{recording.path}: no sensor with a channel that is not auxiliary"
            )
        self.sampling_rate = grid_rate(records, sampling_rate)
        self.channels: tuple[tuple[str, Channel], ...] = tuple(
            (record.name, record.channels[column])
            for record in records
            for column in main_columns(record)
        )
        self.dims = tuple(len(main_columns(record)) for record in records)
        self._records = records
        self._sources: list[SensorSource] = []
        created = recording.created_at
        self._origin = (created.monotonic_ns, created.utc_ns)
        self._set_at = (0, 0)
        self._grid: CommonGrid | None = None
        self._apart = False  # whether the grid has times without some sensors
        self.n_settings = 0  # of the clocks, so far
        self._end = math.inf
        self._at_face_value = nominal_clocks
        self._measured_against: int | None = None
        self.stated_reference: int | None = None  # where stated UTC drifts
        self._frame_delays: tuple[tuple[int, ...], FrameDelays] | None = None
        self.refresh()

    @property
    def start_utc_ns(self) -> int:
        """UTC of grid sample 0, in ns since 1970."""
        return self._origin[1] + round(self._start * 1e9)

    @property
    def clocks(self) -> tuple[ClockState, ...]:
        """State of each sensor's clock, in the order of the sensors."""
        return tuple(source.clock.state for source in self._sources if source.clock)

    @property
    def is_reference(self) -> tuple[bool, ...]:
        """Whether each sensor has the reference clock."""
        if not self._sources:
            return ()
        name = self._sources[self._reference].clock_name
        return tuple(source.clock_name == name for source in self._sources)

    @property
    def longest_stretches(self) -> dict[str, float]:
        """Longest time without a gap in s, by name of the sensor."""
        return {
            source.record.name: max(run.n_samples for run in source.runs)
            / source.record.sampling_rate
            for source in self._sources
        }

    @property
    def n_available(self) -> int:
        """Number of grid samples available now."""
        grid = self._grid
        if grid is None:
            return 0
        ends = self._ends(grid)
        known = self._apart and self._recording.closed  # before that, samples may come
        last = -joint_start([-end for end in ends]) if known else min(ends)
        stop = (min(last, self._end) - grid.start) * self.sampling_rate
        return max(0, math.floor(stop + SNAP) + 1)

    @property
    def common(self) -> tuple[int, int]:
        """First grid sample that all sensors have, and the one after the last.

        All that are available where no sensor begins late or ends early, or never all have any.
        """
        grid, n_available = self._grid, self.n_available
        if grid is None or not self._apart:
            return 0, n_available
        begin = max(map(start_of, self._sources)) - grid.start
        end = min(self._ends(grid)) - grid.start
        first = max(0, math.ceil(begin * self.sampling_rate - SNAP))
        last = min(n_available, math.floor(end * self.sampling_rate + SNAP) + 1)
        return (first, last) if first < last else (0, n_available)

    def _ends(self, grid: CommonGrid) -> list[float]:
        """Return until when each sensor has samples on the grid, in s."""
        return [
            source.known_clock.end - (0.0 if grid.has(source) else grid.reach(source))
            for source in self._sources
        ]

    @property
    def shortened(self) -> dict[str, tuple[float, float]]:
        """Return by how many s sensors begin late and end early, where that shortens the grid.

        Samples that other sensors have before and after are not on it. Ends count in closed
        recordings.
        """
        grid = self._grid
        if grid is None:
            return {}
        begin, _ = self._limits
        starts, ends = list(map(start_of, self._sources)), self._ends(grid)
        late = late_by(starts, max(min(starts), begin), grid.start)
        early = [0.0] * len(late)
        if self._recording.closed:
            last = grid.start + (self.n_available - 1) / self.sampling_rate
            early = late_by([-end for end in ends], -min(max(ends), self._end), -last)
        names = [record.name for record in self._records]
        found = zip(names, zip(late, early, strict=True), strict=True)
        return {name: seconds for name, seconds in found if any(seconds)}

    @property
    def is_exact(self) -> bool:
        """Whether every sensor's samples are on the grid, so that no clock is estimated."""
        return self._untouched and not any(s.offset_in_doubt or s.doubted for s in self._sources)

    @property
    def is_unbroken(self) -> bool:
        """Whether no clock restarts."""
        return all(len(source.known_clock.epochs) == 1 for source in self._sources)

    @property
    def usable(self) -> float:
        """Frequency in Hz up to which interpolation preserves the samples."""
        return (0.5 if self._untouched else USABLE) * self.sampling_rate

    def delays(self, at: FloatArray) -> FloatArray:
        """Return the delay of each sensor's sample index against the grid, by the current clocks.

        Parameters
        ----------
        at : float64, shape (n,)
            Grid positions in samples.

        Returns
        -------
        float64, shape (n, n_sensors)
            In s; only differences are meaningful.
        """
        seconds = self._start + at / self.sampling_rate
        rates = [source.record.sampling_rate for source in self._sources]
        positions = [source.known_clock.position(seconds) for source in self._sources]
        return np.asarray(seconds[:, None] - np.column_stack(positions) / rates)

    def epoch_around(self, at: float) -> tuple[float, float]:
        """Return begin and end of what no clock restarts in, around a grid position; in samples.

        Both are `at` where a sensor has no samples.
        """
        seconds = self._start + at / self.sampling_rate
        spans = [source.known_clock.span_at(seconds) for source in self._sources]
        known = [span for span in spans if span is not None]
        if len(known) < len(spans):
            return at, at
        low, high = max(begin for begin, _ in known), min(end for _, end in known)
        return at + (low - seconds) * self.sampling_rate, at + (high - seconds) * self.sampling_rate

    @property
    def measurable(self) -> tuple[int, ...]:
        """Indices of sensors with measurable delays: the best reference, and one per other clock.

        Also the sensors that share a clock, if the number of samples between their starts is in
        doubt. Empty if no clock must be estimated.
        """
        if self.is_exact:
            return ()
        reference = self._preferred
        seen = {self._sources[reference].clock_name}
        free = []
        for number, source in enumerate(self._sources):
            stated = source.device_utc and not source.doubted
            known = stated or source.polled or number == reference
            doubted = source.offset_in_doubt or source.doubted
            if not known and (source.clock_name not in seen or doubted):
                free.append(number)
                seen.add(source.clock_name)
        return (reference, *free) if free else ()

    @property
    def stated(self) -> tuple[int, ...]:
        """Indices of sensors that state UTC and are not doubted: the reference, two per clock."""
        return undoubted(self._sources, self.stated_reference)

    def stepped(self, number: int) -> float:
        """Return by how many s the clock of a sensor was set, in all."""
        return self._sources[number].arrivals.stepped

    def compare_stated(self, drift: Mapping[int, float], reference: int) -> bool:
        """Take by how much stated UTC drifts, in s rms; return whether that of any sensor does.

        Parameters
        ----------
        drift : mapping of int to float
            Of `stated` sensors; NaN where nobody knows.
        reference : int
            The sensor against which.
        """
        before = [(source.unchecked, source.lost) for source in self._sources]
        take_drift(self._sources, drift, reference)
        found = any(self._sources[number].doubted for number in drift)
        if found:
            self.stated_reference, self._measured_against = reference, None
            self.reset_delays()  # they were measured against another sensor
            self._lay_grid()
        if found or before != [(source.unchecked, source.lost) for source in self._sources]:
            self.set_clocks()
        return found

    def distrust(self, *, followed: bool) -> bool:
        """Take arrivals for the clocks of sensors whose stated UTC is wrong; return whether any.

        Whose UTC is off by more than can be measured, and, once `followed` by the motion, whose
        clocks are not understood.
        """
        found = [
            source
            for source in self._sources
            if source.lost or (source.doubted and followed and not _is_understood(source))
        ]
        for source in found:
            source.distrust()
        self._begin_anew(found)
        return bool(found)

    @property
    def distrusted(self) -> tuple[int, ...]:
        """Indices of sensors whose stated UTC is not their clock."""
        return tuple(n for n, source in enumerate(self._sources) if source.disproved)

    def give_up(self, numbers: Sequence[int]) -> None:
        """State of sensors that their times are off by more than can be measured."""
        for number in numbers:
            self._sources[number].give_up()
        self._begin_anew([self._sources[number] for number in numbers])

    def _begin_anew(self, changed: Sequence[SensorSource]) -> None:
        """Set the clocks of sensors whose kind of clock has changed, without measured delays."""
        if changed:
            self._measured_against = None
            self.reset_delays()
            self.set_clocks()
            self._lay_grid()

    def learn(
        self, at: FloatArray, delays: FloatArray, *, std: FloatArray, frame_delays: FrameDelays
    ) -> None:
        """Add delays measured from the samples.

        Parameters
        ----------
        at : float64, shape (n,)
            Grid positions in samples.
        delays, std : float64, shape (n, n_measurable)
            Delay of each `measurable` sensor against the sensor with standard deviation zero, and
            its standard deviation, in s; an infinite standard deviation means unknown.
        frame_delays : callable
            Returns, when the clocks are set, the correction of all delays since `reset_delays`
            in s, float64, shape (n_measurable,).
        """
        if len(at) == 0:
            return
        self._frame_delays = self.measurable, frame_delays
        certain = np.flatnonzero((std == 0).all(axis=0))
        if len(certain):
            self._measured_against = self.measurable[int(certain[0])]
        seconds = self._start + at / self.sampling_rate
        at_reference = self._sources[self._reference].known_clock.position(seconds)
        for column, number in enumerate(self.measurable):
            source = self._sources[number]
            index = source.known_clock.position(seconds)
            found = index, at_reference, delays[:, column], std[:, column]
            source.learnt.add(np.column_stack(found))

    def reset_delays(self) -> None:
        """Drop all measured delays; the clocks do not change until they are set again."""
        self._frame_delays = None
        for source in self._sources:
            source.learnt.clear()

    def set_clocks(self, *, slips: bool = True) -> None:
        """Set every clock from all current data.

        `slips`: whether samples lost without being counted are looked for in measured delays.
        """
        sources = self._sources
        self.n_settings += 1
        place_stated(sources)
        numbers, frame_delays = self._frame_delays or ((), list)
        for number, delay in zip(numbers, frame_delays(), strict=True):
            sources[number].frame_delay = float(delay)
        if self._at_face_value:
            self._set_nominal_clocks()
            return
        together = len({source.clock_name for source in sources}) == 1 and not any(
            source.device_utc or source.polled for source in sources
        )
        together = together and len({source.record.sampling_rate for source in sources}) == 1
        reference = sources[self._reference]
        measurable = [sources[number] for number in numbers if sources[number] is not reference]
        for source in sources:
            find_by_arrivals(source)
        find_by_motion(reference, [each for each in measurable if each.learnt and slips])
        utc = UtcRate() if all(each.device_utc for each in sources) else reference.utc_rate()
        first_of: dict[str, SensorSource] = {}
        for source in [reference, *(each for each in sources if each is not reference)]:
            name = source.clock_name
            first = first_of.get(name) or source.repeats(first_of.values()) or source
            first_of[name] = first
            measured = None if source is reference else source.measured(reference)
            if source.polled:
                source.clock = utc.by_utc(source.by_instants())
            elif first is not source and not source.device_utc:
                source.share(first, measured)
            elif together:
                ppm, ppm_std = source.heard.rate()
                source.clock = nominal(
                    source.record.name,
                    ClockSource.SHARED_CLOCK,
                    end_sample=source.end_sample,
                    sampling_rate=source.record.sampling_rate,
                    ppm=ppm,
                    ppm_std=ppm_std,
                    shared_clock=source.clock_name,
                )
            else:
                clock = source.solved(measured, utc)
                if clock.state.refined:
                    clock = clock.beside(reference.known_clock.state)
                source.clock = clock
        if self._recording.closed:  # before that, arrivals may be few
            for source in sources:
                if not source.polled:
                    _check_rate(self._recording.path, source)

    def _set_nominal_clocks(self) -> None:
        """Set every clock to its nominal rate."""
        is_one = len({source.clock_name for source in self._sources}) == 1
        for source in self._sources:
            rate = source.record.sampling_rate
            source.clock = nominal(
                source.record.name,
                ClockSource.NOMINAL_RATE,
                end_sample=source.end_sample,
                sampling_rate=rate,
                first=round(source.arrivals.start * rate),
                residual=0.0 if is_one else math.nan,
            )

    def refresh(self) -> None:
        """Read newly committed blocks, and set every clock."""
        self._recording.refresh()
        if not self._sources:
            if any(record.n_samples == 0 for record in self._records):
                return
            self._sources = [SensorSource.of(record, *self._origin) for record in self._records]
            for source in self._sources:
                source.span = self._limits
        for source in self._sources:
            source.refresh()
        n_samples = sum(source.end_sample for source in self._sources)
        n_runs = sum(len(source.runs) for source in self._sources)
        before, runs_before = self._set_at
        enough = _MIN_SECONDS * sum(source.record.sampling_rate for source in self._sources)
        growth = max(_GROWTH * before, min(_FIRST_GROWTH * before, enough))
        if n_runs > runs_before or n_samples > before + growth:
            self._set_at = (n_samples, n_runs)
            self.set_clocks()
        else:
            for source in self._sources:
                source.clock = source.known_clock.extended(source.end_sample)
        if self._grid is None:
            self._lay_grid()

    @property
    def _limits(self) -> tuple[float, float]:
        """Return the limits of the grid that are wanted, in s."""
        begin, end = (None if at is None else (at - self._origin[1]) * 1e-9 for at in self._wanted)
        return -math.inf if begin is None else begin, math.inf if end is None else end

    def _lay_grid(self) -> None:
        begin, self._end = self._limits
        self._apart = False
        self._grid = CommonGrid.laid(self._sources, self.sampling_rate, wanted=begin)
        if not self.measurable:  # delays are measured where all sensors have samples
            self._apart = True
            self._grid = CommonGrid.laid(
                self._sources, self.sampling_rate, wanted=begin, apart=True
            )

    def read(self, start: int, stop: int, *, is_final: bool = True) -> tuple[FloatArray, BoolArray]:
        """Return grid samples `start` to `stop` (not included).

        Parameters
        ----------
        start, stop : int
        is_final : bool
            Whether epochs whose times are uncertain are left out.

        Returns
        -------
        samples : float64, shape (stop - start, n_channels)
            In physical units; NaN where a channel has no sample.
        valid : bool, shape (stop - start,)
            False if any sensor has a gap.

        Raises
        ------
        CannotAlignError
            If the samples are not available yet.
        """
        grid = self._grid
        if grid is None or not 0 <= start <= stop <= self.n_available:
            raise CannotAlignError(
                f"{self._recording.path}: grid samples {start} to {stop} requested;"
                f" {self.n_available} available"
            )
        # Channel after channel in memory: so they are converted, and transformed, the fastest.
        samples = np.empty((len(self.channels), stop - start)).T
        valid = np.ones(stop - start, dtype=bool)
        edges = np.cumsum([0, *self.dims])
        grid = replace(grid, is_final=is_final)
        for source, low, high in zip(self._sources, edges[:-1], edges[1:], strict=True):
            here = grid.read(source, start, samples[:, low:high])
            if not here.all():
                samples[~here, low:high] = np.nan
                valid &= here
        return samples, valid

    def own_samples(self, begins: NDArray[np.int64], length: int) -> list[OwnSamples] | None:
        """Return segments in the samples of each sensor, not interpolated.

        None where any sensor has a gap in them, or a clock that is not straight.

        Parameters
        ----------
        begins : int64, shape (n_segments,)
            Grid samples, increasing.
        length : int
        """
        if self._grid is None:
            return None
        found = []
        for source in self._sources:
            own = OwnSamples.of(source, self._grid, begins, length)
            if own is None:
                return None
            found.append(own)
        return found

    @property
    def _reference(self) -> int:
        """Return the index of the reference sensor."""
        return self._preferred if self._measured_against is None else self._measured_against

    @property
    def _preferred(self) -> int:
        """Return the index of the best reference: a sensor with its own UTC, else the first."""
        return next(iter(self.stated), 0)

    @property
    def _untouched(self) -> bool:
        """Return whether all samples are on the grid."""
        return self._grid is None or all(map(self._grid.has, self._sources))

    @property
    def _start(self) -> float:
        """Return the time from the recording's creation to grid sample 0, in s."""
        return 0.0 if self._grid is None else self._grid.start


def _is_understood(source: SensorSource) -> bool:
    return source.known_clock.state.refined and source.known_clock.state.is_understood


def _check_rate(path: str | Path, source: SensorSource) -> None:
    """Raise CannotAlignError if a clock is further off than that of any device that works."""
    state = source.known_clock.state
    if abs(state.ppm) - 3 * state.ppm_std > MAX_PPM:
        rate = source.record.sampling_rate
        raise CannotAlignError(
            f"{path}: sensor {source.record.name!r} sent {rate * (1 + state.ppm * 1e-6):.4g}"
            f" samples per second; expected its sampling rate, {rate:g} Hz, to 0.1 %: state the"
            " right sampling rate, or check whether samples are lost"
        )
