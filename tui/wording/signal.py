"""Words of a recording seen against time: ticks, times and marks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime, time

from daq.results.signal import CLIPPED, EXCLUDED, GAP, Mark, Spectrogram, Trace, Waveforms
from tui.wording.formatting import readings

STEPS = (
    *(s * 10.0**e for e in (-3, -2, -1) for s in (1, 2, 5)),
    *(1.0, 2.0, 5.0, 10.0, 15.0, 30.0),
    *(60.0 * s for s in (1, 2, 5, 10, 15, 30)),
    *(3600.0 * s for s in (1, 2, 3, 6, 12)),
)
"""Seconds between ticks of time; beyond them whole days."""
DAY = 86400.0
SIGNS = {"mark": "▼", GAP: "░", CLIPPED: "▲", EXCLUDED: "╳"}
"""Signs of marks; of all other kinds `EVENT`."""
EVENT = "◆"


def time_ticks(begin: float, end: float, most: int) -> list[tuple[float, str]]:
    """Return at most so many round times between two, UTC in s since 1970, with their labels."""
    least = (end - begin) / max(most, 1)
    step = next((each for each in STEPS if each >= least), DAY * math.ceil(least / DAY))
    first = math.ceil(begin / step - 1e-9)
    return [(n * step, _label(n * step, step)) for n in range(first, math.floor(end / step) + 1)]


def _label(at: float, step: float) -> str:
    of = datetime.fromtimestamp(round(at, 3), UTC)
    if step >= DAY:
        return f"{of:%m-%d}"
    if step >= 60:
        return f"{of:%H:%M}"
    digits = max(0, math.ceil(-math.log10(step) - 1e-9))
    return f"{of:%H:%M:%S}" + f".{of.microsecond:06d}"[: digits + 1] * bool(digits)


def moment(at: float, *, fine: bool = False) -> str:
    """Return a time as date and time of UTC to the second, or to the millisecond."""
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M:%S.%f}"[: 23 if fine else 19]


def time_of(text: str, near: float, whole: tuple[float, float]) -> float | None:
    """Return a time of UTC; of a time of day without a date, the first after that of `near`.

    None where it is none, or not within the whole.
    """
    begin, end = whole
    try:
        at = datetime.fromisoformat(text.strip()).replace(tzinfo=UTC).timestamp()
    except ValueError:
        day = datetime.fromtimestamp(near, UTC).date()
        try:
            at = datetime.combine(day, time.fromisoformat(text.strip()), UTC).timestamp()
        except ValueError:
            return None
        at = next((each for each in (at, at + DAY, at - DAY) if begin <= each <= end), at)
    return at if begin <= at <= end else None


def stretch_text(begin: float, end: float) -> str:
    """Return a stretch between times of UTC in s, as the option --exclude takes it."""
    return "/".join(datetime.fromtimestamp(at, UTC).isoformat() for at in (begin, end))


def scale(found: Spectrogram) -> str:
    """Return the levels that the colours of a spectrogram show."""
    low, high = found.range_db
    return f"{low:.0f} to {high:.0f} dB re 1 ({found.unit})²/Hz".replace("-", "−")


def loudest(found: Spectrogram) -> str:
    """Return where a spectrogram is loudest; empty where no frequency stands out."""
    at = float(f"{found.loudest:.2g}")
    return f", most near {at:g} Hz" if math.isfinite(at) else ""


def title(view: Waveforms) -> str:
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


def most_first(marks: Sequence[Mark]) -> list[Mark]:
    """Return remarks, gaps and clipped stretches, in this order, then events."""
    order = list(SIGNS)
    return sorted(marks, key=lambda m: order.index(m.kind) if m.kind in SIGNS else len(order))


def sign(mark: Mark) -> str:
    """Return the sign of a mark."""
    return SIGNS.get(mark.kind, EVENT)


def extent(trace: Trace) -> str:
    """Return the largest difference of samples with its unit; empty without any."""
    low, high = trace.range
    if not math.isfinite(low):
        return ""
    (text,), unit = readings([high - low], trace.unit)
    return f"{text} {unit}"
