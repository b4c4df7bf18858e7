"""The settings of a LabJack in a bench file, and what each product has."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
)

from daq.errors import FileFault
from daq.protocols.labjack import registers as reg

if TYPE_CHECKING:
    from collections.abc import Sequence


def _input_number(value: object) -> object:
    text = str(value).upper().removeprefix("AIN")
    return int(text) if text.isdigit() else value


RANGES: dict[str, tuple[float, ...]] = {"T7": tuple(reg.GAINS), "T8": reg.T8_RANGES}
"""Of each product's inputs, in volts, peak; the first is the usual one."""


def _in_words(ranges: Sequence[float]) -> str:
    return ", ".join(f"{volts:g}" for volts in ranges)


def _range(value: float) -> float:
    if not any(value in ranges for ranges in RANGES.values()):
        each = (f"{_in_words(ranges)} V of a {product}" for product, ranges in RANGES.items())
        raise ValueError(f"expected one of {'; or '.join(each)}")
    return value


def _power_of_two(value: int) -> int:
    if value.bit_count() != 1:
        raise ValueError("expected a power of 2")
    return value


Input = Annotated[int, BeforeValidator(_input_number), Field(ge=0, le=254)]


class LabJackSettings(BaseModel):
    """``[sensors.settings]`` of a sensor on a LabJack; ``inputs`` and ranges are the sensor's own.

    What concerns the stream as a whole is taken from the port's first sensor.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    inputs: tuple[Input, ...] | None = None
    """The analog input of each channel, such as ``["AIN0", "AIN1", "AIN2"]``; if not given, those
    that follow the inputs of the port's sensors before."""
    range: Annotated[float, AfterValidator(_range)] | None = None
    """Of the inputs, in volts, peak: 10, 1, 0.1, 0.01 of a T7; 11, 9.6, 4.8, 2.4, 1.2, 0.6, 0.3,
    0.15, 0.075, 0.036, 0.018 of a T8. The widest, if not given."""
    negative_inputs: tuple[Input, ...] | None = None
    """Of differential inputs, one for each channel; single-ended, if not given."""
    resolution_index: Annotated[int, Field(ge=0, le=16)] = 0
    settling_us: NonNegativeFloat = 0.0
    mode: Literal["spontaneous", "command-response"] = "spontaneous"
    stream_port: Annotated[int, Field(gt=0, le=65535)] = 702
    samples_per_packet: Annotated[int, Field(gt=0, le=512)] | None = None
    buffer_bytes: Annotated[int, Field(gt=0), AfterValidator(_power_of_two)] | None = None
    """A power of 2; the largest the model has, if not given."""
    core_timer: bool = True
    external_clock_divisor: Annotated[int, Field(gt=0)] | None = None
    """Scan on an external clock, divided by this; internal, if not given."""
    trigger_index: NonNegativeInt = 0
    """What starts the stream; 0: at once."""
    patience: PositiveFloat | None = None
    """Seconds without samples after which the device is lost and connected again; the length of its
    buffer, and at least 10 s, if not given."""


def range_of(settings: LabJackSettings, product: str) -> float:
    """Return the range of a sensor's inputs, in volts, peak."""
    return RANGES[product][0] if settings.range is None else settings.range


def lacking(settings: LabJackSettings, numbers: tuple[int, ...], product: str) -> FileFault | None:
    """Return a setting that a product does not have; None if it has all."""
    if settings.range is not None and settings.range not in RANGES[product]:
        expected = f"expected one of {_in_words(RANGES[product])} V, as a {product} has"
        return FileFault("settings.range", expected, settings.range)
    if product == "T8" and max(numbers) >= reg.T8_INPUTS:
        expected = f"a T8 has AIN0 to AIN{reg.T8_INPUTS - 1}"
        return FileFault("settings.inputs", expected, list(numbers))
    if product == "T8" and settings.negative_inputs is not None:
        expected = "each input of a T8 has its own negative terminal: leave it out"
        return FileFault("settings.negative_inputs", expected, list(settings.negative_inputs))
    return None
