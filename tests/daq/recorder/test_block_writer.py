"""States of sensors agree in recorder and monitor, and what a driver yields is checked."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from daq.protocols.block import Event, EventKind, HostTime, Reading
from daq.recorder.block_writer import BlockWriter
from daq.recorder.connection import (
    BlockValidator,
    Connected,
    FaultyDriverError,
    Item,
    SensorLate,
    SensorLost,
)
from daq.recording.file_format import SensorLayout
from daq.recording.monitor import RecordingMonitor
from daq.recording.reader import Recording
from daq.recording.sensor_state import SensorState
from daq.recording.writer import RecordingWriter
from estimator.checks.count_limits import share_of_repeats
from tests.scripted_driver import RATE, ManualClock, PlayedDriver, bench, block

LOST_BY = (EventKind.STALLED, EventKind.DISCONNECTED, EventKind.REFUSED)


class Run:
    """A block writer with one sensor "a", its clock, and a monitor of its file."""

    def __init__(self, writer: RecordingWriter, recording: Recording, clock: ManualClock) -> None:
        self.blocks = BlockWriter(writer, {"a": RATE}, share_of_repeats=share_of_repeats)
        self.clock = clock
        self._recording = recording
        self._monitor = RecordingMonitor(recording)

    def write(self, *items: Item) -> None:
        """Write and commit items, a second after those before."""
        self.clock.advance(1.0)
        self.blocks.write(items)
        self.blocks.commit()

    def events(self) -> list[str]:
        """End the run, and return the texts of the conditions that were recorded."""
        self.blocks.close(self.clock.now(), "the end")
        self._recording.refresh()
        return [one.text for one in self._recording.events if one.kind == EventKind.STATUS]

    def event(self, kind: EventKind) -> Event:
        """Return an event that happens with the next items."""
        self.clock.advance(0.001)
        return Event("a", kind, f"a {kind} sensor", self.clock.now())

    def samples(self, first: int) -> None:
        """Write a chunk of samples, which is committed at once."""
        self.write(block("a", first, 100, self.clock.now()))

    def states(self) -> tuple[SensorState, SensorState]:
        """Return the state that the recorder reports, and the monitor's."""
        self._recording.refresh()
        states = self.blocks.states()
        (sensor,) = self._monitor.with_late_sensors(self._monitor.status(), states).sensors
        return states["a"], sensor.state


@contextmanager
def running(path: Path) -> Iterator[Run]:
    clock = ManualClock()
    (sensor,) = bench("a").sensors
    layout = SensorLayout.of(sensor, PlayedDriver().counts_dtype(sensor), "a")
    writer = RecordingWriter.create(path, sensors=[layout], created=clock.now())
    try:
        with Recording.open(path) as recording:
            yield Run(writer, recording, clock)
    finally:
        writer.abandon()


def both(state: SensorState) -> tuple[SensorState, SensorState]:
    return state, state


@pytest.mark.parametrize("kind", LOST_BY)
def test_recorder_and_monitor_give_a_sensor_the_same_state(tmp_path: Path, kind: EventKind) -> None:
    with running(tmp_path / "r.h5") as run:
        run.write(Connected(("a",), ""), run.event(EventKind.CONNECTED))
        assert run.states() == both(SensorState.WAITING)
        run.samples(0)
        assert run.states() == both(SensorState.LIVE)
        run.write(SensorLate(run.event(EventKind.LATE)))
        assert run.states() == both(SensorState.LATE)
        run.write(SensorLost(run.event(kind)))
        assert run.states() == both(SensorState(kind))
        run.write(Connected(("a",), kind), run.event(EventKind.CONNECTED))
        assert run.states() == both(SensorState.WAITING)
        run.samples(0)
        assert run.states() == both(SensorState.LIVE)
        run.blocks.close(run.clock.now(), "end of the test")
        assert run.states() == both(SensorState.ENDED)


