"""The driver contract, as another package runs it: the example passes, broken drivers do not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.waiting import limit

EXAMPLE = Path(__file__).parents[2] / "examples" / "driver"
BROKEN = """
import asyncio
import contextlib
import dataclasses
import time

import huddle_ax3.driver
from daq.devices import interface
from daq.errors import NoAnswerError
from daq.protocols.block import Block, BlockFlag, HostTime
from tests_of_the_example import TestAX3 as Sound


def _changed(block, **changes):
    return dataclasses.replace(block, **changes)


def _at(block, offset_ns):
    at = block.received
    return _changed(block, received=HostTime(at.monotonic_ns + offset_ns, at.utc_ns + offset_ns))


class Session(interface.Session):
    def __init__(self, session):
        self._session = session
        self.information = tuple(map(self.stated, session.information))

    def stated(self, information):
        return information

    def read(self):
        return self.broken(self._session.read())

    async def broken(self, items):
        async for item in items:
            yield self.block(item) if isinstance(item, Block) else item

    def block(self, block):
        return block


def broken(session, settings=lambda sensor: sensor, seconds=1.0):
    class Driver(type(huddle_ax3.driver.DRIVER)):
        @contextlib.asynccontextmanager
        async def open(self, sensors, clock):
            async with super().open([settings(s) for s in sensors], clock) as sound:
                yield session(sound)

    return type("Broken", (Sound,), {"driver": Driver(), "seconds": seconds})


class LosesBlocks(Session):
    async def broken(self, items):
        n = 0
        async for item in items:
            n += 1
            if n != 3:
                yield item


TestLosesBlocks = broken(LosesBlocks)


class AnotherType(Session):
    def block(self, block):
        return _changed(block, counts=block.counts.astype("i8"))


TestAnotherType = broken(AnotherType)


class NoRestartFlag(Session):
    def block(self, block):
        return _changed(block, flags=block.flags & ~BlockFlag.CLOCK_RESTART)


TestNoRestartFlag = broken(NoRestartFlag)


class Impatient(Session):
    async def broken(self, items):
        while True:
            try:
                async with asyncio.timeout(1.0):
                    item = await anext(items)
            except TimeoutError as error:
                raise NoAnswerError("no block for 1 s") from error
            yield item


TestImpatient = broken(Impatient)


class DropsOneInFifty(Session):
    async def broken(self, items):
        n_seen = n_given = 0
        async for item in items:
            kept = [k for k in range(item.n_samples) if (n_seen + k) % 50 != 49]
            n_seen += item.n_samples
            yield _changed(
                item, first_sample=n_given, counts=item.counts[kept], device_counter=None
            )
            n_given += len(kept)


TestDropsOneInFifty = broken(DropsOneInFifty)


class HostTimeIsEarly(Session):
    def block(self, block):
        return _at(block, -500_000_000)


TestHostTimeIsEarly = broken(HostTimeIsEarly)


class HostTimeIsLate(Session):
    def block(self, block):
        return _at(block, 500_000_000)


TestHostTimeIsLate = broken(HostTimeIsLate)


class HostTimeIsTenPercentFast(Session):
    async def broken(self, items):
        async for item in items:
            yield _at(item, round(item.end_sample / 100.0 * 1e8))


TestHostTimeIsTenPercentFast = broken(HostTimeIsTenPercentFast, seconds=2.0)


class StatedRateIsTenPercentOff(Session):
    def stated(self, information):
        return dataclasses.replace(information, sampling_rate=110.0)


TestStatedRateIsTenPercentOff = broken(StatedRateIsTenPercentOff)


class SetsAnotherRate(Session):
    def stated(self, information):
        return dataclasses.replace(information, sampling_rate=100.0)


TestSetsAnotherRate = broken(SetsAnotherRate, lambda s: s.model_copy(update={"sampling_rate": 200}))


class ChannelsAreReversed(Session):
    def block(self, block):
        return _changed(block, counts=block.counts[:, ::-1])


TestChannelsAreReversed = broken(ChannelsAreReversed)


class CounterIsConstant(Session):
    def block(self, block):
        return _changed(block, device_counter=7)


TestCounterIsConstant = broken(CounterIsConstant)


class BlocksTheLoop(Session):
    def block(self, block):
        time.sleep(0.08)
        return block


TestBlocksTheLoop = broken(BlocksTheLoop)


class ForgetsGaps(Session):
    async def broken(self, items):
        n_given = 0
        async for item in items:
            yield _changed(item, first_sample=n_given)
            n_given += item.n_samples


TestForgetsGaps = broken(ForgetsGaps)


class HoldsTheLastBlock(Session):
    async def broken(self, items):
        held = await anext(items)
        async for item in items:
            yield held
            held = item


TestHoldsTheLastBlock = broken(HoldsTheLastBlock)


class TakesCountedRowsForKnown(Session):
    async def broken(self, items):
        known, n_given = set(), 0
        async for item in items:
            kept = [k for k, row in enumerate(item.counts) if row.tobytes() not in known]
            known |= {row.tobytes() for row in item.counts}
            if kept:
                counts = item.counts[kept]
                yield _changed(item, first_sample=n_given, counts=counts, device_counter=None)
            n_given += len(kept)


