"""The recorder, with devices the test plays: what comes, what is lost, what returns."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from daq.acquisition.block_writer import MAX_EVENTS_PER_SECOND
from daq.acquisition.connection import CLOSE_TIMEOUT
from daq.acquisition.recorder import RecorderStatus, record
from daq.errors import (
    DeviceError,
    NoAnswerError,
    NotConnectedError,
    RecordingError,
    WrongDeviceError,
)
from daq.protocols.block import Event, EventKind
from daq.protocols.errors import RemoteProtocolError
from daq.recording.control import ControlRefusedError, ask
from daq.recording.reader import Recording, control_address
from daq.recording.repair import verify
from daq.recording.sensor_state import SensorState
from daq.recording.storage.names import recording_path
from tests.scripted_driver import ManualClock, PlayedDevice, PlayedDriver, bench, block, counts
from tests.waiting import limit

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

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

    def device(self, port: str) -> PlayedDevice:
        """Return what is on a port."""
        return self.driver.devices[port]

    async def record(self) -> RecorderStatus:
        """Run the recorder."""
        return await record(
            self.bench,
            self.path,
            duration=self.duration,
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
        assert kinds[-1] == ("", "stopped")


async def test_all_failures_at_the_start_are_reported_together(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b", "c")
    run.device("a").failure = NotConnectedError("sensor 'a' on a: no such port")
    run.device("c").failure = NoAnswerError("sensor 'c' on c: no answer")
    with pytest.RaisesGroup(
        pytest.RaisesExc(NotConnectedError, match="'a'"),
        pytest.RaisesExc(NoAnswerError, match="'c'"),
    ):
        await run.record()
    assert not run.path.exists()
    assert run.device("b").left_quiet


async def test_a_protocol_error_at_the_start_is_a_device_error(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").failure = RemoteProtocolError("a reply of 3 bytes; expected 5")
    with pytest.RaisesGroup(pytest.RaisesExc(DeviceError, match="port a: a reply of 3 bytes")):
        await run.record()


async def test_a_lost_device_returns_and_the_other_continues(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    async with run.going():
        run.send("a", 0, 200)
        await run.until("a", 200)
        run.device("a").items.put_nowait(NotConnectedError("cable"))
        await run.until("a", 200, *LOST)
        run.send("b", 0, 400)
        await run.until("b", 400)
        # 400 samples went by meanwhile; these come in a session of their own.
        run.send("a", 0, 100)
        await run.until("a", 300)
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
        run.send("a", 100, 100)
        await run.until("a", 200)
        # Nothing comes any more, and nothing says so.
        await run.until("a", 200, SensorState.LATE)
        await run.until("a", 200, SensorState.STALLED, SensorState.WAITING)
        run.send("a", 0, 100)
        await run.until("a", 300)
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
        run.send("a", 150, 100)
        await run.until("a", 200)
    assert run.device("a").n_sessions == 1
    with Recording.open(run.path) as recording:
        assert [e.kind for e in recording.events if e.sensor == "a"] == ["connected"]
        (gap,) = recording.sensors[0].gaps
        assert (gap["first_sample"], gap["missing"], gap["estimated"]) == (100, 50, 0)


async def test_events_of_the_decoder_do_not_make_a_sensor_lost(tmp_path: Path) -> None:
    """Decoders call an answer or a block refused, too."""
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.send("a", 0, 100)
        await run.until("a", 100)
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
        run.send("a", 0, 100)
        await run.until("a", 200)
        await run.until("b", 200)
    assert run.statuses[-1].closed
    assert verify(run.path).intact
    with Recording.open(run.path) as recording:
        assert [e.text for e in recording.events if e.kind == "disconnected"] == [
            "a: driver 'played' yielded counts of type float64 that do not fit int32"
        ]


async def test_an_item_that_is_no_block_ends_only_its_session(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    items: asyncio.Queue[Any] = run.device("a").items
    async with run.going():
        items.put_nowait(b"raw bytes")
        items.put_nowait(Event("c", "status", "of nobody", run.clock.now()))
        run.send("a", 0, 100)
        await run.until("a", 100)
    with Recording.open(run.path) as recording:
        assert [e.text for e in recording.events if e.kind == "disconnected"] == [
            "a: driver 'played' yielded bytes; expected a Block or an Event",
            "a: driver 'played' yielded an event of 'c'; expected 'a'",
        ]


async def test_a_driver_that_does_not_close_its_session_does_not_delay_the_end(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    run.device("a").hangs = True
    async with run.going():
        run.send("a", 0, 100)
        await run.until("a", 100)
    assert run.statuses[-1].closed
    assert run.device("b").left_quiet
    with Recording.open(run.path) as recording:
        assert f"the driver did not close its session within {CLOSE_TIMEOUT:g} s" in [
            e.text for e in recording.events if e.sensor == "a"
        ]


async def test_a_driver_that_cannot_be_cancelled_is_abandoned(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").may_end = may_end = asyncio.Event()
    async with run.going():
        run.send("a", 0, 100)
        await run.until("a", 100)
    assert run.statuses[-1].closed
    with Recording.open(run.path) as recording:
        assert "the driver on a does not end; it was abandoned" in [
            e.text for e in recording.events
        ]
    (left,) = [task for task in asyncio.all_tasks() if task.get_name() == "a"]
    may_end.set()
    await asyncio.wait([left])


async def test_a_silent_client_of_the_control_port_does_not_delay_the_end(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.send("a", 0, 100)
        await run.until("a", 100)
        address = control_address(run.path)
        assert address is not None
        reader, writer = await asyncio.open_connection("127.0.0.1", address[0])
        await asyncio.to_thread(ask, run.path, "stop")
    with contextlib.suppress(ConnectionError):
        assert await reader.read() == b""
    writer.close()
    with contextlib.suppress(ConnectionError):
        await writer.wait_closed()


async def test_another_device_on_the_port_is_refused(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    device = run.device("a")
    async with run.going():
        run.send("a", 0, 100)
        await run.until("a", 100)
        device.serial_number = "2"
        device.items.put_nowait(NotConnectedError("cable"))
        while device.n_sessions < 3:
            device.opened.clear()
            await device.opened.wait()
        device.serial_number = "1"
        run.send("a", 0, 100)
        await run.until("a", 200)
    with Recording.open(run.path) as recording:
        refused = [e.text for e in recording.events if e.kind == "refused"]
        assert refused == ["sensor 'a' on a: expected serial number '1', got '2'"]


async def test_a_wrong_rate_is_refused_at_the_start(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").sampling_rate = 200.0
    with pytest.RaisesGroup(pytest.RaisesExc(WrongDeviceError, match="expected 100 Hz")):
        await run.record()


async def test_a_slightly_different_rate_is_accepted(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").sampling_rate = 100.1
    async with run.going():
        run.send("a", 0, 200)
        await run.until("a", 200)
    with Recording.open(run.path) as recording:
        assert recording.sensors[0].sampling_rate == 100.1


async def test_repeated_blocks_are_recorded_once(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.send("a", 0, 100)
        run.send("a", 0, 100)
        run.send("a", 50, 150)
        run.send("a", 190, 10)
        await run.until("a", 200)
    with Recording.open(run.path) as recording:
        np.testing.assert_array_equal(recording.sensors[0].counts(), counts(0, 200))
        said = [e.text for e in recording.events if e.kind == "resynchronised"]
        assert [text.split()[0] for text in said] == ["100", "150"]


async def test_an_error_in_a_driver_affects_only_its_device(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    async with run.going():
        run.send("a", 0, 100)
        run.send("b", 0, 100)
        await run.until("a", 100)
        run.device("a").items.put_nowait(ZeroDivisionError("a bug"))
        run.send("a", 0, 100)
        await run.until("a", 200)
    with Recording.open(run.path) as recording:
        assert ("disconnected", "a bug") in [(e.kind, e.text) for e in recording.events]


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
        run.send("b", 0, 100)
        await run.until("b", 100)
        await run.until("a", 100)
    assert run.device("bus").n_sessions == 1


async def test_commands_of_the_control_port_are_executed(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going() as task:
        run.send("a", 0, 100)
        await run.until("a", 100)
        status = await asyncio.to_thread(ask, run.path, "status")
        assert status["sensors"]["a"]["samples"] == 100
        await asyncio.to_thread(ask, run.path, "mark", "a door\nslammed")
        address = control_address(run.path)
        assert address is not None
        port, token = address
        with pytest.raises(ControlRefusedError, match="wrong token"):
            await asyncio.to_thread(ask, (port, "0" * 32), "stop")
        with pytest.raises(ControlRefusedError, match="unknown command 'dance'"):
            await asyncio.to_thread(ask, (port, token), "dance")
        await asyncio.to_thread(ask, run.path, "stop")
        assert (await task).closed
    with pytest.raises(NotConnectedError, match="no recorder is writing it"):
        ask(run.path, "stop")
    with Recording.open(run.path) as recording:
        marks = [event.text for event in recording.events if event.kind == "mark"]
        assert marks == ["a door slammed"]
        assert recording.events[-1].text == "stopped by command"


async def test_invalid_requests_to_the_control_port_have_no_effect(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.send("a", 0, 100)
        await run.until("a", 100)
        address = control_address(run.path)
        assert address is not None
        port, _ = address
        for nonsense in (b"", b"\n", b"\xff" * 100 + b"\n", b"x" * 100_000):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            with contextlib.suppress(ConnectionError):
                writer.write(nonsense)
                writer.write_eof()
                await reader.read()
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
        assert (await asyncio.to_thread(ask, run.path, "status"))["closed"] is False


async def test_a_run_stopped_before_its_start_leaves_no_file(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.stop.set()
    status = await run.record()
    assert not status.closed
    assert not run.path.exists()


async def test_a_file_that_cannot_be_created_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "r.h5").write_text("precious", encoding="utf-8")
    run = Run(tmp_path / "r.h5", "a")
    with pytest.raises(RecordingError, match="exists already"):
        await run.record()
    assert run.device("a").left_quiet


async def test_an_event_of_a_device_is_recorded(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        run.device("a").items.put_nowait(Event("a", "checksum", "2 frames", run.clock.now()))
        run.send("a", 0, 100)
        await run.until("a", 100)
    with Recording.open(run.path) as recording:
        assert ("a", "checksum", "2 frames") in [
            (e.sensor, e.kind, e.text) for e in recording.events
        ]


async def test_a_device_full_of_events_does_not_fill_the_file(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        now = run.clock.now()
        for k in range(1000):
            run.device("a").items.put_nowait(Event("a", "checksum", f"noise {k}", now))
        run.device("a").items.put_nowait(Event("a", "status", "another kind", now))
        run.send("a", 0, 100)
        await run.until("a", 100)
    with Recording.open(run.path) as recording:
        texts = [e.text for e in recording.events if e.sensor == "a" and e.kind != "connected"]
    expected = [f"noise {k}" for k in range(MAX_EVENTS_PER_SECOND)]
    assert texts == [
        *expected,
        "another kind",
        f"{1000 - MAX_EVENTS_PER_SECOND} more events of this kind before",
    ]


FULL_DISK = """
import asyncio, resource, signal, sys
from daq.errors import RecordingError
from daq.acquisition.recorder import record
from tests.scripted_driver import ManualClock, PlayedDevice, PlayedDriver, bench, block

