"""Control channel of a running recorder: ``stop``, ``mark``, ``uncounted``, ``status``.

Theory of operation
-------------------
The recorder listens on an ephemeral port of the local host, and writes the port and a random token
into the attributes of the file. Users who can read the recording can therefore stop it; by default
only its owner can. A request is one line, ``token command text``. The reply is one line of JSON,
with the key ``"error"`` if the recorder refuses.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import re
import secrets
import socket
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.errors import HuddleError, NoAnswerError, NotConnectedError
from daq.recording.reader import control_address

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

HOST = "127.0.0.1"
MAX_CONNECTIONS = 16
"""Maximum number of connections; further ones are closed immediately."""
_TOKEN_BYTES = 16
_TOKEN = re.compile(rf"[0-9a-f]{{{2 * _TOKEN_BYTES}}}")
_MAX_PORT = 65535
_MAX_LINE = 4096
_IDLE_TIMEOUT = 10.0
_FINAL_REPLY_TIMEOUT = 1.0
"""Time in s for clients to read the last replies when the recorder ends."""

Answer = dict[str, Any]


class Command(StrEnum):
    """Commands to a recorder; the reply to each is the status."""

    STOP = "stop"
    """Close the recording and end."""
    MARK = "mark"
    """Record a remark."""
    UNCOUNTED = "uncounted"
    """Record samples that a sensor did not count: ns since 1970, within (s), how many, sensor."""
    STATUS = "status"
    """Only reply with the status."""


class ControlRefusedError(HuddleError):
    """The recorder refused a command; the message has its reason."""


@contextlib.asynccontextmanager
async def serve(
    answer: Callable[[Command, str], Awaitable[Answer]],
) -> AsyncIterator[tuple[int, str]]:
    """Listen for commands until the context ends.

    Parameters
    ----------
    answer : coroutine function of command and text
        Executes a command and returns the reply.

    Yields
    ------
    (port, token)
        For the file's attributes.
    """
    token = secrets.token_hex(_TOKEN_BYTES)
    conversations: set[asyncio.Task[None]] = set()
    silent: set[asyncio.Task[None]] = set()  # connections without a request yet

    async def converse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if len(conversations) >= MAX_CONNECTIONS:
            writer.transport.abort()
            return
        if task is not None:
            conversations.add(task)
            silent.add(task)
            task.add_done_callback(conversations.discard)
            task.add_done_callback(silent.discard)
        try:
            async with asyncio.timeout(_IDLE_TIMEOUT):
                line = await reader.readline()
                if task is not None:
                    silent.discard(task)
                reply = await _reply(line, token, answer)
                writer.write(json.dumps(reply, ensure_ascii=False).encode() + b"\n")
                await writer.drain()
        except (TimeoutError, ConnectionError, ValueError):
            pass  # the client closed the connection, or its line is too long
        except asyncio.CancelledError:
            writer.transport.abort()
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    server = await asyncio.start_server(converse, HOST, 0, limit=_MAX_LINE)
    try:
        yield int(server.sockets[0].getsockname()[1]), token
    finally:
        server.close()
        # Complete pending replies, above all to "stop"; drop clients without a request.
        for task in silent:
            task.cancel()
        if conversations:
            _, unread = await asyncio.wait(conversations, timeout=_FINAL_REPLY_TIMEOUT)
            for task in unread:
                task.cancel()
        await server.wait_closed()


async def _reply(
    line: bytes, token: str, answer: Callable[[Command, str], Awaitable[Answer]]
) -> Answer:
    given, _, rest = line.decode(errors="replace").strip().partition(" ")
    word, _, text = rest.partition(" ")
    if not hmac.compare_digest(given.encode(), token.encode()):
        return {"error": "wrong token"}
    try:
        command = Command(word)
    except ValueError:
        return {"error": f"unknown command {word!r}; expected one of {', '.join(Command)}"}
    return await answer(command, text)


def ask(recording: str | Path | tuple[int, str], command: str, text: str = "") -> Answer:
    """Send a command to the recorder of a recording and return its reply.

    Parameters
    ----------
    recording : path, or (port, token)
        The file that the recorder writes, or the address in its attributes.
    command : {"stop", "mark", "uncounted", "status"}
    text : str
        The remark of a ``mark``, or what an ``uncounted`` is about.

    Raises
    ------
    NotConnectedError
        If no recorder is writing it.
    NoAnswerError
        If the recorder does not reply.
    ControlRefusedError
        If the recorder refuses.
    """
    control = recording if isinstance(recording, tuple) else _control_of(Path(recording))
    port, token = control
    if not (0 < port <= _MAX_PORT and _TOKEN.fullmatch(token)):  # the file is not trusted
        raise NotConnectedError(
            f"port {port}: the control address is not one of a recorder; nothing was sent to it"
        )
    line = f"{token} {command} {' '.join(text.split())}"
    try:
        with socket.create_connection((HOST, port), timeout=_IDLE_TIMEOUT) as connection:
            connection.sendall(line.encode() + b"\n")
            with connection.makefile("rb") as reply:
                received = reply.readline()
    except TimeoutError as error:
        raise NoAnswerError(f"the recorder on port {port} does not answer") from error
    except OSError as error:
        raise NotConnectedError(f"no recorder is writing {recording}: {error}") from error
    if not received:
        raise NotConnectedError(f"the recorder on port {port} closed the connection")
    answer: Answer = json.loads(received)
    if "error" in answer:
        raise ControlRefusedError(f"the recorder refused {command!r}: {answer['error']}")
    return answer


def _control_of(path: Path) -> tuple[int, str]:
    address = control_address(path)
    if address is None:
        raise NotConnectedError(f"{path}: no recorder is writing it")
    return address
