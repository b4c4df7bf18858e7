"""Where ticks of an axis are, for whoever draws it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

MOST_MINOR = 10
"""Decades up to which there are ticks between powers of ten."""


def even_ticks(
    low: float, high: float, most: int, steps: Sequence[float] = (1, 2, 5)
) -> list[float]:
    """Return multiples of a round step between two ends, at most so many steps."""
    least = (high - low) / most * (1 - 1e-9)
    tens = 10.0 ** math.floor(math.log10(least))
    step = next(each * tens for each in (*steps, 10 * steps[0]) if each * tens >= least)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]


def set_log_ticks(
    axis: Any,  # noqa: ANN401 - of `tui.page.axes`, or of matplotlib
    low: float,
    high: float,
    name: Callable[[float], str],
    *,
    most: int = 12,
    digits: Sequence[float] = (1,),
    has_minor: bool = True,
) -> None:
    """Name powers of ten between two ends, or their multiples where there are few of them."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))

    def within(digits: Sequence[float], step: int = 1) -> list[float]:
        decades = range(first - first % step, last + 1, step)
        every = (digit * 10.0**decade for decade in decades for digit in digits)
        return [at for at in every if low * (1 - 1e-9) <= at <= high * (1 + 1e-9)]

    major = within(digits, 1 + (last - first) // most)
    major = major if len(major) > 1 else within((1, 2, 5))
    axis.set_ticks(major, [name(at) for at in major])
    minor = within(range(2, 10)) if has_minor and last - first <= MOST_MINOR else []
    axis.set_ticks(minor, [""] * len(minor), minor=True)
