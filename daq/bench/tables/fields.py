"""What every table of the bench file is made of: names, numbers, durations."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from daq.bench.channel import check_name
from daq.bench.durations import parse_duration

Number = Annotated[float, Field(strict=True)]
PositiveNumber = Annotated[float, Field(strict=True, gt=0)]
Name = Annotated[str, AfterValidator(check_name)]
Duration = Annotated[float, BeforeValidator(parse_duration)]


class BenchTable(BaseModel):
    """A table of the bench file: unknown keys are faults."""

    # Built when one is read: what only reads recordings without a bench needs none.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)
