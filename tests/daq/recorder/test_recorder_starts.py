"""What a recorder refuses: devices and files before it records, requests while it does."""

from __future__ import annotations

import asyncio
import contextlib
import stat
from pathlib import Path

import pytest

from daq.errors import (
    DeviceError,
    NoAnswerError,
    NotConnectedError,
    RecordingError,
    WrongDeviceError,
)
from daq.protocols.errors import RemoteProtocolError
from daq.recording.control import ControlRefusedError, ask
from daq.recording.reader import Recording, control_address
from daq.recording.sensor_state import SensorState
from daq.recording.storage.names import recording_path
from tests.daq.recorder.test_recorder import Run
from tests.scripted_driver import ManualClock, bench
from tui.service.documents import RecordedSensorDocument

pytestmark = pytest.mark.virtual_time


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


async def test_a_silent_sensor_of_a_port_is_recorded_without_only_on_request(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a", "b", a="bus", b="bus")
    run.device("bus").troubles = {"b": "sensor 'b' on bus: no answer"}
    with pytest.RaisesGroup(
        pytest.RaisesExc(NoAnswerError, match="'b' on bus: no answer; --anyway records the other")
    ):
        await run.record()
    assert not run.path.exists()
    run.anyway = True
    async with run.going():
        await run.sent("a", 0, 100)
        assert run.statuses[-1].sensors["b"].state is SensorState.STALLED
        await run.sent("b", 0, 100)
    with Recording.open(run.path) as recording:
        assert [sensor.n_samples for sensor in recording.sensors] == [100, 100]


async def test_a_protocol_error_at_the_start_is_a_device_error(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").failure = RemoteProtocolError("a reply of 3 bytes; expected 5")
    with pytest.RaisesGroup(pytest.RaisesExc(DeviceError, match="port a: a reply of 3 bytes")):
        await run.record()


async def test_another_device_on_the_port_is_refused(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    device = run.device("a")
    async with run.going():
        await run.sent("a", 0, 100)
        device.serial_number = "2"
        device.items.put_nowait(NotConnectedError("cable"))
        while device.n_sessions < 3:
            device.opened.clear()
            await device.opened.wait()
        device.serial_number = "1"
        await run.sent("a", 0, 100, 200)
    assert run.texts("refused") == ["sensor 'a' on a: expected serial number '1', got '2'"]


async def test_a_wrong_rate_is_refused_at_the_start(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").sampling_rate = 200.0
    with pytest.RaisesGroup(pytest.RaisesExc(WrongDeviceError, match="expected 100 Hz")):
        await run.record()


async def test_a_slightly_different_rate_is_accepted(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    run.device("a").sampling_rate = 100.1
    async with run.going():
        await run.sent("a", 0, 200)
    with Recording.open(run.path) as recording:
        assert recording.sensors[0].sampling_rate == 100.1


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


# --- the control port ------------------------------------------------------------------------


async def connected(recording: Path) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect as somebody with the account of the recorder."""
    (beside,) = recording.parent.glob(".*.control")
    return await asyncio.open_unix_connection(str(beside))


async def test_a_silent_client_of_the_control_port_does_not_delay_the_end(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        await run.sent("a", 0, 100)
        address = control_address(run.path)
        assert address is not None
        reader, writer = await connected(run.path)
        await asyncio.to_thread(ask, run.path, "stop")
    with contextlib.suppress(ConnectionError):
        assert await reader.read() == b""
    writer.close()
    with contextlib.suppress(ConnectionError):
        await writer.wait_closed()


async def test_commands_of_the_control_port_are_executed(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going() as task:
        await run.sent("a", 0, 100)
        status = await asyncio.to_thread(ask, run.path, "status")
        assert status["sensors"]["a"]["samples"] == 100
        assert status["sensors"]["a"].keys() == RecordedSensorDocument.__required_keys__
        await asyncio.to_thread(ask, run.path, "mark", "a door\nslammed")
        address = control_address(run.path)
        assert address is not None
        port, token = address
        assert port == 0
        (beside,) = tmp_path.glob(".*.control")  # noqa: ASYNC240 - nothing else runs
        assert stat.S_IMODE(beside.stat().st_mode) == 0o600
        reader, writer = await connected(run.path)
        writer.write(b"0" * 32 + b" stop\n")
        assert b"wrong token" in await reader.readline()
        writer.close()
        await writer.wait_closed()
        with pytest.raises(NotConnectedError):
            await asyncio.to_thread(ask, (port, "0" * 32), "stop", folder=tmp_path)
        with pytest.raises(ControlRefusedError, match="unknown command 'dance'"):
            await asyncio.to_thread(ask, (port, token), "dance", folder=tmp_path)
        await asyncio.to_thread(ask, run.path, "stop")
        assert (await task).closed
    with pytest.raises(NotConnectedError, match="no recorder is writing it"):
        ask(run.path, "stop")
    assert run.texts("mark") == ["a door slammed"]
    assert run.texts()[-1] == "stopped by command"


async def test_samples_that_were_not_counted_are_recorded_once(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    at = 1_468_458_187_000_000_000  # 01:03:07
    async with run.going():
        await run.sent("a", 0, 100)
        said = f"{at} 2.500 1 a", f"{at + 4_000_000_000} 2.500 1 a", f"{at} 2.500 -3 a"
        for each in said:  # the second is the first, dated otherwise
            await asyncio.to_thread(ask, run.path, "uncounted", each)
        for wrong in ("1 2 3", f"{at} x 1 a", f"{at} nan 1 b", f"{10**30} 1 1 a"):
            with pytest.raises(ControlRefusedError, match="uncounted"):
                await asyncio.to_thread(ask, run.path, "uncounted", wrong)
        await asyncio.to_thread(ask, run.path, "stop")
    with Recording.open(run.path) as recording:
        found = [(each.sensor, each.text) for each in recording.events if each.kind == "uncounted"]
    to_do = "; check the buffers and the cable of the logger, and the load of its computer"
    assert found == [
        ("a", f"lost 1 sample at 01:03:07 UTC (±3 s) without counting it{to_do}"),
        ("a", f"repeated 3 samples at 01:03:07 UTC (±3 s) without counting them{to_do}"),
    ]


async def test_invalid_requests_to_the_control_port_have_no_effect(tmp_path: Path) -> None:
    run = Run(tmp_path / "r.h5", "a")
    async with run.going():
        await run.sent("a", 0, 100)
        for nonsense in (b"", b"\n", b"\xff" * 100 + b"\n", b"x" * 100_000):
            reader, writer = await connected(run.path)
            with contextlib.suppress(ConnectionError):
                writer.write(nonsense)
                writer.write_eof()
                await reader.read()
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
        assert (await asyncio.to_thread(ask, run.path, "status"))["closed"] is False
