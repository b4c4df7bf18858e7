"""Control channel of a running recorder: ``stop``, ``mark``, ``uncounted``, ``status``.

Theory of operation
-------------------
The recorder writes a port and a random token into the attributes of the file. Port 0 is a Unix
socket beside the recording, of mode 0600 and with a name made from the token: only its owner can
connect. Where there are no such sockets (Windows, some file systems), the port is one of the local
host; users who can read the recording can then stop it, by default only its owner. A request is one
line, ``token command text``. The reply is one line of JSON, with the key ``"error"`` if the
recorder refuses.

Anybody on the computer can connect to a port and say nothing. A connection has a second for its
request, and where there are too many, the longest silent one gives way to the new one. So a request
that is sent at once is answered.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import json
import os
import re
import secrets
import socket
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Any

from daq.errors import HuddleError, NoAnswerError, NotConnectedError
from daq.recording.reader import control_address

HOST = "127.0.0.1"
MAX_CONNECTIONS = 16
"""Maximum number of connections; the longest silent one then gives way to a new one."""
_TOKEN_BYTES = 16
_TOKEN = re.compile(rf"[0-9a-f]{{{2 * _TOKEN_BYTES}}}")
_MAX_PORT = 65535
_MAX_LINE = 4096
_IDLE_TIMEOUT = 10.0
_REQUEST_TIMEOUT = 1.0
"""Time in s for a request to arrive."""
_LONGEST_PATH = 100
"""Bytes of the address of a Unix socket, on every system."""
_SUFFIX = ".control"
_LEFT = 60.0
"""Age in s from which a socket without a listener is one that was left behind."""
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
    folder: Path | None = None,
) -> AsyncIterator[tuple[int, str]]:
    """Listen for commands until the context ends.

    Parameters
    ----------
    answer : coroutine function of command and text
        Executes a command and returns the reply.
    folder : Path, optional
        Of the recording, for a Unix socket; without it, or where it can have none, a port is used.

    Yields
    ------
    (port, token)
        For the file's attributes; port 0 is the socket in the folder.
    """
    token = secrets.token_hex(_TOKEN_BYTES)
    conversations = _Conversations(token, answer)
    listening = None if folder is None else _listening(folder, token)
    if listening is None:
        server = await asyncio.start_server(conversations.begin, HOST, 0, limit=_MAX_LINE)
    else:
        server = await asyncio.start_unix_server(
            conversations.begin, sock=listening, limit=_MAX_LINE
        )
    try:
        port = 0 if listening is not None else int(server.sockets[0].getsockname()[1])
        yield port, token
    finally:
        server.close()
        if listening is not None and folder is not None:
            _socket_of(folder, token).unlink(missing_ok=True)
        await conversations.end()
        await server.wait_closed()


class _Conversations:
    """The connections of a recorder."""

    def __init__(self, token: str, answer: Callable[[Command, str], Awaitable[Answer]]) -> None:
        self._token, self._answer = token, answer
        self._open: dict[asyncio.Task[None], bool] = {}
        """Whether a connection is silent: without a request yet; the oldest first."""

    async def begin(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request."""
        task = asyncio.current_task()
        if task is None or (len(self._open) >= MAX_CONNECTIONS and not self._make_room()):
            writer.transport.abort()
            return
        self._open[task] = True
        task.add_done_callback(lambda _: self._open.pop(task, None))
        try:
            async with asyncio.timeout(_REQUEST_TIMEOUT):
                line = await reader.readline()
            self._open[task] = False
            async with asyncio.timeout(_IDLE_TIMEOUT):
                reply = await _reply(line, self._token, self._answer)
                writer.write(json.dumps(reply, ensure_ascii=False).encode() + b"\n")
                await writer.drain()
        except (TimeoutError, ConnectionError, ValueError):
            pass  # the client closed the connection, says nothing, or its line is too long
        except asyncio.CancelledError:
            writer.transport.abort()
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    def _make_room(self) -> bool:
        """End the longest silent connection."""
        oldest = next((task for task, is_silent in self._open.items() if is_silent), None)
        if oldest is None:
            return False
        del self._open[oldest]
        oldest.cancel()
        return True

    async def end(self) -> None:
        """Complete pending replies, above all to "stop"; drop clients without a request."""
        for task in [task for task, is_silent in self._open.items() if is_silent]:
            task.cancel()
        if self._open:
            _, unread = await asyncio.wait(self._open, timeout=_FINAL_REPLY_TIMEOUT)
            for task in unread:
                task.cancel()


