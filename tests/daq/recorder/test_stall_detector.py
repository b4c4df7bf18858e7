"""When blocks are overdue: at two block periods late, later lost, by the event loop's clock."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from daq.devices.interface import DEFAULT_PATIENCE
from daq.protocols.block import Block, HostTime
from daq.recorder.stall_detector import (
    MIN_LATE_AFTER,
    STALL_MARGIN,
    BlockInterval,
    StallDetector,
)
from tests.virtual_time import VirtualTimeLoop

pytestmark = pytest.mark.virtual_time

RATE = 100.0
NOW = HostTime(0, 0)


def block(sensor: str, n_samples: int) -> Block:
    return Block(sensor, 0, np.zeros((n_samples, 1), np.int32), NOW)


class Said:
    """What a watch says, and when."""

    def __init__(self) -> None:
        self.items: list[tuple[str, str, float]] = []
        self.news = asyncio.Event()
        self.refused = 0

    def __call__(self, sensor: str, stage: str, seconds: float) -> bool:
        """Take it, but for the first ``refused``."""
        if self.refused:
            self.refused -= 1
            return False
        self.items.append((sensor, stage, seconds))
        self.news.set()
        return True

    async def wait(self, n: int) -> None:
        """Return when so much has been said."""
        while len(self.items) < n:
            self.news.clear()
            await self.news.wait()


@pytest.fixture
def said() -> Said:
    return Said()


async def test_late_is_reported_two_block_periods_after_the_last_block(said: Said) -> None:
    """Not at the next look of a clock that ticks: at that very instant."""

    async def wait() -> None:
        async with StallDetector({"a": RATE}, said) as watch:
            watch.block_received(block("a", 20))
            with watch.waiting():
                await asyncio.Event().wait()

    with pytest.raises(TimeoutError):
        await wait()
    ((sensor, stage, after),) = said.items
    assert (sensor, stage) == ("a", "late")
    assert after == pytest.approx(0.4)
    assert asyncio.get_running_loop().time() == pytest.approx(DEFAULT_PATIENCE)


async def test_a_block_ends_the_late_state(said: Said) -> None:
    async with StallDetector({"a": RATE}, said) as watch:
        watch.block_received(block("a", 20))
        with watch.waiting():
            await said.wait(1)
            watch.block_received(block("a", 20))
            await said.wait(2)
    assert [item[:2] for item in said.items] == [("a", "late")] * 2
    assert [after for _, _, after in said.items] == pytest.approx([0.4, 0.4])


async def test_one_of_several_sensors_on_a_port_can_be_lost(said: Said) -> None:
    async with StallDetector({"a": RATE, "b": RATE}, said) as watch:
        watch.block_received(block("a", 10))
        with watch.waiting():
            while len(said.items) < 2:
                watch.block_received(block("b", 10))
                await asyncio.sleep(0.1)
    assert [item[:2] for item in said.items] == [("a", "late"), ("a", "stalled")]


async def test_a_report_that_was_not_accepted_is_repeated(said: Said) -> None:
    said.refused = 3
    async with StallDetector({"a": RATE}, said) as watch:
        watch.block_received(block("a", 10))
        with watch.waiting():
            await said.wait(1)
    assert said.refused == 0


async def test_a_busy_host_makes_no_device_late(said: Said) -> None:
    async with StallDetector({"a": RATE}, said) as watch:
        watch.block_received(block("a", 10))
        with watch.waiting():
            loop = asyncio.get_running_loop()
            assert isinstance(loop, VirtualTimeLoop)
            loop.hold_up(1.0)
            await asyncio.sleep(0.05)
            watch.block_received(block("a", 10))
    assert not said.items


async def test_no_sensor_is_late_while_no_task_waits(said: Said) -> None:
    """Writing lags: blocks are there, and not asked for."""
    async with StallDetector({"a": RATE}, said) as watch:
        watch.block_received(block("a", 10))
        await asyncio.sleep(0.6)
    assert not said.items


async def test_a_device_that_recovers_is_late_and_not_lost(
    said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.recorder.stall_detector.MAX_RECOVERY", 1.0)
    rates = {"a": RATE, "b": RATE}

    async def wait(watch: StallDetector) -> None:
        async with watch:
            for sensor in rates:
                watch.block_received(block(sensor, 10))
            with watch.waiting():
                await asyncio.Event().wait()

    recovering = StallDetector(rates, said, patience=0.5, is_recovering=lambda: True)
    with pytest.raises(TimeoutError):
        await wait(recovering)
    assert recovering.seconds == pytest.approx(1.0)  # not for ever
    assert sorted(item[:2] for item in said.items) == [("a", "late"), ("b", "late")]
    stalled = StallDetector(rates, said, patience=0.5, is_recovering=lambda: False)
    with pytest.raises(TimeoutError):
        await wait(stalled)
    assert stalled.seconds == pytest.approx(0.5)


def test_one_lost_block_is_no_stall() -> None:
    """The next of a second each comes two seconds after the last, and a little: no sooner."""
    patience = BlockInterval(0.0, 10.0, patience=0.5)
    assert patience.stalled_after == 10.0
    for second in range(1, 6):
        patience.block_received(float(second), 1.0)
    assert patience.late_after == 2.0
    assert 2.1 < patience.stalled_after <= 2.5


def test_patience_follows_the_blocks() -> None:
    patience = BlockInterval(0.0, 10.0, patience=0.5)
    patience.block_received(1.0, 0.01)
    assert patience.late_after == MIN_LATE_AFTER
    patience.block_received(2.0, 0.2)  # it came late, which is no reason to wait longer with a word
    assert patience.late_after == pytest.approx(0.4)
    assert patience.stalled_after == pytest.approx(2.0 + STALL_MARGIN)
    for k in range(300):
        patience.block_received(2.0 + 0.1 * (k + 1), 0.1)
    assert patience.late_after == pytest.approx(0.2)
    assert patience.stalled_after == pytest.approx(0.5, abs=0.01)


def test_many_blocks_at_once_do_not_shorten_the_patience() -> None:
    """A logger writes 3 s of rows at once, which arrive in fifty pieces."""
    patience = BlockInterval(0.0, 10.0, patience=0.5)
    for second in range(0, 30, 3):
        for piece in range(50):
            patience.block_received(second + 1e-3 * piece, 0.06)
    assert patience.stalled_after > 5.0
