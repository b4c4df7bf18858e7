"""Every kind of port is the same byte stream."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
import struct
import threading
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from daq.devices.epson import commands
from daq.devices.epson.driver import Configuration, Device, EpsonSession, EpsonSettings
from daq.devices.interface import DeviceInformation
from daq.devices.registry import driver_type
from daq.errors import NotConnectedError, ReplayError
from daq.host_clock import SystemClock
from daq.protocols.block import Block
from daq.transport import address
from daq.transport.address import host_and_port
from daq.transport.byte_stream import ByteStream
from daq.transport.ports import open_port
from daq.transport.wire_log import Replay, logging_to, session_ends, using
from tests.sensors import sensor_at
from tests.tcp import served
from tests.waiting import limit


class _Far:
    """The far end of a port."""

    def __init__(self, send: Callable[[bytes], None], hang_up: Callable[[], None]) -> None:
        self.send = send
        self.hang_up = hang_up
        self.received = bytearray()
        self._more = asyncio.Event()

    def take(self, received: bytes) -> None:
        self.received.extend(received)
        self._more.set()

    async def arrived(self, n_bytes: int) -> bytes:
        while len(self.received) < n_bytes:
            self._more.clear()
            await self._more.wait()
        return bytes(self.received)


@asynccontextmanager
async def _pseudo_terminal() -> AsyncIterator[tuple[str, _Far]]:
    master, slave = os.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    os.set_blocking(master, False)
    opened = [slave, master]
    loop = asyncio.get_running_loop()

    def hang_up() -> None:
        loop.remove_reader(master)
        while opened:
            os.close(opened.pop())

    far = _Far(lambda payload: (os.write(master, payload), None)[1], hang_up)
    loop.add_reader(master, lambda: far.take(os.read(master, 4096)))
    try:
        yield name, far
    finally:
        if opened:
            hang_up()


@asynccontextmanager
async def _tcp() -> AsyncIterator[tuple[str, _Far]]:
    ready = asyncio.Event()
    writers: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        ready.set()
        with suppress(ConnectionError):
            while received := await reader.read(4096):
                far.take(received)
        writer.close()

    def send(payload: bytes) -> None:
        writers[0].write(payload)

    def hang_up() -> None:
        writers[0].close()

    far = _Far(send, hang_up)
    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        number = server.sockets[0].getsockname()[1]
        yield f"socket://127.0.0.1:{number}", far
        await asyncio.gather(*(writer.wait_closed() for writer in writers))


TIOCGEXCL = 0x80045440
"""Of Linux; Python's termios does not name it."""
KINDS = {"pseudo-terminal": _pseudo_terminal, "TCP": _tcp}


@pytest.mark.parametrize("kind", KINDS)
async def test_bytes_pass_both_ways_with_their_time(kind: str) -> None:
    clock = SystemClock()
    async with KINDS[kind]() as (port, far), open_port(port, clock) as stream:
        await stream.write(b"\x80\x0d\xff")
        assert await far.arrived(3) == b"\x80\x0d\xff"
        before = clock.now()
        far.send(bytes(range(256)))
        received = b""
        while len(received) < 256:
            part, at = await stream.read()
            received += part
            assert before.monotonic_ns <= at.monotonic_ns <= clock.now().monotonic_ns
        assert received == bytes(range(256))


@pytest.mark.parametrize("kind", KINDS)
async def test_a_hang_up_ends_the_stream_after_its_last_bytes(kind: str) -> None:
    async with KINDS[kind]() as (port, far):
        label = f"sensor A on {port}"
        async with open_port(port, SystemClock(), label=label) as stream:
            await stream.write(b"?")
            await far.arrived(1)
            if kind == "TCP":  # a pseudo-terminal drops what was not read when its master closes
                far.send(b"last")
            far.hang_up()
            if kind == "TCP":
                assert (await stream.read())[0] == b"last"
            with pytest.raises(NotConnectedError, match=f"{label}: the port closed"):
                await stream.read()
            with pytest.raises(NotConnectedError):
                await stream.write(b"?")


async def test_what_came_before_the_port_closed_is_read_first() -> None:
    stream = ByteStream("sensor A", SystemClock())
    stream.feed(b"last")
    stream.lost("unplugged")
    assert (await stream.read())[0] == b"last"
    with pytest.raises(NotConnectedError, match="unplugged"):
        await stream.read()


@pytest.mark.parametrize("port", ["spy:///dev/null?file={}", "SPY://x?file={}", "alt://x?class=os"])
async def test_a_url_that_is_no_device_is_refused_and_nothing_done(
    port: str, tmp_path: Path
) -> None:
    kept = tmp_path / "kept"
    kept.write_text("mine")
    with pytest.raises(NotConnectedError, match="is no port; expected a device"):
        async with open_port(port.format(kept), SystemClock()):
            pass
    assert kept.read_text() == "mine"


@pytest.fixture
def loop_port(monkeypatch: pytest.MonkeyPatch) -> str:
    """Pyserial's port without a descriptor, which is refused outside of tests."""
    monkeypatch.setattr(address, "SERIAL_SCHEMES", ("loop://",))
    return "loop://"


async def test_a_port_without_descriptor_is_read_by_a_thread(loop_port: str) -> None:
    async with open_port(loop_port, SystemClock()) as stream:
        await stream.write(b"round")
        received = b""
        while received != b"round":
            received += (await stream.read())[0]


