"""What a recorder refuses before it records: absent, wrong and swapped devices, and files."""

from __future__ import annotations

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
from daq.recording.reader import Recording
from daq.recording.sensor_state import SensorState
from daq.recording.storage.names import recording_path
from tests.daq.recorder.test_recorder import Run
from tests.scripted_driver import ManualClock, bench

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
