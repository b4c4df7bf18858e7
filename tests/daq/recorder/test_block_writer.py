"""States of sensors: the recorder's, and those that a monitor derives from the file, agree."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.protocols.block import Event, EventKind
from daq.recorder.block_writer import BlockWriter
from daq.recorder.connection import Connected, Item, SensorLate, SensorLost
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
    ("rate", "said"),
    [
        (1.009 * RATE, "sent 100.9 samples a second, expected 100: correct sampling_rate, or"),
        (0.99 * RATE, "sent 99 samples a second, expected 100: correct sampling_rate, or"),
        (1.0004 * RATE, ""),
    ],
)
def test_an_odd_rate_is_named_at_the_end(tmp_path: Path, rate: float, said: str) -> None:
    with running(tmp_path / "r.h5") as run:
        for first in range(0, 80 * int(RATE), 100):
            run.clock.advance(100 / rate)
            run.blocks.write([block("a", first, 100, run.clock.now())])
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
