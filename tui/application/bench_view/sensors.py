"""The sensors of a bench as a table. Does not use Textual."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tui.application.state import State


def sensors_of_bench(state: State) -> RenderableType:
    """Return a row per sensor of the bench file."""
    if state.bench is None:
        return Text("This recording has no bench file: it was imported.")
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold #9aa5b8")
    for column in ("sensor", "model", "driver", "port", "channels"):
        table.add_column(column, no_wrap=True)
    for sensor in state.bench.sensors:
        channels = " ".join(channel.name for channel in sensor.channels)
        row = (sensor.name, sensor.model, sensor.driver, sensor.port, channels)
        table.add_row(*map(Text, row))
    return table
