"""Following a recording: looks between segments, the estimate when there is news, the end."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.alignment.aligned_recording import AlignedRecording
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.follow import (
    COMMIT_INTERVAL,
    MAX_INTERVAL,
    SHORTEST_INTERVAL,
    RecordingLeftOpenError,
    follow,
)
from daq.estimation.segments import memory
from daq.estimation.segments.newest_samples import NewestSamples
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.recording.monitor import RecordingMonitor, RecordingStatus, SensorStatus
from daq.recording.reader import Recording
from daq.results.sources import sources
from estimator.errors import InsufficientDataError
from tests.tui.example_snapshot import SETTINGS, growing
from tui.output.results import live_remarks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.writer import RecordingWriter

RATE = 200


class NoWait(threading.Event):
    """An event for which nobody waits: what would be a pause is none."""

    def wait(self, timeout: float | None = None) -> bool:
        """Return at once."""
        del timeout
        return self.is_set()


class Goes(NoWait):
    """An event during whose pauses something goes on."""

    def __init__(self, goes_on: Callable[[], object]) -> None:
        super().__init__()
        self._goes_on = goes_on

    def wait(self, timeout: float | None = None) -> bool:
        """Go on."""
        self._goes_on()
        return super().wait(timeout)


@dataclass
class Noted:
    """Writes down what it is told, in order."""

    cancelled: threading.Event = field(default_factory=NoWait)
    wanted: int = 10**9
    """Looks after which it has seen enough."""
    told: list[str] = field(default_factory=list)
    seen: list[RecordingStatus] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    taken: list[int] = field(default_factory=list)

    def status(self, status: RecordingStatus) -> None:
        """Count it."""
        self.told.append("look")
        self.seen.append(status)
        if len(self.seen) >= self.wanted:
            self.cancelled.set()

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Keep it."""
        assert settings.segment > 0
        self.told.append("snapshot")
        self.snapshots.append(snapshot)

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Keep it."""
        assert elapsed > 0
        self.taken.append(n_segments)

    def progress(self, done: int, total: int) -> None:
        """Check it."""
        assert 0 < done <= total


@dataclass
class Process:
    """A recorder's process: notes for how long it is waited for, and then goes on."""

    goes_on: Callable[[], object]
    ended: bool = False
    waits: list[float] = field(default_factory=list)

    def ends_within(self, timeout: float) -> bool:
        """Go on."""
        self.waits.append(timeout)
        self.goes_on()
        return self.ended


class Bench:
    """Three sensors that send what the test wants, at times it gives in seconds."""

    def __init__(self, writer: RecordingWriter) -> None:
        self.writer, self.begun = writer, SystemClock().now()
        self._rng = np.random.default_rng(7)
        self._sent = dict.fromkeys("ABC", 0)

    def at(self, seconds: float) -> HostTime:
        """Return an instant after the start."""
        ns = round(seconds * 1e9)
        return HostTime(self.begun.monotonic_ns + ns, self.begun.utc_ns + ns)

    def send(
        self, sensors: str, until: float, *, dead: int | None = None, clipped: bool = False
    ) -> None:
        """Send one block a second up to a time."""
        for sensor in sensors:
            while self._sent[sensor] < until * RATE:
                first = self._sent[sensor]
                counts = self._rng.integers(-999, 999, (RATE, 3)).astype(np.int32)
                if dead is not None:
                    counts[:, dead] = 4
                flags = BlockFlag.CLIPPED if clipped else BlockFlag.NONE
                at = self.at(first / RATE + 1)
                self.writer.append(Block(sensor, first, counts, at, flags=flags))
                self._sent[sensor] += RATE
        self.writer.commit()

    def say(self, sensor: str, kind: str, at: float, text: str = "") -> None:
        """Write an event."""
        self.writer.event(Event(sensor, kind, text, self.at(at)))
        self.writer.commit()


@contextmanager
def looked_at(path: Path) -> Iterator[tuple[Bench, Callable[[], dict[str, SensorStatus]]]]:
    """Yield a bench that is recorded, and how its sensors are by name."""
    with growing(path) as writer, Recording.open(path) as recording:
        monitor = RecordingMonitor(recording)

        def look() -> dict[str, SensorStatus]:
            recording.refresh()
            return {sensor.name: sensor for sensor in monitor.status_with_stuck_channels().sensors}

        yield Bench(writer), look


