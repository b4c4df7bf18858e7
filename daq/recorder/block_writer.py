"""Writes the items of all connections into the recording: blocks, gaps and events.

It has no clock and no event loop; the recorder calls it from its writing thread.

During the run, :class:`RepeatedRows` finds devices that repeat their readings. Rows are kept for
some seconds at intervals, and judged as in a check list, by
``estimator.checks.count_limits.share_of_repeats``. The caller passes this function, since the
recorder does not import the estimator. A fault is reported after three judgments in a row, so that
a quiet channel is not named by chance.
"""

from __future__ import annotations

import logging
import math
import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daq.protocols.block import Block, Event, EventKind, HostTime, Quantity, Reading, ReadingTimes
from daq.protocols.pace import Pace
from daq.recorder.connection import Connected, Item, SensorLate, SensorLost
from daq.recorder.late_blocks import REASON as LATE_FOR_GOOD
from daq.recorder.late_blocks import LateBlocks
from daq.recorder.sample_index import Gap, SampleIndexer
from daq.recording.sensor_state import SensorState
from daq.recording.writer import Committed, RecordingWriter, SensorCounts

ShareOfRepeats: TypeAlias = "Callable[[NDArray[Any]], float]"

ROWS = 1000
"""Rows that are judged together."""
INTERVAL = 20.0
"""Seconds of the sensor's time from one judgment to the next."""
_TIMES = 3


class RepeatedRows:
    """Judges the rows of one sensor now and then.

    Parameters
    ----------
    sampling_rate : float
        In Hz.
    share_of_repeats : callable
        Returns the share of rows, shape (n_samples, n_channels), that repeat the row before.
    """

    def __init__(self, sampling_rate: float, share_of_repeats: ShareOfRepeats) -> None:
        self._rate = sampling_rate
        self._share_of_repeats = share_of_repeats
        self._kept: list[NDArray[Any]] = []
        self._n_kept = self._n_waited = self._n_times = 0

    def refresh_rate(self, counts: NDArray[Any]) -> float | None:
        """Take rows; return the rate in Hz of new readings, once, when they repeat for long."""
        if self._n_waited > 0:
            self._n_waited -= len(counts)
            return None
        self._kept.append(counts)
        self._n_kept += len(counts)
        if self._n_kept < ROWS:
            return None
        share = self._share_of_repeats(np.concatenate(self._kept))
        self._kept.clear()
        self._n_kept, self._n_waited = 0, round(INTERVAL * self._rate)
        self._n_times = self._n_times + 1 if share else 0
        return (1 - share) * self._rate if self._n_times == _TIMES else None


_LOGGER = logging.getLogger(__name__)
_ROUTINE = {
    EventKind.STARTED,
    EventKind.STOPPED,
    EventKind.MARK,
    EventKind.CONNECTED,
    EventKind.STATUS,
    EventKind.CLOCK,
}
"""Kinds of events that are logged as information; all others are warnings."""
_NEVER_FOLDED = {EventKind.MARK, EventKind.CONNECTED}
"""A user's remarks, and the events that end the loss of a sensor."""
_REPORT_INTERVAL_NS = 1_000_000_000
_FORGOTTEN_NS = 60 * _REPORT_INTERVAL_NS
"""Longest time between two reports of one condition, and time after which it is a new one."""
_NUMBERS = re.compile(r"\d+")
MAX_TEXT = 200
"""Bytes of an event's text."""
MAX_TEXTS = 20
"""Texts of one kind and sensor that are told apart: noise on a line has no end of them."""


@dataclass(frozen=True, slots=True)
class SensorProgress:
    """Recorded samples and state of one sensor."""

    state: SensorState
    samples: int
    """Number of samples safe on disk."""
    gaps: int
    missing: int
    """Known number of samples that were not received."""


class _Sensor:
    def __init__(
        self,
        sampling_rate: float,
        thermometer: tuple[int, float] | None,
        speed: float,
        repeats: RepeatedRows | None,
    ) -> None:
        self.repeats = repeats
        self.rate = sampling_rate
        self.speed = speed
        self.late = LateBlocks(sampling_rate, speed=speed)
        self.thermometer = thermometer
        self.indexer = SampleIndexer(sampling_rate)
        self.pace = Pace(sampling_rate)
        self.state = SensorState.WAITING
        self.late_event: Event | None = None  # written only if the sensor is lost afterwards
        self.n_missing = 0
        self.n_repeated = 0
        self.repeats_reported_ns = -_REPORT_INTERVAL_NS
        self.unsafe = _Unsafe()
        self.rows_before = self.gaps_before = 0
        """Rows and gaps that are safe in earlier files."""
        self.base = 0
        """Index of the first sample of the current file."""


