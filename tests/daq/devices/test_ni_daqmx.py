"""NI-DAQmx: the driver and the package nidaqmx on a stand-in for National Instruments' C library.

The stand-in (tests/peers/nidaqmx_stand_in.c) is a shared library, compiled here. It follows NI's
reference help; docs/hardware-checks.md says what only hardware shows.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import itertools
import shutil
import subprocess
from collections.abc import AsyncGenerator, AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.model import Sensor
from daq.conformance.suite import PAUSE, DriverConformance, Sent, Served, check_truth
from daq.devices.interface import PresentPort
from daq.devices.ni_daqmx import DRIVER
from daq.errors import BenchFileError, NotConnectedError
from daq.host_clock import SystemClock
from daq.protocols.block import Block, BlockFlag
from tests.sensors import sensor_at

RATE = 2048.0
INPUTS = {"A": (0, 1, 2), "B": (5, 7, 4)}
SOURCE = Path(__file__).parents[2] / "peers" / "nidaqmx_stand_in.c"
pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


class StandIn:
    """The library, its converters and what can be done to them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._library = ctypes.CDLL(str(path))
        self._library.si_read.restype = ctypes.c_uint64

    def unplug(self, *, now: bool = True) -> None:
        """Pull the cable, or put it back."""
        self._library.si_unplug(int(now))

    def hang(self, seconds: float) -> None:
        """Let the next read take that long."""
        self._library.si_hang(ctypes.c_double(seconds))

    def hold(self, *, now: bool = True) -> None:
        """Pause the sample clock, or let it run."""
        self._library.si_hold(int(now))

    def limit(self, seconds: float = 1e6) -> None:
        """Limit the buffers of tasks."""
        ctypes.c_uint64.in_dll(self._library, "si_buffer").value = round(seconds * RATE)

    def amplify(self, gain: float) -> None:
        """Amplify the motion."""
        ctypes.c_double.in_dll(self._library, "si_gain").value = gain

    def attribute(self, name: str, number: int, kind: Any) -> Any:  # noqa: ANN401
        """Return how an input of the last task was set up."""
        value = kind()
        task = ctypes.c_void_p.in_dll(self._library, "si_task")
        self._library.DAQmxGetChanAttribute(task, name.encode(), number, ctypes.byref(value))
        return value.value

    def sent(self, inputs: tuple[int, ...]) -> Sent:
        """Return all samples up to the last that was read."""
        n = self._library.si_read()
        n_segments = ctypes.c_int.in_dll(self._library, "si_n_segments").value
        counts = (ctypes.c_uint64 * 64).in_dll(self._library, "si_count")[:n_segments]
        at = (ctypes.c_double * 64).in_dll(self._library, "si_at")
        index = np.arange(n)
        due = np.empty(n)
        for k, count in enumerate(counts):
            due[count:] = at[k] + (index[count:] + 1 - count) / RATE
        return Sent(volts(index, inputs), due)


def volts(index: NDArray[np.int64], inputs: tuple[int, ...]) -> NDArray[np.float64]:
    """Return what the converters of the stand-in give, by a formula of its own."""
    code = (index[:, None] * 7919 + np.array(inputs) * 104729 + 12345) % 2**23 - 2**22
    return np.asarray(code * 5.0 / 2**23, np.float64)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> StandIn:
    path = tmp_path_factory.mktemp("ni") / "libnidaqmx.so"
    options = ["-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", "-pthread"]
    subprocess.run(["cc", *options, "-o", path, SOURCE], check=True)
    return StandIn(path)


@pytest.fixture
def device(library: StandIn, monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIn]:
    """Let nidaqmx find the stand-in where it looks for the library."""
    _found_at(monkeypatch, str(library.path))
    yield library
    library.unplug(now=False)
    library.amplify(1.0)
    library.limit()


def _found_at(monkeypatch: pytest.MonkeyPatch, path: str | None) -> None:
    from nidaqmx import _lib  # noqa: PLC0415 -- the package has no other way

    def find_library(name: str) -> str | None:
        assert name == "nidaqmx"
        return path

    monkeypatch.setattr(_lib, "find_library", find_library)
    monkeypatch.setattr(_lib, "lib_importer", _lib.lib_importer)
    for name in ("_windll", "_cdll"):
        monkeypatch.setattr(_lib.lib_importer, name, None)


