"""What drivers know that their devices and ports cannot do, said from the bench file alone."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from typing import Any

import pytest

from daq.bench.tables.toml_text import to_toml
from daq.devices.bench_file import parse
from daq.devices.registry import driver_type
from daq.errors import BenchFileError
from tests.sensors import sensor_at


def bench(driver: str, settings: str, *, port: str = "/dev/ttyUSB0", rate: float = 200.0) -> str:
    channels = "".join(f'[[sensors.channels]]\nname = "{c}"\nsensitivity = 1e6\n' for c in "xyz")
    return (
        f'name = "floor"\nsampling_rate = {rate}\n'
        f'[[sensors]]\nname = "A"\ndriver = "{driver}"\nport = "{port}"\n{channels}'
        f"[sensors.settings]\n{settings}\n"
    )


@pytest.mark.parametrize(
    ("driver", "settings", "key"),
    [
        ("epson", 'flags = "yes"', "flags"),
        ("fifo", "set_rate = 1", "set_rate"),
        ("fifo", 'baud_rate = "3000000"', "baud_rate"),
        ("text", 'whole = "yes"', "whole"),
        ("text", "columns = [0, 1.0, 2]", "columns[2]"),
    ],
)
def test_settings_of_wrong_type_are_refused(driver: str, settings: str, key: str) -> None:
    with pytest.raises(
        BenchFileError, match=rf'sensors\["A"\].settings.{re.escape(key)} = .*: expected (a|true)'
    ):
        parse(bench(driver, settings))


@pytest.mark.parametrize("driver", ["epson", "fifo", "text"])
@pytest.mark.parametrize("port", ["socket://127.0.0.1:99999", "socket://bridge"])
def test_an_invalid_port_is_reported_as_written(driver: str, port: str) -> None:
    with pytest.raises(
        BenchFileError,
        match=rf'sensors\["A"\].port = "{re.escape(port)}": expected socket://host:port',
    ):
        parse(bench(driver, "", port=port))


@pytest.mark.parametrize(
    ("driver", "settings"),
    [
        ("epson", 'fields = ["z", "x", "y"]\nfull_scale = 15'),
        ("text", "columns = [1, 2, 3]\npatience = 1"),
        ("text", 'layout = "channel"\nchannel_names = ["Z", "N", "E"]'),
        ("text", 'time_column = 0\ntime_format = "epoch"'),
        ("text", 'time_column = 0\ntime_format = "%Y-%m-%dT%H:%M:%S.%fZ"'),
        ("text", 'time_column = 0\ntime_format = "%d%m%y%H%M"'),
        ("fifo", "timeout = 1\npoll_interval = 0.5\nunit = 7"),
    ],
)
def test_values_as_written_in_toml_are_accepted(driver: str, settings: str) -> None:
    driver_type(driver).settings.model_validate(tomllib.loads(settings))


@pytest.mark.parametrize(
    ("driver", "settings", "changes", "said"),
    [
        ("fifo", "", {"rate": 0.5}, "sampling_rate = 0.5: expected whole Hz up to 65535"),
        ("fifo", "", {"rate": 70_000.0}, "sampling_rate = 70000.0: expected whole Hz up to 65535"),
        (
            "fifo",
            "baud_rate = 460800",  # of 41 samples 246 bytes, and 15 of frames: 497 301 baud
            {"rate": 7812.0},
            "settings.baud_rate = 460800: expected at least 497301 for 7812 Hz of 3 channels",
        ),
        ("text", "columns = [1]", {}, r"settings.columns = \[1\]: expected one for each of the"),
        (
            "text",
            'layout = "channel"\nchannel_names = ["Z"]',
            {},
            r'.* = \["Z"\]: expected one for',
        ),
        (
            "text",
            'delimiter = "\\n"',
            {},
            r'settings.terminator = "\\n": is in settings.delimiter = "\\n"; expected one that',
        ),
        (
            "text",
            "device_time = true",
            {},
            "settings.device_time = true: expected settings.time_co",
        ),
        (
            "text",
            'start = "GO"',
            {"port": "udp://0.0.0.0:8888"},
            'settings.start = "GO": nothing can be sent to udp://',
        ),
        (
            "text",
            'stop = "NO"',
            {"port": "udp://0.0.0.0:8888"},
            'settings.stop = "NO": nothing can be sent to udp://',
        ),
        ("fifo", 'baud_rate = 500000\nparity = "E"', {"rate": 7812.0}, ".* at least 547031"),
    ],
)
def test_impossible_settings_of_devices_are_refused(
    driver: str, settings: str, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(BenchFileError, match=rf'sensors\["A"\]\.{said}'):
        parse(bench(driver, settings, **changes))


@pytest.mark.parametrize("time_format", ["%Q", "%H:%M:%S", "%Y-%m-%d %I:%M:%S", "", "now"])
def test_a_time_format_without_time_is_refused(time_format: str) -> None:
    settings = f'time_column = 0\ntime_format = "{time_format}"'
    with pytest.raises(
        BenchFileError, match=r"settings.time_format = .*: expected \"epoch\", \"millis\""
    ):
        parse(bench("text", settings))


# --- sensors that share a port ---------------------------------------------------------------


LABJACK, SCREAM, BUS = "modbus-tcp://10.0.0.5", "udp://10.0.0.6:1567", "/dev/ttyUSB0"
ZNE, OTHERS = ["0123Z2", "0123N2", "0123E2"], ["0124Z2", "0124N2", "0124E2"]


def bench_at(driver: str, port: str, settings: Sequence[dict[str, Any]]) -> str:
    channels = [{"name": axis, "sensitivity": 1e6} for axis in "xyz"]
    sensors = [
        {"name": name, "driver": driver, "port": port, "channels": channels, "settings": own}
        for name, own in zip("AB", settings, strict=False)
    ]
    return to_toml({"name": "floor", "sampling_rate": 200.0, "sensors": sensors})


@pytest.mark.parametrize(
    ("driver", "port", "settings", "said"),
    [
        ("labjack", LABJACK, [{}, {"mode": "command-response"}], 'expected "spontaneous", as of'),
        (
            "labjack",
            LABJACK,
            [{}, {"stream_port": 703}],
            "settings.stream_port = 703: expected 702",
        ),
        ("labjack", LABJACK, [{"resolution_index": 4}, {"resolution_index": 8}], "8: expected 4"),
        ("labjack", LABJACK, [{}, {"inputs": [0, 4, 5]}], "AIN0 is already an input of sensor 'A'"),
        ("labjack", LABJACK, [{}, {"inputs": [3, 4]}], "one for each of the sensor's 3 channels"),
        (
            "labjack",
            LABJACK,
            [{"inputs": ["AIN0", "AIN2", "AIN7"]}, {"negative_inputs": [13, 13, 7]}],
            "settings.negative_inputs = [13, 13, 7]: AIN7 is already an input of sensor 'A'",
        ),
        (
            "labjack",
            LABJACK,
            [{"buffer_bytes": 5000}],
            "buffer_bytes = 5000: expected a power of 2",
        ),
        (
            "labjack",
            "modbus-tcp://127.0.0.1:99999",
            [{}],
            'port = "modbus-tcp://127.0.0.1:99999": expected modbus-tcp://host',
        ),
        ("labjack", "/dev/ttyUSB0", [{}], 'port = "/dev/ttyUSB0": expected modbus-tcp://host'),
        (
            "guralp",
            SCREAM,
            [{"streams": ZNE}, {"streams": OTHERS[:2]}],
            "for each of the sensor's 3 channels",
        ),
        (
            "guralp",
            SCREAM,
            [{"streams": ZNE}, {"streams": ["123Z2", *OTHERS[1:]]}],
            "123Z2 is already a stream of sensor 'A'",
        ),
        ("guralp", SCREAM, [{"streams": ZNE}, {}], "expected a stream ID for each"),
        (
            "guralp",
            SCREAM,
            [{"streams": ZNE}, {"streams": OTHERS, "recovery_port": 1}],
            "settings.recovery_port = 1: expected no value, as of 'A'",
        ),
        ("guralp", "udp://10.0.0.6", [{}], 'port = "udp://10.0.0.6": expected udp://host:port'),
        ("registers", BUS, [{"address": 0}, {}], "settings.address: is missing"),
        (
            "registers",
            BUS,
            [{"address": 65534}],
            "settings: registers up to 65536; expected at most 65535",
        ),
        ("registers", BUS, [{"address": 0, "time_format": "uint32-s"}], "with time_address only"),
        (
            "registers",
            BUS,
            [{"address": 0, "time_address": 9, "time_format": "uint32-s"}],
            "expected at most 0.5 Hz, half of the rate of its time",
        ),
        (
            "registers",
            BUS,
            [{"preset": "witmotion", "baud_rate": 115200}, {"address": 0, "baud_rate": 9600}],
            "settings.baud_rate = 9600: expected 115200, as of 'A'",
        ),
        ("registers", BUS, [{"address": 0}, {"address": 0, "parity": "E"}], '"E": expected "N"'),
        ("registers", "spy:///dev/null?file=x", [{"address": 0}], "expected a device such as"),
        (
            "registers",
            "modbus-tcp://10.0.0.7:99999",
            [{"address": 0}],
            "expected modbus-tcp://host:port",
        ),
    ],
)
def test_impossible_combinations_of_sensors_are_refused(
    driver: str, port: str, settings: list[dict[str, Any]], said: str
) -> None:
    wrong = "AB"[len(settings) - 1]
    expected = rf'sensors\["{wrong}"\].*{re.escape(said)}'
    with pytest.raises(BenchFileError, match=expected) as refused:
        parse(bench_at(driver, port, settings))
    assert [fault.sensor for fault in refused.value.faults if fault.sensor] == [wrong]


@pytest.mark.parametrize(
    ("driver", "port", "settings"),
    [
        ("labjack", LABJACK, [{"stream_port": 703, "buffer_bytes": 4096}, {"range": 1.0}]),
        ("labjack", "10.0.0.5", [{"negative_inputs": [13, 13, 13]}]),
        ("labjack", "modbus-tcp://[fe80::1]:502", [{"stream_port": 703}, {"stream_port": 703}]),
        ("guralp", SCREAM, [{"streams": ZNE, "patience": 60.0}, {"streams": OTHERS}]),
        ("registers", BUS, [{"preset": "witmotion", "baud_rate": 115200}, {"address": 0}]),
        ("registers", BUS, [{"addresses": [0, 300, 65535]}]),
    ],
)
def test_valid_combinations_of_sensors_are_accepted(
    driver: str, port: str, settings: list[dict[str, Any]]
) -> None:
    driver_type(driver).check(
        [
            sensor_at(port, driver, name, rate=200.0, settings=own)
            for name, own in zip("AB", settings, strict=False)
        ]
    )