class _Unsafe:
    """Blocks and gaps of one sensor in the current file that no commit has acknowledged.

    Needed if the file can no longer be written and the recording continues in another file.
    """

    def __init__(self) -> None:
        self._blocks: deque[tuple[int, Block]] = (
            deque()
        )  # each with the number of rows of the file up to its end
        self._gaps: deque[Gap] = deque()
        self._n_rows = self._n_gaps = 0
        self.safe = SensorCounts(0, 0, 0)

    def add(self, item: Block | Gap) -> None:
        if isinstance(item, Gap):
            self._gaps.append(item)
            self._n_gaps += 1
        else:
            self._n_rows += item.n_samples
            self._blocks.append((self._n_rows, item))

    def are_safe(self, counts: SensorCounts) -> None:
        """Drop the acknowledged items."""
        self.safe = counts
        while self._blocks and self._blocks[0][0] <= counts.rows:
            self._blocks.popleft()
        while self._n_gaps - len(self._gaps) < counts.gaps:
            self._gaps.popleft()

    def taken(self) -> list[Block | Gap]:
        """Return and remove the unacknowledged items, for another file."""
        rest: list[Block | Gap] = [*self._gaps, *(block for _, block in self._blocks)]
        self._blocks.clear()
        self._gaps.clear()
        self._n_rows = self._n_gaps = 0
        self.safe = SensorCounts(0, 0, 0)
        return rest


class _Fold:
    """Folds events of one sensor and kind that say the same, but for their numbers.

    The first is written at once. Later ones are counted, and written together at intervals that
    double: a condition that lasts for weeks must not fill the file.
    """

    def __init__(self) -> None:
        self._interval_ns = _REPORT_INTERVAL_NS
        self._reported_ns = 0
        self._last: Event | None = None
        self._n = 0

    def passed(self, event: Event) -> Iterator[Event]:
        """Yield what is to be written now."""
        now_ns = event.received.monotonic_ns
        quiet = self._last is None or now_ns - self._last.received.monotonic_ns > _FORGOTTEN_NS
        if quiet:
            yield from self.left_out()
            self._interval_ns, self._reported_ns = _REPORT_INTERVAL_NS, now_ns
            self._last = event
            yield event
            return
        self._last = event
        self._n += 1
        if now_ns - self._reported_ns >= self._interval_ns:
            yield from self.left_out()
            self._interval_ns = min(2 * self._interval_ns, _FORGOTTEN_NS)
            self._reported_ns = now_ns

    def left_out(self) -> Iterator[Event]:
        """Yield one event for all that were counted and not written."""
        if self._last is not None and self._n:
            seconds = (self._last.received.monotonic_ns - self._reported_ns) * 1e-9
            times = f", {self._n} times in {max(seconds, 1.0):.0f} s" if self._n > 1 else ""
            text = self._last.text.encode()[: MAX_TEXT - len(times)].decode(errors="ignore")
            yield replace(self._last, text=text + times)
        self._n = 0


