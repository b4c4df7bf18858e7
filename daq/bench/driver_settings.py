"""The settings of a driver in words, from its model.

What a setting means is said by the docstring below its field. It is read from the source when
someone asks: a recorder, which imports a driver to record, needs none of it.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from itertools import pairwise
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic import BaseModel


def settings_of(model: type[BaseModel]) -> list[dict[str, str]]:
    """Return name, values, default and meaning of each field of the settings of a driver."""
    schema = model.model_json_schema()
    required = schema.get("required", ())
    definitions = schema.get("$defs", {})
    meanings = _docstrings(model)
    return [
        {
            "name": name,
            "values": _values(one, definitions),
            "default": "needed" if name in required else _default(one.get("default")),
            "meaning": _plain(str(one.get("description") or meanings.get(name, ""))),
        }
        for name, one in schema.get("properties", {}).items()
    ]


def meaning_of(model: type[BaseModel], name: str) -> str:
    """Return what a field means, in one line; empty if nothing says so."""
    return _plain(model.model_fields[name].description or _docstrings(model).get(name, ""))


def _docstrings(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring of each field that has one; none if there is no source."""
    found: dict[str, str] = {}
    for each in reversed(model.__mro__):
        if each.__module__.partition(".")[0] in {"builtins", "pydantic"}:
            continue
        try:
            source = textwrap.dedent(inspect.getsource(each))
        except (OSError, TypeError):
            continue
        body = getattr(ast.parse(source).body[0], "body", [])
        for field, text in pairwise(body):
            match field, text:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(meaning))),
                ):
                    found[name] = inspect.cleandoc(meaning)
    return found


def _plain(text: str) -> str:
    return " ".join(text.replace("``", "").split())


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
