"""Words of a recording seen against time: ticks, times and marks."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from daq.results.signal import CLIPPED, EXCLUDED, GAP
from tui.wording.formatting import readings

if TYPE_CHECKING:
    from daq.results.signal import Mark, SignalView, Trace

STEPS = (
    *(s * 10.0**e for e in (-3, -2, -1) for s in (1, 2, 5)),
    *(1.0, 2.0, 5.0, 10.0, 15.0, 30.0),
    *(60.0 * s for s in (1, 2, 5, 10, 15, 30)),
    *(3600.0 * s for s in (1, 2, 3, 6, 12)),
)
"""Seconds between ticks of time; beyond them whole days."""
_DAY = 86400.0
SHORT = {"mark": "▼", EXCLUDED: "✗", GAP: "░", CLIPPED: "▲"}
"""Signs of marks; of all other kinds `EVENT`."""
EVENT = "◆"


def time_ticks(begin: float, end: float, most: int) -> list[tuple[float, str]]:
    """Return at most so many round times between two, UTC in s since 1970, with their labels."""
    least = (end - begin) / max(most, 1)
    step = next((each for each in STEPS if each >= least), _DAY * math.ceil(least / _DAY))
    first = math.ceil(begin / step - 1e-9)
    return [(n * step, _label(n * step, step)) for n in range(first, math.floor(end / step) + 1)]


def _label(time: float, step: float) -> str:
    moment = datetime.fromtimestamp(round(time, 3), UTC)
    if step >= _DAY:
        return f"{moment:%m-%d}"
    if step >= 60:
        return f"{moment:%H:%M}"
    digits = max(0, math.ceil(-math.log10(step) - 1e-9))
    return f"{moment:%H:%M:%S}" + f".{moment.microsecond:06d}"[: digits + 1] * bool(digits)


def moment(time: float, *, fine: bool = False) -> str:
    """Return a time as date and time of UTC to the second, or to the millisecond."""
    return f"{datetime.fromtimestamp(time, UTC):%Y-%m-%d %H:%M:%S.%f}"[: 23 if fine else 19]


def title(view: SignalView) -> str:
    """Return the span of a view."""
    begin, end = moment(view.begin), moment(view.end)
    return f"{begin} to {end[11:] if begin[:10] == end[:10] else end} UTC"


def words(mark: Mark) -> str:
    """Return when something happened, to which sensor, what, and how often."""
    at = moment(mark.begin)[11:]
    lasted = mark.end - mark.begin
    parts = [at if lasted < 1 else f"{at} to {moment(mark.end)[11:]}", mark.sensor]
    parts.append(mark.kind if mark.count == 1 else f"{mark.count} × {mark.kind}")
    return " ".join(filter(None, parts)) + (f": {mark.text}" if mark.text else "")


def sign(mark: Mark) -> str:
    """Return the sign of a mark."""
    return SHORT.get(mark.kind, EVENT)


def extent(trace: Trace) -> str:
    """Return the largest difference of samples with its unit; empty without any."""
    low, high = trace.range
    if not math.isfinite(low):
        return ""
    (text,), unit = readings([high - low], trace.unit)
    return f"{text} {unit}"
