"""The register poller against slaves whose replies are damaged, and through adapters that echo."""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import pytest

from daq.bench.model import Channel, Sensor
from daq.drivers.registry import driver_type
from daq.errors import NoAnswerError
from daq.protocols.block import Block, Event
from daq.protocols.modbus import rtu
from tests.devices import host_clock

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytestmark = pytest.mark.virtual_time

RATE = 20.0
DRIVER = driver_type("registers")


@contextlib.asynccontextmanager
async def slave(answer: Callable[[int, bytes], bytes]) -> AsyncIterator[str]:
    """Serve a slave that answers its n-th request, of eight bytes; yield its port."""
    tasks: list[asyncio.Task[None] | None] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        tasks.append(asyncio.current_task())
        n = 0
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                request = await reader.readexactly(8)
                await asyncio.sleep(0.005)  # the line
                writer.write(answer(n, request))
                n += 1
        writer.close()

    async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
        yield f"socket://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    await asyncio.gather(*filter(None, tasks))


def reply(n: int, *, unit: int = 1) -> bytes:
    return rtu.encode_registers(unit, 3, np.array([n, 7, 9], np.uint16))


def sensor(port: str, **settings: object) -> Sensor:
    return Sensor(
        name="A",
        driver="registers",
        port=port,
        sampling_rate=RATE,
        channels=tuple(Channel(name=axis, sensitivity=1.0) for axis in "xyz"),
        settings={"address": 0, **settings},
    )


async def polled(one: Sensor, n_polls: int) -> tuple[int, int, Counter[str]]:
    """Return samples recorded and missing after so many polls, and the events by their kind."""
    n_samples = end = 0
    kinds: Counter[str] = Counter()
    async with DRIVER.open([one], host_clock()) as session:
        async for item in session.read():
            if isinstance(item, Event):
                kinds[item.kind] += 1
                continue
            assert isinstance(item, Block)
            assert (item.counts[:, 1:] == [7, 9]).all()
            n_samples += item.n_samples
            end = item.end_sample
            if end >= n_polls:
                break
    return n_samples, end - n_samples, kinds


def flipped(frame: bytes, at: int) -> bytes:
    return frame[:at] + bytes([frame[at] ^ 0x10]) + frame[at + 1 :]


@pytest.mark.parametrize("at", [10, 5, 2, 0], ids=["checksum", "value", "length", "unit"])
async def test_a_damaged_reply_loses_one_poll(at: int) -> None:
    """One in twenty: 5 % of the samples, whatever byte of the reply is damaged."""

    def answer(n: int, _request: bytes) -> bytes:
        return flipped(reply(n), at) if n % 20 == 10 else reply(n)

    async with slave(answer) as port:
        n_samples, n_missing, kinds = await polled(sensor(port), 400)
    assert kinds == {"checksum": pytest.approx(20, abs=1)}
    assert n_missing <= 20
    assert n_samples >= 380


async def test_garbage_before_a_reply_loses_at_most_one_poll() -> None:
    """And its reply never answers the next request."""

    def answer(n: int, _request: bytes) -> bytes:
        return bytes(range(40)) + reply(n) if n % 20 == 10 else reply(n)

    async with slave(answer) as port:
        n_samples, n_missing, _ = await polled(sensor(port), 400)
    assert n_missing <= 20
    assert n_samples >= 380


async def test_a_cut_reply_loses_two_polls() -> None:
    """That its rest will not come is known after 60 ms."""

    def answer(n: int, _request: bytes) -> bytes:
        return reply(n)[:-3] if n % 20 == 10 else reply(n)

    async with slave(answer) as port:
        n_samples, n_missing, _ = await polled(sensor(port), 400)
    assert n_missing <= 40
    assert n_samples >= 360


@pytest.mark.parametrize("settings", [{}, {"echo": True}], ids=["recognised", "stated"])
async def test_replies_are_read_over_an_adapter_with_echo(settings: dict[str, object]) -> None:
    async with slave(lambda n, request: request + reply(n)) as port:
        n_samples, n_missing, kinds = await polled(sensor(port, **settings), 100)
    assert (n_missing, kinds) == (0, {})
    assert n_samples >= 100


async def test_an_echo_is_not_accepted_as_reply_to_a_write() -> None:
    """Where the user says that the adapter echoes, a silent slave is none that obeys."""
    async with slave(lambda _n, request: request) as port:
        silent = sensor(port)
        settings = {"preset": "witmotion", "echo": True, "timeout": 0.1}
        silent = silent.model_copy(update={"settings": settings, "sampling_rate": 50.0})
        with pytest.raises(NoAnswerError, match="function 6"):
            async with DRIVER.open([silent], host_clock()):
                pass