@pytest.mark.parametrize("kind", LOST_BY)
def test_a_sensor_that_is_lost_at_the_end_keeps_its_state(tmp_path: Path, kind: EventKind) -> None:
    with running(tmp_path / "r.h5") as run:
        run.samples(0)
        run.write(SensorLost(run.event(kind)))
        run.clock.advance(3.0)
        run.blocks.close(run.clock.now(), "end of the test")
        assert run.states() == both(SensorState(kind))
    with Recording.open(tmp_path / "r.h5") as recording:
        (gap,) = recording.sensors[0].gaps
    assert (gap["first_sample"], gap["reason"]) == (100, b"lost at the end")


def test_a_sensor_without_a_block_since_it_was_connected_again_has_a_gap_at_the_end(
    tmp_path: Path,
) -> None:
    with running(tmp_path / "r.h5") as run:
        run.samples(0)
        run.write(SensorLost(run.event(EventKind.DISCONNECTED)))
        run.write(Connected(("a",), EventKind.DISCONNECTED), run.event(EventKind.CONNECTED))
        run.blocks.close(run.clock.now(), "end of the test")
        assert run.states() == both(SensorState.ENDED)
    with Recording.open(tmp_path / "r.h5") as recording:
        assert recording.sensors[0].gaps["reason"].tolist() == [b"lost at the end"]


def test_a_late_event_is_recorded_only_if_the_sensor_is_lost_afterwards(tmp_path: Path) -> None:
    with running(tmp_path / "r.h5") as run:
        run.samples(0)
        run.write(SensorLate(run.event(EventKind.LATE)))
        run.samples(100)
        run.write(SensorLate(run.event(EventKind.LATE)))
        run.write(SensorLost(run.event(EventKind.STALLED)))
        run.blocks.close(run.clock.now(), "end of the test")
    with Recording.open(tmp_path / "r.h5") as recording:
        kinds = [event.kind for event in recording.events]
    assert kinds == [EventKind.LATE, EventKind.STALLED, EventKind.STOPPED]


@pytest.mark.parametrize(
    ("rate", "skipped", "said"),
    [
        (1.009 * RATE, 0, "sent 100.9 samples a second, expected 100: correct sampling_rate, or"),
        (0.99 * RATE, 0, "sent 99 samples a second, expected 100: correct sampling_rate, or"),
        (1.0004 * RATE, 0, ""),
        (RATE, 90, ""),  # the device's counter stepped
    ],
)
def test_an_odd_rate_is_named_at_the_end(
    tmp_path: Path, rate: float, skipped: int, said: str
) -> None:
    with running(tmp_path / "r.h5") as run:
        for first in range(0, 80 * int(RATE), 100):
            run.clock.advance(100 / rate)
            index = first + skipped * (first >= 20 * RATE)
            run.blocks.write([block("a", index, 100, run.clock.now())])
        found = run.events()
    assert len(found) == bool(said)
    assert all(text.startswith(said) and "--sampling-rate a=" in text for text in found)


