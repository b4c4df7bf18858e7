"""Logs of ports, and what a replay refuses. Replays of every driver: test_conformance.py."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from daq.errors import NotConnectedError, ReplayError
from daq.host_clock import SystemClock
from daq.transport.ports import open_port
from daq.transport.wire_log import Replay, logging_to, session_ends, using
from tests.tcp import served


@contextlib.asynccontextmanager
async def echo() -> AsyncIterator[str]:
    """Serve a port that answers each line; yield its address."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            writer.write(b"you said " + line)

    async with served(answer) as number:
        yield f"socket://127.0.0.1:{number}"


async def talk(port: str, *lines: bytes) -> list[tuple[bytes, int]]:
    found = []
    async with open_port(port, SystemClock(), label="A") as stream:
        for line in lines:
            await stream.write(line)
            received, at = await stream.read()
            found.append((received, at.monotonic_ns))
        session_ends()
    return found


async def logged(path: Path, *lines: bytes) -> tuple[str, list[tuple[bytes, int]]]:
    async with echo() as port:
        with logging_to(path):
            return port, await talk(port, *lines)


async def test_a_session_is_logged_and_replayed(tmp_path: Path) -> None:
    path = tmp_path / "wire.jsonl"
    port, found = await logged(path, b"one\n", b"two\n")
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    kinds = [next(k for k in ("open", "out", "in", "end", "lost") if k in line) for line in lines]
    assert kinds[:6] == ["open", "out", "in", "out", "in", "end"]
    assert bytes.fromhex(lines[2]["in"]) == b"you said one\n"
    times = [line["at_ns"] for line in lines]
    assert times == sorted(times)
    with using(Replay(path)):
        assert await talk(port, b"one\n", b"two\n") == found


@pytest.mark.parametrize(
    ("lines", "error", "said"),
    [
        ((b"one\n", b"TWO\n"), ReplayError, "sent b'TWO.n'; the log has b'two.n'"),
        ((b"one\n", b"two\n", b"three\n"), NotConnectedError, "end of the log"),
    ],
)
async def test_a_replay_refuses_what_was_not_sent(
    lines: tuple[bytes, ...], error: type[Exception], said: str, tmp_path: Path
) -> None:
    port, _ = await logged(tmp_path / "wire.jsonl", b"one\n", b"two\n")
    with using(Replay(tmp_path / "wire.jsonl")), pytest.raises(error, match=said):
        await talk(port, *lines)


async def test_each_opening_is_replayed_once(tmp_path: Path) -> None:
    port, _ = await logged(tmp_path / "wire.jsonl", b"one\n")
    with using(Replay(tmp_path / "wire.jsonl")):
        await talk(port, b"one\n")
        with pytest.raises(ReplayError, match="no further opening of socket"):
            await talk(port, b"one\n")


async def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "wire.jsonl").write_text("kept", encoding="utf-8")
    with pytest.raises(FileExistsError):
        await logged(tmp_path / "wire.jsonl", b"one\n")
    assert (tmp_path / "wire.jsonl").read_text(encoding="utf-8") == "kept"
