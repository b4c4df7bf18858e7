"""States of sensors while a recording grows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from daq.bench.end_condition import EndCondition
from daq.recording.monitor import RecordingMonitor, SensorStatus
from daq.recording.reader import Recording
from tests.daq.recording.sending_bench import Bench
from tests.tui.example_snapshot import growing, made_now


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
        assert seen.n_gaps == 1
        assert seen.n_missing == pytest.approx(6.5 * seen.sampling_rate, rel=0.05)
        assert look()["A"].n_missing == 0
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
        rate = lost.sensors[0].sampling_rate
        assert [s.n_missing for s in later.sensors] == pytest.approx(
            [s.n_missing + 60 * speed * rate for s in lost.sensors]
        )


@pytest.mark.parametrize("duration", [60.0, None])
def test_what_ends_by_itself_says_when(tmp_path: Path, duration: float | None) -> None:
    path = tmp_path / "run.h5"
    with growing(path, duration=duration) as writer, Recording.open(path) as recording:
        Bench(writer).send("ABC", 8)
        recording.refresh()
        now = RecordingMonitor(recording).status()
        assert now.until == EndCondition(duration)
        assert now.in_local_time(60.0) is None  # faster than real time: no clock shows it
        at = replace(now, speed=1.0).in_local_time(60 - now.elapsed)
        assert at is not None
        assert at.timestamp() == pytest.approx(recording.created_at.utc_ns * 1e-9 + 60)
        writer.close()


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


def test_a_moment_to_come_is_counted_from_what_was_recorded() -> None:
    now = made_now(elapsed=100.0)
    moment = now.in_local_time(20.0)
    assert moment is not None
    assert moment.timestamp() == pytest.approx(now.started_utc_ns * 1e-9 + 120.0, rel=0, abs=1e-3)
    assert now.in_local_time(None) is None
    assert replace(now, speed=8.0).in_local_time(20.0) is None  # it is not in real time
