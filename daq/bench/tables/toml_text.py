"""TOML to plain tables, in bounded time, and back (the standard library only reads)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

_MAX_LENGTH = 1 << 20
_MAX_KEYS = 10_000
"""Counted by equals signs and brackets, before the slow parser: hundreds of sensors have fewer."""
_DOTTED = re.compile(r"""(?<![\w"'-])(?:[\w"'-]++[ \t]*+\.[ \t]*+){16}""")
"""A key of so many parts: the time that tomllib takes for one grows with their square."""


def checked_table(text: str) -> dict[str, Any]:
    """Return the table of a TOML text, in bounded time.

    Raises
    ------
    ValueError
        Saying what is wrong with the text.
    """
    if len(text) > _MAX_LENGTH:
        problem = f"{len(text)} characters; expected at most {_MAX_LENGTH}"
    elif (keys := text.count("=") + text.count("\n[")) > _MAX_KEYS:
        problem = f"{keys} keys and tables; expected at most {_MAX_KEYS}"
    elif _DOTTED.search(text):
        problem = "a key of more than 16 parts; expected a bench file"
    else:
        import tomllib  # noqa: PLC0415 - imported recordings have no bench

        try:
            return tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            problem = f"not TOML: {error}"
        except RecursionError:
            problem = "tables or arrays nested too deeply; expected a bench file"
    raise ValueError(problem)


def to_toml(table: Mapping[str, Any]) -> str:
    """Return ``table`` as TOML text; entries that are None are left out."""
    import tomlkit  # noqa: PLC0415 - only where a table is written

    return tomlkit.dumps(_present(table))


def _present(value: Any) -> Any:  # noqa: ANN401 - whatever TOML holds
    if isinstance(value, Mapping):
        return {key: _present(entry) for key, entry in value.items() if entry is not None}
    return [_present(entry) for entry in value] if isinstance(value, (list, tuple)) else value
