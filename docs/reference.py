"""The references of commands and of the bench file: Markdown, made of what the program declares."""

# ruff: noqa: ANN401 - annotations and fields of pydantic are of any type

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Iterator
from dataclasses import fields
from enum import StrEnum
from importlib import resources
from itertools import chain
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, BeforeValidator
from pydantic_core import PydanticUndefined

from daq.bench.durations import format_duration, parse_duration
from daq.bench.estimate_settings import OPTIONS, EstimateSettings, table_keys
from daq.bench.model import TABLES, Bench
from daq.protocols.block import EventKind
from daq.recording.sensor_state import SensorState
from daq.results.facts.fact import MARKS, Fact, Finding
from docs.schema import ATTRIBUTE, explanations, plain_text
from estimator.checks.advice import Advice, Names, Rank
from estimator.decision.verdict import Obstacle
from estimator.records import json_key
from tests.tui.wording.advice_examples import EXAMPLES as ADVICE
from tests.tui.wording.fact_examples import EXAMPLES as FACTS
from tests.tui.wording.fact_examples import kinds
from tui.commands.help import PANELS, subcommand
from tui.service.records.run_state import RunState
from tui.wording.facts import RANKS

_WRITTEN = {"[[schedule.runs]]": "[[schedule]]"}
"""Tables that a person writes by another name than that of their model."""
_STYLE = re.compile(r"\x1b\[[0-9;]*m")
_DURATION = "duration, such as `90s` or `2h`"
_BLANK = "\n\n"
"""Names and meaning of attributes of one entry of a numpydoc section."""
ROOT = Path(__file__).resolve().parents[1]
VALUES: dict[str, type[StrEnum]] = {
    "events": EventKind,
    "obstacles": Obstacle,
    "runs": RunState,
    "states": SensorState,
}
"""Kinds of values that recordings, JSON and lists of runs have."""
_NAMES = {str: "text", float: "number", int: "whole number", bool: "true or false"}


def commands() -> str:
    """Return a section for each command, with the text of its help."""
    parts = []
    for panel, names in PANELS.items():
        parts.append(f"## {panel}\n")
        for name in names:
            command = subcommand(name)
            with command.make_context(name, [], resilient_parsing=True) as context:
                context.info_name = f"huddle {name}"
                text = command.get_help(context)
            parts.append(f"### huddle {name}\n\n```text\n{_STYLE.sub('', text).strip()}\n```\n")
    return "\n".join(parts)


def troubleshooting() -> str:
    """Return each kind of fact with an example in words: what is seen, its effect, what to do."""
    names = Names(("A", "B", "C"), tuple(f"{s}.{c}" for s in "ABC" for c in "XYZ"), (3, 3, 3))
    examples = [
        *(Finding(rank=advice.rank, findings=(advice,), names=names) for advice in ADVICE),
        *(fact for fact in FACTS if not isinstance(fact, Finding)),
    ]
    parts = []
    for rank in Rank:
        parts.append(f"## {MARKS[rank]} {RANKS[rank].capitalize()}\n")
        for fact in (each for each in examples if each.rank is rank):
            words = fact.words
            kind = type(fact.findings[0] if isinstance(fact, Finding) else fact).__name__
            parts.append(f"### {words.line}\n\n{words} (`{kind}`)\n")
    return "\n".join(parts)


def bench_file() -> str:
    """Return a table of keys for each table of the bench file."""
    tables: dict[str, type[BaseModel]] = {}
    _collect("", Bench, tables)
    del tables["[schedule]"]
    return "\n".join(_section(path, model) for path, model in tables.items())


def keys(file: str) -> str:
    """Return a table for each object of a JSON document, made of its schema."""
    schema = json.loads((resources.files("tui.resources") / file).read_text("utf-8"))
    parts = []
    for name, each in {"document": schema, **schema["$defs"]}.items():
        rows = [f"| `{key}` | {meaning} |" for key, meaning in _keys(each, "")]
        about = "" if each is schema else each.get("description", "") + _BLANK
        table = "\n".join(["| key | meaning |", "|---|---|", *rows])
        parts.append(f"#### `{name}`\n\n{about}{table}\n")
    return "\n".join(parts)


def values(name: str) -> str:
    """Return a table of the values of one of `VALUES`, by their docstrings."""
    kind = VALUES[name]
    said = explanations(kind)
    rows = [f"| `{each.value}` | {plain_text(said[each.name])} |" for each in kind]
    return "\n".join(["| value | meaning |", "|---|---|", *rows])


def packages() -> str:
    """Return a table of the packages, with the first sentence of each."""
    rows = ["| package | |", "|---|---|"]
    for room in ("daq", "estimator", "sim_devices", "tui"):
        for path in sorted((ROOT / room).glob("*/__init__.py")):
            about = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            rows.append(
                f"| `{room}.{path.parent.name}` | {plain_text(about.partition(_BLANK)[0])} |"
            )
    return "\n".join(rows)


def facts() -> str:
    """Return a table of the kinds of facts in JSON, with their numbers."""
    return _kinds(Fact, {kind.name: kind for kind in kinds()})


