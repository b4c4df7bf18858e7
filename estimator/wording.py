"""One piece of advice, and how numbers are written in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

Level = Literal["problem", "warning", "note"]


@dataclass(frozen=True, slots=True)
class Advice:
    """One thing to know about the test.

    Attributes
    ----------
    level : {"problem", "warning", "note"}
        The estimate is wrong; it may be, or is less sure than it could be; good to know.
    sensors : tuple of int
        It concerns, from 0; empty for all.
    band : (float, float) or None
        Hz; None for all frequencies.
    text : str
        A sentence or two.
    numbers : mapping of str to float
        What the text is based on.
    remedy : str
        What to do about it, where something can be done: a sentence or more.
    """

    level: Level
    sensors: tuple[int, ...]
    band: tuple[float, float] | None
    text: str
    numbers: Mapping[str, float]
    remedy: str = ""


def signed(value: float, spec: str) -> str:
    """Return a number with the minus sign of typography."""
    return f"{value:{spec}}".replace("-", "−")


def percent(share: float) -> str:
    """Return a share in per cent, to two digits."""
    value = float(f"{100 * share:.2g}")
    return f"{value:.0f} %" if value >= 10 else f"{value:.2g} %"


def ratio(value: float) -> str:
    """Return a ratio to two digits, without an exponent where people need none."""
    return f"{float(f'{value:.2g}'):.0f}" if 10 <= value < 1e6 else signed(value, ".2g")


def in_hz(band: tuple[float, float]) -> str:
    """Return a band in words."""
    return f"{band[0]:.3g}–{band[1]:.3g} Hz"


def listed(words: Sequence[str]) -> str:
    """Return words as a list with "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
