"""Reads masks from CSV files, and puts those of a bench file into its text.

A mask has a header with units, such as ``frequency (Hz), noise (µg/√Hz)``, and a row a point. The
first column can be a period in s. Lines that start with ``#`` are comments. Columns are separated
by commas, semicolons (numbers may then have decimal commas) or tabs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from daq.bench.masks.mask import NOISE_MODELS, Mask, check_points
from daq.bench.option_values import expected_of
from daq.bench.units import DensityUnit
from daq.errors import FileFault, HuddleError, WrongSettingError

_MOST = 1 << 20
"""Bytes of a file: far more than a mask has."""
_HEADER = 'a header with units, such as "frequency (Hz), noise (µg/√Hz)"'


class MaskFileError(HuddleError, ValueError):
    """A file that is no mask; the message names it and what was expected."""

    is_usage_error = True


def read_mask(path: str | Path) -> Mask:
    """Read a mask.

    Raises
    ------
    MaskFileError
        If the file cannot be read, or is no mask.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            content = file.read(_MOST + 1)
    except OSError as error:
        raise MaskFileError(f"{path}: {error.strerror}; expected a mask (CSV)") from error
    if len(content) > _MOST:
        raise MaskFileError(f"{path}: larger than {_MOST} bytes; expected a mask (CSV)")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    try:
        return _mask(path.stem, text)
    except ValueError as error:
        raise MaskFileError(f"{path}: {error}") from None


def masks_named(text: str) -> tuple[Mask, ...]:
    """Return masks from names of models and CSV files, separated by commas.

    Raises
    ------
    WrongSettingError
        If a name is neither, with the models there are.
    MaskFileError
        If a file is no mask.
    """
    found = []
    for word in filter(None, map(str.strip, text.split(","))):
        if word.lower() in NOISE_MODELS:
            found.append(NOISE_MODELS[word.lower()])
        elif Path(word).suffix.lower() in {".csv", ".txt", ".tsv"}:
            found.append(read_mask(word))
        else:
            expected = expected_of(word.lower(), tuple(NOISE_MODELS))
            raise WrongSettingError(f"{word!r}: {expected}, or a CSV file")
    return tuple(found)


def embed_masks(
    text: str, table: Mapping[str, object], folder: Path
) -> tuple[str, list[FileFault]]:
    """Return the text of a bench file with the points of its masks in place of their files.

    A recording holds the text: it needs no other file. Comments and order are kept.

    Parameters
    ----------
    text : str
        Of valid TOML.
    table : mapping
        What the text holds.
    folder : path
        Of the bench file: names of files are relative to it.

    Returns
    -------
    text : str
    faults : list of FileFault
        Files that are no masks.
    """
    limits = table.get("limits")
    if not isinstance(limits, list) or not any(
        isinstance(limit, dict) and "file" in limit for limit in limits
    ):
        return text, []
    import tomlkit  # noqa: PLC0415 - only where a bench file names files of masks

    document = tomlkit.parse(text)
    faults = []
    for limit in document["limits"]:
        if "file" not in limit:
            continue
        name, key = str(limit["file"]), f'limits["{limit.get("name", "?")}"].file'
        if {"frequency", "psd", "unit", "model"} & set(limit):
            faults.append(FileFault(key, "expected without frequency, psd, unit and model", name))
            continue
        try:
            mask = read_mask(folder / name)
        except MaskFileError as error:
            faults.append(FileFault(key, str(error), name))
            continue
        limit.remove("file")
        limit["frequency"], limit["psd"] = list(mask.frequency), list(mask.psd)
        limit["unit"] = f"({mask.unit})²/Hz"
    return tomlkit.dumps(document), faults


def _mask(name: str, text: str) -> Mask:
    """Return the mask of a text.

    Raises
    ------
    ValueError
        With the line, and what was expected.
    """
    rows = _rows(text)
    try:
        _, header = next(rows)
    except StopIteration:
        raise ValueError(f"no lines; expected {_HEADER}") from None
    if len(header) < 2:
        raise ValueError(f"one column; expected {_HEADER}, and a row a point")
    is_period = _unit_of(header[0]) in {"s", "sec", "seconds"}
    if not is_period and _unit_of(header[0]).lower() != "hz":
        raise ValueError(f"first column {header[0]!r}; expected {_HEADER}, or a period (s)")
    unit = DensityUnit.parse(_unit_of(header[1]))
    points = []
    for number, row in rows:
        try:
            x, y = float(row[0]), float(row[1])
        except (ValueError, IndexError):
            raise ValueError(f"line {number}: expected two numbers") from None
        if not (0 < x < math.inf and math.isfinite(y) and (unit.is_level or y > 0)):
            raise ValueError(
                f"line {number}: {x:g}, {y:g}; expected a finite frequency above 0, and a finite"
                " density, above 0 unless in dB"
            )
        points.append((1 / x if is_period else x, unit.psd(y)))
    points.sort()
    frequency, psd = [f for f, _ in points], [p for _, p in points]
    check_points(frequency, psd)
    return Mask(name, unit.unit, tuple(frequency), tuple(psd))


def _rows(text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each line that is not a comment."""
    lines = [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    first = lines[0][1] if lines else ""
    separator = next((mark for mark in ";\t" if mark in first), ",")
    for place, (number, line) in enumerate(lines):
        cells = [cell.strip().strip('"').strip() for cell in line.split(separator)]
        if place and separator != ",":
            cells = [cell.replace(",", ".") for cell in cells]
        yield number, cells


def _unit_of(cell: str) -> str:
    """Return what the outer brackets of a header hold; empty if there are none."""
    for opening, closing in ("()", "[]"):
        first, last = cell.find(opening), cell.rfind(closing)
        if 0 <= first < last:
            return cell[first + 1 : last].strip()
    return ""