def test_states_of_sensors_are_those_of_blocks_and_events(tmp_path: Path) -> None:
    with looked_at(tmp_path / "run.h5") as (bench, look):
        assert {sensor.state for sensor in look().values()} == {"waiting"}
        bench.send("ABC", 6)
        assert {sensor.state for sensor in look().values()} == {"live"}
        bench.send("AC", 8)
        assert look()["B"].state == "live"  # not so long yet
        bench.send("AC", 12)
        seen = look()["B"]
        assert (seen.state, round(seen.overdue_for), seen.state.is_lost) == ("silent", 6, True)
        bench.say("B", "late", 12.1, "no block for 2 s")
        assert look()["B"].state == "late"
        bench.say("B", "stalled", 12.5, "no block for 6.5 s")
        seen = look()["B"]
        assert (seen.state, seen.reason) == ("stalled", "no block for 6.5 s")
        bench.say("B", "connected", 12.8)
        assert look()["B"].state == "waiting"
        bench.send("B", 14)
        assert look()["B"].state == "live"
        bench.say("C", "disconnected", 14.5, "the port is gone")
        bench.writer.close()
        states = {name: sensor.state for name, sensor in look().items()}
        assert states == {"A": "ended", "B": "ended", "C": "disconnected"}


def test_time_goes_on_when_every_sensor_is_lost(tmp_path: Path) -> None:
    path, clock = tmp_path / "run.h5", [100.0]
    with growing(path) as writer, Recording.open(path) as recording:
        bench, monitor = Bench(writer), RecordingMonitor(recording, now=lambda: clock[0])
        bench.send("ABC", 6)
        recording.refresh()
        before = monitor.status()
        clock[0] += 7.0
        assert monitor.status().elapsed == before.elapsed  # they may send, and commits come later
        for sensor in "ABC":
            bench.say(sensor, "disconnected", 6.5, "the port is gone")
        recording.refresh()
        lost = monitor.status()
        clock[0] += 60.0
        speed = 1.0 if recording.bench is None else recording.bench.speed
        later = monitor.status()
        assert later.elapsed == pytest.approx(lost.elapsed + 60 * speed)
        assert [s.overdue_for for s in later.sensors] == pytest.approx(
            [s.overdue_for + 60 * speed for s in lost.sensors]
        )


def test_channels_of_one_segment_are_not_called_copies(tmp_path: Path) -> None:
    with growing(tmp_path / "run.h5") as writer:
        Bench(writer).send("ABC", 3)
        with Estimation([writer.path], SETTINGS) as estimation:
            estimation.update()
            snapshot = estimation.snapshot()
    assert snapshot.n_segments == 1
    assert snapshot.diagnostics.advice == ()


def test_a_sensor_whose_every_block_is_clipped_has_a_snapshot(tmp_path: Path) -> None:
    with growing(tmp_path / "run.h5") as writer:
        bench = Bench(writer)
        bench.send("AB", 5)
        bench.send("C", 5, clipped=True)
        with Estimation([writer.path], replace(SETTINGS, reject=False)) as estimation:
            estimation.update()
            snapshot = estimation.snapshot()
    assert snapshot.n_segments > 1


@pytest.mark.parametrize("duration", [60.0, None])
def test_what_ends_by_itself_says_when(tmp_path: Path, duration: float | None) -> None:
    path = tmp_path / "run.h5"
    with growing(path, duration=duration) as writer, Recording.open(path) as recording:
        Bench(writer).send("ABC", 8)
        recording.refresh()
        now = RecordingMonitor(recording).status()
        assert now.ends_in == (None if duration is None else pytest.approx(60 - now.elapsed))
        writer.close()
        recording.refresh()
        assert RecordingMonitor(recording).status().ends_in is None


def test_a_sensor_is_late_when_its_recorder_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer, Recording.open(path) as recording:
        bench, monitor = Bench(writer), RecordingMonitor(recording)
        bench.send("ABC", 2)
        recording.refresh()
        assert not monitor.is_any_sensor_quiet()
        bench.send("AC", 4)
        recording.refresh()
        assert monitor.is_any_sensor_quiet()
        now = monitor.with_late_sensors(
            monitor.status(), {"A": "live", "B": "late", "C": "waiting"}
        )
        assert [sensor.state for sensor in now.sensors] == ["live", "late", "live"]
        assert now.sensors[1].overdue_for == pytest.approx(2, abs=0.1)


def test_channels_at_the_end_of_their_range_and_without_signal(tmp_path: Path) -> None:
    with looked_at(tmp_path / "run.h5") as (bench, look):
        bench.send("AB", 6)
        bench.send("C", 6, dead=1)
        bench.send("A", 8, clipped=True)
        seen = look()
        assert (seen["A"].is_clipping, seen["A"].n_clipped) == (True, 2)
        assert seen["C"].stuck == ("Y",)
        assert not any((seen["B"].is_clipping, seen["B"].stuck, seen["A"].stuck))
        bench.send("ABC", 20)
        seen = look()
        assert (seen["A"].is_clipping, seen["A"].n_clipped) == (False, 2)
        assert (seen["C"].stuck, seen["C"].was_stuck) == ((), ("Y",))


