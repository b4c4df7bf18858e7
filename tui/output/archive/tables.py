"""The course of the noise over months, as tables and sentences."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from daq.archive.changes import MIN_DAYS
from daq.bench.units import decibels
from tui.wording.formatting import listed, percent, several, signed, span

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.archive.answers import Answer

LARGE = 8
"""Changes in single octaves that are listed."""


def day_text(utc_ns: int) -> str:
    """Return the date of an instant."""
    return f"{datetime.fromtimestamp(utc_ns / 1e9, UTC):%Y-%m-%d}"


def course_title(answer: Answer) -> Text:
    """Return the title of `course_table`."""
    days = [int(day) for day in answer.days_utc_ns]
    return Text.assemble(
        (f"Noise by day, {span(*answer.bands[0])}, {answer.method}", "bold"),
        f", {several(len(days), 'day')} from {day_text(days[0])} to {day_text(days[-1])},"
        f" dB re 1 ({answer.pooled.unit})²/Hz",
    )


def course_table(answer: Answer) -> Table:
    """Return every channel's range, drift and change in the first band."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for number, name in enumerate(
        (
            "sensor",
            "channel",
            "lowest day",
            "highest day",
            "drift (dB/year)",
            "work − night (dB)",
            "change",
        )
    ):
        table.add_column(name, justify="right" if 1 < number < 6 else "left", no_wrap=True)
    for column, label in enumerate(answer.pooled.channels):
        levels = [decibels(float(psd)) for psd in answer.levels.mean[:, 0, column]]
        known = [level for level in levels if not math.isnan(level)]
        table.add_row(
            *map(
                Text,
                (
                    label.sensor,
                    label.channel,
                    signed(min(known), ".2f") if known else "?",
                    signed(max(known), ".2f") if known else "?",
                    _drift(answer, column),
                    _contrast(answer, column),
                    _change(answer, column),
                ),
            )
        )
    return table


def remarks(answer: Answer, zone: str) -> Iterator[str]:
    """Yield sentences below the table; `zone` is that of working hours and nights."""
    if answer.doubted:
        whose = listed(sorted({one for each in answer.doubted for one in each.not_understood}))
        n = len(answer.doubted)
        yield (
            f"{several(n, 'recording is', 'recordings are')} left out: the clock of {whose} is not"
            f" understood in {'it' if n == 1 else 'them'} ({_names(answer)}). Check whether samples"
            " are lost or repeated without being counted (buffers, cable, the logger's software),"
            " and the sampling rate."
        )
    changes = answer.changes
    n_channels = len(answer.pooled.channels)
    if changes.decided.any():
        yield (
            f"The test for a change has {several(int(changes.decided.sum()), 'series', 'series')}"
            f" ({several(n_channels, 'channel')}, {several(len(answer.bands), 'band')}); without a"
            " change it raises a false alarm in any of them with a probability of"
            f" {percent(changes.false_alarm)}."
        )
    else:
        yield (
            f"Drift and change are not decided: {several(len(answer.days_utc_ns), 'day')}, and"
            f" {MIN_DAYS} with an estimate are needed."
        )
    found = [
        series for series in range(n_channels, len(changes.found)) if bool(changes.found[series])
    ]
    for series in found[:LARGE]:
        band, column = divmod(series, n_channels)
        yield (
            f"{answer.pooled.channels[column].name}, {span(*answer.bands[band])}:"
            f" changed by {_amount(answer, series)}"
        )
    if len(found) > LARGE:
        yield f"{several(len(found) - LARGE, 'further change')} in single octaves: see --json."
    density = answer.density
    if density.n_short:
        yield (
            f"{several(density.n_short, 'stretch', 'stretches')} with less than half of the"
            " segments are not in the probability density."
        )
    if answer.contrast is None:
        yield (
            "Working hours and nights are not compared: stretches are days, or one of the two has"
            " too few segments."
        )
    else:
        yield (
            "Work: Monday to Friday, 8–18 h; night: 22–6 h"
            f" ({zone}). Each ± is half of a 95 % interval."
        )


def _names(answer: Answer) -> str:
    """Return the names of the first recordings that are left out."""
    names = [Path(each.origin.path).name for each in answer.doubted[:LARGE]]
    return ", ".join(names) + ", …" * (len(answer.doubted) > LARGE)


def _contrast(answer: Answer, column: int) -> str:
    found = answer.contrast
    if found is None:
        return "?"
    return _with_interval(float(found.difference[0, column]), float(found.high[0, column]))


def _drift(answer: Answer, series: int) -> str:
    slope, high = float(answer.drift.slope[series]), float(answer.drift.high[series])
    return "not decided" if math.isnan(slope) else _with_interval(slope, high)


def _change(answer: Answer, series: int) -> str:
    changes = answer.changes
    if not changes.decided[series]:
        return "not decided"
    if not changes.found[series]:
        return "none beyond uncertainty"
    return _amount(answer, series)


def _amount(answer: Answer, series: int) -> str:
    changes = answer.changes
    day = day_text(int(answer.days_utc_ns[changes.day[series]]))
    size = _with_interval(float(changes.amount[series]), float(changes.high[series]), plus=True)
    return f"{size} dB on {day}"


def _with_interval(value: float, high: float, *, plus: bool = False) -> str:
    if math.isnan(value):
        return "?"
    half = high - value
    digits = max(0, min(4, 1 - math.floor(math.log10(half)))) if half > 0 else 2
    spec = f"{'+' if plus else ''}.{digits}f"
    return f"{signed(value, spec)} ±{half:.{digits}f}"
