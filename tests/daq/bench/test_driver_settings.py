"""The settings of a driver in words: what each means stands below its field."""

from __future__ import annotations

import subprocess
import sys

import pytest
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from daq.bench.driver_settings import settings_of
from daq.bench.loading import field_faults
from daq.devices.registry import driver_names, driver_type


class Common(BaseModel):
    """Settings of several devices."""

    baud_rate: int = 9600
    """Of the serial port,
    in ``Bd``."""
    parity: str = "N"


class Own(Common):
    """Settings of one device."""

    timeout: float = 0.5
    """Of a reply, s."""
    station: str = Field(description="Code of the station.")
    """Not for users."""


class Documented(BaseModel):
    """Settings whose model has the docstrings itself."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    rate: int = 1
    """In Hz."""


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Meaning of each setting."""
    return {one["name"]: one["meaning"] for one in settings_of(model)}


def test_a_docstring_is_the_meaning_of_its_field() -> None:
    assert meanings(Own) == {
        "baud_rate": "Of the serial port, in Bd.",
        "parity": "",
        "timeout": "Of a reply, s.",
        "station": "Code of the station.",
    }
    assert meanings(Documented) == {"rate": "In Hz."}


def test_a_model_without_source_has_settings_without_meaning() -> None:
    assert meanings(create_model("Made", rate=(int, 1))) == {"rate": ""}


def test_a_recorder_does_not_read_the_source_of_its_driver() -> None:
    """Pydantic would, when a driver is imported: a thirtieth of the start of a recorder.

    One process imports them all: a process for each took ten times as long.
    """
    code = (
        "import inspect\n"
        "def refused(*_): raise AssertionError('read the source')\n"
        "inspect.getsource = inspect.getsourcelines = inspect.findsource = refused\n"
        "from daq.devices.registry import driver_names, driver_type\n"
        "for name in driver_names(): driver_type(name).settings.model_fields"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", driver_names())
def test_every_driver_says_what_its_settings_mean(name: str) -> None:
    assert any(meanings(driver_type(name).settings).values())


def test_a_missing_setting_is_named_with_its_meaning() -> None:
    class Settings(BaseModel):
        """Settings with one that has no default."""

        rate: int
        """Samples a second,
        in ``Hz``."""

    with pytest.raises(ValidationError) as caught:
        Settings.model_validate({})
    (fault,) = field_faults(caught.value, Settings, {})
    assert fault.expected == "is missing; expected Samples a second, in Hz"
