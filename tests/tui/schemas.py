"""JSON documents against the published schemas."""

from __future__ import annotations

import copy
import json
from importlib import resources
from typing import Any

from jsonschema import Draft202012Validator
from referencing import Registry, Resource

from docs.schema import ROOTS

SHORT = 8
"""Most items of an array that stays as it is: schemas say how many those of few have."""
OPEN = ("settings",)
"""Objects with keys that the schema does not describe."""
SCHEMAS: dict[str, dict[str, Any]] = {
    file: json.loads((resources.files("tui.resources") / file).read_text("utf-8")) for file in ROOTS
}
REGISTRY = Registry().with_resources(
    (file, Resource.from_contents(schema)) for file, schema in SCHEMAS.items()
)


def validator(name: str) -> Draft202012Validator:
    """Return what compares documents with a schema, all of whose keys are documented."""
    return Draft202012Validator(strict(SCHEMAS[f"{name}.schema.json"]), registry=REGISTRY)


def validate(name: str, document: object) -> None:
    """Compare a document, read from JSON, with a schema such as "result-2"."""
    validator(name).validate(thinned(document))


def strict(schema: dict[str, Any]) -> dict[str, Any]:
    """Return the schema, refusing keys that it does not describe: all are documented."""
    closed = copy.deepcopy(schema)

    def close(part: object, name: str = "") -> None:
        if isinstance(part, dict):
            if "properties" in part and name not in OPEN and part.get("type") == "object":
                part.setdefault("additionalProperties", False)
            for key, entry in part.items():
                close(entry, key)
        elif isinstance(part, list):
            for entry in part:
                close(entry)

    close(closed)
    return closed


def thinned(value: Any) -> Any:  # noqa: ANN401 - JSON
    """Return a document whose long arrays have one item of each kind that was in them.

    A validator reads it fifty times faster.
    """
    if isinstance(value, dict):
        return {key: thinned(each) for key, each in value.items()}
    if not isinstance(value, list):
        return value
    items = [thinned(each) for each in value]
    return items if len(items) <= SHORT else list({_kind(each): each for each in items}.values())


def _kind(value: Any) -> object:  # noqa: ANN401 - JSON
    """Return what a schema can ask for: types, keys, texts, and signs of numbers."""
    if isinstance(value, dict):
        return frozenset((key, _kind(each)) for key, each in value.items())
    if isinstance(value, list):
        return tuple(_kind(each) for each in value)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return type(value), value > 0, value < 0, value > 0.5
    return type(value), value
