"""The settings of a Güralp digitizer in a bench file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveFloat

StreamId = Annotated[
    str, Field(pattern="^[0-9A-Z]{1,6}$"), AfterValidator(lambda text: text.lstrip("0") or "0")
]
"""A stream ID without leading zeros, which blocks do not preserve."""


class GuralpSettings(BaseModel):
    """``[sensors.settings]`` of a Güralp digitizer."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    streams: tuple[StreamId, ...] | None = None
    """Stream ID of each channel, such as ``("DEMOZ2", "DEMON2", "DEMOE2")``. Default: the streams
    of the only digitizer received, in the order Z, N, E, X of their fifth character."""
    link: Literal["serial", "scream"] = "serial"
    """Protocol of a ``socket://`` port."""
    baud_rate: Annotated[int, Field(gt=0)] = 115200
    acknowledge: bool = True
    """Whether to acknowledge blocks and request lost ones again (serial)."""
    recovery_port: Annotated[int, Field(ge=0, le=65535)] | None = None
    """TCP port for packets lost over UDP; default: the server's port; 0 for no recovery."""
    patience: PositiveFloat = 30.0
    """Seconds to wait for every stream at the start. Later, seconds without a block after which the
    digitizer is lost and reconnected."""
    system_id: str = ""
    """Expected system ID; empty for any."""