def findings() -> str:
    """Return a table of the kinds of findings in JSON, with their numbers."""
    return _kinds(Advice, {kind.name: kind for kind in kinds(Advice)})


def _kinds(base: type[Any], named: dict[str, type[Any]]) -> str:
    common = {each.name for each in fields(base)}
    rows = ["| `kind` | meaning | `numbers` |", "|---|---|---|"]
    for name, kind in sorted(named.items()):
        in_json = {each.name: json_key(each) for each in fields(kind)}
        about, _, rest = (inspect.getdoc(kind) or "").partition(_BLANK)
        said = {names: text for names, _, text in ATTRIBUTE.findall(rest)}
        entries = [keys.split(", ") for keys in said]
        written = set(chain.from_iterable(entries))
        entries += [[each.name] for each in fields(kind) if each.name not in written]
        numbers = "; ".join(
            f"{', '.join(f'`{in_json[key]}`' for key in keys)}"
            f" {plain_text(said.get(', '.join(keys), ''))}".rstrip(". ")
            for keys in entries
            if keys[0] not in common
        )
        rows.append(re.sub("NaN|None", "null", f"| `{name}` | {plain_text(about)} | {numbers} |"))
    return "\n".join(rows)


def _keys(schema: dict[str, Any], before: str) -> Iterator[tuple[str, str]]:
    """Yield each key of an object and of the objects in it, with what it means."""
    for key, part in schema.get("properties", {}).items():
        links = re.findall(r'"#/\$defs/(\w+)"', json.dumps(part))
        link = "".join(f" See `{each}`." for each in dict.fromkeys(links))
        enum = ", ".join(f"`{each}`" for each in part.get("enum", ()) if each is not None)
        text = plain_text(part.get("description", "") + link + (f" One of {enum}." if enum else ""))
        yield before + key, text.replace("|", "\\|")
        for option in (part, *part.get("anyOf", ()), *part.get("oneOf", ())):
            for inner in (option, option.get("items", {})):
                yield from _keys(inner, f"{before}{key}.")


def _collect(path: str, model: type[BaseModel], tables: dict[str, type[BaseModel]]) -> None:
    tables[path] = model
    for key, field in model.model_fields.items():
        found = _table_of(field.annotation)
        if found is not None:
            inner, is_list = found
            full = f"{path.strip('[]')}.{key}".lstrip(".")
            _collect(f"[[{full}]]" if is_list else f"[{full}]", inner, tables)


def _table_of(annotation: Any) -> tuple[type[BaseModel], bool] | None:
    """Return the table of an annotation, and whether there may be several."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation, False
    if isinstance(annotation, type) and annotation in TABLES:
        return TABLES[annotation], False
    for each in get_args(annotation):
        found = _table_of(each)
        if found is not None:
            return found[0], found[1] or get_origin(annotation) is tuple
    return None


def _section(path: str, model: type[BaseModel]) -> str:
    heading = f"`{_WRITTEN.get(path, path)}`" if path else "At the top"
    about = "" if path == "[estimate]" else inspect.getdoc(model) or ""
    rows = []
    for key, field in model.model_fields.items():
        if _table_of(field.annotation) is None:
            cells = _kind(field), _default(key, field, path), _text(key, field, model, path)
            rows.append(f"| `{key}` | {' | '.join(cells)} |")
    table = "\n".join(["| key | value | default | |", "|---|---|---|---|", *rows]) if rows else ""
    return f"## {heading}\n\n{plain_text(about.partition(_BLANK)[0])}\n\n{table}\n"


def _text(key: str, field: Any, model: type[BaseModel], path: str) -> str:
    if path == "[estimate]":
        found = OPTIONS[table_keys()[key]].help
    else:
        found = explanations(model).get(key) or field.description or ""
    return plain_text(found).replace("|", "\\|")


def _default(key: str, field: Any, path: str) -> str:
    if path == "[estimate]":
        name = table_keys()[key]
        value = getattr(EstimateSettings(), name)
        value = None if value is None else OPTIONS[name].show(value)
    elif field.is_required():
        return (
            "that of the bench" if (path, key) == ("[[sensors]]", "sampling_rate") else "required"
        )
    else:
        value = field.get_default(call_default_factory=True)
    if value is None or value is PydanticUndefined or value in ("", (), {}):
        return ""
    if _kind(field) == _DURATION:
        return f"`{format_duration(float(value))}`"
    return f"`{value}`".lower() if isinstance(value, bool) else f"`{value}`"


def _kind(field: Any) -> str:
    if any(isinstance(e, BeforeValidator) and e.func is parse_duration for e in field.metadata):
        return _DURATION
    found = _named(field.annotation)
    return found if found != "Any" else ""


def _named(annotation: Any) -> str:
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Annotated and BeforeValidator(parse_duration) in args:
        return _DURATION
    if origin in (Union, UnionType):
        return " or ".join(_named(each) for each in args if each is not NoneType)
    if origin is Literal:
        return ", ".join(f"`{each}`" for each in args)
    if origin is tuple:
        return f"list of {_named(args[0])}"
    if origin is not None and args and origin is not dict:
        return _named(args[0])
    return _NAMES.get(
        annotation, "table" if origin is dict else getattr(annotation, "__name__", "")
    )
