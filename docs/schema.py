"""Makes the JSON Schemas in ``tui/resources`` of the types that documents declare.

``python -m docs.schema`` writes them, a definition a line; a test compares them with the types.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from datetime import date
from enum import Enum, EnumType
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NotRequired,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import numpy as np

from estimator.records import json_key
from tui.output.documents import (
    ArchiveDocument,
    CalibrationDocument,
    ResultDocument,
    StationsDocument,
)
from tui.service.documents import StatusDocument

Schema = dict[str, Any]
FOLDER = Path(__file__).parents[1] / "tui" / "resources"
ROOTS: dict[str, tuple[Any, str]] = {
    "result-2.schema.json": (ResultDocument, "Result of a huddle test, version 2"),
    "archive-2.schema.json": (ArchiveDocument, "Answer of an archive, version 2"),
    "archive-stations-1.schema.json": (StationsDocument, "Answers of several stations, version 1"),
    "calibration-1.schema.json": (CalibrationDocument, "Calibration of sensors, version 1"),
    "status-1.schema.json": (StatusDocument, "Status of a service, version 1"),
}
"""The document of each file, and its title. A file refers to those before it."""
PLAIN: dict[Any, Schema] = {
    str: {"type": "string"},
    date: {"type": "string", "format": "date"},
    **{kind: {"type": "boolean"} for kind in (bool, np.bool_)},
    **{kind: {"type": "integer", "minimum": 0} for kind in (int, np.int64)},
    **{kind: {"type": ["number", "null"]} for kind in (float, np.float64)},
    NoneType: {"type": "null"},
}
ATTRIBUTE = re.compile(r"^(\w[\w, ]*) : (.*)((?:\n +.*)*)", re.MULTILINE)
"""Names, type and text of attributes in the docstring of a class."""
_NAMED = {"properties", "$defs"}
_SHAPE = re.compile(r"shape \(([^)]+)\)")
_AXIS = re.compile(r"\b(?:n_)?(\w+)")
_NULL = re.compile(r"\b(NaN|None)\b")
_NAME = re.compile(r"`(\w+)`")


class Schemas:
    """Makes schemas; classes are definitions.

    Attributes
    ----------
    definitions : dict
        Of the classes found, by name.
    places : dict
        Where the definition of each class is.
    links : mapping
        Definitions of other files, by class.
    """

    def __init__(self, links: Mapping[Any, str]) -> None:
        self.definitions: dict[str, Schema] = {}
        self.places: dict[Any, str] = {}
        self.links = links

    def of(self, kind: Any, dims: int = 0) -> Schema:  # noqa: ANN401 - any type
        """Return the schema of a type; arrays have `dims` dimensions."""
        if kind in self.links:
            return {"$ref": self.links[kind]}
        if get_origin(kind) is not None:
            return self._composed(get_origin(kind), get_args(kind), dims)
        if kind in PLAIN:
            return dict(PLAIN[kind])
        if isinstance(kind, EnumType):
            return {"enum": [each.value for each in list[Enum](kind)]}
        name = re.sub(r"(?<=.)([A-Z])", r"_\1", kind.__name__.removesuffix("Document")).lower()
        if kind not in self.places:
            if name in self.definitions:
                raise ValueError(f"two classes would be {name}, one of them {kind}")
            self.places[kind], self.definitions[name] = f"#/$defs/{name}", {}
            self.definitions[name] = self.object(kind)
        return {"$ref": self.places[kind]}

    def _composed(self, origin: Any, inner: tuple[Any, ...], dims: int) -> Schema:  # noqa: ANN401
        made: Schema
        if origin is NotRequired:
            made = self.of(inner[0])
        elif origin is Annotated:
            made = self._noted(inner[0], inner[1:])
        elif origin is Literal:
            made = {"const": inner[0]} if len(inner) == 1 else {"enum": list(inner)}
        elif origin in {Union, UnionType}:
            made = self._either(inner, dims)
        elif origin is np.ndarray:
            made = self.of(get_args(inner[1])[0])
            for _ in range(dims):
                made = {"type": "array", "items": made}
        elif issubclass(origin, Mapping):
            made = {"type": "object"}
            if inner[1] is not Any:
                made["additionalProperties"] = self.of(inner[1])
        else:
            n = 0 if ... in inner else len(inner)
            length = {"minItems": n, "maxItems": n} if n > 1 else {}
            made = {"type": "array", "items": self.of(inner[0])} | length
        return made

    def _either(self, options: tuple[Any, ...], dims: int) -> Schema:
        """Return the schema of one of several types, in the shortest form."""
        made = [self.of(each, dims) for each in options if each is not NoneType]
        if NoneType not in options or len(made) > 1:
            return {"anyOf": [self.of(each, dims) for each in options]}
        if "enum" in made[0]:
            return {"enum": [*made[0]["enum"], None]}
        kind = made[0].get("type", "object")
        if kind == "object":
            return {"anyOf": [{"type": "null"}, *made]}
        types = kind if isinstance(kind, list) else [kind]
        return made[0] | {"type": list(dict.fromkeys([*types, "null"]))}

    def _noted(self, kind: Any, notes: tuple[Any, ...]) -> Schema:  # noqa: ANN401 - any type
        beside = next((note for note in notes if isinstance(note, type)), None)
        if beside is None:
            made = self.of(kind, sum(note for note in notes if isinstance(note, int)))
        elif isinstance(kind, type):
            made = self.object(kind, beside)
        else:
            made = self.object(beside) | {"additionalProperties": True}
        for note in notes:
            if isinstance(note, tuple):
                made[note[0]] = note[1] if get_origin(note[1]) is None else self.of(note[1])
            elif isinstance(note, str):
                made["description"] = note
        return _known(made)

    def object(self, *kinds: type[Any]) -> Schema:
        """Return the schema of an object with the keys of all classes."""
        found = [each for kind in kinds for each in self._keys(kind)]
        properties = {key: schema for key, schema, _ in found}
        required = list(dict.fromkeys(key for key, _, is_always in found if is_always))
        about = plain_text((inspect.getdoc(kinds[0]) or "").partition("\n\nAttributes\n")[0])
        made = {"type": "object", "description": about, "properties": properties}
        return made | ({"required": required} if required else {})

    def _keys(self, kind: type[Any]) -> Iterator[tuple[str, Schema, bool]]:
        if is_typeddict(kind):
            for key, hint in get_type_hints(kind, include_extras=True).items():
                is_always = key in kind.__required_keys__ and get_origin(hint) is not NotRequired
                yield key, self.of(hint), is_always
            return
        about = attributes(kind)
        named = ((each.name, json_key(each)) for each in fields(kind))
        keys = {name: key for name, key in named if key is not None}
        for each in (each for each in fields(kind) if each.name in keys):
            axes, text = about.get(each.name, ((), ""))
            made = self.of(_annotation(kind, each.name), len(axes))
            made |= {name: more for name, more in each.metadata.items() if name != "key"}
            text += f" Array of {' × '.join(axes)}." if axes else ""
            text = _NAME.sub(lambda name: f"`{keys.get(name[1], name[1])}`", text)
            made["description"] = _NULL.sub("null", text).strip() or None
            if keys[each.name].endswith("utc_ns"):
                made["minimum"] = None  # before 1970
            yield keys[each.name], _known(made), True
        for key, name in getattr(kind, "IN_JSON", {}).items():
            found = getattr(kind, name)
            hints = get_type_hints(found.fget, _names(kind.__module__), include_extras=True)
            axes, text = about.get(name, ((), plain_text(inspect.getdoc(found) or "")))
            text += f" Array of {' × '.join(axes)}." if axes else ""
            made = self.of(hints["return"], len(axes))
            yield key, made | {"description": _NULL.sub("null", text)}, True

    def document(self, kind: Any) -> Schema:  # noqa: ANN401 - any type
        """Return the schema of a document; of several, that of all their keys."""
        kinds = get_args(kind) or (kind,)
        made = [self.object(each) for each in kinds]
        required = [each["required"] for each in made]
        common = [key for key in required[0] if all(key in each for each in required)]
        made[0]["properties"] |= made[-1]["properties"]
        made[0]["required"] = common
        others = [[key for key in each if key not in common] for each in required]
        return made[0] | ({"oneOf": [{"required": each} for each in others]} if any(others) else {})


def _known(schema: Schema) -> Schema:
    return {key: value for key, value in schema.items() if value is not None}


@cache
def _names(module: str) -> dict[str, Any]:
    """Return what a module has, with what it imports for types only."""
    found = dict(vars(sys.modules[module]))
    for node in ast.parse(inspect.getsource(sys.modules[module])).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            body = ast.Module(node.body, type_ignores=[])
            exec(compile(body, module, "exec"), found)  # noqa: S102 - of our own modules
    return found


def _annotation(kind: type[Any], name: str) -> Any:  # noqa: ANN401 - any type
    owner = next(each for each in kind.__mro__ if name in inspect.get_annotations(each))
    return eval(inspect.get_annotations(owner)[name], _names(owner.__module__))  # noqa: S307 - ours


def attributes(kind: type[Any]) -> dict[str, tuple[Sequence[str], str]]:
    """Return the axes and the text of each attribute that a class describes."""
    found: dict[str, tuple[Sequence[str], str]] = {
        name: ((), plain_text(text)) for name, text in explanations(kind).items()
    }
    for names, about, text in ATTRIBUTE.findall(inspect.getdoc(kind) or ""):
        shape = _SHAPE.search(about)
        axes = _AXIS.findall(shape[1]) if shape else ()
        found |= {name: (axes, plain_text(text)) for name in names.split(", ")}
    return found


def explanations(model: type[Any]) -> dict[str, str]:
    """Return what the docstrings below the keys of a table, or the values of a kind, say."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]
    assert isinstance(tree, ast.ClassDef)  # noqa: S101 - for the types
    found, key = {}, ""
    for node in tree.body:
        target = getattr(node, "target", None) or getattr(node, "targets", [None])[0]
        if isinstance(target, ast.Name):
            key = target.id
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and key:
            found[key] = inspect.cleandoc(str(node.value.value))
    return found