class BlockWriter:
    """Writes the rows of a recording.

    Parameters
    ----------
    writer : RecordingWriter
    sampling_rates : mapping
        In Hz, by sensor.
    thermometers : mapping
        Column and sensitivity of the channel that measures the temperature, by sensor.
    speed : float
        Of the host's clock against real time.
    share_of_repeats : callable, optional
        See :class:`RepeatedRows`; default: repeats are not looked for.
    """

    def __init__(
        self,
        writer: RecordingWriter,
        sampling_rates: Mapping[str, float],
        thermometers: Mapping[str, tuple[int, float]] = MappingProxyType({}),
        *,
        speed: float = 1.0,
        share_of_repeats: ShareOfRepeats | None = None,
    ) -> None:
        self._writer = writer
        judge = share_of_repeats
        self._sensors = {
            name: _Sensor(
                *(rate, thermometers.get(name), speed),
                None if judge is None else RepeatedRows(rate, judge),
            )
            for name, rate in sampling_rates.items()
        }
        self._folds: defaultdict[tuple[str, str], dict[str, _Fold]] = defaultdict(dict)
        self._items: deque[Item] = deque()
        self._reading_times: defaultdict[tuple[str, str], ReadingTimes] = defaultdict(ReadingTimes)
        self._unsafe_events: list[Event | Reading] = []
        self._ended = False

    def write(self, items: Iterable[Item]) -> None:
        """Write items in order, after those left by an earlier error.

        Raises
        ------
        RecordingError
            If the file cannot be written.
        """
        self._items.extend(items)
        while self._items:
            item = self._items.popleft()
            if isinstance(item, Block):
                self._write_block(item)
            elif isinstance(item, Event):
                self._write_event(item)
            elif isinstance(item, Reading):
                self._write_reading(item)
            elif isinstance(item, SensorLate):
                self._set_late(item)
            elif isinstance(item, SensorLost):
                self._set_lost(item)
            else:
                self._begin_session(item)

    @property
    def run_id(self) -> str:
        """Unique identifier of the current file."""
        return self._writer.run_id

    @property
    def n_written(self) -> int:
        """Rows of samples of all sensors in the file, including uncommitted ones."""
        return self._writer.n_written

    def commit(self) -> Committed:
        """Make all written items safe on disk."""
        committed = self._writer.commit()
        for name, counts in committed.sensors.items():
            self._sensors[name].unsafe.are_safe(counts)
        self._unsafe_events.clear()
        return committed

    def continue_in(self, writer: RecordingWriter, *, lost: bool = False) -> None:
        """Continue in another file, and write the unacknowledged items there.

        `lost`: what was safe in the file before is safe no longer.
        """
        before, self._writer = self._writer, writer
        before.abandon()  # last: a follower that sees its end looks for the next file
        events, self._unsafe_events = self._unsafe_events, []
        for event in events:
            self._unsafe_events.append(event)
            if isinstance(event, Event):
                writer.event(event)
            else:
                writer.reading(event)
        for name, sensor in self._sensors.items():
            sensor.rows_before += 0 if lost else sensor.unsafe.safe.rows
            sensor.gaps_before += 0 if lost else sensor.unsafe.safe.gaps
            rest = sensor.unsafe.taken()
            sensor.base = min(
                (item.first_sample for item in rest), default=sensor.indexer.next_sample
            )
            for item in rest:
                if isinstance(item, Block):
                    self._append(name, item)
                else:
                    self._append_gap(name, item)

    def close(self, now: HostTime, reason: str) -> Committed:
        """Record the last gap of lost sensors and the reason of the end, and close the file.

        May be called again after an error.
        """
        if not self._ended:
            self._ended = True
            self._end(now, reason)
        return self._writer.close()

    def _end(self, now: HostTime, reason: str) -> None:
        for name, sensor in self._sensors.items():
            self._write_held(sensor)
            if sensor.state.is_lost or sensor.state is SensorState.WAITING:
                gap = sensor.indexer.lost_until(now)
                if gap is not None:
                    self._write_gap(name, sensor, gap)
            if not sensor.state.is_lost:
                sensor.state = SensorState.ENDED
            if (rate := sensor.pace.odd_rate()) is not None:
                text = (
                    f"sent {rate:.5g} samples a second, expected {sensor.rate:g}: correct"
                    f" sampling_rate, or estimate with --sampling-rate {name}={rate:.5g}"
                )
                self._record(Event(name, EventKind.STATUS, text, now), is_warning=True)
        for fold in [one for folds in self._folds.values() for one in folds.values()]:
            for event in fold.left_out():
                self._record(event)
        self._record(Event("", EventKind.STOPPED, reason, now))

    def abandon(self) -> None:
        """Close the file without writing anything more."""
        self._writer.abandon()

    def progress(self, committed: Committed) -> dict[str, SensorProgress]:
        """Return the progress of each sensor."""
        return {
            name: SensorProgress(
                self._sensors[name].state,
                self._sensors[name].rows_before + counts.rows,
                self._sensors[name].gaps_before + counts.gaps,
                self._sensors[name].n_missing,
            )
            for name, counts in committed.sensors.items()
        }

    def states(self) -> dict[str, SensorState]:
        """Return the state of each sensor."""
        return {name: sensor.state for name, sensor in self._sensors.items()}

    def recorded_seconds(self) -> float:
        """Return the recorded duration in s, with gaps, of the sensor with the shortest one."""
        return min(s.indexer.next_sample / s.rate for s in self._sensors.values())

    def _write_event(self, event: Event) -> None:
        if event.kind in _NEVER_FOLDED:
            self._record(event)
            return
        folds = self._folds[event.sensor, event.kind]
        said = _NUMBERS.sub("", event.text)
        if said not in folds and len(folds) >= MAX_TEXTS:
            said = next(reversed(folds))
        for passed in folds.setdefault(said, _Fold()).passed(event):
            self._record(passed)

    def _write_reading(self, reading: Reading) -> None:
        """Write the first reading of each minute."""
        if self._reading_times[reading.sensor, reading.quantity].is_due(reading.received):
            self._unsafe_events.append(reading)
            self._writer.reading(reading)

    def _set_late(self, item: SensorLate) -> None:
        """Keep the event of a late sensor until it is lost.

        Otherwise blocks that are slightly late would fill the file with events.
        """
        sensor = self._sensors[item.event.sensor]
        if sensor.state is SensorState.LIVE:
            sensor.state, sensor.late_event = SensorState.LATE, item.event

    def _set_lost(self, item: SensorLost) -> None:
        sensor = self._sensors[item.event.sensor]
        if sensor.late_event is not None:
            self._write_event(sensor.late_event)
        sensor.state, sensor.late_event = item.state, None
        self._record(item.event)  # the state of the sensor follows from it

    def _begin_session(self, item: Connected) -> None:
        for name in item.sensors if item.reason else ():
            sensor = self._sensors[name]
            self._write_held(sensor)
            sensor.state = SensorState.WAITING
            if item.resumed:
                sensor.indexer.resume(item.reason)
            else:
                sensor.indexer.new_session(item.reason)

    def _write_block(self, block: Block) -> None:
        sensor = self._sensors[block.sensor]
        sensor.state, sensor.late_event = SensorState.LIVE, None
        for passed in sensor.late.passed(block):
            self._write_passed(sensor, passed)

    def _write_held(self, sensor: _Sensor) -> None:
        """Write the blocks that are held back: the session ended."""
        for block in sensor.late.rest():
            self._write_passed(sensor, block)
        sensor.late = LateBlocks(sensor.rate, speed=sensor.speed)

    def _write_passed(self, sensor: _Sensor, block: Block) -> None:
        placed = sensor.indexer.place(block)
        if placed.repeated:
            sensor.n_repeated += placed.repeated
            self._report_repeated(sensor, block)
        if placed.gap is not None:
            self._write_gap(block.sensor, sensor, placed.gap)
            if placed.gap.reason == LATE_FOR_GOOD:
                missing = placed.gap.missing
                text = (
                    f"blocks arrive {missing / sensor.rate:.3g} s late for good: about {missing}"
                    " samples were lost, and not counted, while they were not read"
                )
                self._record(Event(block.sensor, EventKind.OVERFLOW, text, block.received))
        if placed.block is not None:
            self._append(block.sensor, placed.block)
            repeats = sensor.repeats
            rate = None if repeats is None else repeats.refresh_rate(placed.block.counts)
            if rate is not None:
                how = f"it refreshes at {rate:.3g} Hz, polled at {sensor.rate:g} Hz"
                status = Event(
                    block.sensor, EventKind.STATUS, f"repeats its values: {how}", block.received
                )
                self._record(status, is_warning=True)
            if placed.gap is not None and placed.gap.estimated:
                sensor.pace.restart()
            if placed.block.instants_ns is None:
                sensor.pace.take(placed.block.end_sample - 1, block.received)
            self._write_thermometer(sensor, placed.block)

    def _write_thermometer(self, sensor: _Sensor, block: Block) -> None:
        """Write the newest sample of an auxiliary channel in °C as a reading."""
        if sensor.thermometer is not None:
            column, sensitivity = sensor.thermometer
            value = float(block.counts[-1, column]) / sensitivity
            if math.isfinite(value):
                kind = Quantity.TEMPERATURE
                self._write_reading(Reading(block.sensor, kind, value, block.received))

    def _append(self, name: str, block: Block) -> None:
        sensor = self._sensors[name]
        sensor.unsafe.add(block)
        self._writer.append(replace(block, first_sample=block.first_sample - sensor.base))

    def _report_repeated(self, sensor: _Sensor, block: Block) -> None:
        """Report at most once a second: a device may repeat all samples for weeks."""
        at = block.received
        if at.monotonic_ns - sensor.repeats_reported_ns >= _REPORT_INTERVAL_NS:
            sensor.repeats_reported_ns = at.monotonic_ns
            text = f"{sensor.n_repeated} samples so far arrived twice and were recorded once"
            self._record(Event(block.sensor, EventKind.RESYNCHRONISED, text, at))

    def _record(self, event: Event, *, is_warning: bool = False) -> None:
        """Write an event to the recording and to the log."""
        self._unsafe_events.append(event)
        self._writer.event(event)
        is_routine = event.kind in _ROUTINE and not is_warning
        level = logging.INFO if is_routine else logging.WARNING
        what = " ".join(part for part in (event.sensor, event.kind) if part)
        fields = {"sensor": event.sensor, "kind": event.kind}
        _LOGGER.log(level, "%s: %s", what, event.text, extra=fields)

    def _write_gap(self, name: str, sensor: _Sensor, gap: Gap) -> None:
        sensor.n_missing += gap.missing
        _LOGGER.debug(
            "%s gap: %d samples missing from %d on: %s",
            *(name, gap.missing, gap.first_sample, gap.reason),
            extra={"sensor": name, "first_sample": gap.first_sample, "missing": gap.missing},
        )
        self._append_gap(name, gap)

    def _append_gap(self, name: str, gap: Gap) -> None:
        sensor = self._sensors[name]
        sensor.unsafe.add(gap)
        first = gap.first_sample - sensor.base
        self._writer.gap(name, first, gap.missing, reason=gap.reason, estimated=gap.estimated)
