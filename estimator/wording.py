"""Words for what is found: a line, an explanation, an action; and numbers as people read them.

No program parses them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import accumulate


@dataclass(frozen=True, slots=True)
class Words:
    """A fact or a finding in words.

    Attributes
    ----------
    line : str
        What is wrong where, and what to do, as short as possible; without a full stop.
    explanation : str
        The fact and its effect, in whole sentences.
    action : str
        What to do, in whole sentences; empty if nothing can or need be done.
    """

    line: str
    explanation: str
    action: str = ""

    def __str__(self) -> str:
        return f"{self.explanation} {self.action}" if self.action else self.explanation


def time_of_day(utc_ns: int) -> str:
    """Return the time of an instant, in UTC."""
    return f"{datetime.fromtimestamp(utc_ns // 10**9, UTC):%H:%M:%S}"


def clock_time(seconds: float) -> str:
    """Return a length of time as h:mm:ss, or m:ss below an hour."""
    whole = max(0, math.floor(seconds + 0.5))
    hours, rest = divmod(whole, 3600)
    minutes, left = divmod(rest, 60)
    return f"{hours}:{minutes:02d}:{left:02d}" if hours else f"{minutes}:{left:02d}"


def roughly(seconds: float) -> str:
    """Return a length of time in its largest unit, rounded up."""
    for limit, unit, size in ((90, "s", 1), (5400, "min", 60), (172800, "h", 3600)):
        if seconds < limit:
            return f"{math.ceil(seconds / size)} {unit}"
    return f"{math.ceil(seconds / 86400)} days"


def signed(value: float, spec: str) -> str:
    """Return a number with the minus sign of typography."""
    return f"{value:{spec}}".replace("-", "−")


def measured(value: float, half: float, digits: int) -> str:
    """Return a number with the half-width of its interval where that is known."""
    reach = f" ±{half:.{digits}f}" if math.isfinite(half) else ""
    return f"{signed(value, f'.{digits}f')}{reach}" if math.isfinite(value) else "?"


def several(count: int, one: str, more: str | None = None) -> str:
    """Return a count with its noun."""
    return f"{count:,} {one if count == 1 else more or one + 's'}".replace(",", "\u202f")


def degrees(angle: float) -> str:
    """Return an angle to a thousandth of a degree."""
    return f"{signed(angle, '.3f')}°" if math.isfinite(angle) else "?"


def percent(share: float) -> str:
    """Return a share in per cent, to two digits."""
    value = float(f"{100 * share:.2g}")
    return f"{value:.0f} %" if value >= 10 else f"{value:.2g} %"


def ratio(value: float) -> str:
    """Return a ratio to two digits, without an exponent where people need none."""
    return f"{float(f'{value:.2g}'):.0f}" if 10 <= value < 1e6 else signed(value, ".2g")


def span(low: float, high: float) -> str:
    """Return a band of frequencies; one frequency where both ends read alike."""
    ends = dict.fromkeys((f"{low:.3g}", f"{high:.3g}"))
    return f"{'–'.join(ends)} Hz"


def listed(words: Sequence[str], conjunction: str = "and") -> str:
    """Return words as a list with "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {conjunction} {words[-1]}"


def few(words: Sequence[str], conjunction: str = "and", *, room: int = 36) -> str:
    """Return a list of the first words that fit into `room` characters, and how many are left."""
    ends = accumulate(len(word) + len(", ") for word in words)
    shown = list(words[: max(1, sum(end <= room for end in ends))])
    left = len(words) - len(shown)
    return listed([*shown, f"{left} more"] if left else shown, conjunction)
