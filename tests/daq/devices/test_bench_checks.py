"""What drivers know that their devices cannot do, said from the bench file alone."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import pytest

from daq.devices.bench_file import parse
from daq.devices.registry import driver_type
from daq.errors import BenchFileError


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
