"""What drivers know that their devices cannot do, said from the bench file alone."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from daq.bench import parse
from daq.drivers.registry import driver_type
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
    ],
)
def test_settings_are_of_their_type(driver: str, settings: str, key: str) -> None:
    with pytest.raises(BenchFileError, match=rf'sensors\["A"\].settings.{key} = .*: expected a'):
        parse(bench(driver, settings))


@pytest.mark.parametrize(
    ("driver", "settings"),
    [
        ("epson", 'fields = ["z", "x", "y"]\nfull_scale = 15'),
        ("fifo", "timeout = 1\npoll_interval = 0.5\nunit = 7"),
    ],
)
def test_what_toml_writes_is_taken(driver: str, settings: str) -> None:
    driver_type(driver).settings.model_validate(tomllib.loads(settings))


@pytest.mark.parametrize(
    ("driver", "settings", "changes", "said"),
    [
        ("fifo", "", {"rate": 0.5}, "sampling_rate = 0.5; expected whole Hz up to 65535"),
        ("fifo", "", {"rate": 70_000.0}, "sampling_rate = 70000; expected whole Hz up to 65535"),
        (
            "fifo",
            "baud_rate = 460800",  # of 41 samples 246 bytes, and 15 of frames: 497 301 baud
            {"rate": 7812.0},
            "7812 Hz of 3 channels need 497301 baud; settings.baud_rate = 460800",
        ),
        ("fifo", 'baud_rate = 500000\nparity = "E"', {"rate": 7812.0}, ".* need 547031 baud"),
    ],
)
def test_what_devices_cannot_do(
    driver: str, settings: str, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(BenchFileError, match=rf'sensors\["A"\]: {said}'):
        parse(bench(driver, settings, **changes))