def sensors(port: str = "ni://cDAQ1", **settings: object) -> list[Sensor]:
    found = []
    for name, numbers in INPUTS.items():
        own = {"inputs": [f"Mod{1 + k // 4}/ai{k % 4}" for k in numbers], **settings}
        found.append(sensor_at(port, "nidaqmx", name, rate=RATE, settings=own))
    return found


class TestNiDaqmx(DriverConformance):
    """Two sensors on two modules of a chassis."""

    driver = DRIVER

    @pytest.fixture(autouse=True)
    def _device(self, device: StandIn) -> None:
        self.device = device

    @contextlib.asynccontextmanager
    async def serve(self) -> AsyncIterator[Served]:
        """Serve the stand-in."""

        def overrun() -> None:
            self.device.limit(0.4)
            self.device.hang(0.8)

        yield Served(
            sensors(),
            vanish=self.device.unplug,
            truth=lambda name: self.device.sent(INPUTS[name]),
            drop=overrun,
            pause=lambda: self.device.hang(PAUSE),
        )


async def read(bench: list[Sensor], n_samples: int) -> AsyncGenerator[Block]:
    """Yield the blocks of the first sensor up to a sample."""
    async with DRIVER.open(bench, SystemClock()) as session:
        items = cast("AsyncGenerator[Block]", session.read())
        async with contextlib.aclosing(items):
            async for block in items:
                if block.sensor == bench[0].name:
                    yield block
                    if block.end_sample >= n_samples:
                        return


async def exhausted(blocks: AsyncGenerator[Block]) -> None:
    """Read to the end."""
    async for _ in blocks:
        pass


async def test_the_gap_after_an_overrun_has_its_length(device: StandIn) -> None:
    """The library holds up its reads for longer than its buffer."""
    device.limit(0.5)
    bench = sensors()
    found: list[Block] = []
    async for block in read(bench, round(2 * RATE)):
        if not found:
            device.hang(1.0)
        found.append(block)
    gaps = [b for a, b in itertools.pairwise(found) if b.first_sample != a.end_sample]
    assert [one.reason for one in gaps] == ["overrun of the buffer of NI-DAQmx"]
    assert BlockFlag.MISSING_ESTIMATED not in gaps[0].flags
    assert [block.device_counter for block in found] == [block.first_sample for block in found]
    check_truth(bench[0], found, device.sent(INPUTS["A"]), gaps=True)


async def test_the_suite_sees_wrong_rows_of_fractions(device: StandIn) -> None:
    """Volts are below 0.5, where whole counts would be called equal."""
    device.amplify(0.05)
    found = [block async for block in read(sensors(), 3000)]
    sent = device.sent(INPUTS["A"])
    check_truth(sensors()[0], found, replace(sent, counts=0.05 * sent.counts))
    with pytest.raises(AssertionError, match="channels or scale are wrong"):
        check_truth(sensors()[0], found, replace(sent, counts=0.05 * sent.counts[:, ::-1]))


async def test_samples_before_a_stall_are_handed_on(device: StandIn) -> None:
    """The sample clock pauses within a read, then runs again."""
    found: list[Block] = []
    async for block in read(sensors(), 3000):
        found.append(block)
        if len(found) == 3:
            device.hold()
        if block.n_samples < found[0].n_samples:  # those taken before the pause
            device.hold(now=False)
    assert any(block.n_samples < found[0].n_samples for block in found)
    counts = np.concatenate([block.counts for block in found])
    assert found[-1].end_sample == len(counts)
    np.testing.assert_array_equal(counts, volts(np.arange(len(counts)), INPUTS["A"]))


async def test_an_unplugged_device_is_found_again(device: StandIn) -> None:
    blocks = read(sensors(), 10**9)
    await anext(blocks)
    device.unplug()
    with pytest.raises(NotConnectedError, match=r"'A', 'B' on ni://cDAQ1: Device cannot be acc"):
        await exhausted(blocks)
    with pytest.raises(NotConnectedError, match="identifier is invalid"):
        await anext(read(sensors(), 1))
    device.unplug(now=False)
    blocks = read(sensors(), 1)
    async with contextlib.aclosing(blocks):
        again = await anext(blocks)
    np.testing.assert_array_equal(again.counts, volts(np.arange(again.n_samples), INPUTS["A"]))


async def test_a_device_in_use_says_so(device: StandIn) -> None:
    del device
    blocks, others = read(sensors(), 10**9), read(sensors(), 1)
    async with contextlib.aclosing(blocks), contextlib.aclosing(others):
        await anext(blocks)
        with pytest.raises(NotConnectedError, match="resource is reserved"):
            await anext(others)


