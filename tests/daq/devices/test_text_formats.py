"""The text driver reads what loggers and microcontrollers write, and says what would fit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from daq.devices.registry import driver_type
from daq.errors import BenchFileError, NoAnswerError
from daq.preflight.device_check import discover
from sim_devices.server.launch import RunningDevice
from tests.daq.devices import reading
from tests.devices import host_clock, serving
from tests.sim_devices.simulated_bench import device, sensors, spec

pytestmark = pytest.mark.devices

SPEED = 2.0
DRIVER = driver_type("text")
NAMES = ("X", "Y", "Z")
FORMATS: dict[str, dict[str, Any]] = {
    "hexadecimal": {"hexadecimal_bits": 24, "whole": True},
    "decimal comma": {"decimal_comma": True, "delimiter": ";"},
    "labelled": {"layout": "labelled", "whole": True, "counter_column": "n"},
    "json": {"layout": "json", "time_column": "t", "time_format": "millis", "whole": True},
    "millis": {"columns": [1, 2, 3], "time_column": 0, "time_format": "millis", "whole": True},
}
TABLES = [
    device(
        name,
        "text",
        port="tcp",
        sampling_rate=100.0,
        axes=NAMES,
        sensitivity=1e5,
        settings=settings,
    )
    for name, settings in FORMATS.items()
]


@pytest.fixture(scope="module")
def running() -> Iterator[dict[str, RunningDevice]]:
    with serving(spec(*TABLES, speed=SPEED, sampling_rate=100.0)) as devices:
        yield dict(zip(FORMATS, devices, strict=True))


@pytest.mark.parametrize("name", ["decimal comma", "labelled", "json", "millis"])
async def test_the_format_of_a_port_is_guessed_correctly(
    running: dict[str, RunningDevice], name: str
) -> None:
    (found,) = await discover(running[name].port, host_clock(SPEED))
    assert found.driver == "text"
    wanted = {k: v for k, v in FORMATS[name].items() if k != "whole"}
    assert wanted.items() <= found.settings.items()
    table = TABLES[list(FORMATS).index(name)]
    (sensor,) = sensors(running[name], table, settings=found.settings)
    blocks, _ = await reading.record(DRIVER, sensor, 50, speed=SPEED)
    assert blocks


async def test_a_format_without_matches_suggests_one_that_matches(
    running: dict[str, RunningDevice],
) -> None:
    (sensor,) = sensors(
        running["decimal comma"], TABLES[1], settings={"columns": [0, 1, 2], "patience": 2.0}
    )
    with pytest.raises(
        NoAnswerError,
        match=r"received rows that settings do not match: '.*;.*'; these would: delimiter = \";\", "
        r"decimal_comma = true, columns = \[0, 1, 2\]",
    ):
        await reading.record(DRIVER, sensor, 1, speed=SPEED)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"decimal_comma": True}, "settings.decimal_comma = true: expected another"),
        ({"time_column": "t"}, 'settings.time_column = "t": expected the number of a field'),
        ({"layout": "json", "time_column": 0}, "settings.time_column = 0: expected the name"),
        (
            {"time_column": 0, "time_format": "millis", "device_time": True},
            "device_time = true: a time in millis is no UTC",
        ),
    ],
)
def test_contradicting_settings_are_refused(
    running: dict[str, RunningDevice], settings: dict[str, Any], said: str
) -> None:
    (sensor,) = sensors(running["json"], TABLES[3], settings=settings)
    with pytest.raises(BenchFileError, match=said):
        DRIVER.counts_dtype(sensor)
