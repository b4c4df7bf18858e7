"""Errors of single values of a table: pydantic's errors as value, key and expectation."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, get_args

from pydantic import BaseModel

from daq.bench.driver_settings import meaning_of
from daq.bench.model import TABLES
from daq.errors import ABSENT, FileFault

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

_EXPECTED = {
    "string_type": "expected a text",
    "bool_type": "expected true or false",
    "bool_parsing": "expected true or false",
    "int_type": "expected a whole number",
    "int_parsing": "expected a whole number",
    "int_from_float": "expected a whole number",
    "float_type": "expected a number",
    "float_parsing": "expected a number",
    "finite_number": "expected a finite number",
    "literal_error": "expected {expected}",
    "list_type": "expected a list",
    "tuple_type": "expected a list",
    "dict_type": "expected a table",
    "model_type": "expected a table",
    "model_attributes_type": "expected a table",
    "greater_than": "expected a number above {gt:g}",
    "greater_than_equal": "expected at least {ge:g}",
    "less_than": "expected a number below {lt:g}",
    "less_than_equal": "expected at most {le:g}",
}
"""By pydantic's type of error. Other types keep pydantic's message."""


def field_faults(
    error: ValidationError,
    model: type[BaseModel],
    table: object,
    *,
    path: tuple[str, ...] = (),
    sensor: str = "",
) -> Iterator[FileFault]:
    """Yield a fault for each error of pydantic.

    Parameters
    ----------
    error : ValidationError
    model : type
        Model of the table.
    table : object
        The table as in the file.
    path : tuple of str
        Keys of the table in the file, or in the table of a sensor.
    sensor : str
        Name of the sensor of the table, if it has one.
    """
    errors = error.errors(include_url=False)
    places = [tuple(details["loc"]) for details in errors]
    for details, location in zip(errors, places, strict=True):
        kind, value = details["type"], details["input"]
        # Pydantic does not count invalid entries, which are reported themselves.
        if kind == "too_short" and any(
            other != location and other[: len(location)] == location for other in places
        ):
            continue
        expected = _expectation(details, _model_at(model, location[:-1]))
        key, owner = _place(table, location, path, sensor)
        # The value of a whole table would repeat the file.
        is_shown = kind != "missing" and not isinstance(value, dict | BaseModel)
        yield FileFault(key, expected, value if is_shown else ABSENT, owner)


def _expectation(details: ErrorDetails, model: type[BaseModel] | None) -> str:
    """Return the expectation; ``model`` is that of the table with the wrong key."""
    kind, context = details["type"], details.get("ctx", {})
    name = str(details["loc"][-1]) if details["loc"] else ""
    known = {} if model is None else model.model_fields
    field = known.get(name)
    description = "" if model is None or field is None else meaning_of(model, name).rstrip(".")
    if kind == "missing":
        return f"is missing; expected {description or 'a value'}"
    if kind == "extra_forbidden":
        return (
            f"unknown key; {one_of(name, tuple(each.alias or key for key, each in known.items()))}"
        )
    if kind == "string_too_short":
        return f"expected {description or 'a word'}"
    if kind == "too_short":
        return f"too few; expected {description or 'entries'}"
    if kind == "value_error":
        return str(context["error"])  # a validator's own words
    template = _EXPECTED.get(kind)
    return details["msg"] if template is None else template.format(**context)


def _model_at(model: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel] | None:
    """Return the model of the table at ``location``; None for an unknown table."""
    current = model
    for step in location:
        if isinstance(step, int):
            continue
        field = current.model_fields.get(step)
        if field is None:
            return None
        found = _model_in(field.annotation)
        if found is None:
            return None
        current = found
    return current


def _model_in(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and annotation in TABLES:
        return TABLES[annotation]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_model_in, get_args(annotation)) if m is not None), None)


def _place(
    table: object, location: tuple[int | str, ...], path: tuple[str, ...], sensor: str
) -> tuple[str, str]:
    """Return the key at a location, and its sensor.

    Entries of a list are identified by their name, or counted from 1.
    """
    key = ".".join(path)
    for number, step in enumerate(location):
        if isinstance(step, int):
            table = table[step] if isinstance(table, (list, tuple)) and step < len(table) else None
            name = table.get("name") if isinstance(table, dict) else None
            name = name if isinstance(name, str) else ""
            if name and not sensor and location[:number] == ("sensors",):
                key, sensor = "", name
            else:
                key += f'["{name}"]' if name else f"[{step + 1}]"
        elif isinstance(table, (list, tuple)):
            continue  # a list in the file that is a field of a table here
        else:
            key += f".{step}" if key else str(step)
            table = table.get(step) if isinstance(table, dict) else None
    return key if key or sensor else "the file", sensor


def one_of(value: str, known: Sequence[str]) -> str:
    """Return the list of known words as an expectation, with the closest match."""
    close = difflib.get_close_matches(value, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return f"expected one of {', '.join(known) or '(none)'}{hint}"
