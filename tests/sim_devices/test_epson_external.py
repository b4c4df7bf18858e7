"""What the EXT pin does: a trigger for every sample, or 1PPS on the M-A370."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.model import Sensor
from daq.devices.epson import commands
from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError, WrongDeviceError
from daq.transport.ports import open_port
from sim_devices.devices.interface import Source
from sim_devices.server.launch import RunningDevice
from sim_devices.server.serve import device_spec
from sim_devices.world.scenario import Scenario
from tests.daq.devices.reading import record
from tests.devices import host_clock, paced_clock, serving
from tests.sim_devices.simulated_bench import device, sensors, spec

pytestmark = pytest.mark.devices

SPEED = 8.0
DRIVER = driver_type("epson")
XYZ = [{"name": axis, "sensitivity": commands.COUNTS_PER_UNIT} for axis in "xyz"]
OFF = 500.0
"""ppm of the devices' own clocks."""
TABLES = {
    "pps": device(
        "pps", model="M-A370", channels={"pps": XYZ}, settings={"external": "pps-rising"}
    ),
    "none": device("none", model="M-A370", channels={"none": XYZ}),
    "trigger": device(
        "trigger",
        model="M-A370",
        channels={"trigger": XYZ},
        sampling_rate=100.0,
        settings={"external": "trigger-rising"},
    ),
    "A352": device("A352", model="M-A352", channels={"A352": XYZ}),
}


def world() -> dict[str, Any]:
    told = spec(*TABLES.values(), speed=SPEED)
    for table in told["scenario"]["sensors"].values():
        table["clock"] = {"offset": 0.0021, "ppm": OFF}
    return told


class Running(dict[str, "RunningDevice"]):
    """The devices of a world that began when they did, by sensor."""

    def __init__(self, spec: dict[str, Any], devices: Sequence[RunningDevice]) -> None:
        super().__init__({one.sensors[0]: one for one in devices})
        self.spec = spec

    def source(self, name: str) -> Source:
        """Return what a sensor of it reads."""
        return Source(Scenario.from_dict(self.spec["scenario"]), device_spec(TABLES[name]))


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    spec = world()
    with serving(spec) as devices:
        yield Running(spec, devices)


def connecting(running: Running, name: str, **changes: Any) -> Sensor:  # noqa: ANN401
    (sensor,) = sensors(running[name], TABLES[name], **changes)
    return sensor


async def mismatch(sensor: Sensor, truth: Source) -> float:
    """Return how far 800 samples are from what ``truth`` took, in counts."""
    blocks, events = await record(DRIVER, sensor, 800, speed=SPEED)
    assert not events
    ends = [0, *(block.end_sample for block in blocks)]
    assert [block.first_sample for block in blocks] == ends[:-1]
    counts: NDArray[Any] = np.concatenate([block.counts for block in blocks])[:800]
    taken = truth.counts(sensor.name, 0, round(600 * truth.sampling_rate))
    start = int(np.argmin(np.abs(taken - counts[0]).max(axis=1)))
    return float(np.abs(taken[start : start + 800] - counts).max())


@pytest.mark.parametrize("edge", ["rising", "falling"])
async def test_samples_are_synchronised_with_the_seconds(running: Running, edge: str) -> None:
    sensor = connecting(running, "pps", settings={"external": f"pps-{edge}"})
    whole_seconds = -paced_clock().utc_of(running.spec["epoch_ns"]) % 10**9 / 1e9
    # The system's UTC at world time 0 is known to some µs, and is another one here and there.
    truth = running.source("pps").disciplined(whole_seconds)
    alone = await mismatch(sensor, running.source("pps"))
    assert await mismatch(sensor, truth) < 0.02 * alone


async def test_without_pps_a_device_samples_by_its_own_clock(
    running: Running,
) -> None:
    sensor = connecting(running, "none", settings={"external": "pps-rising"})
    assert await mismatch(sensor, running.source("none")) <= 0.5


async def test_every_trigger_makes_a_sample(running: Running) -> None:
    settings = {"external": "trigger-falling"}
    sensor = connecting(running, "trigger", settings=settings)
    truth = running.source("trigger").disciplined(0.0)
    assert await mismatch(sensor, truth) <= 0.5


async def test_without_a_trigger_there_is_no_sample(running: Running) -> None:
    sensor = connecting(running, "A352", settings={"external": "trigger-rising"})
    with pytest.raises(NoAnswerError, match="one per trigger; check the signal at EXT"):
        await record(DRIVER, sensor, 1, speed=SPEED)


async def test_a_model_without_pps_is_refused(running: Running) -> None:
    sensor = connecting(running, "A352", settings={"external": "pps-rising"})
    with pytest.raises(WrongDeviceError, match=r'"pps-rising": only an M-A370 follows 1PPS'):
        await record(DRIVER, sensor, 1, speed=SPEED)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"filter": "K128_FC350"}, r'settings.filter = "K128_FC350": an M-A370 has K64_FC83, K128'),
        ({"reduced_noise": True}, "settings.reduced_noise = true: only an M-A352 has it"),
        (
            {"temperature_stabilisation": True},
            "settings.temperature_stabilisation = true: only an M-A352 has it",
        ),
    ],
)
async def test_settings_that_an_a370_lacks_are_refused(
    running: Running, settings: dict[str, Any], said: str
) -> None:
    """As soon as the model is known: in the bench file, or from the device."""
    named = connecting(running, "none", settings=settings, model="M-A370")
    with pytest.raises(BenchFileError, match=rf'sensors\["none"\]\.{said}'):
        checked([named])
    unnamed = connecting(running, "none", settings=settings)
    checked([unnamed])
    with pytest.raises(WrongDeviceError, match=rf'{unnamed.port}: sensors\["none"\]\.{said}'):
        await record(DRIVER, unnamed, 1, speed=SPEED)


def checked(some: list[Sensor]) -> None:
    DRIVER.check(some)


@pytest.mark.parametrize(
    ("name", "register", "expected"),
    [
        ("none", commands.SIG_CTRL, 0x00),
        ("none", commands.FILTER_CTRL, commands.FILTERS["K512_FC210"]),
        ("A352", commands.SIG_CTRL, 0x04),
        ("A352", commands.FILTER_CTRL, commands.FILTERS["K512_FC460"]),
    ],
)
async def test_a_model_is_configured_with_its_own_settings(
    running: Running, name: str, register: commands.Register, expected: int
) -> None:
    """At 1000 Hz, with nothing said of filter and stabilisation."""
    assert await low_byte(connecting(running, name, sampling_rate=1000.0), register) == expected


@pytest.mark.parametrize(
    ("external", "bits"),
    [
        ("off", 0b000),
        ("trigger-rising", 0b010),
        ("trigger-falling", 0b011),
        ("pps-rising", 0b100),
        ("pps-falling", 0b101),
    ],
)
async def test_the_register_has_the_ext_setting(running: Running, external: str, bits: int) -> None:
    """MSC_CTRL: bit 6 EXT_SEL, bit 5 EXT_POL; 1PPS is code 4 or 5 in bits 7:5."""
    sensor = connecting(running, "pps", settings={"external": external})
    assert await low_byte(sensor, commands.MSC_CTRL) == bits << 5 | 0x06


async def low_byte(sensor: Sensor, register: commands.Register) -> int:
    """Return what a register holds after a session."""
    async with DRIVER.open([sensor], host_clock(SPEED)):
        pass
    async with open_port(sensor.port, host_clock()) as stream:
        await stream.write(commands.read(register))
        received = b""
        while (value := commands.find_reply(received, register.address)) is None:
            received += (await stream.read())[0]
    return value & 0xFF
