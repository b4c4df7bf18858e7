"""Libraries whose calls block: the thread, its queue, and how it ends."""

from __future__ import annotations

import threading
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing
from typing import Any, cast

import numpy as np
import pytest

from daq.bench.model import Sensor
from daq.devices.blocking import BlockingSource, Samples
from daq.errors import NoAnswerError, NotConnectedError
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag
from tests.sensors import sensor_at
from tests.waiting import limit


def sensor(name: str, n_channels: int = 1) -> Sensor:
    return sensor_at("COM1", "epson", name, rate=100.0, channels="xyz"[:n_channels])


def rows(first: int, n: int = 10, n_channels: int = 1) -> np.ndarray[Any, Any]:
    return np.arange(first, first + n, dtype=np.int32)[:, None] + 1000 * np.arange(n_channels)


class Library:
    """Returns what it is given; after that, nothing, until it is stopped."""

    def __init__(self, *reads: object) -> None:
        self._reads: Iterator[object] = iter(reads)
        self.calls: list[str] = []
        self.stopped = threading.Event()

    def start(self) -> None:
        """Count the call."""
        self.calls.append("start")

    def read(self) -> Samples | None:
        """Return the next read."""
        one = next(self._reads, None)
        if isinstance(one, Exception):
            raise one
        if callable(one):
            one()
            return None
        if one is None:
            self.stopped.wait(0.01)
        return cast("Samples | None", one)

    def stop(self) -> None:
        """End a read that waits."""
        self.calls.append("stop")
        self.stopped.set()

    def source(self, *sensors: Sensor, queue: int = 100) -> BlockingSource:
        """Return a session on this library."""
        return BlockingSource(
            sensors or [sensor("A")],
            SystemClock(),
            read=self.read,
            start=self.start,
            stop=self.stop,
            queue=queue,
        )


async def blocks_of(
    source: BlockingSource, n_blocks: int, *, into: list[Block] | None = None
) -> list[Block]:
    found: list[Block] = [] if into is None else into
    async with aclosing(cast("AsyncGenerator[Block]", source.read())) as blocks:
        async for block in blocks:
            found.append(block)
            if len(found) == n_blocks:
                break
    return found


def places(found: list[Block]) -> list[tuple[int, int]]:
    return [(block.first_sample, block.end_sample) for block in found]


async def test_sensors_share_the_columns_and_the_library_is_stopped() -> None:
    library = Library(Samples(rows(0, 10, 3)), Samples(rows(10, 10, 3)))
    found = await blocks_of(library.source(sensor("A", 2), sensor("B")), 4)
    assert [block.sensor for block in found] == ["A", "B", "A", "B"]
    assert places(found) == [(0, 10), (0, 10), (10, 20), (10, 20)]
    np.testing.assert_array_equal(found[2].counts, rows(10, 10, 2))
    np.testing.assert_array_equal(found[3].counts, rows(2010, 10))
    assert [BlockFlag.CLOCK_RESTART in block.flags for block in found] == [True, True, False, False]
    assert library.calls == ["start", "stop"]


async def test_a_queue_that_overruns_is_a_gap_of_exact_length() -> None:
    """The event loop is held up while the thread reads ten times; three reads wait."""
    go, done, room = threading.Event(), threading.Event(), threading.Event()
    library = Library(
        Samples(rows(0)),
        lambda: go.wait(limit()),
        *[Samples(rows(10 + 10 * k)) for k in range(10)],
        done.set,
        lambda: room.wait(limit()),
        Samples(rows(110)),
    )
    source = library.source(queue=3)
    found: list[Block] = []
    async with aclosing(cast("AsyncGenerator[Block]", source.read())) as blocks:
        async for block in blocks:
            found.append(block)
            if len(found) == 1:
                go.set()
                assert done.wait(limit())  # the loop does nothing else meanwhile
            if block.end_sample == 40:
                room.set()
            if block.end_sample == 120:
                break
    assert places(found) == [(0, 10), (10, 20), (20, 30), (30, 40), (110, 120)]
    assert found[-1].reason == "the computer was too slow"
    np.testing.assert_array_equal(found[-1].counts, rows(110))


async def test_gaps_follow_from_the_position_or_from_what_is_said_to_be_missing() -> None:
    library = Library(
        Samples(rows(0), position=500),
        Samples(rows(0), position=517),
        Samples(rows(0), position=527),
    )
    found = await blocks_of(library.source(), 3)
    assert places(found) == [(0, 10), (17, 27), (27, 37)]
    assert [block.device_counter for block in found] == [500, 517, 527]
    assert [bool(block.reason) for block in found] == [False, True, False]
    said = Library(Samples(rows(0)), Samples(rows(0), missing=5, reason="overflow"))
    found = await blocks_of(said.source(), 2)
    assert places(found) == [(0, 10), (15, 25)]
    assert found[1].reason == "overflow"


async def test_a_position_that_goes_back_is_a_restart() -> None:
    library = Library(Samples(rows(0), position=500), Samples(rows(0), position=3))
    first, second = await blocks_of(library.source(), 2)
    assert second.first_sample >= first.end_sample
    assert BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED in second.flags


@pytest.mark.parametrize(
    ("error", "kind"),
    [(RuntimeError("unplugged"), NotConnectedError), (NoAnswerError("silent"), NoAnswerError)],
)
async def test_an_error_ends_the_session_after_what_was_read(
    error: Exception, kind: type[Exception]
) -> None:
    library = Library(Samples(rows(0)), Samples(rows(10)), error)
    found: list[Block] = []
    with pytest.raises(kind, match=str(error)):
        await blocks_of(library.source(), 3, into=found)
    assert places(found) == [(0, 10), (10, 20)]
    assert library.calls == ["start", "stop"]


async def test_a_start_that_fails_is_an_error_of_the_session() -> None:
    def fails() -> None:
        raise OSError("no such device")

    source = BlockingSource([sensor("A")], SystemClock(), read=lambda: None, start=fails)
    with pytest.raises(NotConnectedError, match="'A' on COM1: no such device"):
        await blocks_of(source, 1)


async def test_the_host_time_is_that_of_the_read() -> None:
    """Not that of the event loop, which was held up."""
    clock = SystemClock()
    times: list[int] = []

    def timed(act: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            act()
            times.append(clock.now().monotonic_ns)

        return run

    go, done = threading.Event(), threading.Event()
    library = Library(
        Samples(rows(0)), timed(lambda: go.wait(limit())), Samples(rows(10)), timed(done.set)
    )
    found: list[Block] = []
    async with aclosing(cast("AsyncGenerator[Block]", library.source().read())) as blocks:
        async for block in blocks:
            found.append(block)
            if len(found) == 2:
                break
            go.set()
            assert done.wait(limit())
    assert times[0] <= found[1].received.monotonic_ns <= times[1]
