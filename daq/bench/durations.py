"""Durations as people write them: ``10s``, ``90 min``, ``1.5h``, ``2d 12h``; instants."""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime, timedelta

_SECONDS = {
    "ms": 1e-3,
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("m", "min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
    **dict.fromkeys(("w", "week", "weeks"), 604800.0),
}
_PART = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)\s*", re.ASCII)
_EXPECTED = 'expected a positive duration such as "10s", "90 min", "3h" or "1d 12h"'


def parse_duration(value: str | float, *, zero: bool = False) -> float:
    """Return a duration in seconds; a bare number is seconds. None at all is one where `zero`.

    Raises
    ------
    ValueError
        If ``value`` is not a positive, finite duration; the message says what was expected.
    """
    numeric = isinstance(value, (int, float)) and not isinstance(value, bool)
    seconds = float(value) if numeric else _parse_text(str(value))
    if not (math.isfinite(seconds) and (seconds > 0 or (zero and seconds == 0))):
        raise ValueError(_EXPECTED)
    return seconds


def _parse_text(text: str) -> float:
    lowered = text.lower()
    total, position, bare = 0.0, 0, False
    while position < len(lowered):
        part = _PART.match(lowered, position)
        # A bare number stands alone: in "1h 30" nobody knows what the 30 counts.
        if part is None or bare or (not part[2] and position > 0):
            raise ValueError(_EXPECTED)
        if part[2] and part[2] not in _SECONDS:
            raise ValueError(_EXPECTED)
        bare = not part[2]
        total += float(part[1]) * _SECONDS.get(part[2], 1.0)
        position = part.end()
    return total


def format_duration(seconds: float) -> str:
    """Return a duration for people: ``10s``, ``1h30m``, ``2d12h``; always parsed back."""
    if seconds < 60 or not math.isfinite(seconds):
        return f"{seconds:.3g}s"
    rest = round(seconds)
    parts = []
    for unit, length in (("d", 86400), ("h", 3600), ("m", 60), ("s", 1)):
        count, rest = divmod(rest, length)
        if count:
            parts.append(f"{count}{unit}")
    return "".join(parts)


def instant(text: str, created: datetime) -> datetime:
    """Return a UTC time, or a time after the start of the recording, as an instant.

    Raises
    ------
    ValueError
        With what was expected.
    """
    try:
        return created + timedelta(seconds=parse_duration(text, zero=True))
    except OverflowError:
        raise ValueError(f"{text!r} after the start is after the year 9999") from None
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(
            f"{text!r}: expected UTC as in 2026-11-21T03:00:00, or a time after the start as in 2h"
        ) from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


def stretch(text: str, created: datetime) -> tuple[datetime, datetime]:
    """Return start and end of a stretch of a recording, such as ``0s/60s``, as instants.

    Raises
    ------
    ValueError
        With what was expected.
    """
    begin, slash, end = text.partition("/")
    if not slash:
        raise ValueError(f"{text!r}: expected START/END, such as 0s/60s")
    found = instant(begin, created), instant(end, created)
    if found[0] >= found[1]:
        raise ValueError(f"{text!r}: expected a start before the end, in the same form")
    return found
