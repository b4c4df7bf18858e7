"""Guesses the format of text from a few rows, as settings of the bench file.

A guess is only shown to the user, not used. Rows of one device have the same fields, so a property
must hold for all rows.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from typing import Any

from daq.devices.text.format import LABELLED, flatten, nmea_checksum, read_number

MIN_ROWS = 3
_DELIMITERS = (";", "\t", ",", " ")
_COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+")
_HEX = re.compile(r"[0-9A-Fa-f]{2,8}")
_TIME_FORMATS = (
    "%Y-%m-%dT%H:%M:%S.%fZ",
    "%Y-%m-%dT%H:%M:%S.%f",
    "%Y-%m-%dT%H:%M:%SZ",
    "%Y-%m-%dT%H:%M:%S",
    "%Y-%m-%d %H:%M:%S.%f",
    "%Y-%m-%d %H:%M:%S",
    "%Y/%m/%d %H:%M:%S.%f",
    "%Y/%m/%d %H:%M:%S",
)
_EPOCHS = (1e9, 4e9)
"""Plausible range of present times, in seconds since 1970."""


def guess_settings(rows: Sequence[bytes]) -> dict[str, Any] | None:
    """Return settings of the text driver that fit rows, or None.

    Parameters
    ----------
    rows : sequence of bytes
        Complete lines without terminators, in order of arrival.
    """
    texts = [row.decode("ascii", "replace").strip() for row in rows]
    texts = [text for text in texts if text]
    if len(texts) < MIN_ROWS or any("\ufffd" in t or not t.isprintable() for t in _tabless(texts)):
        return None
    return _json(texts) or _labelled(texts) or _delimited(texts)


def _tabless(texts: Sequence[str]) -> list[str]:
    return [text.replace("\t", " ") for text in texts]


def _json(texts: Sequence[str]) -> dict[str, Any] | None:
    try:
        objects = [flatten(json.loads(text)) for text in texts]
    except (ValueError, TypeError, RecursionError):
        return None
    columns = {key: [one.get(key, "") for one in objects] for key in objects[0]}
    return _by_name(columns, {"layout": "json"})


def _labelled(texts: Sequence[str]) -> dict[str, Any] | None:
    rows = [dict(LABELLED.findall(text)) for text in texts]
    if not rows[0] or any(row.keys() != rows[0].keys() for row in rows):
        return None
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    return _by_name(columns, {"layout": "labelled"})


def _by_name(columns: dict[str, list[str]], settings: dict[str, Any]) -> dict[str, Any] | None:
    numeric = {key: values for key, values in columns.items() if _are_numbers(values)}
    special = _special(numeric | {k: v for k, v in columns.items() if _time_format(v)})
    channels = [key for key in numeric if key not in special.values()]
    if not channels:
        return None
    return {**settings, "channel_names": channels, **special, **_whole(numeric, channels)}


def _delimited(texts: Sequence[str]) -> dict[str, Any] | None:
    settings: dict[str, Any] = {}
    if all(text.startswith("$") for text in texts):
        settings["prefix"] = "$"
        texts = [text[1:] for text in texts]
    bodies = [text.rpartition("*") for text in texts]
    if all(star and f"{nmea_checksum(body):02X}" == sum_.upper() for body, star, sum_ in bodies):
        settings["nmea_checksum"] = True
        texts = [body for body, _, _ in bodies]
    found: list[tuple[int, dict[str, Any]]] = []
    for delimiter in _DELIMITERS:
        rows = [text.split(None if delimiter == " " else delimiter) for text in texts]
        if len({len(row) for row in rows}) != 1:
            continue
        columns = {n: [field.strip() for field in c] for n, c in enumerate(zip(*rows, strict=True))}
        own = _columns(columns, delimiter)
        if own is not None:
            found.append((len(own["columns"]), {**settings, "delimiter": delimiter, **own}))
    return max(found, key=lambda one: one[0])[1] if found else None


def _columns(columns: dict[int, list[str]], delimiter: str) -> dict[str, Any] | None:
    """Return the settings for the columns of channels and the format of numbers."""
    settings: dict[str, Any] = {}
    first = columns[0]
    if len(set(first)) == 1 and not _are_numbers(first) and first[0]:
        settings["tag"] = first[0]
        columns = {n: values for n, values in columns.items() if n}
    fields = list(itertools.chain.from_iterable(columns.values()))
    if delimiter != "," and any(_COMMA_NUMBER.fullmatch(field) for field in fields):
        settings["decimal_comma"] = True
        columns = {n: [v.replace(",", ".") for v in values] for n, values in columns.items()}
    numeric = {n: values for n, values in columns.items() if _are_numbers(values)}
    special = _special(numeric | {n: v for n, v in columns.items() if _time_format(v)})
    channels = [n for n in numeric if n not in special.values()]
    hexadecimal = [n for n, values in columns.items() if _are_hexadecimal(values)]
    if len(hexadecimal) > len(channels) and any(not _are_numbers(columns[n]) for n in hexadecimal):
        width = max(len(value) for n in hexadecimal for value in columns[n])
        return {**settings, "columns": hexadecimal, "hexadecimal_bits": 4 * width, "whole": True}
    if not channels:
        return None
    return {**settings, "columns": channels, **special, **_whole(numeric, channels)}


def _special(columns: dict[Any, list[str]]) -> dict[str, Any]:
    """Return the settings for the columns of a time and of a counter."""
    found: dict[str, Any] = {}
    for key, values in columns.items():
        if "time_column" not in found and (format_ := _time_format(values)):
            found |= {"time_column": key, "time_format": format_}
        elif "counter_column" not in found and _are_counts(values):
            found["counter_column"] = key
    return found


def _time_format(values: Sequence[str]) -> str:
    """Return the format of times; empty if the values are no times."""
    for format_ in _TIME_FORMATS:
        if _all(partial(_read_time, format_), values):
            return format_
    if not _are_numbers(values):
        return ""
    numbers = [read_number(value) for value in values]
    steps = [b - a for a, b in itertools.pairwise(numbers)]
    if any(step < 0 for step in steps) or not any(steps):
        return ""
    if all(_EPOCHS[0] < number < _EPOCHS[1] for number in numbers):
        return "epoch"
    even = max(steps) - min(steps) <= max(2.0, 0.2 * max(steps))
    whole = all(number == int(number) >= 0 for number in numbers)
    if not (even and whole and min(steps) > 1):
        return ""
    return "micros" if min(steps) >= 1000 else "millis"


def _read_time(format_: str, value: str) -> None:
    datetime.strptime(value, format_)  # noqa: DTZ007 -- only tests the format


def _all(read: Callable[[str], object], values: Sequence[str]) -> bool:
    try:
        for value in values:
            read(value)
    except ValueError:
        return False
    return True


def _are_numbers(values: Sequence[str]) -> bool:
    return _all(read_number, values)


def _are_counts(values: Sequence[str]) -> bool:
    if not all(value.isdigit() for value in values):
        return False
    return all(int(b) - int(a) == 1 or int(b) == 0 for a, b in itertools.pairwise(values))


def _are_hexadecimal(values: Sequence[str]) -> bool:
    return all(_HEX.fullmatch(value) for value in values) and len({len(v) for v in values}) == 1


def _whole(columns: dict[Any, list[str]], channels: Sequence[Any]) -> dict[str, Any]:
    whole = all(re.fullmatch(r"[+-]?\d+", v) for key in channels for v in columns[key])
    return {"whole": True} if whole else {}
