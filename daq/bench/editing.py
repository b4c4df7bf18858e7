"""Writes values into a bench file that a person wrote, and keeps their comments and order."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Array, InlineTable, Table

from daq.whole_file import write_whole


def set_sensor_values(path: str | Path, values: Mapping[str, Mapping[str, str]]) -> None:
    """Set keys in the tables of sensors.

    The file is replaced whole or not at all.

    Parameters
    ----------
    path : path
        A valid bench file.
    values : mapping of str to mapping of str to str
        For each sensor, by name, keys and values.

    Raises
    ------
    OSError
        If the file cannot be written; it is unchanged then.
    """
    document = tomlkit.parse(Path(path).read_text(encoding="utf-8"))
    for table in document["sensors"]:
        for key, value in values.get(str(table["name"]), {}).items():
            _set(table, key, value)
    write_whole(Path(path), tomlkit.dumps(document).encode())


def without_tables(text: str, *names: str) -> str:
    """Return the text of a bench file without these tables, whatever way they are written."""
    document = tomlkit.parse(text)
    for name in names:
        document.pop(name, None)
    return tomlkit.dumps(document)


def with_sensor(text: str, values: Mapping[str, Any], *, replaces: str = "") -> str:
    """Return the text of a bench file with another sensor, or with other values of one.

    Parameters
    ----------
    text : str
        TOML, valid or not as a bench file.
    values : mapping
        Keys of the table of the sensor; None for one that it is not to have. Of tables in it, and
        of channels where there are as many, only what differs is changed. Other keys stay.
    replaces : str
        Name of the sensor that gets them; a new one, if empty.
    """
    document = tomlkit.parse(text)
    sensors = document.setdefault("sensors", tomlkit.aot())
    for table in sensors:
        if replaces and str(table.get("name")) == replaces:
            _change(table, values)
            return tomlkit.dumps(document)
    new = tomlkit.table()
    _change(new, values)
    new.add(tomlkit.nl())
    sensors.append(new)
    return tomlkit.dumps(document)


def with_values(text: str, values: Mapping[str, Any]) -> str:
    """Return the text of a bench file with other values of keys and tables; None removes one."""
    document = tomlkit.parse(text)
    _change(document, values)
    return tomlkit.dumps(document)


def without_sensor(text: str, name: str) -> str:
    """Return the text of a bench file without a sensor, nor what is simulated of it."""
    document = tomlkit.parse(text)
    sensors = document["sensors"]
    for number, table in enumerate(sensors):
        if str(table.get("name")) == name:
            del sensors[number]
            break
    document.get("simulation", {}).get("sensors", {}).pop(name, None)
    return tomlkit.dumps(document)


def _change(table: Any, values: Mapping[str, Any]) -> None:  # noqa: ANN401 - tomlkit's are many
    """Give a table values; those that it has already stay as they are written."""
    for key, value in values.items():
        before = table.get(key)
        if value is None:
            table.pop(key, None)
        elif isinstance(value, dict) and isinstance(before, dict):
            _change(before, value)
        elif _has_as_many(value, before):
            for one, changed in zip(before, value, strict=True):
                _change(one, changed)
        elif before is None and isinstance(value, dict):
            if some := {name: one for name, one in value.items() if one is not None}:
                table[key] = some
        elif before is None and _is_tables(value):
            table[key] = _lines([{n: v for n, v in one.items() if v is not None} for one in value])
        elif before != value:
            table[key] = value


def _is_tables(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(one, dict) for one in value)


def _has_as_many(value: object, before: object) -> bool:
    return (
        isinstance(value, list)
        and isinstance(before, list)
        and _is_tables(value)
        and len(value) == len(before)
    )


def _lines(tables: list[dict[str, Any]]) -> Array:
    """Return an array of tables, a line for each."""
    lines = tomlkit.array()
    for one in tables:
        inline = tomlkit.inline_table()
        inline.update(one)
        lines.append(inline)
    return lines.multiline(multiline=True)


def _set(table: Table | InlineTable, key: str, value: str) -> None:
    """Set a key; a new one goes behind ``name``, before a comment that belongs to what follows."""
    if key in table or isinstance(table, InlineTable):
        table[key] = value
        return
    line_end = table["name"].trivia
    line_end.trail += f"{key} = {tomlkit.item(value).as_string()}{line_end.trail or chr(10)}"
