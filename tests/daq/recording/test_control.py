"""Who may speak to a recorder, and what a file of somebody else can make us send."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
import sys
from pathlib import Path

import pytest

from daq.errors import NotConnectedError
from daq.recording.control import HOST, MAX_CONNECTIONS, Answer, Command, ask, serve


@pytest.mark.parametrize(
    ("port", "token"),
    [
        (None, "GET / HTTP/1.1\r\n"),
        (None, "0" * 31),
        (None, "0" * 32 + "\n"),
        (0, "0" * 32),
        (70_000, "0" * 32),
    ],
)
def test_no_bytes_are_sent_to_an_invalid_address(port: int | None, token: str) -> None:
    with socket.create_server((HOST, 0)) as listening:
        listening.settimeout(0)
        at = listening.getsockname()[1] if port is None else port
        with pytest.raises(NotConnectedError, match="nothing was sent to it"):
            ask((at, token), "status")
        with pytest.raises(BlockingIOError):
            listening.accept()


async def _well(_command: Command, _text: str) -> Answer:
    return {"well": True}


async def test_silent_connections_give_way_to_the_owner() -> None:
    async with serve(_well) as (port, token):
        silent = [await asyncio.open_connection(HOST, port) for _ in range(2 * MAX_CONNECTIONS)]
        answer = await asyncio.to_thread(ask, (port, token), "status")
        assert answer == {"well": True}
        reader, _ = silent[0]
        assert await reader.read() == b""  # the longest silent one was dropped
        for _, each in silent:
            each.close()


@pytest.mark.skipif(sys.platform == "win32", reason="Unix sockets")
@pytest.mark.parametrize("depth", [0, 6])
async def test_a_socket_lies_beside_a_recording_however_long_its_path_is(
    tmp_path: Path, depth: int
) -> None:
    folder = tmp_path.joinpath(*["a folder with a long name"] * depth)
    folder.mkdir(parents=True, exist_ok=True)
    async with serve(_well, folder) as (port, token):
        if depth and sys.platform != "linux":
            assert port > 0
            return
        assert port == 0
        (path,) = folder.iterdir()
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert token[:8] not in path.name
        found = await asyncio.to_thread(ask, (port, token), "status", folder=folder)
        assert found == {"well": True}
    assert list(folder.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="Unix sockets")
@pytest.mark.parametrize("is_raced", [False, True])
async def test_the_socket_of_a_killed_recorder_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_raced: bool
) -> None:
    """Also where another recorder removes it at the same time."""

    def removed(path: Path) -> socket.socket:
        path.unlink()
        raise ConnectionRefusedError

    if is_raced:
        monkeypatch.setattr("daq.recording.control._connected", removed)
    left = tmp_path / ".0123456789abcdef.control"
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(left))
    os.utime(left, (0, 0))
    async with serve(_well, tmp_path):
        assert not left.exists()
