"""``huddle devices --driver``: the settings of installed drivers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer
from rich.table import Table
from rich.text import Text

from daq.drivers.registry import driver_names, driver_type
from daq.errors import DriverError
from tui.output.console import console, for_people, write_json

if TYPE_CHECKING:
    from collections.abc import Mapping


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
    settings = settings_of(driver.settings.model_json_schema())
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


def settings_of(schema: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return name, values, default and meaning of each property of a JSON schema."""
    required = schema.get("required", ())
    definitions = schema.get("$defs", {})
    return [
        {
            "name": name,
            "values": _values(one, definitions),
            "default": "needed" if name in required else _default(one.get("default")),
            "meaning": " ".join(str(one.get("description", "")).replace("``", "").split()),
        }
        for name, one in schema.get("properties", {}).items()
    ]


def _values(one: Mapping[str, Any], definitions: Mapping[str, Any]) -> str:
    """Return the possible values of a property as text."""
    if "$ref" in one:
        one = definitions[one["$ref"].rpartition("/")[2]]
    if "anyOf" in one:
        kinds = (_values(kind, definitions) for kind in one["anyOf"] if kind.get("type") != "null")
        return " or ".join(kinds)
    if one.get("type") == "array":
        items = one.get("items") or next(iter(one.get("prefixItems", [{}])))
        return f"list of {_values(items, definitions)}"
    if choices := one.get("enum") or [one[key] for key in ("const",) if key in one]:
        return ", ".join(map(str, choices))
    words = {"number": "number", "integer": "whole number", "boolean": "true, false"}
    return words.get(str(one.get("type")), "text") + _bounds(one)


def _bounds(one: Mapping[str, Any]) -> str:
    low, high = one.get("minimum"), one.get("maximum")
    above = one.get("exclusiveMinimum")
    parts = ["" if above is None else f"above {above:g}"]
    parts += ["" if low is None else f"from {low:g}", "" if high is None else f"to {high:g}"]
    return "".join(f" {part}" for part in parts if part)


def _default(value: object) -> str:
    if value is None:
        return ""
    return str(value).lower() if isinstance(value, bool) else str(value)


def print_others(known: str) -> None:
    """Print the drivers of other packages, which a text does not name."""
    for name, summary in summaries().items():
        if f"#   {name} " not in known:
            console().print(f"  driver {name}: {summary}", markup=False, highlight=False)