async def main():
    clock, driver = ManualClock(), PlayedDriver({"a": PlayedDevice()})
    for first in range(0, 1_000_000, 1000):
        driver.devices["a"].items.put_nowait(block("a", first, 1000, clock.now()))
    await record(bench("a"), sys.argv[1], clock=clock, drivers=driver.find)

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
try:
    asyncio.run(main())
except RecordingError as error:
    print(error, flush=True)
"""


def test_a_full_disk_ends_the_run_with_an_error(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    # A process of its own: HDF5 may crash the interpreter when it exits with what it cannot write.
    said = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(path)],
        check=False,
        capture_output=True,
        text=True,
        timeout=limit(),
    )
    assert said.stdout == f"{path}: cannot be written: File too large\n", said.stderr
    report = verify(path)
    assert report.intact
    assert not report.closed
    assert not path.with_stem("r-2").exists()  # which the disk refused, too


REFUSED_ONCE = """
import asyncio, os, resource, signal, sys
from daq.acquisition.recorder import record
from daq.host_clock import HostTime
from tests.scripted_driver import ManualClock, PlayedDevice, PlayedDriver, bench, block, counts

N = 300

async def main():
    clock, driver = ManualClock(), PlayedDriver({name: PlayedDevice() for name in "abc"})
    stop, sent = asyncio.Event(), 0
    samples = []

    def acknowledged(status):
        nonlocal sent
        samples.append(status.sensors["a"].samples)
        if status.path.endswith("-2.h5"):
            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)  # the disk takes files again
        if sent == N and samples[-1] >= 1000 * (N - 1):
            stop.set()
        for _ in range(min(10, N - sent)):
            clock.advance(10.0)
            for name in "abc":
                at = clock.now()
                driver.devices[name].items.put_nowait(block(name, 1000 * sent, 1000, at))
            sent += 1

    status = await record(
        bench(*"abc"), sys.argv[1], clock=clock, drivers=driver.find, stop=stop,
        acknowledged=acknowledged,
    )
    assert samples == sorted(samples)
    print(status.closed, status.sensors["a"].samples, status.path, flush=True)
    os._exit(0)  # as the command does: HDF5 cannot free what the disk refused

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, unlimited[1]))
asyncio.run(main())
"""


def test_a_recording_continues_in_another_file_after_a_disk_error(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    said = subprocess.run(
        [sys.executable, "-c", REFUSED_ONCE, str(path)],
        check=False,
        capture_output=True,
        text=True,
        timeout=limit(),
    )
    following = path.with_stem("r-2")
    assert said.stdout.split()[::2] == ["True", str(following)], said.stderr
    assert "cannot be written: File too large; the recording continues in" in said.stderr
    with Recording.open(path) as first, Recording.open(following) as second:
        assert not first.closed
        assert second.closed
        assert second.continues == first.run_id
        texts = [event.text for event in second.events]
        assert "continues r.h5, which could no longer be written" in texts
        for name in "abc":
            one, two = first.sensor(name), second.sensor(name)
            assert two.blocks["first_sample"][0] == 0
            expected = counts(0, 300_000)
            n = one.n_samples
            assert n > 1000
            assert np.array_equal(one.counts(), expected[:n])
            assert np.array_equal(two.counts(), expected[len(expected) - two.n_samples :])
            assert two.n_samples >= len(expected) - n  # nothing is lost between them


STUBBORN = """
import asyncio, functools, signal, sys
from daq.acquisition import connection, recorder
from tests.scripted_driver import PlayedDevice, PlayedDriver, bench

