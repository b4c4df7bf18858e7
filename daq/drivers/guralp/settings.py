"""The settings of a Güralp digitizer in a bench file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveFloat

StreamId = Annotated[
    str, Field(pattern="^[0-9A-Z]{1,6}$"), AfterValidator(lambda text: text.lstrip("0") or "0")
]
"""Without leading zeros, which no block tells."""


class GuralpSettings(BaseModel):
    """``[sensors.settings]`` of a Güralp digitizer."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    streams: tuple[StreamId, ...] | None = None
    """Stream ID of each channel, as ``("DEMOZ2", "DEMON2", "DEMOE2")``. If not given, those of the
    one digitizer that is heard, in the order Z, N, E, X of their fifth character."""
    link: Literal["serial", "scream"] = "serial"
    """What a ``socket://`` port speaks."""
    baud_rate: Annotated[int, Field(gt=0)] = 115200
    acknowledge: bool = True
    """Whether blocks are acknowledged and lost ones asked for again (serial)."""
    recovery_port: Annotated[int, Field(ge=0, le=65535)] | None = None
    """TCP port for packets lost over UDP; that of the server if not given, 0 for none."""
    patience: PositiveFloat = 30.0
    """Seconds to wait until every stream has been heard; and without any block later, after which
    the digitizer is lost and connected again."""
    system_id: str = ""
    """Expected system ID; any, if empty."""
