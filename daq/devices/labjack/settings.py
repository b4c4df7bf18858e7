"""The settings of a LabJack in a bench file, and their limits for each product."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
)

from daq.devices.interface import DriverSettings
from daq.devices.labjack import registers as reg
from daq.errors import FileFault

if TYPE_CHECKING:
    from collections.abc import Sequence


def _input_number(value: object) -> object:
    text = str(value).upper().removeprefix("AIN")
    return int(text) if text.isdigit() else value


RANGES: dict[str, tuple[float, ...]] = {"T7": tuple(reg.GAINS), "T8": reg.T8_RANGES}
"""Ranges of each product's inputs, in volts, peak; the first is the default."""


def _in_words(ranges: Sequence[float]) -> str:
    return ", ".join(f"{volts:g}" for volts in ranges)


def _range(value: float) -> float:
    if not any(value in ranges for ranges in RANGES.values()):
        each = (f"{_in_words(ranges)} V for a {product}" for product, ranges in RANGES.items())
        raise ValueError(f"expected one of {'; or '.join(each)}")
    return value


def _power_of_two(value: int) -> int:
    if value.bit_count() != 1:
        raise ValueError("expected a power of 2")
    return value


Input = Annotated[int, BeforeValidator(_input_number), Field(ge=0, le=254)]


class LabJackSettings(DriverSettings):
    """``[sensors.settings]`` of a sensor on a LabJack.

    Inputs and range belong to each sensor; all other settings to the port's first sensor.
    """

    inputs: tuple[Input, ...] | None = None
    """The analog input of each channel, such as ``["AIN0", "AIN1", "AIN2"]``; default: the inputs
    after those of the port's previous sensors."""
    range: Annotated[float, AfterValidator(_range)] | None = None
    """Range of the inputs in volts, peak. T7: 10, 1, 0.1, 0.01; T8: 11, 9.6, 4.8, 2.4, 1.2, 0.6,
    0.3, 0.15, 0.075, 0.036, 0.018. Default: the widest."""
    negative_inputs: tuple[Input, ...] | None = None
    """Negative input of each channel if differential; default: single-ended."""
    resolution_index: Annotated[int, Field(ge=0, le=16)] = 0
    settling_us: NonNegativeFloat = 0.0
    mode: Literal["spontaneous", "command-response"] = "spontaneous"
    stream_port: Annotated[int, Field(gt=0, le=65535)] = 702
    samples_per_packet: Annotated[int, Field(gt=0, le=512)] | None = None
    buffer_bytes: Annotated[int, Field(gt=0), AfterValidator(_power_of_two)] | None = None
    """Size of the device's buffer, a power of 2; default: the largest that the model has."""
    core_timer: bool = True
    external_clock_divisor: Annotated[int, Field(gt=0)] | None = None
    """Divisor of an external scan clock; default: internal clock."""
    trigger_index: NonNegativeInt = 0
    """Trigger that starts the stream (STREAM_TRIGGER_INDEX); 0 for no trigger."""
    patience: PositiveFloat | None = None
    """Seconds without samples after which the device is lost and reconnected; default: the length
    of its buffer, at least 10 s."""


def range_of(settings: LabJackSettings, product: str) -> float:
    """Return the range of a sensor's inputs, in volts, peak."""
    return RANGES[product][0] if settings.range is None else settings.range


def lacking(settings: LabJackSettings, numbers: tuple[int, ...], product: str) -> FileFault | None:
    """Return a fault for a setting that the product lacks; None if there is none."""
    if settings.range is not None and settings.range not in RANGES[product]:
        expected = f"expected one of {_in_words(RANGES[product])} V for a {product}"
        return FileFault("settings.range", expected, settings.range)
    if product == "T8" and max(numbers) >= reg.T8_INPUTS:
        expected = f"a T8 has AIN0 to AIN{reg.T8_INPUTS - 1}"
        return FileFault("settings.inputs", expected, list(numbers))
    if product == "T8" and settings.negative_inputs is not None:
        expected = "each input of a T8 has its own negative terminal: leave it out"
        return FileFault("settings.negative_inputs", expected, list(settings.negative_inputs))
    return None
