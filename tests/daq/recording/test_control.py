"""Who may speak to a recorder, and what a file of somebody else can make us send."""

from __future__ import annotations

import asyncio
import socket

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


async def test_the_number_of_connections_is_limited() -> None:
    async def answer(_command: Command, _text: str) -> Answer:
        return {"well": True}

    async with serve(answer) as (port, token):
        open_ones = [await asyncio.open_connection(HOST, port) for _ in range(MAX_CONNECTIONS)]
        reader, writer = await asyncio.open_connection(HOST, port)
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await reader.readexactly(1)
        writer.close()
        first_reader, first_writer = open_ones[0]
        first_writer.write(f"{token} status\n".encode())
        assert await first_reader.readline() == b'{"well": true}\n'
        for _, each in open_ones:
            each.close()
