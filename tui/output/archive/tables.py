"""The course of the noise over months, as tables and sentences."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from rich.text import Text

from daq.archive.facts import NightsNotCompared, facts_of_archive
from daq.bench.units import decibels
from estimator.wording import percent, several, signed, span
from tui.page.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from daq.archive.answers import Answer
    from daq.archive.changes import Interval, Segment

_MOST_DIGITS = 4
LARGE = 8
"""Changes in single octaves that are listed."""


def day_text(utc_ns: int) -> str:
    """Return the date of an instant."""
    return f"{datetime.fromtimestamp(utc_ns / 1e9, UTC):%Y-%m-%d}"


def stations_table(found: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a line for each station, of its summary (`daq.archive.task`)."""
    rows = []
    for name, each in found.items():
        low, high = each["lowest_db"], each["highest_db"]
        days = (day_text(each["first_day_ns"]), day_text(each["last_day_ns"]))
        noise = "?" if low is None else f"{low:+.1f} to {high:+.1f} re 1 ({each['unit']})²/Hz"
        changes = several(each["n_changed"], "channel") if each["n_changed"] else "none"
        counts = (each["n_channels"], each["n_days"])
        rows.append((name, *counts, *days, span(*each["band_hz"]), noise, changes))
    names = ("station", "channels", "days", "from", "to", "band", "noise (dB)", "changes")
    return Table.of(names, rows, right=("channels", "days"))


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
    rows = []
    for column, label in enumerate(answer.pooled.channels):
        levels = [decibels(float(psd)) for psd in answer.levels.mean[:, 0, column]]
        known = [level for level in levels if not math.isnan(level)]
        last = answer.courses[column].segments[-1]
        ends = [signed(end(known), ".2f") if known else "?" for end in (min, max)]
        course = (_interval(last.drift), _interval(last.contrast), _change(answer, column))
        rows.append((label.sensor, label.channel, *ends, *course))
    numbers = ("lowest day", "highest day", "drift (dB/year)", "work − night (dB)")
    return Table.of(("sensor", "channel", *numbers, "change"), rows, right=numbers)


def remarks(answer: Answer, zone: str) -> Iterator[str]:
    """Yield sentences below the table; `zone` is that of working hours and nights."""
    facts = list(facts_of_archive(answer))
    yield from map(str, facts)
    n_channels = len(answer.pooled.channels)
    n_decided = sum(each.decided for each in answer.courses)
    if n_decided:
        yield (
            f"The test for changes has {several(n_decided, 'series', 'series')}"
            f" ({several(n_channels, 'channel')}, {several(len(answer.bands), 'band')}); without a"
            " change it raises a false alarm in any of them with a probability of"
            f" {percent(answer.false_alarm)} at most, however often one asks."
        )
    for series, course in enumerate(answer.courses[:n_channels]):
        if course.steps:
            name = answer.pooled.channels[series].name
            for segment in course.segments:
                yield f"{name}, {_between(answer, segment)}: {_segment(segment)}"
    single = [
        (series, step, segment)
        for series, course in enumerate(answer.courses[n_channels:], n_channels)
        for step, segment in zip(course.steps, course.segments[1:], strict=True)
    ]
    for series, step, segment in single[:LARGE]:
        band, column = divmod(series, n_channels)
        yield (
            f"{answer.pooled.channels[column].name}, {span(*answer.bands[band])}:"
            f" changed by {_amount(answer, step, segment)}"
        )
    if len(single) > LARGE:
        yield f"{several(len(single) - LARGE, 'further change')} in single octaves: see --json."
    if any(each.steps for each in answer.courses[:n_channels]):
        yield (
            "Drift and difference in the table are those since the last change; no interval of"
            " theirs spans a change. The estimate above is of all days together."
        )
    if not any(isinstance(each, NightsNotCompared) for each in facts):
        yield (
            "Work: Monday to Friday, 8–18 h; night: 0–6 h and 22–24 h of the same days"
            f" ({zone}). Each ± is half of a 95 % interval."
        )


def _change(answer: Answer, column: int) -> str:
    course = answer.courses[column]
    if not course.decided:
        return "not decided"
    if not course.steps:
        return "none beyond uncertainty"
    last = _amount(answer, course.steps[-1], course.segments[-1])
    return last if len(course.steps) == 1 else f"{last}, the last of {len(course.steps)}"


def _amount(answer: Answer, step: Interval, segment: Segment) -> str:
    """Return the size and the date of a change before a segment."""
    day = day_text(int(answer.days_utc_ns[segment.begin]))
    return f"{_interval(step, plus=True)} dB on {day}"


def _between(answer: Answer, segment: Segment) -> str:
    first, last = (
        day_text(int(answer.days_utc_ns[row])) for row in (segment.begin, segment.end - 1)
    )
    return f"{first} to {last}"


def _segment(segment: Segment) -> str:
    return (
        f"{signed(decibels(segment.mean), '.2f')} dB, drift {_interval(segment.drift)} dB/year,"
        f" work − night {_interval(segment.contrast)} dB ({several(segment.contrast_days, 'day')})"
    )


def _interval(found: Interval, *, plus: bool = False) -> str:
    if math.isnan(found.value):
        return "not decided"
    half = found.high - found.value
    digits = max(0, min(_MOST_DIGITS, 1 - math.floor(math.log10(half)))) if half > 0 else 2
    spec = f"{'+' if plus else ''}.{digits}f"
    shown = f"{half:.{digits}f}" if 2 * half >= 10**-digits else f"<{10**-digits:.{digits}f}"
    return f"{signed(found.value, spec)} ±{shown}"
