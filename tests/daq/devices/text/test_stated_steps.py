"""Clocks of loggers that are set: every row that arrived is recorded, and no gap is invented.

The logger is `tests.peers.text_logger`, which shares no code with the driver.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from daq.devices.registry import driver_type
from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import RASPBERRY_SHAKE, TextFormat
from daq.errors import NotConnectedError
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag, DeviceItem, Event, EventKind, HostTime
from tests.daq.devices.found import blocks_of, events_of
from tests.peers.text_logger import CHANNELS, UNIX, TextLogger
from tests.sensors import sensor_at
from tests.tcp import served

ROWS = TextFormat(columns=(1, 2, 3), time_column=0, whole=True)
SIZES = [0.02, 0.3, 1.0, 3600.0]
SIGNED = [sign * size for size in SIZES for sign in (1, -1)]


def arrival(seconds: float) -> HostTime:
    return HostTime(3_000_000_000_000 + round(seconds * 1e9), round((UNIX + seconds) * 1e9))


def by_rows(logger: TextLogger) -> list[DeviceItem]:
    decoder = TextDecoder("A", ROWS, sampling_rate=100.0)
    found = [item for data, at in logger.rows() for item in decoder.receive(data, arrival(at))]
    return [*found, *decoder.flush()]


def by_packets(logger: TextLogger) -> list[DeviceItem]:
    shake = replace(RASPBERRY_SHAKE, channel_names=CHANNELS)
    decoder = TextDecoder("A", shake, sampling_rate=100.0)
    found: list[DeviceItem] = []
    for data, at in logger.packets():
        found += decoder.receive_datagram(data, arrival(at))
    return [*found, *decoder.flush()]


def check(
    found: list[DeviceItem], logger: TextLogger, *, n_lost: int = 0
) -> tuple[list[Block], list[Event]]:
    """See that every row is recorded once, with its index up to estimated gaps."""
    blocks = blocks_of(found)
    index = np.concatenate([np.arange(b.first_sample, b.end_sample) for b in blocks])
    rows = np.concatenate([b.counts for b in blocks])
    known = {tuple(row): n for n, row in enumerate(logger.samples.tolist())}
    true = np.array([known[tuple(row)] for row in rows.tolist()])
    assert (np.diff(true) > 0).all()
    assert len(true) == len(logger.samples) - n_lost
    estimated = [b.first_sample for b in blocks if BlockFlag.MISSING_ESTIMATED in b.flags]
    sure = index < min(estimated, default=index[-1] + 1)
    assert np.array_equal(index[sure], true[sure])
    return blocks, events_of(found)


@pytest.mark.parametrize("size", [-3600.0, -0.02, 0.02, 0.3])
def test_rows_of_a_clock_that_is_set_are_all_kept(size: float) -> None:
    logger = TextLogger(seconds=40.0, steps=((27.77, size),))
    blocks, events = check(by_rows(logger), logger)
    decided = size < 0 or size > 0.1
    if decided:
        assert [event.kind for event in events] == [EventKind.RESET]
        restarts = [b.first_sample for b in blocks[1:] if BlockFlag.CLOCK_RESTART in b.flags]
        assert restarts == [2777]
        assert not any(BlockFlag.MISSING_ESTIMATED in b.flags for b in blocks)


@pytest.mark.parametrize("size", SIGNED)
def test_packets_of_a_clock_that_is_set_are_all_kept(size: float) -> None:
    logger = TextLogger(steps=((67.75, size),))
    blocks, events = check(by_packets(logger), logger)
    assert [event.kind for event in events] == [EventKind.RESET]
    restarts = [b.first_sample for b in blocks[1:] if BlockFlag.CLOCK_RESTART in b.flags]
    assert restarts == [6775]
    assert not any(BlockFlag.MISSING_ESTIMATED in b.flags for b in blocks)


@pytest.mark.parametrize("n", [1, 4, 40])
def test_lost_packets_are_an_exact_gap(n: int) -> None:
    logger = TextLogger(lost=frozenset(range(200, 200 + n)), ppm=80.0)
    blocks, events = check(by_packets(logger), logger, n_lost=25 * n)
    assert not events
    assert not any(b.flags & BlockFlag.MISSING_ESTIMATED for b in blocks)


@pytest.mark.parametrize("n", [1, 20, 400])
def test_lost_rows_are_a_gap_of_their_length(n: int) -> None:
    logger = TextLogger(seconds=40.0, lost=frozenset(range(2000, 2000 + n)), ppm=-80.0)
    blocks, events = check(by_rows(logger), logger, n_lost=n)
    assert not events
    (gap,) = [b for b in blocks if b.reason]
    assert (BlockFlag.MISSING_ESTIMATED in gap.flags) == (n == 1)
    assert gap.first_sample == 2000 + n


@pytest.mark.parametrize(("receive", "length"), [(by_rows, 1), (by_packets, 25)])
@pytest.mark.parametrize(("n_lost", "step"), [(4, 0.0), (0, -0.5), (0, 3600.0)])
def test_what_begins_a_jump_as_the_last_of_a_session_is_recorded(
    receive: Callable[[TextLogger], list[DeviceItem]], length: int, n_lost: int, step: float
) -> None:
    last = 4000 // length - 1
    lost = frozenset(range(last - n_lost, last))
    logger = TextLogger(40.0, lost=lost, steps=((last * length / 100, step),))
    blocks, _ = check(receive(logger), logger, n_lost=n_lost * length)
    assert BlockFlag.MISSING_ESTIMATED in blocks[-1].flags


async def test_a_row_that_begins_a_jump_before_a_hang_up_is_recorded() -> None:
    async def serve(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        rows = [f"{n / 100 + 9 * (n == 299):.2f},{n}\n" for n in range(300)]
        writer.write("".join(rows).encode())

    numbers: list[int] = []
    async with served(serve) as number:
        port, settings = f"socket://127.0.0.1:{number}", {"columns": [1], "time_column": 0}
        one = sensor_at(port, "text", rate=100.0, channels="X", settings=settings)
        async with driver_type("text").open([one], SystemClock()) as session:
            with contextlib.suppress(NotConnectedError):
                async for item in session.read():
                    if isinstance(item, Block):
                        numbers += item.counts[:, 0].astype(int).tolist()
    assert numbers == list(range(1, 300))  # the first may lack its start


@pytest.mark.parametrize(("seed", "packets"), [(0, True), (1, True), (1, False)])
def test_a_busy_host_makes_no_gap_and_no_epoch(seed: int, *, packets: bool) -> None:
    rng = np.random.default_rng(seed)
    begins = np.arange(20.0, 160.0, 20.0)
    stalls = tuple(
        (float(t), float(t + d)) for t, d in zip(begins, rng.uniform(1, 15, 7), strict=True)
    )
    logger = TextLogger(seconds=180.0, jitter=0.2, stalls=stalls, ppm=300.0, seed=seed)
    blocks, events = check(by_packets(logger) if packets else by_rows(logger), logger)
    assert not events
    assert not any(b.flags & ~BlockFlag.DEVICE_UTC for b in blocks[1:])
