"""Reads bench files.

``load`` and ``parse`` report every fault of a file at once, each with its key, its value and what
was expected. The tables are in :mod:`daq.bench.model`; checks of several keys together are in
:mod:`daq.bench.validation`.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from daq.bench.field_faults import field_faults
from daq.bench.model import Bench
from daq.bench.validation import cross_faults
from daq.errors import BenchFileError, FileFault

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daq.bench.driver_rules import DriverRules


def load(path: str | Path, drivers: Mapping[str, DriverRules] | None = None) -> Bench:
    """Read and check a bench file.

    Raises
    ------
    BenchFileError
        With every fault of the file, one a line.
    """
    source = Path(path)
    try:
        text = source.read_text(encoding="utf-8")
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}; expected a bench file"
        raise BenchFileError(FileFault("", problem), source=source) from None
    except UnicodeDecodeError as error:
        if source.suffix.lower() in {".h5", ".hdf5"}:
            found = "is a recording"
        else:
            found = f"byte {error.start} is not UTF-8 text"
        fault = FileFault("", f"{found}; expected a bench file (.toml)")
        raise BenchFileError(fault, source=source) from None
    return parse(text, source, drivers)


def parse(
    text: str,
    source: str | Path = "bench",
    drivers: Mapping[str, DriverRules] | None = None,
) -> Bench:
    """Parse and check the text of a bench file.

    Parameters
    ----------
    text : str
        TOML.
    source : path or str
        What messages call it; recordings go beside it if it is a path.
    drivers : mapping, optional
        The drivers of this computer. Where given, the bench must also make sense as a huddle test
        here. A bench that comes out of a recording need not: its drivers may be elsewhere.

    Raises
    ------
    BenchFileError
        With every fault of the file, one a line.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BenchFileError(FileFault("", f"not TOML: {error}"), source=source) from None
    bench: Bench | None = None
    faults: list[FileFault] = []
    context = {"text": text, "source": source if isinstance(source, Path) else None}
    try:
        bench = Bench.model_validate(table, context=context)
    except ValidationError as error:
        faults += field_faults(error, Bench, table)
    if drivers is not None:
        faults += cross_faults(table, drivers)
    if faults or bench is None:
        raise BenchFileError(*faults, source=source)
    return bench


def dump(bench: Bench) -> str:
    """Return a bench as TOML text that parses to an equal bench."""
    return bench.dump()
