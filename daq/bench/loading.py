"""Reads bench files.

``load`` and ``parse`` report all errors of a file together, each with key, value and expectation.
The tables are in :mod:`daq.bench.model`; checks of several keys together are in
:mod:`daq.bench.validation`.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from daq.bench.field_faults import field_faults
from daq.bench.masks.mask_file import embed_masks
from daq.bench.model import Bench
from daq.bench.tables.toml_text import checked_table
from daq.bench.validation import cross_faults
from daq.errors import BenchFileError, FileFault
from daq.foreign_files import SUFFIXES, import_command, is_foreign

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daq.bench.driver_rules import DriverRules

_MAX_FAULTS = 100
"""Errors that are reported: a file with more is another kind of file."""


def load(path: str | Path, drivers: Mapping[str, DriverRules] | None = None) -> Bench:
    """Read and check a bench file.

    Raises
    ------
    BenchFileError
        With every error in the file, one per line.
    """
    source = Path(path)
    try:
        text = source.read_text(encoding="utf-8")
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}; expected a bench file"
        raise BenchFileError(FileFault("", problem), source=source) from None
    except UnicodeDecodeError as error:
        if is_foreign(source):
            raise _of_another_program(source) from None
        fault = FileFault("", "is a recording; expected a bench file (.toml)")
        if source.suffix.lower() not in {".h5", ".hdf5"}:
            fault = FileFault("", f"byte {error.start} is not UTF-8 text; expected a bench file")
        raise BenchFileError(fault, source=source) from None
    try:
        return parse(text, source, drivers)
    except BenchFileError:
        if source.suffix.lower() in SUFFIXES:
            raise _of_another_program(source) from None
        raise


def _of_another_program(source: Path) -> BenchFileError:
    problem = f"not a bench file (.toml); convert it to a recording: {import_command([source])}"
    return BenchFileError(FileFault("", problem), source=source)


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
        Name of the text in messages; recordings and files of limits are beside it if it is a path.
    drivers : mapping, optional
        The drivers of this computer. With them the bench is also checked as a huddle test on this
        computer. The bench in a recording is not: its drivers may be on another computer.

    Raises
    ------
    BenchFileError
        With every error in the file, one per line.
    """
    table = _table(text, source)
    if isinstance(source, Path):
        embedded, faults = embed_masks(text, table, source.parent)
        if faults:
            raise BenchFileError(*faults, source=source)
        if embedded != text:
            text, table = embedded, _table(embedded, source)
    return _check(table, text, source, drivers)


def _check(
    table: dict[str, Any],
    text: str,
    source: str | Path,
    drivers: Mapping[str, DriverRules] | None,
) -> Bench:
    """Return the bench of a table, or raise every error in it."""
    bench: Bench | None = None
    faults: list[FileFault] = []
    context = {"text": text, "source": source if isinstance(source, Path) else None}
    try:
        bench = Bench.model_validate(table, context=context)
    except ValidationError as error:
        faults += islice(field_faults(error, Bench, table), _MAX_FAULTS)
        if error.error_count() > _MAX_FAULTS:
            raise BenchFileError(
                *faults,
                FileFault("", f"{error.error_count()} errors; the first {_MAX_FAULTS} are above"),
                source=source,
            ) from None
    if drivers is not None:
        faults += cross_faults(table, drivers)
    if faults or bench is None:
        raise BenchFileError(*faults, source=source)
    return bench


def _table(text: str, source: str | Path) -> dict[str, Any]:
    try:
        return checked_table(text)
    except ValueError as error:
        raise BenchFileError(FileFault("", str(error)), source=source) from None


def dump(bench: Bench) -> str:
    """Return a bench as TOML text that parses to an equal bench."""
    return bench.dump()
