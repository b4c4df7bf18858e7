"""The register poller against slaves whose replies are damaged, and through adapters that echo."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import struct
from collections import Counter
from collections.abc import AsyncIterator, Callable

import numpy as np
import pytest
from pymodbus.transaction import TransactionManager

from daq.bench.model import Sensor
from daq.devices.modbus import rtu
from daq.devices.modbus.bus import open_bus
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError
from daq.protocols.block import Block, Event
from tests.devices import host_clock
from tests.sensors import sensor_at
from tests.tcp import served

pytestmark = pytest.mark.virtual_time

RATE = 20.0
DRIVER = driver_type("registers")


@contextlib.asynccontextmanager
async def slave(answer: Callable[[int, bytes], bytes]) -> AsyncIterator[str]:
    """Serve a slave that answers its n-th request, of eight bytes; yield its port."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for n in itertools.count():
            request = await reader.readexactly(8)
            await asyncio.sleep(0.005)  # the line
            writer.write(answer(n, request))

    async with served(serve) as number:
        yield f"socket://127.0.0.1:{number}"


def reply(n: int, *, unit: int = 1) -> bytes:
    return rtu.encode_registers(unit, 3, np.array([n, 7, 9], np.uint16))


def sensor(port: str, **settings: object) -> Sensor:
    return sensor_at(port, "registers", rate=RATE, settings={"address": 0, **settings})


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


SPOILED: dict[str, tuple[Callable[[bytes], bytes], int]] = {
    "checksum": (lambda frame: flipped(frame, 10), 20),
    "value": (lambda frame: flipped(frame, 5), 20),
    "length": (lambda frame: flipped(frame, 2), 20),
    "unit": (lambda frame: flipped(frame, 0), 20),
    "garbage before": (lambda frame: bytes(range(40)) + frame, 20),
    "cut": (lambda frame: frame[:-3], 40),  # that its rest will not come is known after 60 ms
}
"""What becomes of one reply in twenty, and the most samples of 400 that it costs."""


@pytest.mark.parametrize("kind", SPOILED)
async def test_a_spoiled_reply_loses_one_poll_or_two_and_never_answers_the_next(kind: str) -> None:
    spoil, most = SPOILED[kind]

    def answer(n: int, _request: bytes) -> bytes:
        return spoil(reply(n)) if n % 20 == 10 else reply(n)

    async with slave(answer) as port:
        n_samples, n_missing, kinds = await polled(sensor(port), 400)
    if kind in {"checksum", "value", "length", "unit"}:
        assert kinds == {"checksum": pytest.approx(20, abs=1)}
    assert n_missing <= most
    assert n_samples >= 400 - most


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


