"""The recorder, with devices the test plays: what comes, what is lost, what returns."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.errors import NotConnectedError
from daq.protocols.block import Event, EventKind
from daq.recorder.block_writer import MAX_TEXTS
from daq.recorder.connection import CLOSE_TIMEOUT
from daq.recorder.recorder import RecorderStatus, record
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.sensor_state import SensorState
from tests.scripted_driver import ManualClock, PlayedDevice, PlayedDriver, bench, block, counts

pytestmark = pytest.mark.virtual_time


LOST = (SensorState.DISCONNECTED, SensorState.WAITING)
"""Lost, and soon connected again."""


class Run:
    """A recorder in a task, its devices, and what it acknowledged."""

    def __init__(self, path: Path, *names: str, **ports: str) -> None:
        self.path = path
        self.bench = bench(*names, **ports)
        self.clock = ManualClock()
        self.driver = PlayedDriver({port: PlayedDevice() for port in self.bench.ports()})
        self.stop = asyncio.Event()
        self.statuses: list[RecorderStatus] = []
        self.news = asyncio.Event()
        self.duration: float | None = None
        self.anyway = False

    def device(self, port: str) -> PlayedDevice:
        """Return what is on a port."""
        return self.driver.devices[port]

    async def record(self) -> RecorderStatus:
        """Run the recorder."""
        return await record(
            self.bench,
            self.path,
            duration=self.duration,
            anyway=self.anyway,
            clock=self.clock,
            stop=self.stop,
            acknowledged=self._acknowledged,
            drivers=self.driver.find,
        )

    def _acknowledged(self, status: RecorderStatus) -> None:
        self.statuses.append(status)
        self.news.set()

    @contextlib.asynccontextmanager
    async def going(self) -> AsyncIterator[asyncio.Task[RecorderStatus]]:
        """Run it in the background until told to stop."""
        task = asyncio.create_task(self.record())
        try:
            yield task
            self.stop.set()
            await task
        finally:
            task.cancel()
            await asyncio.wait([task])

    def texts(self, kind: str = "") -> list[str]:
        """Return what the events of the recording say, or those of one kind."""
        with Recording.open(self.path) as recording:
            return [event.text for event in recording.events if kind in {"", event.kind}]

    async def until(self, sensor: str, samples: int, *states: SensorState) -> None:
        """Wait for an acknowledgment with one of these states, ``LIVE`` if none is given."""
        while not self._is(sensor, samples, states or (SensorState.LIVE,)):
            self.news.clear()
            await self.news.wait()

    def _is(self, sensor: str, samples: int, states: tuple[SensorState, ...]) -> bool:
        if not self.statuses:
            return False
        now = self.statuses[-1].sensors[sensor]
        return now.samples >= samples and now.state in states

    async def sent(self, sensor: str, first: int, n: int, until: int | None = None) -> None:
        """Send samples, and wait until the last of them, or `until`, is recorded."""
        self.send(sensor, first, n)
        await self.until(sensor, first + n if until is None else until)

    def send(self, sensor: str, first: int, n: int) -> None:
        """Let a device take samples and send them."""
        self.clock.advance(n / 100.0)
        port = self.bench.sensor(sensor).port
        self.device(port).items.put_nowait(block(sensor, first, n, self.clock.now()))


async def test_every_sensor_is_recorded(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    async with run.going():
        for first in range(0, 300, 30):
            run.send("a", first, 30)
            run.send("b", first, 30)
        await run.until("b", 270)
    final = run.statuses[-1]
    assert final.closed
    assert all(run.device(name).left_quiet for name in "ab")
    report = verify(run.path)
    assert report.closed
    assert report.intact
    with Recording.open(run.path) as recording:
        for sensor in recording.sensors:
            np.testing.assert_array_equal(sensor.counts(), counts(0, 300))
            assert sensor.serial_number == "1"
        kinds = [(event.sensor, event.kind) for event in recording.events]
        assert kinds[0] == ("", "started")
        assert sorted(kinds[1:3]) == [("a", "connected"), ("b", "connected")]
        assert ("", "clock") in kinds
        assert kinds[-1] == ("", "stopped")


async def test_a_lost_device_returns_and_the_other_continues(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    async with run.going():
        await run.sent("a", 0, 200)
        run.device("a").items.put_nowait(NotConnectedError("cable"))
        await run.until("a", 200, *LOST)
        await run.sent("b", 0, 400)
        # 400 samples went by meanwhile; these come in a session of their own.
        await run.sent("a", 0, 100, 300)
    assert run.device("a").n_sessions == 2
    assert run.device("b").n_sessions == 1
    with Recording.open(run.path) as recording:
        a, b = recording.sensors
        (gap,) = a.gaps
        assert (gap["first_sample"], gap["missing"], gap["estimated"]) == (200, 400, 1)
        assert gap["reason"] == b"disconnected"
        assert a.blocks["first_sample"].tolist() == [0, 600]
        assert len(b.gaps) == 0
        said = [(e.kind, e.text) for e in recording.events if e.sensor == "a"]
        assert [kind for kind, _ in said] == ["connected", "disconnected", "connected"]
        assert said[1][1] == "cable"


async def test_a_stalled_device_is_detected_and_reconnected(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.send("a", 0, 100)
        await run.sent("a", 100, 100)
        # Nothing comes any more, and nothing says so.
        await run.until("a", 200, SensorState.LATE)
        await run.until("a", 200, SensorState.STALLED, SensorState.WAITING)
        await run.sent("a", 0, 100, 300)
    with Recording.open(run.path) as recording:
        kinds = [event.kind for event in recording.events if event.sensor == "a"]
        assert kinds == ["connected", "late", "stalled", "connected"]


async def test_one_lost_block_only_makes_a_sensor_late(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.send("a", 0, 50)
        run.send("a", 50, 50)
        await run.until("a", 100, SensorState.LATE)
        run.clock.advance(0.5)
        await run.sent("a", 150, 100, 200)
    assert run.device("a").n_sessions == 1
    with Recording.open(run.path) as recording:
        assert [e.kind for e in recording.events if e.sensor == "a"] == ["connected"]
        (gap,) = recording.sensors[0].gaps
        assert (gap["first_sample"], gap["missing"], gap["estimated"]) == (100, 50, 0)


async def test_events_of_the_decoder_do_not_make_a_sensor_lost(tmp_path: Path) -> None:
    """Decoders call an answer or a block refused, too."""
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        await run.sent("a", 0, 100)
        for kind in (EventKind.REFUSED, EventKind.STALLED, EventKind.DISCONNECTED):
            run.device("a").items.put_nowait(Event("a", kind, "a block", run.clock.now()))
        run.device("a").items.put_nowait(Event("a", "status", "last", run.clock.now()))
        n_statuses = len(run.statuses)
        while len(run.statuses) < n_statuses + 2:
            run.news.clear()
            await run.news.wait()
        assert not run.statuses[-1].sensors["a"].state.is_lost


async def test_a_faulty_block_ends_only_its_sensors_session(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    async with run.going():
        run.send("a", 0, 100)
        run.send("b", 0, 100)
        await run.until("a", 100)
        wrong = replace(block("a", 100, 10, run.clock.now()), counts=np.full((10, 2), 0.5))
        run.device("a").items.put_nowait(wrong)
        await run.until("a", 100, *LOST)
        run.send("b", 100, 100)
        await run.sent("a", 0, 100, 200)
        await run.until("b", 200)
    assert run.statuses[-1].closed
    assert verify(run.path).intact
    assert run.texts("disconnected") == [
        "a: driver 'played' yielded counts of type float64 that do not fit int32"
    ]


async def test_an_item_that_is_no_block_ends_only_its_session(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    items: asyncio.Queue[Any] = run.device("a").items
    async with run.going():
        items.put_nowait(b"raw bytes")
        items.put_nowait(Event("c", "status", "of nobody", run.clock.now()))
        await run.sent("a", 0, 100)
    assert run.texts("disconnected") == [
        "a: driver 'played' yielded bytes; expected a Block, an Event or a Reading",
        "a: driver 'played' yielded an event of 'c'; expected 'a'",
    ]


async def test_a_driver_that_does_not_close_its_session_does_not_delay_the_end(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    run.device("a").hangs = True
    async with run.going():
        await run.sent("a", 0, 100)
    assert run.statuses[-1].closed
    assert run.device("b").left_quiet
    assert f"the driver did not close its session within {CLOSE_TIMEOUT:g} s" in run.texts()


async def test_a_driver_that_cannot_be_cancelled_is_abandoned(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").may_end = may_end = asyncio.Event()
    async with run.going():
        await run.sent("a", 0, 100)
    assert run.statuses[-1].closed
    assert "the driver on a does not end; it was abandoned" in run.texts()
    (left,) = [task for task in asyncio.all_tasks() if task.get_name() == "a"]
    may_end.set()
    await asyncio.wait([left])


async def test_repeated_blocks_are_recorded_once(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.send("a", 0, 100)
        run.send("a", 0, 100)
        run.send("a", 50, 150)
        await run.sent("a", 190, 10)
    with Recording.open(run.path) as recording:
        np.testing.assert_array_equal(recording.sensors[0].counts(), counts(0, 200))
    assert [text.split()[0] for text in run.texts("resynchronised")] == ["100", "150"]


async def test_an_error_in_a_driver_affects_only_its_device(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    async with run.going():
        run.send("a", 0, 100)
        run.send("b", 0, 100)
        await run.until("a", 100)
        run.device("a").items.put_nowait(ZeroDivisionError("a bug"))
        await run.sent("a", 0, 100, 200)
    assert "a bug" in run.texts("disconnected")


async def test_the_duration_is_measured_in_device_time(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    run.duration = 2.0
    run.send("a", 0, 200)
    run.send("b", 0, 150)
    run.send("b", 150, 50)
    status = await run.record()
    assert status.closed
    assert [sensor.samples for sensor in status.sensors.values()] == [200, 200]


async def test_the_run_does_not_wait_for_a_lost_sensor_beyond_the_duration(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    run.duration = 2.0
    async with run.going() as task:
        run.send("b", 0, 100)
        run.device("b").items.put_nowait(NotConnectedError("cable"))
        await run.until("b", 100, *LOST)
        run.device("b").failure = NotConnectedError("still away")
        run.clock.advance(5.0)
        status = await task
    assert status.sensors["b"].missing == 500
    with Recording.open(run.path) as recording:
        (gap,) = recording.sensor("b").gaps
        assert gap["reason"] == b"lost at the end"


async def test_sensors_on_one_port_share_a_session(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b", a="bus", b="bus")
    async with run.going():
        run.send("a", 0, 100)
        await run.sent("b", 0, 100)
        await run.until("a", 100)
    assert run.device("bus").n_sessions == 1


async def test_a_device_full_of_events_does_not_fill_the_file(tmp_path: Path) -> None:
    """Ten events a second for 100 s that say the same, other kinds, and texts without end."""
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        begin = run.clock.now()
        items = run.device("a").items
        for k in range(1000):
            at = replace(begin, monotonic_ns=begin.monotonic_ns + k * 10**8)
            items.put_nowait(Event("a", "refused", f"device busy ({k + 1} so far)", at))
            if k % 100 == 0:  # a device that comes back is not folded
                items.put_nowait(Event("a", "connected", "answers again", at))
        items.put_nowait(Event("a", "status", "another kind", begin))
        for k in range(1000):
            letters = "".join(chr(97 + int(c)) for c in str(k))
            items.put_nowait(Event("a", "checksum", f"noise {letters}", begin))
        await run.sent("a", 0, 100)
    with Recording.open(run.path) as recording:
        events = [e for e in recording.events if e.sensor == "a"]
    assert len([e for e in events if e.text == "answers again"]) == 10
    texts = [e.text for e in events if e.kind == "refused"]
    assert texts[:4] == [
        "device busy (1 so far)",
        "device busy (11 so far), 10 times in 1 s",
        "device busy (31 so far), 20 times in 2 s",
        "device busy (71 so far), 40 times in 4 s",
    ]
    assert len(texts) == 8
    folded = [re.search(r", (\d+) times", text) for text in texts[1:]]
    assert sum(int(each[1]) for each in folded if each) == 999
    assert [e.text for e in events if e.kind == "status"] == ["another kind"]
    assert len([e for e in events if e.kind == "checksum"]) == MAX_TEXTS + 1
