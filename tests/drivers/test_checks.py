"""What drivers know that their devices cannot do, said from the bench file alone."""

from __future__ import annotations

import tomllib

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
    ],
)
def test_settings_are_of_their_type(driver: str, settings: str, key: str) -> None:
    with pytest.raises(BenchFileError, match=rf'sensors\["A"\].settings.{key} = .*: expected a'):
        parse(bench(driver, settings))


@pytest.mark.parametrize(
    ("driver", "settings"),
    [
        ("epson", 'fields = ["z", "x", "y"]\nfull_scale = 15'),
    ],
)
def test_what_toml_writes_is_taken(driver: str, settings: str) -> None:
    driver_type(driver).settings.model_validate(tomllib.loads(settings))
