"""The control port of a recorder: commands, invalid requests, a silent client."""

from __future__ import annotations

import asyncio
import contextlib
import stat
from pathlib import Path

import pytest

from daq.errors import NotConnectedError
from daq.recording.control import ControlRefusedError, ask
from daq.recording.reader import Recording, control_address
from tests.daq.recorder.test_recorder import Run
from tui.service.documents import RecordedSensorDocument

pytestmark = pytest.mark.virtual_time


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