def test_an_estimate_is_made_only_when_a_segment_has_come(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        bench, noted = Bench(writer), Noted(wanted=4)
        bench.send("ABC", 6)
        assert follow(path, SETTINGS, noted, cancelled=noted.cancelled) is None
    assert noted.told == ["look", "look", "snapshot", "look", "look"]
    assert noted.seen[-1].elapsed >= 6


def test_the_end_is_one_result(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        Bench(writer).send("ABC", 30)
        writer.close()
    noted = Noted()
    result = follow(path, SETTINGS, noted)
    assert noted.snapshots == [result]
    assert result is not None
    assert result.closed
    assert result.diagnostics.diagnosis is not None
    assert noted.seen[-1].closed


def test_what_closes_with_its_last_segment_has_one_result(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:

        class Closing(Noted):
            def status(self, status: RecordingStatus) -> None:
                if not self.seen:  # it has been seen open, and ends before the next look
                    Bench(writer).send("ABC", 30)
                    writer.close()
                super().status(status)

        noted = Closing()
        result = follow(path, SETTINGS, noted, cancelled=noted.cancelled)
    assert result is not None
    assert noted.snapshots == [result]
    assert result.diagnostics.diagnosis is not None


def test_a_result_that_is_not_wanted_is_not_computed(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        Bench(writer).send("ABC", 30)
        writer.close()
    noted = Noted(wanted=1)
    assert follow(path, SETTINGS, noted, cancelled=noted.cancelled) is None
    assert not noted.snapshots


def test_too_short_a_recording_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        Bench(writer).send("ABC", 1)
        writer.close()
    noted = Noted()
    with pytest.raises(InsufficientDataError, match="record longer"):
        follow(path, SETTINGS, noted)
    assert noted.snapshots[-1].closed


def test_a_remote_recorder_that_has_ended_is_found_by_its_silence(tmp_path: Path) -> None:
    path = tmp_path / "killed.h5"
    with growing(path):
        pass
    noted = Noted()
    with pytest.raises(RecordingLeftOpenError, match=f"huddle repair {path}"):
        follow(path, None, noted, cancelled=noted.cancelled, silence=0.0)


@pytest.mark.skipif(sys.platform == "win32", reason="no locks are seen there")
def test_a_remote_recorder_that_was_killed_is_noticed_at_once(tmp_path: Path) -> None:
    """By the lock that ends with it: not after seconds of silence."""
    path = tmp_path / "killed.h5"
    with growing(path) as writer:
        Bench(writer).send("ABC", 6)
    noted = Noted()
    with pytest.raises(RecordingLeftOpenError, match="huddle repair"):
        follow(path, None, noted, cancelled=noted.cancelled, silence=1e9)
    assert "snapshot" not in noted.told


def test_a_process_that_ends_without_closing_its_recording_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        bench, noted = Bench(writer), Noted()
        bench.send("ABC", 6)

        def be_killed() -> None:
            process.ended = True

        process = Process(be_killed)
        with pytest.raises(RecordingLeftOpenError, match="huddle repair"):
            follow(path, SETTINGS, noted, recorder=process, watch_sensors=False)
    assert noted.told == ["snapshot"]  # of the sensors nothing, as they are not watched
    assert noted.taken == [4]


class Spans(AlignedRecording):
    """Writes down what is read."""

    def __init__(self, recording: Recording) -> None:
        self.spans: list[tuple[int, int]] = []
        super().__init__(recording)

    def read(self, start: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Read it."""
        self.spans.append((start, stop))
        return super().read(start, stop)


def test_what_overlaps_is_read_once_as_long_as_clocks_stay(tmp_path: Path) -> None:
    with growing(tmp_path / "run.h5") as writer:
        Bench(writer).send("ABC", 6)
        with Recording.open(writer.path) as recording:
            aligned = Spans(recording)
            newest = NewestSamples(aligned)
            found = [newest.read(begin, begin + 400) for begin in (0, 200, 400)]
            aligned.set_clocks()
            found.append(newest.read(600, 1000))
            assert aligned.spans == [(0, 400), (400, 600), (600, 800), (600, 1000)]
            for number, (samples, valid) in enumerate(found):
                expected = AlignedRecording.read(aligned, 200 * number, 200 * number + 400)
                np.testing.assert_array_equal(samples, expected[0])
                np.testing.assert_array_equal(valid, expected[1])


def test_a_process_that_closes_its_recording_as_it_ends_has_a_result(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        bench, noted = Bench(writer), Noted()

        def end() -> None:
            bench.send("ABC", 30)
            writer.close()
            process.ended = True

        process = Process(end)
        result = follow(path, SETTINGS, noted, recorder=process, watch_sensors=False)
    assert result is not None
    assert result.n_segments > 20


@pytest.mark.skipif(sys.platform == "win32", reason="no locks are seen there")
@pytest.mark.parametrize("started_here", [True, pytest.param(False, marks=pytest.mark.long)])
def test_what_the_disk_refused_is_followed_into_the_next_file(
    tmp_path: Path, started_here: bool
) -> None:
    path = tmp_path / "run.h5"
    unrelated = tmp_path / "run-2.h5"
    with growing(unrelated) as writer:
        Bench(writer).send("ABC", 30)
        writer.close()
    with growing(path, duration=600.0) as first:
        Bench(first).send("ABC", 30)
        with growing(tmp_path / "run-3.h5", continues=first.run_id) as second:
            noted, bench = Noted(), Bench(second)
            steps: list[Callable[[], object]] = [
                first.abandon,
                partial(bench.send, "ABC", 20),
                second.close,
            ]
            stages = iter(steps)

            def goes_on() -> None:
                next(stages)()

            noted.cancelled = Goes(goes_on)
            recorder = Process(goes_on) if started_here else None
            result = follow(path, SETTINGS, noted, recorder=recorder, cancelled=noted.cancelled)
    assert result is not None
    assert result.closed
    assert noted.seen[-1].closed
    assert len({status.started_utc_ns for status in noted.seen}) == 1  # its time goes on
    for status in noted.seen[:-1]:
        assert status.ends_in == pytest.approx(600.0 - status.elapsed)
    if started_here:  # the same files again
        return
    alone = [estimate([tmp_path / name], SETTINGS) for name in ("run.h5", "run-3.h5")]
    assert alone[0].n_segments == result.n_segments  # given the first, it finds the other
    assert result.n_segments > alone[1].n_segments > 10
    said = [(source.path.name, source.state) for source in sources([path])]
    assert said == [("run.h5", "continued"), ("run-3.h5", "closed")]
    both = estimate([path, tmp_path / "run-3.h5"], SETTINGS)
    assert both.n_segments == result.n_segments
    np.testing.assert_array_equal(both.csm, result.csm)


def test_more_sensors_than_memory_allows_wait_for_the_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "LARGE", 0.0)
    monkeypatch.setattr(memory, "PART_BYTES", 0.0)
    monkeypatch.setattr(memory, "MIN_SENSORS", 2)
    with growing(tmp_path / "run.h5") as writer:
        noted = Noted()
        Bench(writer).send("ABC", 30)
        process = Process(writer.close)
        result = follow(writer.path, SETTINGS, noted, recorder=process)
    live, last = noted.snapshots
    assert live.sensor_names == ("A", "B")
    assert live.not_estimated == ("C",)
    assert live_remarks(live)[0].startswith("Live estimate of the first 2 of 3 sensors")
    assert result is last
    assert last.not_estimated == ()
    np.testing.assert_array_equal(last.csm, estimate([writer.path], SETTINGS).csm)


def test_an_observer_that_decides_by_the_estimate_gets_all_sensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("LARGE", "PART_BYTES", "MIN_SENSORS"):
        monkeypatch.setattr(memory, limit, 0)
    with growing(tmp_path / "run.h5") as writer:
        noted = Noted()
        Bench(writer).send("ABC", 30)
        follow(writer.path, SETTINGS, noted, recorder=Process(writer.close), whole=True)
    assert [live.not_estimated for live in noted.snapshots] == [(), ()]


def test_without_sensors_to_watch_the_next_look_is_when_a_segment_can_be_there(
    tmp_path: Path,
) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        bench, noted = Bench(writer), Noted()
        steps: list[Callable[[], object]] = [partial(bench.send, "ABC", 1)]
        steps += [partial(bench.send, "ABC", 3), writer.close]

        def go_on() -> None:
            steps.pop(0)()

        process = Process(go_on)
        settings = replace(SETTINGS, segment=6.0)
        with pytest.raises(InsufficientDataError):
            follow(path, settings, noted, recorder=process, watch_sensors=False)
    # The demo's bench runs at four times real time; each commit adds about a second.
    # Looks, a few milliseconds each, may take 3 % of the time, which can make a wait longer.
    speed = 4.0
    for waited, lacking in zip(process.waits, (6.0, 5.0, 3.0), strict=True):
        assert waited >= max(SHORTEST_INTERVAL, (lacking - COMMIT_INTERVAL) / speed) - 1e-9
        assert waited <= MAX_INTERVAL
