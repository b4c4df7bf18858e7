"""Following a recording: looks between segments, the estimate when there is news, the end."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.estimation import estimation as memory
from daq.estimation import follow as following
from daq.estimation import noise_estimates, snapshot_builder
from daq.estimation.estimation import Estimation, estimate
from daq.estimation.follow import (
    COMMIT_INTERVAL,
    MAX_INTERVAL,
    SHORTEST_INTERVAL,
    STATUS_INTERVAL,
    RecordingLeftOpenError,
    follow,
)
from daq.estimation.segments.segment_pass import NewestSamples
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.estimation.throttle import Throttle
from daq.recording.control import Command, serve
from daq.recording.monitor import RecordingStatus
from daq.recording.reader import Recording
from daq.results.facts.recordings import NotInLiveEstimate
from daq.results.result import Result
from daq.results.sources import sources, uncounted_events
from estimator.errors import InsufficientDataError
from tests import known_clocks
from tests.daq.recording.sending_bench import Bench
from tests.known_clocks import Scene
from tests.tui.example_snapshot import SETTINGS, growing
from tests.waiting import limit


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
    """Keeps the calls it receives, in order."""

    cancelled: threading.Event = field(default_factory=NoWait)
    wanted: int = 10**9
    """Looks after which it has seen enough."""
    calls: list[str] = field(default_factory=list)
    seen: list[RecordingStatus] = field(default_factory=list)
    snapshots: list[Snapshot] = field(default_factory=list)
    taken: list[int] = field(default_factory=list)

    def status(self, status: RecordingStatus) -> None:
        """Count it."""
        self.calls.append("look")
        self.seen.append(status)
        if len(self.seen) >= self.wanted:
            self.cancelled.set()

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Keep it."""
        assert settings.segment > 0
        self.calls.append("snapshot")
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


def closed(path: Path, seconds: float) -> Path:
    """Write a recording of so many seconds, and close it."""
    with growing(path) as writer:
        Bench(writer).send("ABC", seconds)
        writer.close()
    return path


def test_an_estimate_is_made_only_when_a_segment_has_come(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        bench, noted = Bench(writer), Noted(wanted=4)
        bench.send("ABC", 6)
        assert follow(path, SETTINGS, noted, cancelled=noted.cancelled) is None
    assert noted.calls == ["look", "look", "snapshot", "look", "look"]
    assert noted.seen[-1].elapsed >= 6


def test_the_dimension_is_chosen_again_beside_the_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes seconds: estimates with new segments do not wait for it."""
    monkeypatch.setattr(following, "LOOK_SHARE", 1e9)  # nobody waits here
    path = tmp_path / "run.h5"
    settings = replace(SETTINGS, methods=("maximum-likelihood",), dimension="auto")
    choose, is_seen = noise_estimates.chosen_dimensions, threading.Event()
    chosen: list[bool] = []

    def counted(*arguments: Any) -> noise_estimates.Dimensions:  # noqa: ANN401
        is_beside = threading.current_thread() is not threading.main_thread()
        chosen.append(is_beside)
        if is_beside:  # as long as it takes: until a segment has come after it was begun
            assert is_seen.wait(limit())
        return choose(*arguments)

    class Waiting(Noted):
        def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
            super().snapshot(snapshot, settings)
            if len(self.snapshots) == 3:
                is_seen.set()
            if len(self.snapshots) == 4:
                self.cancelled.set()

    for module in (noise_estimates, snapshot_builder):
        monkeypatch.setattr(module, "chosen_dimensions", counted)
    with growing(path) as writer:
        bench, seconds = Bench(writer), iter((41, 43, 45, 47))
        bench.send("ABC", 20)
        noted = Waiting(cancelled=Goes(lambda: bench.send("ABC", next(seconds))))
        follow(path, settings, noted, cancelled=noted.cancelled, share=1e6)
    assert chosen == [False, True]


def test_a_choice_that_is_refused_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sensor may have become a copy of another one: the dimension stays the last one."""
    monkeypatch.setattr(following, "LOOK_SHARE", 1e9)  # nobody waits here
    settings = replace(SETTINGS, methods=("maximum-likelihood",), dimension="auto")
    refused = threading.Event()

    def refuses(*arguments: object) -> noise_estimates.Dimensions:
        del arguments
        refused.set()
        raise InsufficientDataError("2 sensors have a signal of their own; expected at least 3")

    monkeypatch.setattr(snapshot_builder, "chosen_dimensions", refuses)
    with growing(tmp_path / "run.h5") as writer:
        bench, seconds = Bench(writer), iter((41, 43, 45, 47))
        bench.send("ABC", 20)

        class Waiting(Noted):
            def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
                super().snapshot(snapshot, settings)
                if len(self.snapshots) == 3:
                    assert refused.wait(limit())
                if len(self.snapshots) == 4:
                    self.cancelled.set()

        noted = Waiting(cancelled=Goes(lambda: bench.send("ABC", next(seconds))))
        follow(writer.path, settings, noted, cancelled=noted.cancelled, share=1e6)
    assert len(noted.snapshots) == 4
    assert "maximum-likelihood" in noted.snapshots[-1].results


def test_the_end_is_one_result(tmp_path: Path) -> None:
    noted = Noted()
    result = follow(closed(tmp_path / "run.h5", 30), SETTINGS, noted)
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


async def test_samples_that_a_sensor_does_not_count_become_an_event_of_the_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "LOOK_SHARE", 1e9)  # nobody waits here
    path, heard = tmp_path / "run.h5", list[str]()
    scene = Scene(rates=(50.0, 50.0, 50.0), seconds=200.0, slips={1: [(100.0, 1)]})

    async def answer(command: Command, text: str) -> dict[str, Any]:
        heard.extend([text] * (command is Command.UNCOUNTED))
        return {"sensors": {}}

    async with serve(answer) as address:
        grows = known_clocks.growing(path, scene, every=50.0, control=address)
        next(grows)
        noted = Noted(cancelled=Goes(lambda: next(grows, None)))
        process = Process(lambda: next(grows, None))
        result = await asyncio.to_thread(
            follow, path, Settings(), noted, recorder=process, cancelled=noted.cancelled, share=1e9
        )
    (said,) = heard
    utc_ns, within, n_samples, sensor = said.split()
    assert (sensor, n_samples) == ("B", "1")
    assert abs(known_clocks.seconds_of(int(utc_ns)) - 100.0) <= float(within) < 15.0
    assert result is not None
    (event,) = uncounted_events(result.clocks)
    assert event.sensor == "B"


