"""``huddle devices --driver``: the settings of installed drivers."""

from __future__ import annotations

import typer
from rich.table import Table
from rich.text import Text

from daq.bench.driver_settings import settings_of
from daq.devices.registry import driver_names, driver_type
from daq.errors import DriverError
from tui.output.console import console, for_people, write_json


def list_settings(name: str, *, json: str | None) -> None:
    """Print the settings of a driver, keys of ``[sensors.settings]``.

    Raises
    ------
    typer.BadParameter
        The driver is not installed.
    """
    if name not in driver_names():
        known = "\n".join(f"  {other}  {summary}" for other, summary in summaries().items())
        raise typer.BadParameter(f"{name!r} is no driver; expected one of\n{known}")
    driver = driver_type(name)
    settings = settings_of(driver.settings)
    write_json(json, {"driver": name, "summary": driver.summary, "settings": settings})
    screen = for_people(json)
    screen.print(f"{name}: {driver.summary}\n", markup=False, highlight=False)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("setting", "values", "default", "meaning"):
        table.add_column(column)
    for one in settings:
        cells = (one["name"], one["values"], one["default"], one["meaning"])
        table.add_row(*(Text(cell) for cell in cells))
    screen.print(table)


def summaries() -> dict[str, str]:
    """Return the summary of each installed driver, or why it cannot be imported."""
    found = {}
    for name in driver_names():
        try:
            found[name] = driver_type(name).summary
        except DriverError as error:
            found[name] = str(error)
    return found


def print_others(known: str) -> None:
    """Print the drivers of other packages, which a text does not name."""
    for name, summary in summaries().items():
        if f"#   {name} " not in known:
            console().print(f"  driver {name}: {summary}", markup=False, highlight=False)