def _socket_of(folder: Path, token: str) -> Path:
    """Return the Unix socket of a recorder: its name does not give its token away."""
    return folder / f".{hashlib.sha256(token.encode()).hexdigest()[:16]}{_SUFFIX}"


@contextlib.contextmanager
def _short(path: Path) -> Iterator[str]:
    """Yield an address of a Unix socket that is short enough, however long its path is.

    Raises
    ------
    OSError
        If there is none.
    """
    if len(os.fsencode(path)) <= _LONGEST_PATH:
        yield str(path)
        return
    if sys.platform != "linux":
        raise OSError(f"{path}: too long for a Unix socket")
    handle = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{handle}/{path.name}"
    finally:
        os.close(handle)


def _listening(folder: Path, token: str) -> socket.socket | None:
    """Return a socket of mode 0600 in a folder; None where it can have none."""
    if not hasattr(socket, "AF_UNIX") or sys.platform == "win32":
        return None
    path = _socket_of(folder.resolve(), token)
    _remove_left(path.parent)
    made = socket.socket(socket.AF_UNIX)
    try:
        with _short(path) as address:
            made.bind(address)
        path.chmod(0o600)  # before it listens: nobody has connected
    except OSError:
        made.close()
        path.unlink(missing_ok=True)
        return None
    return made


def _remove_left(folder: Path) -> None:
    """Remove sockets of recorders that were killed: nobody listens there."""
    for path in folder.glob(f".*{_SUFFIX}"):
        try:
            if time.time() - path.lstat().st_mtime > _LEFT and path.is_socket():
                with contextlib.closing(_connected(path)):
                    pass
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
        except OSError:
            continue  # busy, or of somebody else


def _connected(path: Path) -> socket.socket:
    made = socket.socket(socket.AF_UNIX)
    made.settimeout(_IDLE_TIMEOUT)
    try:
        with _short(path) as address:
            made.connect(address)
    except BaseException:
        made.close()
        raise
    return made


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


def ask(
    recording: str | Path | tuple[int, str],
    command: str,
    text: str = "",
    *,
    folder: Path | None = None,
) -> Answer:
    """Send a command to the recorder of a recording and return its reply.

    Parameters
    ----------
    recording : path, or (port, token)
        The file that the recorder writes, or the address in its attributes.
    command : {"stop", "mark", "uncounted", "status"}
    text : str
        The remark of a ``mark``, or what an ``uncounted`` is about.
    folder : Path, optional
        Of the recording, where its address is given.

    Raises
    ------
    NotConnectedError
        If no recorder is writing it.
    NoAnswerError
        If the recorder does not reply.
    ControlRefusedError
        If the recorder refuses.
    """
    if isinstance(recording, tuple):
        port, token = recording
    else:
        port, token = _control_of(Path(recording))
        folder = Path(recording).resolve().parent
    lowest = 0 if folder is not None and hasattr(socket, "AF_UNIX") else 1
    if not (lowest <= port <= _MAX_PORT and _TOKEN.fullmatch(token)):  # the file is not trusted
        raise NotConnectedError(
            f"port {port}: the control address is not one of a recorder; nothing was sent to it"
        )
    line = f"{token} {command} {' '.join(text.split())}"
    try:
        with (
            socket.create_connection((HOST, port), timeout=_IDLE_TIMEOUT)
            if port or folder is None
            else _connected(_socket_of(folder, token))
        ) as connection:
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