def interrupt(status):
    if not status.closed:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

connection.CLOSE_TIMEOUT, recorder.CANCEL_TIMEOUT = 0.1, 0.3
if "windows" in sys.argv:
    def not_here(*_):
        raise NotImplementedError
    asyncio.SelectorEventLoop.add_signal_handler = not_here
device = PlayedDevice(may_end=asyncio.Event() if "stubborn" in sys.argv else None)
driver = PlayedDriver({"a": device})
recorder.record = functools.partial(recorder.record, drivers=driver.find)
print(recorder.run(bench("a"), sys.argv[1], acknowledged=interrupt).closed, flush=True)
"""


@pytest.mark.parametrize("how", ["stubborn", "windows"])
def test_interrupted_twice_a_run_ends_properly_whatever_its_driver_does(
    tmp_path: Path, how: str
) -> None:
    path = tmp_path / "r.h5"
    said = subprocess.run(
        [sys.executable, "-c", STUBBORN, str(path), how],
        check=False,
        capture_output=True,
        text=True,
        timeout=limit(),
    )
    assert (said.returncode, said.stdout) == (0, "True\n"), said.stderr
    assert verify(path).closed


def test_the_default_path_has_bench_and_time() -> None:
    path = recording_path(bench("a"), ManualClock(0).now())
    assert path.as_posix() == "recordings/played-bench-20010909T014640Z.h5"


async def test_swapped_adapters_are_named(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a", "b")
    sensors = tuple(
        sensor.model_copy(update={"serial_number": {"a": "1", "b": "2"}[sensor.name]})
        for sensor in run.bench.sensors
    )
    run.bench = run.bench.model_copy(update={"sensors": sensors})
    run.device("a").serial_number, run.device("b").serial_number = "2", "1"
    with pytest.RaisesGroup(
        pytest.RaisesExc(WrongDeviceError, match="'a' on a: .*that is sensor 'b' of port b: the p"),
        pytest.RaisesExc(WrongDeviceError, match="'b' on b: .*that is sensor 'a' of port a: the p"),
    ):
        await run.record()
