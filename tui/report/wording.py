"""Numbers and times as a report has them."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

from daq.bench.units import decibels

if TYPE_CHECKING:
    from daq.bench.model import Bench

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NOTHING = "?"
"""Where nothing can be said."""


def power_of_ten(exponent: float) -> str:
    """Return a power of ten as people write it."""
    return "10" + f"{exponent:.0f}".translate(_SUPERSCRIPTS)


def scientific(value: float, digits: int = 3) -> str:
    """Return a number with so many digits, and a power of ten where it is far from one."""
    if not math.isfinite(value):
        return NOTHING
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        return plain_number(value, f".{places}f")
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    return f"{mantissa}×{power_of_ten(int(exponent))}".replace("-", "−")


def plain_number(value: float, form: str) -> str:
    """Return a number in Python's format, with a true minus; ``?`` where there is none."""
    if not math.isfinite(value):
        return NOTHING
    text = format(value, form)
    return text.replace("-", "−") if text.strip("+-0.") else text.lstrip("-")


def share(value: float) -> str:
    """Return a fraction in percent."""
    if not math.isfinite(value):
        return NOTHING
    percent = 100 * value
    return (
        "< 0.1 %" if percent < 0.1 else f"{percent:.2g} %" if percent < 100 else f"{percent:.0f} %"
    )


def probability(value: float) -> str:
    """Return a probability; small ones as a bound."""
    if not math.isfinite(value):
        return NOTHING
    return "< 0.001" if value < 0.001 else f"{value:.2g}"


def decibel(psd: float, digits: int = 1) -> str:
    """Return a PSD in dB; in words where it has none."""
    if math.isnan(psd):
        return NOTHING
    return "below 0" if psd <= 0 else plain_number(decibels(psd), f".{digits}f")


def utc_time(moment: datetime) -> str:
    """Return an instant in UTC to the second."""
    return f"{moment.astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC" if is_known(moment) else "not known"


def is_known(moment: datetime) -> bool:
    """Whether an instant is one: files from elsewhere without a time begin at that of computers."""
    return moment.timestamp() > 366 * 86400


def local_time(moment: datetime, bench: Bench | None) -> str:
    """Return an instant in the bench's time zone where its file names one, or this machine's."""
    if not is_known(moment):
        return "not known"
    named = bench is not None and bench.schedule.named_zone != "UTC"
    name = bench.schedule.named_zone if bench is not None and named else ""
    local = moment.astimezone(ZoneInfo(name) if name else None)
    return f"{local:%Y-%m-%d %H:%M:%S} UTC{local:%z}" + (f" ({name})" if name else "")
