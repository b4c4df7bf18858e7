"""Where results go: tables for people to standard output, JSON for programs where it is asked."""

from __future__ import annotations

import json
import math
import sys
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

if TYPE_CHECKING:
    from collections.abc import Mapping

STANDARD_OUTPUT = "-"
WIDTH_OF_FILES = 110
"""Columns of tables that go into a file or a pipe."""


def console() -> Console:
    """Return standard output."""
    terminal = sys.stdout.isatty()
    return Console(highlight=False, width=None if terminal else WIDTH_OF_FILES)


@cache
def notices() -> Console:
    """Return standard error, where progress and remarks go."""
    return Console(stderr=True, highlight=False)


def for_people(json_file: str | None, csv_file: str | None = None) -> Console:
    """Return where to print tables: standard error, if a program reads standard output."""
    return notices() if STANDARD_OUTPUT in {json_file, csv_file} else console()


def write_text(file: str, text: str, *, append: bool = False) -> None:
    """Write to a file, or to standard output if it is called ``-``.

    Raises
    ------
    OSError
        With the name of what could not be written: a full disk tells none.
    """
    try:
        if file == STANDARD_OUTPUT:
            sys.stdout.write(text)
            sys.stdout.flush()
        else:
            with Path(file).open("a" if append else "w", encoding="utf-8") as out:
                out.write(text)
    except OSError as error:
        if error.filename is None:
            error.filename = "standard output" if file == STANDARD_OUTPUT else file
        raise


def write_json(file: str | None, document: Mapping[str, Any]) -> None:
    """Write a document as one line of JSON, if a file is given; what is not finite becomes null."""
    if file is not None:
        write_text(file, json.dumps(finite(document), ensure_ascii=False, allow_nan=False) + "\n")


def finite(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Return a JSON value with null for every number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(entry) for entry in value]
    return value