def plain_text(text: str) -> str:
    """Return a docstring as one line of Markdown."""
    return " ".join(text.replace("``", "`").split())


def texts() -> dict[str, str]:
    """Return the text of each file."""
    made: dict[str, str] = {}
    links: dict[Any, str] = {}
    for file, (kind, title) in ROOTS.items():
        schemas = Schemas(links)
        about = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title}
        definitions = schemas.document(kind), schemas.definitions
        made[file] = _text(about | definitions[0] | {"$defs": definitions[1]}) + "\n"
        links |= {each: f"{file}{place}" for each, place in schemas.places.items()} | {kind: file}
    return made


def _text(value: Any) -> str:  # noqa: ANN401 - JSON
    """Return JSON with a line for each key of an object that is described."""
    if not isinstance(value, dict):
        return json.dumps(value, ensure_ascii=False)
    between = ",\n" if _NAMED & value.keys() else ", "
    parts = (
        f"{json.dumps(key)}: {(_lines if key in _NAMED else _text)(each)}"
        for key, each in value.items()
    )
    return f"{{{between.join(parts)}}}"


def _lines(named: Mapping[str, Schema]) -> str:
    entries = ",\n".join(f"{json.dumps(key)}: {_text(each)}" for key, each in named.items())
    return f"{{\n{entries}\n}}"


if __name__ == "__main__":
    for name, text in texts().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
