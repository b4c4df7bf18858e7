"""The answer of an archive as JSON and CSV; docs/archives.md describes both.

``tui/resources/archive-2.schema.json`` describes the JSON for programs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq.archive.density import LOWEST_DB
from tui.output.archive.tables import day_text
from tui.output.csv_text import csv_text
from tui.output.json_document import document
from tui.output.json_values import plain

if TYPE_CHECKING:
    from daq.archive.answers import Answer, Levels
    from daq.archive.density import Density
    from daq.archive.store import Store

SCHEMA_VERSION = 2
"""Rises when a key is removed or changes its meaning; new keys do not change it."""
PERCENTILES = (10, 50, 90)


def archive_document(answer: Answer, store: Store, n_recordings: int) -> dict[str, Any]:
    """Return the answer as JSON; arrays in the order that their names say."""
    pooled = answer.pooled
    shape = (len(answer.bands), len(pooled.channels))
    changes = answer.changes
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
        "drift_db_per_year": {
            name: plain(getattr(answer.drift, name).reshape(shape))
            for name in ("slope", "low", "high")
        },
        "change": {
            "false_alarm": changes.false_alarm,
            "decided": plain(changes.decided.reshape(shape)),
            "found": plain(changes.found.reshape(shape)),
            "date": [
                [day_text(int(answer.days_utc_ns[day])) if day >= 0 else None for day in row]
                for row in changes.day.reshape(shape).tolist()
            ],
            **{
                f"{name}_db": plain(getattr(changes, name).reshape(shape))
                for name in ("amount", "low", "high")
            },
        },
        "density": _density(answer.density),
        "recorded_density": _density(answer.recorded),
        "weekday_against_night": None
        if answer.contrast is None
        else {
            "days": answer.contrast.n_days,
            "difference_db": plain(answer.contrast.difference),
            "difference_db_low": plain(answer.contrast.low),
            "difference_db_high": plain(answer.contrast.high),
        },
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
