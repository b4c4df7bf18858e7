"""How the sensors stand, as text: a sketch of the axes of each, and the coherence of pairs."""

from __future__ import annotations

import math
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from rich.text import Text

from daq.results.standing import PairCoherence, Stance, stances
from estimator.records import dataclass
from estimator.wording import listed, signed
from tui.page.table import Cell, Table
from tui.page.terminal import terminal_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rich.console import RenderableType

    from daq.results.result import Result
    from estimator.types import FloatArray

_WIDTH, _HEIGHT = 17, 7
"""Columns and rows of a sketch; a row is as high as two columns are wide."""
_SHADES = "·░▒▓█"
LEVELS = (0.5, 0.9, 0.99, 0.999)
"""Coherences at which a shade begins."""
_SMALL = 0.35
"""Length in the plane, of a unit vector, up to which an axis points at the viewer."""


def standing(result: Result, *, width: int) -> list[RenderableType]:
    """Return sketches of all axes and the coherence of all pairs; empty where none is known."""
    found, coherence = stances(result.snapshot), result.coherence
    means = coherence_table(result)
    parts: list[RenderableType] = []
    if found:
        parts.append(Text("Axes of the sensors, seen from above", "bold"))
        per_row = max(1, width // (_WIDTH + 3))
        starts = range(0, len(found), per_row)
        rows = (_row(found[first : first + per_row]) for first in starts)
        parts += [terminal_table(row, gap=3) for row in rows]
        parts.append(Text(caption(found)))
    if coherence is not None and means is not None:
        names = result.snapshot.sensor_names
        low, high = result.band
        parts += [
            Text(f"Coherence of pairs, mean over {low:.3g} to {high:.3g} Hz", "bold"),
            terminal_table(means, wraps=False),
            Text("Coherence of pairs against frequency", "bold"),
            terminal_table(_strips(coherence, names), wraps=False, folded=("pair", "least")),
            Text(_legend()),
        ]
    return parts


def caption(found: Sequence[Stance]) -> str:
    """Return what the sketches show, and which sensors could not be compared."""
    reference = next(each for each in found if each.is_reference)
    names = [reference.channels[each] for each in reference.order]
    ways = ("right", "up", "at you (⊙; ⊗ away)")
    points = ", ".join(f"{name} {way}" for name, way in zip(names, ways, strict=False))
    said = f"{reference.name} is the reference: its {points}. Channels of others by their motion."
    missing = [each.name for each in found if not each.is_known]
    return f"{said} Not known: {listed(missing)}." if missing else said


def remark(stance: Stance) -> str:
    """Return rotation, lean and polarity of a sensor in words."""
    if stance.is_reference:
        return "reference"
    if not stance.is_known:
        return "not known"
    parts = []
    if math.isfinite(stance.turn_deg):
        parts.append(f"turned {signed(round(stance.turn_deg, 1) + 0.0, '.1f')}°")
    if math.isfinite(stance.lean_deg):
        parts.append(f"leans {stance.lean_deg:.1f}°")
    if stance.is_upside_down:
        parts.append("upside down")
    if stance.reversed_channels:
        names = [stance.channels[each] for each in stance.reversed_channels]
        parts.append(f"reversed {' '.join(names)}")
    return ", ".join(parts) or "same polarity"


@dataclass(frozen=True, slots=True)
class Arrow:
    """An axis of a sensor in a drawing: how far right, up and towards the viewer it points."""

    right: float
    up: float
    out: float
    channel: str
    is_reversed: bool

    @property
    def is_end_on(self) -> bool:
        """Whether it points more at the viewer, or away, than along the drawing."""
        return abs(self.out) > math.hypot(self.right, self.up)


def arrows(stance: Stance) -> list[Arrow]:
    """Return the axes of a sensor; none of one that could not be compared."""
    axes = stance.directions[:, list(stance.order)] if stance.is_known else ()
    found = []
    for number, axis in enumerate(axes):
        right, up, out = [*axis.tolist(), 0.0, 0.0][:3]
        is_reversed = number in stance.reversed_channels
        found.append(Arrow(right, up, out, stance.channels[number], is_reversed))
    return found


def coherence_table(result: Result) -> Table | None:
    """Return the mean coherence of all pairs over the band; None where none is known."""
    found, names = result.coherence, result.snapshot.sensor_names
    if found is None:
        return None
    rows = (
        (name, *("" if n == row else _shown(float(value)) for n, value in enumerate(values)))
        for row, (name, values) in enumerate(zip(names, found.matrix, strict=True))
    )
    return Table(("sensor", *names), tuple(rows))


def _row(found: Sequence[Stance]) -> Table:
    rows = (
        tuple(Cell(fill(each.name, _WIDTH), strong=True) for each in found),
        tuple("\n".join(sketch(each)) for each in found),
        tuple(fill(remark(each), _WIDTH) for each in found),
    )
    return Table(("",) * len(found), rows, left=frozenset(range(len(found))))


def sketch(stance: Stance) -> list[str]:
    """Return the axes of a sensor in rows of characters, as seen from above."""
    rows = [[" "] * _WIDTH for _ in range(_HEIGHT)]
    across, down = _WIDTH // 2, _HEIGHT // 2
    if not stance.is_known:
        rows[down][across] = "?"
        return ["".join(row) for row in rows]
    rows[down][across] = "+"
    for arrow in arrows(stance):
        right, up, letter = arrow.right, arrow.up, arrow.channel[-1:]
        if math.hypot(right, up) <= _SMALL and arrow.is_end_on:
            rows[down][across] = "⊙" if arrow.out > 0 else "⊗"
            rows[down + 1][across + 1] = letter
            continue
        for step in range(1, 2 * down + 1):
            place = step / (2 * down)
            at = across + round(right * place * 2 * down), down - round(up * place * down)
            if rows[at[1]][at[0]] == " ":
                rows[at[1]][at[0]] = "·"
        rows[down - round(up * down)][across + round(right * 2 * down)] = letter
    return ["".join(row) for row in rows]


def _shown(value: float) -> str:
    return "?" if math.isnan(value) else f"{_shade(value)} {value:.4f}"


def _shade(value: float) -> str:
    return " " if math.isnan(value) else _SHADES[sum(value >= each for each in LEVELS)]


def _strips(found: PairCoherence, names: Sequence[str]) -> Table:
    """Return a row of shades for each pair, from the lowest to the highest frequency."""
    low, high = (f"{found.frequency[end]:.3g} Hz" for end in (0, -1))
    gap = " " * max(1, found.frequency.size - len(low) - len(high))
    rows = (
        (f"{names[one]} {names[two]}", "".join(map(_shade, values)), _least(found, values))
        for (one, two), values in zip(found.pairs, found.value, strict=True)
    )
    return Table.of(("pair", f"{low}{gap}{high}", "least"), rows)


def _least(found: PairCoherence, values: FloatArray) -> str:
    if np.isnan(values).all():
        return "?"
    least = int(np.nanargmin(values))
    return f"{values[least]:.4f} at {found.frequency[least]:.3g} Hz"


def _legend() -> str:
    ends: Iterator[str] = (f"from {each:g}" for each in LEVELS)
    parts = (f"{shade} {end}" for shade, end in zip(_SHADES[1:], ends, strict=True))
    return f"{_SHADES[0]} below {LEVELS[0]:g}, {', '.join(parts)}; in the direction of the least."