def test_rows_that_repeat_for_long_are_an_event_once(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    read = np.floor(np.arange(200 * int(RATE)) * 0.4).astype(int)  # at two fifths of the rate
    with running(tmp_path / "r.h5") as run:
        rows = rng.integers(-9000, 9000, (read[-1] + 1, 2)).astype(np.int32)[read]
        for first in range(0, len(rows), 100):
            run.clock.advance(100 / RATE)
            now = run.clock.now()
            run.blocks.write(
                [replace(block("a", first, 100, now), counts=rows[first : first + 100])]
            )
        assert run.events() == ["repeats its values: it refreshes at 39.9 Hz, polled at 100 Hz"]


# --- what a driver yields, checked -----------------------------------------------------------


NOW = HostTime(10**9, 10**18)
FAULTY: dict[str, tuple[dict[str, Any], str]] = {
    "shape": ({"counts": np.zeros((10, 3), np.int32)}, r"shape \(10, 3\); expected .* 2\)"),
    "flat": ({"counts": np.zeros(10, np.int32)}, r"shape \(10,\)"),
    "no array": ({"counts": [[1, 2]]}, "counts of shape None"),
    "type": ({"counts": np.full((10, 2), 0.5)}, "type float64 that do not fit int32"),
    "text": ({"counts": np.full((10, 2), "1")}, "type <U1 that do not fit int32"),
    "nan": ({"counts": np.full((10, 2), np.nan)}, "type float64 that do not fit int32"),
    "too large": ({"counts": np.full((10, 2), 2**40)}, "type int64 that do not fit int32"),
    "empty": ({"counts": np.zeros((0, 2), np.int32)}, "a block without samples"),
    "sensor": ({"sensor": "c"}, "a block of 'c'; expected 'a' or 'b'"),
    "index": ({"first_sample": -5}, "first_sample -5; expected 0 or more"),
    "no index": ({"first_sample": None}, "first_sample None; expected 0 or more"),
    "counter": ({"device_counter": 2**70}, "device_counter .*; expected an integer of 64 bits"),
    "flags": ({"flags": 2**40}, "flags 1099511627776"),
    "reason": ({"reason": None}, "reason None; expected text"),
    "time": ({"received": 12.0}, r"received at 12\.0"),
    "instants": ({"instants_ns": np.zeros(9, np.int64)}, r"shape \(9,\); expected int64 \(10,\)"),
    "real instants": ({"instants_ns": np.zeros(10)}, "expected int64"),
}


def checked() -> BlockValidator:
    return BlockValidator(PlayedDriver(), bench("a", "b", a="bus", b="bus").sensors)


@pytest.mark.parametrize("case", FAULTY)
def test_blocks_that_the_file_cannot_hold_are_refused(case: str) -> None:
    changes, said = FAULTY[case]
    with pytest.raises(FaultyDriverError, match=f"^bus: driver 'played' yielded .*{said}"):
        checked().validated(replace(block("a", 100, 10, NOW), **changes))


@pytest.mark.parametrize(
    ("item", "said"),
    [
        (b"raw", "bytes; expected a Block, an Event or a Reading"),
        (None, "NoneType"),
        (Event("c", "status", "", NOW), "an event of 'c'; expected 'a' or 'b'"),
        (Event("a", "status", cast("str", None), NOW), "'status', None; expected text"),
        (Event("a", "status", "", cast("HostTime", 5)), "an event received at 5"),
        (Reading("c", "temperature", 20.0, NOW), "a reading of 'c'; expected 'a' or 'b'"),
        (Reading("a", "temperature", math.nan, NOW), "'temperature', nan; expected text and a"),
        (Reading("a", "temperature", 20.0, cast("HostTime", 5)), "a reading received at 5"),
    ],
)
def test_items_of_other_types_or_sensors_are_refused(item: object, said: str) -> None:
    with pytest.raises(FaultyDriverError, match=said):
        checked().validated(item)


def test_sample_times_are_in_all_blocks_or_none() -> None:
    one = checked()
    one.validated(block("a", 0, 10, NOW))
    one.validated(block("b", 0, 10, NOW, instants_ns=np.arange(10)))
    with pytest.raises(FaultyDriverError, match="with sample times and others without"):
        one.validated(block("a", 10, 10, NOW, instants_ns=np.arange(10)))


@pytest.mark.parametrize("kind", ["i1", "u2", "i4", "i8", "u8", "f4", "f8"])
def test_counts_of_any_fitting_type_are_valid(kind: str) -> None:
    one = block("a", 0, 5, NOW)
    item = replace(one, counts=one.counts.astype(kind))
    assert checked().validated(item) is item


def test_events_of_the_port_are_valid() -> None:
    item = Event("", "status", "of the port", NOW)
    assert checked().validated(item) is item