TestTakesCountedRowsForKnown = broken(TakesCountedRowsForKnown)


class ForgetsRestarts(Session):
    def block(self, block):
        return _changed(block, flags=block.flags if block.first_sample == 0 else BlockFlag.NONE)


TestForgetsRestarts = broken(ForgetsRestarts)


class RestartsWithoutGap(Session):
    async def broken(self, items):
        n_given = 0
        async for item in items:
            if isinstance(item, Block):
                yield _changed(item, first_sample=n_given, reason="")
                n_given += item.n_samples


TestRestartsWithoutGap = broken(RestartsWithoutGap)


del Sound
"""
FAILING = {
    "LosesBlocks": ("test_blocks_are_in_order_and_whole", "samples were lost"),
    "AnotherType": (
        "test_blocks_are_in_order_and_whole",
        "assert dtype('int64') == dtype('int32')",
    ),
    "NoRestartFlag": ("test_blocks_are_in_order_and_whole", "the sampling clock begins here"),
    "Impatient": ("test_a_pause_ends_nothing", "no block for 1 s"),
    "DropsOneInFifty": (
        "test_rows_times_and_rate_are_those_of_the_device",
        "rows are not those of their numbers",
    ),
    "HostTimeIsEarly": (
        "test_rows_times_and_rate_are_those_of_the_device",
        "s before it was sampled",
    ),
    "HostTimeIsLate": (
        "test_rows_times_and_rate_are_those_of_the_device",
        "s after the last sample",
    ),
    "HostTimeIsTenPercentFast": (
        "test_rows_times_and_rate_are_those_of_the_device",
        "host time runs away",
    ),
    "StatedRateIsTenPercentOff": (
        "test_rows_times_and_rate_are_those_of_the_device",
        "stated rate 110 Hz",
    ),
    "SetsAnotherRate": ("test_rows_times_and_rate_are_those_of_the_device", "measured rate 200 Hz"),
    "ChannelsAreReversed": (
        "test_rows_times_and_rate_are_those_of_the_device",
        "channels or scale are wrong",
    ),
    "CounterIsConstant": (
        "test_rows_times_and_rate_are_those_of_the_device",
        "device_counter of A does not grow",
    ),
    "BlocksTheLoop": ("test_the_event_loop_is_not_blocked", "the event loop was blocked"),
    "ForgetsGaps": ("test_lost_samples_become_a_gap", "rows are not those of their numbers"),
    "HoldsTheLastBlock": (
        "test_a_hang_up_after_an_arrival_loses_nothing_that_arrived",
        "samples had arrived and were not handed on",
    ),
    "TakesCountedRowsForKnown": (
        "test_samples_that_no_counter_shows_change_nothing[counted twice]",
        "rows are not those of their numbers",
    ),
    "ForgetsRestarts": ("test_a_restart_of_the_device_is_flagged", "1 blocks with CLOCK_RESTART"),
    "RestartsWithoutGap": ("test_a_restart_of_the_device_is_flagged", "the gap is off by"),
}
"""The test that catches each broken driver, and what it says."""


def run_suite(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run pytest as in the package of the example."""
    paths = os.pathsep.join((str(EXAMPLE), str(EXAMPLE.parents[1]), str(folder)))
    options = ["-q", "-p", "no:cacheprovider", "-c", os.devnull, "-o", "asyncio_mode=auto"]
    return subprocess.run(
        [sys.executable, "-m", "pytest", *options, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={
            **os.environ,
            "COLUMNS": "400",
            "PYTHONPATH": paths,
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        },
        timeout=limit(),
    )


PLUGINS = ("-p", "daq.conformance.plugin", "-p", "pytest_asyncio")


@pytest.mark.parametrize(
    ("chosen", "n_tests"),
    [
        ("TestAX3", 14),
        ("TestSdk and (rows or loop or hang_up or restart)", 4),
        pytest.param("TestSdk", 14, marks=pytest.mark.long),
    ],
)
def test_the_examples_pass_their_suite(chosen: str, n_tests: int, tmp_path: Path) -> None:
    """The driver with a protocol of its own, and the one through a library that blocks."""
    done = run_suite(tmp_path, *PLUGINS, "-k", chosen, str(EXAMPLE / "tests"))
    assert done.returncode == 0, done.stdout
    assert f"{n_tests} passed" in done.stdout


@pytest.mark.long
def test_the_suite_catches_every_broken_driver(tmp_path: Path, subtests: pytest.Subtests) -> None:
    """Also those that yield blocks in perfect order: rows, times, rates or the loop are wrong."""
    sound = (EXAMPLE / "tests" / "test_conformance.py").read_text(encoding="utf-8")
    (tmp_path / "tests_of_the_example.py").write_text(sound, encoding="utf-8")
    (tmp_path / "test_broken.py").write_text(BROKEN, encoding="utf-8")
    chosen = [f"test_broken.py::Test{name}::{test}" for name, (test, _) in FAILING.items()]
    done = run_suite(tmp_path, *PLUGINS, *chosen)
    failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
    for one, (name, (_, reason)) in zip(chosen, FAILING.items(), strict=True):
        with subtests.test(name):
            assert any(one in line and reason in line for line in failed), done.stdout
