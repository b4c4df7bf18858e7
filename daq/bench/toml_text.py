"""TOML from plain tables: the few shapes a bench file has (the standard library only reads)."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+", re.ASCII)


def to_toml(table: Mapping[str, Any]) -> str:
    """Return ``table`` as TOML text; entries that are None are left out."""
    return "\n".join(_lines(table, ())).strip() + "\n"


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    present = {key: value for key, value in table.items() if value is not None}
    nested = {key: value for key, value in present.items() if _is_table(value)}
    lines = [
        f"{_key(key)} = {_value(value)}" for key, value in present.items() if key not in nested
    ]
    for key, value in nested.items():
        below = (*path, _key(key))
        header = ".".join(below)
        if isinstance(value, Mapping):
            lines += ["", f"[{header}]", *_lines(value, below)]
        else:
            for entry in value:
                lines += ["", f"[[{header}]]", *_lines(entry, below)]
    return lines


def _is_table(value: object) -> bool:
    if isinstance(value, Mapping):
        return True
    if isinstance(value, str) or not isinstance(value, Sequence) or not value:
        return False
    return all(isinstance(entry, Mapping) for entry in value)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _value(key)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None)
        return f"{{{inner}}}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(_value(entry) for entry in value)}]"
    # A JSON string with its escapes is a TOML basic string, but for DEL, which TOML wants escaped.
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007F")
