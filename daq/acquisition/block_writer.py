"""From what ports hand over to rows of a recording: places blocks, writes gaps and events.

No clock and no event loop: the recorder calls it from its writing thread.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from daq.acquisition.connection import SensorLost
from daq.acquisition.sample_index import Gap, SampleIndexer
from daq.protocols.block import Block, Event, EventKind

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from daq.acquisition.connection import Connected, Item
    from daq.protocols.block import HostTime
    from daq.recording.writer import Committed, RecordingWriter

_LOGGER = logging.getLogger(__name__)
_ROUTINE = {
    EventKind.STARTED,
    EventKind.STOPPED,
    EventKind.MARK,
    EventKind.CONNECTED,
    EventKind.STATUS,
}
"""Kinds of events that are logged as information; all others are warnings."""
_SAY_INTERVAL_NS = 1_000_000_000
MOST_ALIKE = 20
"""Events of one kind of one sensor that are written of each second."""


@dataclass(frozen=True, slots=True)
class SensorStatus:
    """How one sensor is doing."""

    state: str
    """``waiting`` for its first block, ``recording``, ``late`` with the next, or ``lost``."""
    samples: int
    """Safe on disk."""
    gaps: int
    missing: int
    """Samples that were not received, as far as is known."""


class _Sensor:
    def __init__(self, sampling_rate: float) -> None:
        self.rate = sampling_rate
        self.continuity = SampleIndexer(sampling_rate)
        self.state = "waiting"
        self.late: Event | None = None  # to be written if nothing comes after all
        self.missing = 0
        self.repeated = 0
        self.said_ns = -_SAY_INTERVAL_NS


class _Alike:
    """Events of one kind of one sensor: a line full of noise must not fill the file."""

    def __init__(self) -> None:
        self._since_ns = -_SAY_INTERVAL_NS
        self._n = 0

    def take(self, event: Event) -> Iterator[Event]:
        """Yield what is to be written."""
        if event.kind == "mark":  # a person's words
            yield event
            return
        now_ns = event.received.monotonic_ns
        if now_ns - self._since_ns >= _SAY_INTERVAL_NS:
            yield from self.left_out(event)
            self._since_ns, self._n = now_ns, 0
        self._n += 1
        if self._n <= MOST_ALIKE:
            yield event

    def left_out(self, event: Event) -> Iterator[Event]:
        """Yield how many were left out, as an event like this one."""
        if self._n > MOST_ALIKE:
            yield replace(event, text=f"{self._n - MOST_ALIKE} more of these before")


class BlockWriter:
    """The one who writes a recording's rows."""

    def __init__(self, writer: RecordingWriter, sampling_rates: Mapping[str, float]) -> None:
        self._writer = writer
        self._sensors = {name: _Sensor(rate) for name, rate in sampling_rates.items()}
        self._alike: defaultdict[tuple[str, str], _Alike] = defaultdict(_Alike)

    def take(self, items: Iterable[Item]) -> None:
        """Write what came, in order.

        Raises
        ------
        RecordingError
            If it cannot be written.
        """
        for item in items:
            if isinstance(item, Block):
                self._block(item)
            elif isinstance(item, Event):
                self._event(item)
            elif isinstance(item, SensorLost):
                self._trouble(item)
            else:
                self._connected(item)

    @property
    def n_written(self) -> int:
        """Rows of samples in the file, of all sensors: what a commit now would make safe."""
        return self._writer.n_written

    def commit(self) -> Committed:
        """Make it safe."""
        return self._writer.commit()

    def close(self, now: HostTime, reason: str) -> Committed:
        """Record what is missing of lost sensors, say why the run ended, and close the file."""
        for name, sensor in self._sensors.items():
            if sensor.state == "lost":
                gap = sensor.continuity.lost_until(now, "lost at the end")
                if gap is not None:
                    self._gap(name, sensor, gap)
        for (name, kind), alike in self._alike.items():
            for event in alike.left_out(Event(name, kind, "", now)):
                self._record(event)
        self._record(Event("", EventKind.STOPPED, reason, now))
        return self._writer.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._writer.abandon()

    def status(self, committed: Committed) -> dict[str, SensorStatus]:
        """Return how the sensors are doing."""
        return {
            name: SensorStatus(
                self._sensors[name].state, counts.rows, counts.gaps, self._sensors[name].missing
            )
            for name, counts in committed.sensors.items()
        }

    def recorded(self) -> float:
        """Return how much of the sensor that has least is recorded, gaps included, in s."""
        return min(s.continuity.next_sample / s.rate for s in self._sensors.values())

    def states(self) -> dict[str, str]:
        """Return how the sensors are doing, in a word."""
        return {name: sensor.state for name, sensor in self._sensors.items()}

    def _event(self, event: Event) -> None:
        for said in self._alike[event.sensor, event.kind].take(event):
            self._record(said)

    def _trouble(self, trouble: SensorLost) -> None:
        """Change a sensor's state. That it was late is recorded once it is lost, not before.

        A line that is a little late now and then would fill the file with it.
        """
        sensor = self._sensors[trouble.event.sensor]
        if trouble.state == "late":
            if sensor.state == "recording":
                sensor.state, sensor.late = "late", trouble.event
            return
        if sensor.late is not None:
            self._event(sensor.late)
        sensor.state, sensor.late = "lost", None
        self._event(trouble.event)

    def _connected(self, item: Connected) -> None:
        for name in item.sensors if item.reason else ():
            continuity = self._sensors[name].continuity
            if item.resumed:
                continuity.resume(item.reason)
            else:
                continuity.new_session(item.reason)

    def _block(self, block: Block) -> None:
        sensor = self._sensors[block.sensor]
        placed = sensor.continuity.place(block)
        if placed.repeated:
            sensor.repeated += placed.repeated
            self._say_repeated(sensor, block)
        if placed.gap is not None:
            self._gap(block.sensor, sensor, placed.gap)
        if placed.block is not None:
            sensor.state, sensor.late = "recording", None
            self._writer.append(placed.block)

    def _say_repeated(self, sensor: _Sensor, block: Block) -> None:
        """Say it at most once a second: a line may repeat everything, for weeks."""
        at = block.received
        if at.monotonic_ns - sensor.said_ns >= _SAY_INTERVAL_NS:
            sensor.said_ns = at.monotonic_ns
            text = f"{sensor.repeated} samples so far came again and were recorded once"
            self._record(Event(block.sensor, EventKind.RESYNCHRONISED, text, at))

    def _record(self, event: Event) -> None:
        """Write an event to the recording and to the log."""
        self._writer.event(event)
        level = logging.INFO if event.kind in _ROUTINE else logging.WARNING
        what = " ".join(part for part in (event.sensor, event.kind) if part)
        fields = {"sensor": event.sensor, "kind": event.kind}
        _LOGGER.log(level, "%s: %s", what, event.text, extra=fields)

    def _gap(self, name: str, sensor: _Sensor, gap: Gap) -> None:
        sensor.missing += gap.missing
        _LOGGER.debug(
            "%s gap: %d samples missing from %d on: %s",
            *(name, gap.missing, gap.first_sample, gap.reason),
            extra={"sensor": name, "first_sample": gap.first_sample, "missing": gap.missing},
        )
        self._writer.gap(
            name, gap.first_sample, gap.missing, reason=gap.reason, estimated=gap.estimated
        )