async def test_devices_and_rates_are_stated(device: StandIn) -> None:
    del device
    wanted = [one.model_copy(update={"sampling_rate": 100.0}) for one in sensors()]
    async with DRIVER.open(wanted, SystemClock()) as session:
        first, second = session.information
    assert (first.model, first.serial_number) == ("NI 9234", "1A2B3C1")
    assert second.details == {"inputs": "cDAQ1Mod2/ai1, cDAQ1Mod2/ai3, cDAQ1Mod2/ai0"}
    assert first.sampling_rate == pytest.approx(51200 / 31)  # the lowest of an NI 9234


def test_present_devices_are_listed(device: StandIn) -> None:
    assert DRIVER.ports() == [
        PresentPort("ni://cDAQ1", "cDAQ-9174"),
        PresentPort("ni://cDAQ1Mod1", "NI 9234"),
        PresentPort("ni://cDAQ1Mod2", "NI 9234"),
    ]
    device.unplug()
    assert not DRIVER.ports()


async def test_inputs_are_set_up(device: StandIn) -> None:
    bench = sensors(excitation=0.002, coupling="ac", terminal="pseudodifferential")
    async with DRIVER.open(bench, SystemClock()):
        for name in ("cDAQ1Mod1/ai0", "cDAQ1Mod2/ai3"):
            assert device.attribute(name, 0x17F5, ctypes.c_double) == 0.002  # A
            assert device.attribute(name, 0x17F4, ctypes.c_int32) == 10200  # internal
            assert device.attribute(name, 0x17F6, ctypes.c_int32) == 10134  # a current
            assert device.attribute(name, 0x64, ctypes.c_int32) == 10045  # AC
            assert device.attribute(name, 0x1097, ctypes.c_int32) == 12529


async def test_clipping_is_flagged(device: StandIn) -> None:
    device.amplify(4.0)
    found = [block async for block in read(sensors(), 1)]
    assert BlockFlag.CLIPPED in found[0].flags
    device.amplify(1.0)
    found = [block async for block in read(sensors(), 1)]
    assert BlockFlag.CLIPPED not in found[0].flags


async def test_values_that_the_device_refuses_are_named(device: StandIn) -> None:
    del device
    with pytest.raises(NotConnectedError, match=r"not a supported value: AI\.Max"):
        await anext(read(sensors(range=50.0), 1))
    fast = [one.model_copy(update={"sampling_rate": 1e5}) for one in sensors()]
    with pytest.raises(NotConnectedError, match=r"not a supported value: SampClk\.Rate"):
        await anext(read(fast, 1))


async def test_without_ni_daqmx_there_is_advice(
    device: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    del device
    _found_at(monkeypatch, None)
    with pytest.raises(NotConnectedError, match="NI-DAQmx is installed on this machine"):
        await anext(read(sensors(), 1))


@pytest.mark.parametrize(
    ("port", "settings", "said"),
    [
        ("/dev/ttyUSB0", {}, "expected ni:// and the name"),
        ("ni://", {}, "expected ni:// and the name"),
        ("ni://cDAQ1", {"inputs": ["Mod1/ai0"]}, "one for each of the sensor's"),
        ("ni://cDAQ1", {"inputs": ["ai0", "ai1", "/ai0"]}, "already an input of sensor 'A'"),
    ],
)
def test_impossible_settings_are_refused(port: str, settings: dict[str, Any], said: str) -> None:
    with pytest.raises(BenchFileError, match=said):
        DRIVER.check(sensors(port, **settings))


async def test_inputs_follow_those_of_the_sensor_before(device: StandIn) -> None:
    bench = [
        one.model_copy(update={"settings": {}, "port": "ni://cDAQ1Mod1", "channels": channels})
        for one, channels in zip(
            sensors(), (sensors()[0].channels[:1], sensors()[0].channels), strict=True
        )
    ]
    found: dict[str, Block] = {}
    async with (
        asyncio.timeout(60),
        DRIVER.open(bench, SystemClock()) as session,
        contextlib.aclosing(cast("AsyncGenerator[Block]", session.read())) as items,
    ):
        async for block in items:
            found.setdefault(block.sensor, block)
            if len(found) == 2:
                break
    del device
    index = np.arange(found["A"].n_samples)
    np.testing.assert_array_equal(found["A"].counts, volts(index, (0,)))
    np.testing.assert_array_equal(found["B"].counts, volts(index, (1, 2, 3)))
