"""Numbers and times as people read them."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from daq.bench.units import decibels
from estimator.levels.interval import NORMAL_95
from estimator.wording import measured, several, signed, span

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.bench.model import Bench
    from estimator.checks.relative_response import RelativeResponse


ONE_SIDED = 1.1
"""Lower half of an interval over its upper half, from which on both are shown."""
ONE_SIDED_DB = 0.02
"""Halves that differ by less are shown as one, the larger."""
NOT_KNOWN = "not known"
"""Said of a level whose interval has no upper end."""
_PREFIXES = {0: "", -3: "m", -6: "µ", -9: "n"}
_PREFIXED = {"m/s²", "m/s", "m", "g", "Gal", "V", "rad"}
"""Units that take a prefix."""
_MOST_DECIMALS = 3
NOTHING = "?"
"""Where nothing can be said."""
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def utc(ns: int, digits: int = 3) -> str:
    """Return an instant as ISO 8601 with so many digits of its second, usually milliseconds."""
    whole, rest = divmod(ns, 1_000_000_000)
    moment = datetime.fromtimestamp(whole, tz=UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{f'{rest:09d}'[:digits]}Z"


def level(psd: float, digits: int = 2) -> str:
    """Return a PSD in dB, or a word if it has none."""
    if math.isnan(psd):
        return NOTHING
    return "below 0" if psd <= 0 else plain_number(decibels(psd), f".{digits}f")


def level_with_error(
    psd: float, high: float, low: float = math.nan, *, short: bool = False, bare: bool = False
) -> str:
    """Return a PSD in dB with half the width of its 95 % interval.

    With both halves where the lower one is larger, as by what the clocks may have added. The
    upper end alone where the lower end is at or below zero, or the estimate outside its interval.

    Parameters
    ----------
    psd, high, low : float
        In unit²/Hz.
    short : bool
        Whether room is scarce: one decimal, and the wider half alone.
    bare : bool
        Whether the width is left out.
    """
    digits, below = (1, "<") if short else (2, "below ")
    if math.isnan(psd) or math.isnan(high) or high <= 0:
        return level(psd, digits)
    if math.isinf(high):
        return NOT_KNOWN
    if psd <= 0 or low <= 0 or psd > high:
        return f"{below}{level(high, digits)}"
    return level(psd, digits) + ("" if bare else _width(psd, high, low, short=short))


def _width(psd: float, high: float, low: float, *, short: bool) -> str:
    up = decibels(high) - decibels(psd)
    down = up if math.isnan(low) else decibels(psd) - decibels(low)
    if short:
        wider = max(up, down)
        return f"±{wider:.1f}" if wider >= 0.05 else "±<.1"
    if down < ONE_SIDED * up:
        return f" ±{up:.2f}"
    return f" ±{down:.2f}" if down < up + ONE_SIDED_DB else f" +{up:.2f} −{down:.2f}"


def readings(values: Sequence[float], unit: str) -> tuple[list[str], str]:
    """Return readings of one unit as decimal numbers, and the unit that all of them have then.

    The unit gets the SI prefix, or the power of ten where it takes none, with which the largest
    reading is between 1 and 1000. All have as many decimals as show three digits of the largest
    and two of the smallest, but at most three. Readings that are no finite number are "?".
    """
    own = next((n for n, prefix in _PREFIXES.items() if n and unit.removeprefix(prefix) != unit), 0)
    base = unit.removeprefix(_PREFIXES[own])
    if base not in _PREFIXED:
        base, own = unit, 0
    known = [abs(value) for value in values if value and math.isfinite(value)]
    exponents = [math.floor(math.log10(value)) for value in known]
    if not exponents:
        return ["0" if value == 0 else NOTHING for value in values], unit
    takes_prefix = base in _PREFIXED
    largest = 3 * ((max(exponents) + own) // 3)
    if takes_prefix:
        shift = min(max(largest, min(_PREFIXES)), 0)
    else:
        shift = 0 if largest in {0, 3} else largest
    digits = max(2 - max(exponents), 1 - min(exponents)) + shift - own
    decimals = min(max(digits, 0), _MOST_DECIMALS)
    least = 10.0**-decimals
    texts = []
    for value in values:
        text = signed(value * 10.0 ** (own - shift), f".{decimals}f")
        if not math.isfinite(value):
            text = NOTHING
        elif value and not any(digit in text for digit in "123456789"):
            text = f"<{least:.{decimals}f}" if value > 0 else f">−{least:.{decimals}f}"
        texts.append(text)
    if takes_prefix:
        return texts, _PREFIXES[shift] + base
    return texts, f"{power_of_ten(shift)} {unit}" if shift else unit


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


def response_cells(pair: RelativeResponse) -> tuple[str, str, list[str], str, str]:
    """Return rotation, horizontal angle, gains, delay and skew with their 95 % half-widths.

    Angles are in degrees, the delay in microseconds.
    """
    return (
        measured(pair.rotation_deg, NORMAL_95 * pair.rotation_uncertainty_deg, 3),
        measured(pair.horizontal_deg, NORMAL_95 * pair.angle_error_deg, 3),
        [
            measured(gain, NORMAL_95 * error, 4)
            for gain, error in zip(pair.gains.tolist(), pair.gain_errors.tolist(), strict=True)
        ],
        measured(1e6 * pair.delay, 1e6 * NORMAL_95 * pair.delay_error, 1),
        measured(pair.nonorthogonality_deg, NORMAL_95 * pair.nonorthogonality_error_deg, 2),
    )


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
    from zoneinfo import ZoneInfo  # noqa: PLC0415 - a report needs it

    named = bench is not None and bench.schedule.named_zone != "UTC"
    name = bench.schedule.named_zone if bench is not None and named else ""
    local = moment.astimezone(ZoneInfo(name) if name else None)
    return f"{local:%Y-%m-%d %H:%M:%S} UTC{local:%z}" + (f" ({name})" if name else "")


def drift_line(
    sensor: str,
    change: tuple[float, float],
    *,
    since: datetime,
    n_tests: int,
    band: tuple[float, float],
) -> str:
    """Return by how many dB, ± the 95 % interval, the noise of a sensor differs from the first."""
    year = "" if since.year == datetime.now(UTC).year else f" {since.year}"
    db, error = change
    return (
        f"{sensor}: {signed(round(db, 1) + 0.0, '+.1f')} ± {error:.1f} dB since {since.day}"
        f" {since:%B}{year}, {several(n_tests, 'test')} ({span(*band)})"
    )
