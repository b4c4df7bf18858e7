"""What every table of the bench file is made of: names, numbers, durations."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from daq.bench.durations import parse_duration


def check_name(value: str) -> str:
    """Return a name that a sensor, a channel, a limit or a bench may have.

    Raises
    ------
    ValueError
        Saying what was expected.
    """
    if value in {".", ".."} or "/" in value or not value.isprintable() or value != value.strip():
        raise ValueError("expected a printable name without '/' and outer spaces")
    if not 0 < len(value.encode()) <= 64:
        raise ValueError("expected a name of 1 to 64 bytes")
    return value


Number = Annotated[float, Field(strict=True)]
PositiveNumber = Annotated[float, Field(strict=True, gt=0)]
Name = Annotated[str, AfterValidator(check_name)]
Duration = Annotated[float, BeforeValidator(parse_duration)]


class Table(BaseModel):
    """A table of the bench file: unknown keys are faults."""

    # Built when one is read: what only reads recordings without a bench needs none.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)
