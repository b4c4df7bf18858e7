"""Writes values into a bench file that a person wrote, and keeps their comments and order."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import tomlkit
from tomlkit.items import InlineTable, Table

if TYPE_CHECKING:
    from collections.abc import Mapping


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
    path = Path(path).resolve()
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    for table in document["sensors"]:
        for key, value in values.get(str(table["name"]), {}).items():
            _set(table, key, value)
    descriptor, new = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            file.write(tomlkit.dumps(document))
            file.flush()
            os.fsync(file.fileno())
        Path(new).chmod(path.stat().st_mode)
        Path(new).replace(path)
    except BaseException:
        Path(new).unlink(missing_ok=True)
        raise


def _set(table: Table | InlineTable, key: str, value: str) -> None:
    """Set a key; a new one goes behind ``name``, before a comment that belongs to what follows."""
    if key in table or isinstance(table, InlineTable):
        table[key] = value
        return
    line_end = table["name"].trivia
    line_end.trail += f"{key} = {tomlkit.item(value).as_string()}{line_end.trail or chr(10)}"
