"""The settings of a driver in words, from the JSON schema of its model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


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
