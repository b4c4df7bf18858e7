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
import dataclasses

import huddle_ax3.driver
from daq.errors import NoAnswerError
from daq.protocols.block import Block
from tests_of_the_example import TestAX3 as Sound


class Session:
    def __init__(self, session):
        self._session = session
        self.information = session.information

    async def read(self):
        {read}


class Driver(type(huddle_ax3.driver.DRIVER)):
    def open(self, sensors, clock):
        import contextlib

        @contextlib.asynccontextmanager
        async def opened():
            async with super(Driver, self).open(sensors, clock) as session:
                yield Session(session)

        return opened()


class TestBroken(Sound):
    driver = Driver()


del Sound
"""
BREAKS = {
    "loses blocks": (
        """n = 0
        async for item in self._session.read():
            n += 1
            if n != 3:
                yield item""",
        "test_blocks_are_in_order_and_whole",
    ),
    "another type": (
        """async for item in self._session.read():
            if isinstance(item, Block):
                item = dataclasses.replace(item, counts=item.counts.astype("i8"))
            yield item""",
        "test_blocks_are_in_order_and_whole",
    ),
    "impatient": (
        """items = self._session.read()
        while True:
            try:
                async with asyncio.timeout(1.0):
                    item = await anext(items)
            except TimeoutError as error:
                raise NoAnswerError("no block for 1 s") from error
            yield item""",
        "test_a_pause_ends_nothing",
    ),
}


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
        env={**os.environ, "PYTHONPATH": paths, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        timeout=limit(),
    )


def test_the_example_passes_its_suite(tmp_path: Path) -> None:
    plugin = ("-p", "daq.conformance.plugin", "-p", "pytest_asyncio")
    done = run_suite(tmp_path, *plugin, str(EXAMPLE / "tests"))
    assert done.returncode == 0, done.stdout
    assert "6 passed, 1 skipped" in done.stdout


@pytest.mark.parametrize(
    "name",
    [
        name if number == 0 else pytest.param(name, marks=pytest.mark.long)
        for number, name in enumerate(BREAKS)
    ],
)
def test_a_broken_driver_fails(name: str, tmp_path: Path) -> None:
    read, failing = BREAKS[name]
    sound = (EXAMPLE / "tests" / "test_conformance.py").read_text(encoding="utf-8")
    (tmp_path / "tests_of_the_example.py").write_text(sound, encoding="utf-8")
    (tmp_path / "test_broken.py").write_text(BROKEN.replace("{read}", read), encoding="utf-8")
    plugin = ("-p", "daq.conformance.plugin", "-p", "pytest_asyncio", "-k", failing)
    done = run_suite(tmp_path, *plugin, "test_broken.py")
    assert done.returncode == 1, done.stdout
    assert f"FAILED test_broken.py::TestBroken::{failing}" in done.stdout
