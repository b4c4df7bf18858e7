"""The answer of an archive as JSON and CSV; docs/archives.md describes both.

``tui/resources/archive-2.schema.json`` describes the JSON for programs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq.archive.answers import facts_of_archive
from daq.archive.density import LOWEST_DB
from tui.output.archive.tables import day_text
from tui.output.csv_text import csv_text
from tui.output.json_document import document, facts_document
from tui.output.json_values import plain
from tui.wording.facts import worded

if TYPE_CHECKING:
    from daq.archive.answers import Answer, Levels
    from daq.archive.changes import Course
    from daq.archive.density import Density
    from daq.archive.store import Store

SCHEMA_VERSION = 2
"""Rises when a key is removed or changes its meaning; new keys do not change it."""
PERCENTILES = (10, 50, 90)


def archive_document(answer: Answer, store: Store, n_recordings: int) -> dict[str, Any]:
    """Return the answer as JSON; arrays in the order that their names say."""
    pooled = answer.pooled
    n_channels = len(pooled.channels)
    rows = [
        answer.courses[begin : begin + n_channels]
        for begin in range(0, len(answer.courses), n_channels)
    ]
    return {
        "schema_version": SCHEMA_VERSION,
        "archive": {
            "stretch_s": store.plan.stretch_s,
            "recordings": n_recordings,
            "problems": list(answer.problems),
            "doubted": [
                {"source": each.origin.path, "clocks": list(each.not_understood)}
                for each in answer.doubted
            ],
        },
        "facts": facts_document(worded(facts_of_archive(answer))),
        "pooled": document(pooled, answer.settings),
        "method": answer.method,
        "unit": pooled.unit,
        "channels": [label.name for label in pooled.channels],
        "bands_hz": [list(band) for band in answer.bands],
        "days": {
            "date": [day_text(int(day)) for day in answer.days_utc_ns],
            "segments": plain(answer.n_segments),
            **_levels(answer.levels),
        },
        "changes": {
            "false_alarm": answer.false_alarm,
            "decided": [[each.decided for each in row] for row in rows],
        },
        "segments": [[_segments(each, answer) for each in row] for row in rows],
        "density": _density(answer.density),
        "recorded_density": _density(answer.recorded),
    }


def days_csv(answer: Answer) -> str:
    """Return the noise of every day, band and channel as CSV."""
    unit = f"({answer.pooled.unit})²/Hz"
    header = (
        "date", "sensor", "channel", "band from (Hz)", "band to (Hz)", "segments",
        f"noise PSD ({unit})", f"95 % low ({unit})", f"95 % high ({unit})",
    )  # fmt: skip
    levels = answer.levels
    return csv_text(
        header,
        (
            (
                day_text(int(utc_ns)),
                label.sensor,
                label.channel,
                *band,
                int(answer.n_segments[day]),
                *(
                    None if value != value else value  # noqa: PLR0124 - NaN
                    for value in (
                        float(levels.mean[day, number, column]),
                        float(levels.low[day, number, column]),
                        float(levels.high[day, number, column]),
                    )
                ),
            )
            for day, utc_ns in enumerate(answer.days_utc_ns)
            for number, band in enumerate(answer.bands)
            for column, label in enumerate(answer.pooled.channels)
        ),
    )


def _segments(course: Course, answer: Answer) -> list[dict[str, Any]]:
    """Return the segments of a series, each with the change at its beginning."""
    return [
        {
            "first_day": day_text(int(answer.days_utc_ns[each.begin])),
            "last_day": day_text(int(answer.days_utc_ns[each.end - 1])),
            "change_db": None if step is None else plain(step),
            "noise_psd": plain(each.mean),
            "drift_db_per_year": plain(each.drift),
            "work_minus_night_db": plain(each.contrast),
            "work_minus_night_days": each.contrast_days,
        }
        for step, each in zip((None, *course.steps), course.segments, strict=True)
    ]


def _density(density: Density) -> dict[str, Any]:
    return {
        "stretches": density.n_stretches,
        "short_stretches": density.n_short,
        "frequency_hz": plain(density.frequency),
        "lowest_db": LOWEST_DB,
        "counts": plain(density.counts),
        "not_positive": plain(density.not_positive),
        "percentile_db": {str(p): plain(density.percentile(p / 100)) for p in PERCENTILES},
    }


def _levels(levels: Levels) -> dict[str, Any]:
    """Return levels as JSON; the axes are day (if any), band, channel."""
    return {
        "noise_psd": plain(levels.mean),
        "noise_psd_low": plain(levels.low),
        "noise_psd_high": plain(levels.high),
    }