@pytest.mark.parametrize("kind", KINDS)
async def test_a_read_returns_when_the_expected_bytes_are_available(kind: str) -> None:
    async with KINDS[kind]() as (port, far), open_port(port, SystemClock()) as stream:
        await stream.write(b"?")
        await far.arrived(1)
        stream.expect(100)
        reading = asyncio.create_task(stream.read())
        far.send(bytes(99))
        done, _ = await asyncio.wait([reading], timeout=0.05)
        assert not done
        far.send(bytes(1))
        assert len((await reading)[0]) == 100
        stream.expect(100)
        reading = asyncio.create_task(stream.read())
        far.send(bytes(1))
        far.hang_up()  # is seen at once, whatever is expected
        with suppress(NotConnectedError):
            await reading


@pytest.mark.parametrize(("n_frames", "n_pending"), [(3, 0), (2, 30)])
async def test_a_terminal_with_a_limited_count_wakes_at_the_end_of_a_frame(
    n_frames: int, n_pending: int
) -> None:
    """Bytes of the frame that are there already are not awaited again."""
    async with _pseudo_terminal() as (port, far), open_port(port, SystemClock()) as stream:
        await stream.write(b"?")
        await far.arrived(1)
        stream.expect(n_frames, 100, n_pending=n_pending)
        reading = asyncio.create_task(stream.read())
        far.send(bytes(199 - n_pending))
        done, _ = await asyncio.wait([reading], timeout=0.05)
        assert not done
        far.send(bytes(1))
        assert len((await reading)[0]) == 200 - n_pending


async def test_reads_of_an_epson_return_to_the_ends_of_frames() -> None:
    """Else every block's time is late by most of a sample period, until the host is late once."""
    sensor = sensor_at("x", "epson", rate=50.0)
    configuration = Configuration.of(sensor, EpsonSettings())
    zeros = np.zeros(20, np.int32)
    sent = commands.encode_bursts(
        configuration.burst, x=zeros, y=zeros, z=zeros, count=np.arange(20)
    )
    cut = 7
    async with _pseudo_terminal() as (port, far), open_port(port, SystemClock()) as stream:
        decoder = configuration.decoder("A")
        device = Device(sensor, stream)
        session = EpsonSession(
            device, configuration, (DeviceInformation("A"),), decoder, SystemClock()
        )
        items = session.read()

        async def block() -> Block:
            while not isinstance(item := await anext(items), Block):
                pass
            return item

        reading = asyncio.create_task(block())
        await far.arrived(1)  # it is told to begin
        size = configuration.burst.size
        far.send(sent[cut : cut + 5 * size])  # its first frame lacks its start
        assert ((await reading).n_samples, decoder.n_pending) == (4, cut)
        reading = asyncio.create_task(block())
        far.send(sent[cut + 5 * size : 10 * size])
        async with asyncio.timeout(limit()):  # the driver loses its own patience sooner
            second = await reading
        assert (second.first_sample, second.n_samples, decoder.n_pending) == (4, 5, 0)


async def test_a_reading_thread_takes_the_time_of_the_last_byte(
    loop_port: str,
) -> None:
    async with open_port(loop_port, SystemClock()) as stream:
        stream.expect(10)
        await stream.write(bytes(1))  # for the read that is under way
        await stream.read()
        reading = asyncio.create_task(stream.read())
        for _ in range(10):  # they take three times as long as a read waits
            await stream.write(bytes(1))
            await asyncio.to_thread(threading.Event().wait, 0.03)
        assert len((await reading)[0]) == 10


async def test_discard_drops_unread_bytes() -> None:
    async with _pseudo_terminal() as (port, far), open_port(port, SystemClock()) as stream:
        stream.feed(b"old")
        assert stream.discard() == 3
        far.send(b"new")
        assert (await stream.read())[0] == b"new"


async def test_a_busy_port_is_named() -> None:
    async with _pseudo_terminal() as (port, _), open_port(port, SystemClock()):
        with pytest.raises(NotConnectedError, match=f"{port}: busy: another program"):
            async with open_port(port, SystemClock()):
                pass


@pytest.mark.parametrize(
    ("port", "reason"),
    [
        ("/dev/ttyNotThere", "port does not exist; serial ports of this computer: "),
        ("/dev/null", "not a serial port"),
        ("socket://127.0.0.1:1", "connection refused"),
        ("socket://127.0.0.1", "expected socket://host:port"),
        ("nonsense://x", "nonsense"),
    ],
)
async def test_errors_of_opening_name_cause_and_remedy(port: str, reason: str) -> None:
    with pytest.raises(NotConnectedError, match=reason) as caught:
        async with open_port(port, SystemClock(), label="sensor A"):
            pass
    assert str(caught.value).startswith("sensor A: ")


def test_addresses_are_parsed() -> None:
    assert host_and_port("socket://[::1]:502") == ("::1", 502)
    with pytest.raises(ValueError, match="expected modbus-tcp://host:port"):
        host_and_port("modbus-tcp://somewhere:many")


def test_an_unknown_driver_is_refused_with_the_known_names() -> None:
    with pytest.raises(ValueError, match=r"'seismo'; expected one of .*epson"):
        driver_type("seismo")


async def test_a_serial_port_is_opened_exclusively() -> None:
    """For programs that know no lock; TIOCGEXCL tells what the kernel would say to them."""

    def is_exclusive(port: str) -> bool:
        descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
        try:
            return bool(struct.unpack("i", fcntl.ioctl(descriptor, TIOCGEXCL, bytes(4)))[0])
        finally:
            os.close(descriptor)

    async with _pseudo_terminal() as (port, _):
        if os.geteuid() != 0:
            async with open_port(port, SystemClock()):
                with pytest.raises(OSError, match="busy"):
                    is_exclusive(port)
        else:  # root is let in
            async with open_port(port, SystemClock()):
                assert is_exclusive(port)
        assert not is_exclusive(port)


# --- the log of a wire -----------------------------------------------------------------------


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
