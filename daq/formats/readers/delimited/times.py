"""Times as loggers write them, exact to the last decimal."""

from __future__ import annotations

import logging
import math
import re
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np

from daq.formats.foreign_sensor import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_DATE = re.compile(
    r"^(?P<a>\d{1,4})(?P<sign>[-./])(?P<b>\d{1,2})(?P=sign)(?P<c>\d{1,4})"
    r"(?:[T\s,]+(?P<clock>\d.*))?$"
)
_CLOCK = re.compile(
    r"^(?P<h>\d{1,2}):(?P<m>\d{2})(?::(?P<s>\d{2})(?:[.,:](?P<f>\d{1,24}))?)?\s*(?P<half>[AaPp][Mm])?"
    r"\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2})?$"
)
SCALES = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), NS_PER_S),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1_000_000),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microseconds"), 1000),
    **dict.fromkeys(("ns", "nanoseconds"), 1),
    **dict.fromkeys(("min", "minutes"), 60 * NS_PER_S),
    **dict.fromkeys(("h", "hours"), 3600 * NS_PER_S),
}
_EPOCHS = ((1e17, "ns"), (1e14, "µs"), (1e11, "ms"))
"""Numbers without a unit above these are ns, µs or ms since 1970: as seconds, the year 5138."""
_LOGGER = logging.getLogger(__name__)


def is_time(cell: str) -> bool:
    """Tell whether a cell is a date, a time of day or both."""
    return bool(_DATE.match(cell) or _CLOCK.match(cell))


def nanoseconds(cells: Sequence[str], unit: str, *, decimal_comma: bool) -> NDArray[np.int64]:
    """Return times in ns; since 1970 if they have a date.

    Parameters
    ----------
    cells : sequence of str
        Numbers, or dates as in 2026-11-21T03:00:00.005, 21.11.2026 03:00:00,005 or
        11/21/2026 3:00:00 PM. UTC if they state no zone.
    unit : str
        Of numbers; seconds if it is none of time, unless they are too large for that.

    Raises
    ------
    ValueError
        Naming the cell, if it is no time or can be read as two dates.
    """
    first = cells[0].replace(",", ".") if decimal_comma else cells[0]
    try:
        value = float(first)
    except ValueError:
        order = _order(cells)
        return _within_range([_dated(cell, order) for cell in cells], cells)
    scale = SCALES.get(unit.lower())
    if scale is None:
        guessed = next((each for least, each in _EPOCHS if abs(value) > least), "s")
        scale = SCALES[guessed]
        if guessed != "s":
            _LOGGER.info(
                "times such as %s have no unit; read as %s since 1970: state the unit in the"
                " header, as in time (s)",
                cells[0],
                guessed,
            )
    return _within_range([_scaled(cell, scale, comma=decimal_comma) for cell in cells], cells)


def _within_range(times: list[int], cells: Sequence[str]) -> NDArray[np.int64]:
    try:
        return np.array(times, dtype=np.int64)
    except OverflowError:
        at = next(number for number, ns in enumerate(times) if abs(ns) >= 1 << 63)
        raise ValueError(
            f"time {cells[at]!r}: beyond the year 2262; expected seconds since 1970 or less, or"
            " their unit in the header, as in time (ms)"
        ) from None


def _scaled(cell: str, scale: int, *, comma: bool) -> int:
    """Return a number times a scale, exactly: floats of seconds since 1970 are not."""
    text = cell.replace(",", ".") if comma else cell
    whole, _, fraction = text.partition(".")
    if not whole.lstrip("+-").isdigit() or (fraction and not fraction.isdigit()):
        value = float(text) * scale
        if not math.isfinite(value):
            raise ValueError(f"time {cell!r}: expected a finite number")
        return round(value)
    sign: int = -1 if whole.startswith("-") else 1
    digits = fraction[:18]
    return int(whole) * scale + sign * (int(digits or "0") * scale // int(10 ** len(digits)))


def _order(cells: Sequence[str]) -> str:
    """Return the order of year, month and day of dates, found from all of them."""
    sign, half = "", False
    largest = [0, 0]
    for cell in (cells[0], cells[len(cells) // 2], cells[-1]):
        found = _DATE.match(cell)
        if found is None:
            continue
        sign = found["sign"]
        half = half or bool(re.search(r"[AaPp][Mm]", cell))
        largest = [max(largest[0], int(found["a"])), max(largest[1], int(found["b"]))]
    if largest[0] > 31:
        return "ymd"
    if sign == "." or largest[0] > 12:
        return "dmy"
    if not sign or largest[1] > 12 or half:
        return "mdy"
    raise ValueError(
        f"{cells[0]!r}: day and month cannot be told apart; expected a date as in 2026-11-21"
    )


def _dated(cell: str, order: str) -> int:
    found = _DATE.match(cell)
    clock = _CLOCK.match(found["clock"].strip() if found and found["clock"] else cell)
    if found is None and clock is None:
        raise ValueError(f"{cell!r}: expected a number or a time as in 2026-11-21T03:00:00.005")
    if found is not None and found["clock"] and clock is None:
        raise ValueError(f"{cell!r}: expected a time of day as in 03:00:00.005")
    ns = 0
    if found is not None:
        parts = dict(zip(order, (found["a"], found["b"], found["c"]), strict=True))
        year = int(parts["y"])
        year += 2000 if year < 100 else 0
        day = datetime(year, int(parts["m"]), int(parts["d"]))  # noqa: DTZ001 - days only
        ns = (day - datetime(1970, 1, 1)) // timedelta(seconds=1) * NS_PER_S  # noqa: DTZ001
    if clock is None:
        return ns
    hour = int(clock["h"])
    if clock["half"]:
        hour = hour % 12 + (12 if clock["half"].lower() == "pm" else 0)
    seconds = hour * 3600 + int(clock["m"]) * 60 + int(clock["s"] or 0)
    zone = clock["zone"] or "Z"
    if zone[0] in "+-":
        offset = int(zone[1:3]) * 3600 + int(zone[-2:]) * 60
        seconds -= offset if zone[0] == "+" else -offset
    return ns + seconds * NS_PER_S + int((clock["f"] or "0").ljust(9, "0")[:9])