class SlowSlave:
    """Answers in order, some requests late and some never; it tells when each was read.

    Its first three registers have the time of the reading in units of 0.1 ms.
    """

    def __init__(self, seed: int, *, lost: float, late: float, n_registers: int = 100) -> None:
        self._rng = np.random.default_rng(seed)
        self._lost, self._late, self._n_registers = lost, late, n_registers
        self.n_late = 0
        self.n_lost = 0

    @contextlib.asynccontextmanager
    async def serve(self) -> AsyncIterator[str]:
        """Serve; yield the port."""

        async def answered(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while True:
                request = await reader.readexactly(8)
                await asyncio.sleep(0.002)
                writer.write(await self._reply(request))

        async with served(answered) as number:
            yield f"socket://127.0.0.1:{number}"

    async def _reply(self, request: bytes) -> bytes:
        count = int.from_bytes(request[4:6], "big")
        if count > self._n_registers:
            return rtu.encode_exception(1, 3, 2)
        now = round(host_clock().now().monotonic_ns / 1e5)
        values = [now >> 32 & 0xFFFF, now >> 16 & 0xFFFF, now & 0xFFFF, *range(count - 3)]
        drawn = self._rng.uniform()
        if drawn < self._lost:
            self.n_lost += 1
            return b""
        late = drawn < self._lost + self._late
        self.n_late += late
        await asyncio.sleep(self._rng.uniform(0.02, 0.4) if late else 0.003)
        return rtu.encode_registers(1, 3, np.array(values[:count], np.uint16))


async def _polled_slow(slow: SlowSlave, n_polls: int) -> float:
    """Return the share of missing readings."""
    n_samples = end = 0
    async with slow.serve() as port:
        one = sensor(port).model_copy(update={"sampling_rate": 50.0})
        async with DRIVER.open([one], host_clock()) as session:
            async for item in session.read():
                if isinstance(item, Block):
                    n_samples += item.n_samples
                    end = item.end_sample
                if end >= n_polls:
                    return 1 - n_samples / end
    raise AssertionError("the session ended")


@pytest.mark.parametrize("n_registers", [100, 4])
async def test_lost_replies_cost_little_more_than_themselves(n_registers: int) -> None:
    """2 % lost at 50 Hz: at most 8 % missing."""
    slow = SlowSlave(1, lost=0.02, late=0.0, n_registers=n_registers)
    assert 0.01 < await _polled_slow(slow, 1500) <= 0.08
    assert slow.n_lost > 15


@pytest.mark.parametrize("n_registers", [4, 3])
@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.study) for n in (1, 2))])
async def test_a_late_reply_is_never_the_reply_to_a_later_request(
    seed: int, n_registers: int
) -> None:
    """Whether the device has further registers, which tell by their number, or not."""
    slow = SlowSlave(seed, lost=0.02, late=0.03, n_registers=n_registers)
    clock, n_replies = host_clock(), 0
    async with slow.serve() as port, open_bus(port, clock, label="A") as bus:
        for _ in range(2000):
            with contextlib.suppress(NoAnswerError):
                reply = await bus.read(3, 1, 0, 3)
                read_ns = sum(
                    word << shift for word, shift in zip(reply.registers, (32, 16, 0), strict=True)
                )
                assert reply.sent.monotonic_ns <= read_ns * 10**5 + 10**5
                assert read_ns * 10**5 <= reply.received.monotonic_ns + 10**5
                n_replies += 1
            await asyncio.sleep(0.015)
    assert slow.n_late > 20
    assert n_replies > 1600


async def test_numbers_of_requests_may_wrap_over_tcp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each reply comes after a second copy of the one before, which has another number."""

    def connected(manager: TransactionManager) -> None:
        begun(manager)
        manager.next_tid = 64_980

    begun = TransactionManager.callback_connected
    monkeypatch.setattr(TransactionManager, "callback_connected", connected)
    numbers: list[int] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        before = b""
        while True:
            number, _, _, unit, function, _, n_words = struct.unpack(
                ">HHHBBHH", await reader.readexactly(12)
            )
            words = np.arange(len(numbers), len(numbers) + n_words, dtype=">u2").tobytes()
            pdu = struct.pack(">BBB", unit, function, len(words)) + words
            answer = struct.pack(">HHH", number, 0, len(pdu)) + pdu
            numbers.append(number)
            writer.write(before + answer)
            before = answer

    async with served(serve) as tcp:
        port = f"modbus-tcp://127.0.0.1:{tcp}"
        async with open_bus(port, host_clock(), label="A") as bus:
            for n in range(50):
                answer = await bus.read(3, 1, 0, 2)
                assert answer.registers == [n, n + 1]
    assert numbers == [*range(64_981, 65_001), *range(1, 31)]


def test_sensors_that_read_one_register_are_refused_with_the_bench() -> None:
    first = sensor("/dev/ttyUSB0", address=0)
    second = first.model_copy(update={"name": "Q"})
    check = driver_type("registers").check
    with pytest.raises(BenchFileError, match=r"Q.*device 1 is that of sensor .*device_id"):
        check([first, second])
    check([first, second.model_copy(update={"settings": {"address": 0, "device_id": 2}})])
    check([first, second.model_copy(update={"settings": {"address": 100}})])
