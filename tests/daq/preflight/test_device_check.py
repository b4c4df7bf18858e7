"""What ``huddle check`` learns about devices."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import resources
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from daq.bench.model import Bench
from daq.devices.registry import driver_names
from daq.errors import NotConnectedError
from daq.preflight.device_check import (
    MODBUS_BAUD_RATES,
    MODBUS_DEVICES,
    discover,
    examine,
    search_description,
)
from daq.preflight.preview import arrivals
from daq.protocols.block import Block, HostTime
from sim_devices.server.launch import RunningDevice
from tests.devices import host_clock, serving
from tests.sim_devices.simulated_bench import device, sensors, spec
from tui.commands.main import app

pytestmark = pytest.mark.devices

SPEED = 4.0
RATE = 50.0
POLLED: dict[str, Any] = device(
    "P", "registers", sampling_rate=RATE, settings={"preset": "witmotion"}, sensitivity=2e5
)
TABLES = [device("A", serial_number="A0000007"), POLLED]
CLOCK = host_clock(SPEED)
FAULTS = [
    {"kind": "dead", "at": 0.0, "duration": 1e6, "channel": 1, "sensors": ["A"]},
    {"kind": "clip", "at": 0.0, "duration": 1e6, "channel": 2, "sensors": ["A"], "level": 100.0},
]


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    world = spec(*TABLES, speed=SPEED, sampling_rate=RATE)
    world["scenario"]["sensors"]["A"]["sampling_rate"] = 200.0
    with serving(world | {"faults": FAULTS}) as devices:
        yield devices


def bench_of(running: RunningDevice, table: dict[str, Any], **given: Any) -> Bench:  # noqa: ANN401
    chosen = tuple(sensors(running, table, **given))
    return Bench(name="bench", sampling_rate=table["sampling_rate"], sensors=chosen)


async def test_an_examination_reads_one_second_of_samples(
    running: tuple[RunningDevice, ...],
) -> None:
    (check,) = (await examine(bench_of(running[0], TABLES[0]), CLOCK, seconds=1.0)).found
    assert check.information.serial_number == "A0000007"
    assert check.n_samples >= 200
    assert check.n_missing == 0
    if check.measured_rate is not None:  # a busy host takes what comes in bunches
        assert check.measured_rate == pytest.approx(200, rel=0.1)
    x, y, z, temperature = check.channels
    assert 0.5e-3 < x.rms < 20e-3  # white motion of 1e-6 (m/s²)²/Hz
    assert not x.is_stuck
    assert y.is_stuck
    assert (y.mean, y.rms) == (0, 0)
    assert z.maximum == pytest.approx(100 / TABLES[0]["channels"]["A"][2]["sensitivity"])
    assert temperature.mean == pytest.approx(2634, abs=140)
    assert not temperature.is_stuck
    assert check.jitter is None


@pytest.mark.parametrize(
    ("came", "rate"),
    [
        (np.arange(9) / 8, 200.0),
        (np.arange(9) / 9, 225.0),  # it is not what the bench file says
        (np.arange(9) / 8 + 0.004 * np.tile([0, 1, 0], 3), 200.0),  # a polled adapter
        (np.maximum(np.arange(9) / 8, 0.12), 200.0),  # the first had waited
        (np.maximum(np.arange(9) / 8, 0.8), None),  # what had waited came at once
        (np.append(np.zeros(8), 0.2), None),
        (np.zeros(9), None),
        ([0.0, 0.125, 0.25], None),
    ],
)
def test_rate_is_measured_only_if_blocks_arrive_evenly(
    came: Sequence[float], rate: float | None
) -> None:
    instants = (HostTime(round(at * 1e9), 0) for at in came)
    counts = np.zeros((25, 3), np.int32)
    found = arrivals([Block("A", 25 * k, counts, at) for k, at in enumerate(instants)]).rate
    assert found == (None if rate is None else pytest.approx(rate, rel=0.003))


async def test_bandwidth_of_polled_sensors_follows_from_the_longest_interval(
    running: tuple[RunningDevice, ...],
) -> None:
    chosen = bench_of(running[1], TABLES[1], settings={"preset": "witmotion"})
    (check,) = (await examine(chosen, CLOCK, seconds=2.0)).found
    assert check.bandwidth is not None
    assert 0 < check.bandwidth <= RATE / 2 * 1.1  # how far below, a busy host says
    assert check.jitter is not None
    assert check.jitter > 0
    assert check.signal_to_noise_db is not None


async def test_failing_ports_do_not_hide_the_others(running: tuple[RunningDevice, ...]) -> None:
    bench = bench_of(running[0], TABLES[0])
    (a,) = bench.sensors
    gone = a.model_copy(update={"name": "B", "port": "/dev/ttyNotThere"})
    bench = bench.model_copy(update={"sensors": (a, gone)})
    examined = await examine(bench, CLOCK, seconds=0.1)
    assert [check.information.sensor for check in examined.found] == ["A"]
    assert ["'B' on /dev/ttyNotThere" in str(error) for error in examined.errors] == [True]


async def test_devices_on_a_port_are_discovered(running: tuple[RunningDevice, ...]) -> None:
    (accelerometer,) = await discover(running[0].port, CLOCK)
    assert (accelerometer.driver, accelerometer.settings) == ("epson", {"baud_rate": 460800})
    assert accelerometer.information is not None
    assert accelerometer.information.model == "A352AD10"
    (slave,) = await discover(running[1].port, CLOCK, baud_rates=[9600], device_ids=[7, 0x50])
    assert (slave.driver, slave.settings) == ("registers", {"device_id": 0x50, "baud_rate": 9600})
    assert slave.remark == "replies, but has no register 0"
    with pytest.raises(NotConnectedError, match="port does not exist"):
        await discover("/dev/ttyNotThere", CLOCK)


async def test_silent_or_wrong_devices_do_not_hide_others_on_their_port(
    running: tuple[RunningDevice, ...],
) -> None:
    settings = {"preset": "witmotion", "device_id": 80, "timeout": 0.2}
    (p,) = sensors(running[1], POLLED, settings=settings)
    q = p.model_copy(update={"name": "Q", "settings": settings | {"device_id": 81}})
    (a,) = sensors(running[0], TABLES[0], serial_number="another")
    bench = Bench(name="b", sampling_rate=RATE, sensors=(p, q, a))
    examined = await examine(bench, CLOCK, seconds=0.2)
    assert "P" in [check.information.sensor for check in examined.found]
    said = sorted(str(error) for error in examined.errors)
    assert len(said) == 2
    assert "'A'" in said[0]
    assert "serial number 'another', got 'A0000007'" in said[0]
    assert "'Q': expected registers 48 to 54 (0x0030 to 0x0036) of device 81" in said[1]


def test_the_search_is_described() -> None:
    said = search_description("/dev/ttyUSB0")
    assert all(str(each) in said for each in (*MODBUS_DEVICES, *MODBUS_BAUD_RATES, 460800))
    assert "Epson" not in search_description("modbus-tcp://10.0.0.9:502")
    text = " ".join(CliRunner().invoke(app, ["check", "--help"]).output.replace("│", " ").split())
    assert MODBUS_DEVICES == (1, 2, 3, 4, 5, 80)
    assert "Modbus devices 1 to 5 and 80" in text
    assert f"{min(MODBUS_BAUD_RATES)} to {max(MODBUS_BAUD_RATES)} baud" in text


def test_a_new_bench_file_names_every_driver() -> None:
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    assert all(f"#   {name} " in text for name in driver_names())