def test_a_result_that_is_not_wanted_is_not_computed(tmp_path: Path) -> None:
    noted, path = Noted(wanted=1), closed(tmp_path / "run.h5", 30)
    assert follow(path, SETTINGS, noted, cancelled=noted.cancelled) is None
    assert not noted.snapshots


def test_too_short_a_recording_says_so(tmp_path: Path) -> None:
    noted, path = Noted(), closed(tmp_path / "run.h5", 1)
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
    assert "snapshot" not in noted.calls


def test_a_process_that_ends_without_closing_its_recording_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        bench, noted = Bench(writer), Noted()
        bench.send("ABC", 6)

        def be_killed() -> None:
            process.ended = True

        process = Process(be_killed)
        with pytest.raises(RecordingLeftOpenError, match="huddle repair"):
            follow(path, SETTINGS, noted, recorder=process, states_every=None)
    assert noted.calls == ["snapshot"]  # of the sensors nothing, as they are not watched
    assert noted.taken == [4]


def test_a_process_that_closes_its_recording_as_it_ends_has_a_result(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with growing(path) as writer:
        bench, noted = Bench(writer), Noted()

        def end() -> None:
            bench.send("ABC", 30)
            writer.close()
            process.ended = True

        process = Process(end)
        result = follow(path, SETTINGS, noted, recorder=process, states_every=None)
    assert result is not None
    assert result.n_segments > 20


@pytest.mark.skipif(sys.platform == "win32", reason="no locks are seen there")
@pytest.mark.parametrize("started_here", [True, pytest.param(False, marks=pytest.mark.long)])
def test_what_the_disk_refused_is_followed_into_the_next_file(
    tmp_path: Path, started_here: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(following, "LOOK_SHARE", 1e9)  # nobody waits here
    path = tmp_path / "run.h5"
    closed(tmp_path / "run-2.h5", 30)  # unrelated
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
        assert status.until.duration == 600.0
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
    monkeypatch.setattr(memory, "LIVE", 0.0)
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
    (left_out,) = [
        each for each in Result(live, Settings()).facts if isinstance(each, NotInLiveEstimate)
    ]
    assert left_out.sensors == ("C",)
    assert left_out.n_all == 3
    assert result is last
    assert last.not_estimated == ()
    np.testing.assert_array_equal(last.csm, estimate([writer.path], SETTINGS).csm)


def test_a_test_whose_sensor_never_sent_ends_with_the_result_of_the_others(tmp_path: Path) -> None:
    with growing(tmp_path / "run.h5") as writer:
        noted, settings = Noted(), replace(SETTINGS, methods=("auto",))
        Bench(writer).send("AB", 30)
        result = follow(writer.path, settings, noted, recorder=Process(writer.close))
    assert result is noted.snapshots[-1]
    assert (result.sensor_names, result.not_estimated) == (("A", "B"), ("C",))
    np.testing.assert_array_equal(result.csm, estimate([writer.path], settings).csm)


def test_an_observer_that_decides_by_the_estimate_gets_all_sensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("LIVE", "PART_BYTES", "MIN_SENSORS"):
        monkeypatch.setattr(memory, name, 0)
    with growing(tmp_path / "run.h5") as writer:
        noted = Noted()
        Bench(writer).send("ABC", 30)
        follow(writer.path, SETTINGS, noted, recorder=Process(writer.close), whole=True)
    assert [live.not_estimated for live in noted.snapshots] == [(), ()]


def test_estimates_delay_no_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An estimate costs three seconds: its own limit holds it up, not that of the looks."""
    at = 0.0

    def slowly(estimation: Estimation) -> Snapshot:
        nonlocal at
        at += 3.0
        return made(estimation)

    made = Estimation.snapshot
    monkeypatch.setattr(Estimation, "snapshot", slowly)
    monkeypatch.setattr("daq.estimation.follow.Throttle", partial(Throttle, now=lambda: at))
    monkeypatch.setattr("daq.estimation.throttle.time.process_time", lambda: 0.0)
    with growing(tmp_path / "run.h5") as writer:
        Bench(writer).send("ABC", 30)
        process = Process(writer.close)
        follow(writer.path, SETTINGS, Noted(), recorder=process)
    assert at == 3.0
    assert process.waits[0] <= STATUS_INTERVAL


def test_new_segments_delay_no_look_at_the_sensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A segment costs a second: the next one waits half a minute, the sensors do not."""
    at = 0.0

    def slowly(estimation: Estimation, progress: Callable[[int, int], None]) -> bool:
        nonlocal at
        at += 1.0
        return made(estimation, progress)

    made = Estimation.update
    monkeypatch.setattr(Estimation, "update", slowly)
    monkeypatch.setattr("daq.estimation.follow.Throttle", partial(Throttle, now=lambda: at))
    monkeypatch.setattr("daq.estimation.throttle.time.process_time", lambda: 0.0)
    with growing(tmp_path / "run.h5") as writer:
        bench, noted = Bench(writer), Noted()
        steps: list[Callable[[], object]] = [partial(bench.send, "ABC", t) for t in range(9, 54, 9)]
        steps.append(writer.close)
        stages = iter(steps)

        def goes_on() -> None:
            next(stages)()

        process = Process(goes_on)
        follow(writer.path, SETTINGS, noted, recorder=process)
    assert max(process.waits) <= STATUS_INTERVAL
    assert at == 2.0  # the first, and the last when it is closed
    seen = [status.sensors[0].n_samples for status in noted.seen]
    assert seen == [0, *range(0, 9001, 1800), 9000]


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
            follow(path, settings, noted, recorder=process, states_every=None)
    # The demo's bench runs at four times real time; each commit adds about a second.
    # Looks, a few milliseconds each, may take 3 % of the time, which can make a wait longer.
    speed = 4.0
    for waited, lacking in zip(process.waits, (6.0, 5.0, 3.0), strict=True):
        assert waited >= max(SHORTEST_INTERVAL, (lacking - COMMIT_INTERVAL) / speed) - 1e-9
        assert waited <= MAX_INTERVAL


# --- a recording that grows: first segments, what is read again ------------------------------


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


class Spans(AlignedRecording):
    """Writes down what is read."""

    def __init__(self, recording: Recording) -> None:
        self.spans: list[tuple[int, int]] = []
        super().__init__(recording)

    def read(
        self, start: int, stop: int, *, is_final: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Read it."""
        self.spans.append((start, stop))
        return super().read(start, stop, is_final=is_final)


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


def test_a_large_estimate_is_announced_before_it_starts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.estimation.estimation.LARGE", 1.0)
    with growing(tmp_path / "run.h5") as writer:
        Bench(writer).send("ABC", 3)
        with Estimation([writer.path], SETTINGS):
            assert "takes about" in caplog.text
        caplog.clear()
        with Estimation([writer.path], SETTINGS, live=True):
            assert not caplog.text


# --- repeated work takes its share of the time -----------------------------------------------


def test_work_that_takes_long_makes_the_next_wait() -> None:
    at = 100.0
    throttle = Throttle(0.1, now=lambda: at)
    assert throttle.is_due  # the first
    taken, times = 0.0, 0
    for second in range(1000):
        at = 100.0 + second
        if throttle.is_due:
            assert throttle.remaining == 0
            with throttle:
                at += 2.5
            assert throttle.remaining == 22.5
            taken, times = taken + 2.5, times + 1
    assert times == 40  # once in 25 s
    assert taken <= 0.1 * 1000


def test_quick_work_is_done_every_time() -> None:
    at = 0.0
    throttle = Throttle(0.1, now=lambda: at)
    for second in range(0, 100, 5):
        at = float(second)
        assert throttle.is_due
        with throttle:
            at += 0.4


def test_work_that_is_limited_elsewhere_delays_nothing() -> None:
    at = 0.0
    throttle = Throttle(0.1, now=lambda: at)
    with throttle:
        at += 1.3
        throttle.deduct(0.9)
    assert throttle.cost == 1.3 - 0.9
    at = 4.01
    assert throttle.is_due
    with throttle:
        at += 1.3
    assert throttle.cost == pytest.approx(1.3)  # deducted once


def test_what_is_due_after_a_time_waits_no_longer() -> None:
    at = 0.0
    throttle = Throttle(0.1, longest=2.0, now=lambda: at)
    with throttle:
        at += 5.0
    assert throttle.remaining == 2.0
