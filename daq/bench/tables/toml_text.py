"""TOML from plain tables (the standard library only reads)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def to_toml(table: Mapping[str, Any]) -> str:
    """Return ``table`` as TOML text; entries that are None are left out."""
    import tomlkit  # noqa: PLC0415 - only where a table is written

    return tomlkit.dumps(_present(table))


def _present(value: Any) -> Any:  # noqa: ANN401 - whatever TOML holds
    if isinstance(value, Mapping):
        return {key: _present(entry) for key, entry in value.items() if entry is not None}
    return [_present(entry) for entry in value] if isinstance(value, (list, tuple)) else value
