"""Numbers and times as people read them."""

from __future__ import annotations

import math
from datetime import UTC, datetime


def utc(ns: int) -> str:
    """Return an instant as ISO 8601 to the millisecond."""
    whole, rest = divmod(ns, 1_000_000_000)
    moment = datetime.fromtimestamp(whole, tz=UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest // 1_000_000:03d}Z"


def clock_time(seconds: float) -> str:
    """Return a length of time as h:mm:ss, or m:ss below an hour."""
    whole = max(0, math.floor(seconds + 0.5))
    hours, rest = divmod(whole, 3600)
    minutes, seconds = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def time_left(seconds: float | None) -> str:
    """Return how long something still takes, roughly."""
    if seconds is None or not math.isfinite(seconds):
        return "time left unknown"
    if seconds <= 0:
        return "done"
    for limit, unit, size in ((90, "s", 1), (5400, "min", 60), (172800, "h", 3600)):
        if seconds < limit:
            return f"{math.ceil(seconds / size)} {unit} left"
    return f"{math.ceil(seconds / 86400)} days left"


def level(psd: float) -> str:
    """Return a PSD in dB, and say so where there is none."""
    if not math.isfinite(psd):
        return "?"
    if psd <= 0:
        return "below 0"
    return f"{10 * math.log10(psd):.2f}".replace("-", "−")
