"""The answer of an archive, or of several, as JSON and CSV; docs/archives.md describes both.

``tui/resources/archive-2.schema.json`` describes the JSON for programs, and
``archive-stations-1.schema.json`` that of several stations.
"""

from __future__ import annotations

import json
import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from daq.archive.density import LOWEST_DB, Density
from daq.archive.facts import facts_of_archive
from daq.results.band_summary import held
from tui.output.archive.tables import day_text
from tui.output.console import growing
from tui.output.csv_text import csv_text
from tui.output.json_document import document, facts_document
from tui.output.json_values import json_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from daq.archive.answers import Answer
    from daq.archive.changes import Course
    from daq.archive.store import Store
    from estimator.types import FloatArray

    AddStation: TypeAlias = Callable[[str, str], None]

SCHEMA_VERSION = 2
"""Rises when a key is removed or changes its meaning; new keys do not change it."""
STATIONS_VERSION = 1
"""That of the document of several stations."""
PERCENTILES = (10, 50, 90)
DIGITS = 7
"""Of the levels of days, which are kept in single precision."""
_PSD = f"%.{DIGITS}g"
_DAY = ("date", "sensor", "channel", "band from (Hz)", "band to (Hz)", "segments")


def archive_json(answer: Answer, store: Store, n_recordings: int, wrong: Sequence[str] = ()) -> str:
    """Return the answer as one line of JSON; arrays in the order that their names say.

    `wrong` are sentences on recordings that are not in the answer.
    """
    pooled = answer.pooled
    n_channels = len(pooled.channels)
    rows = [
        answer.courses[begin : begin + n_channels]
        for begin in range(0, len(answer.courses), n_channels)
    ]
    others = {
        "schema_version": SCHEMA_VERSION,
        "archive": {
            "stretch_s": store.plan.stretch_s,
            "recordings": n_recordings,
            "problems": [*wrong, *answer.problems],
            "doubted": [
                {"source": each.origin.path, "clocks": list(each.not_understood)}
                for each in answer.doubted
            ],
        },
        "facts": facts_document(tuple(facts_of_archive(answer))),
        "pooled": document(answer.result),
        "method": answer.method,
        "unit": pooled.unit,
        "channels": [label.name for label in pooled.channels],
        "bands_hz": [list(band) for band in answer.bands],
        "changes": {
            "false_alarm": answer.false_alarm,
            "decided": [[each.decided for each in row] for row in rows],
        },
        "segments": [[_segments(each, answer) for each in row] for row in rows],
        "density": _density(answer.density),
        "recorded_density": _density(answer.recorded),
    }
    of_days = {
        "date": [day_text(int(day)) for day in answer.days_utc_ns],
        "segments": answer.n_segments,
    }
    levels = answer.levels
    arrays = {
        "noise_psd": held(levels.mean, levels.low, levels.high),
        "noise_psd_low": levels.low,
        "noise_psd_high": levels.high,
    }
    texts = [f'"{name}": {_json_of(values)}' for name, values in arrays.items()]
    return f'{json_text(others)[:-1]}, "days": {json_text(of_days)[:-1]}, {", ".join(texts)}}}}}'


def _json_of(levels: FloatArray) -> str:
    """Return the levels of days, bands and channels as JSON: numbers of `DIGITS` digits."""
    text = _PSD
    for n in reversed(levels.shape):
        text = f"[{', '.join([text] * n)}]"
    values = tuple(levels.ravel().tolist())
    return (text % values).replace("nan", "null").replace("-inf", "null").replace("inf", "null")


def days_csv(answer: Answer) -> str:
    """Return the noise of every day, band and channel as CSV."""
    unit = f"({answer.pooled.unit})²/Hz"
    header = (*_DAY, f"noise PSD ({unit})", f"95 % low ({unit})", f"95 % high ({unit})")
    return csv_text(header, ()) + "".join(_day_rows(answer))


STATIONS_HEADER = (
    "station", *_DAY, "unit", "noise PSD (unit²/Hz)", "95 % low (unit²/Hz)",
    "95 % high (unit²/Hz)",
)  # fmt: skip


def stations_csv(station: str, answer: Answer) -> str:
    """Return the rows of a station in the table that begins with `STATIONS_HEADER`."""
    return "".join(_day_rows(answer, f"{_cells(station)},", f"{_cells(answer.pooled.unit)},"))


def _cells(*values: object) -> str:
    return csv_text(None, [values])[:-1]


def _day_rows(answer: Answer, station: str = "", unit: str = "") -> Iterator[str]:
    """Yield the rows of each day: ten years have a quarter of a million."""
    levels = answer.levels
    psd = np.stack([levels.mean, levels.low, levels.high], axis=-1).reshape(len(levels.mean), -1)
    series = [
        _cells("", label.sensor, label.channel, *band, "").replace("%", "%%")
        for band in answer.bands
        for label in answer.pooled.channels
    ]
    station, unit = (each.replace("%", "%%") for each in (station, unit))
    known = np.all(np.isfinite(psd), axis=1).tolist()
    for day, values in enumerate(psd.tolist()):
        texts = values if known[day] else ["" if math.isnan(v) else _PSD % v for v in values]
        cells = ",".join([_PSD if known[day] else "%s"] * 3)
        begin = f"{station}{day_text(int(answer.days_utc_ns[day]))}"
        end = f"{answer.n_segments[day]},{unit}{cells}\n"
        yield "".join([f"{begin}{about}{end}" for about in series]) % tuple(texts)


@contextmanager
def stations_json(file: str | None, problems: Sequence[str]) -> Iterator[AddStation]:
    """Write the answers of stations as one document, each as it comes; nothing without a file.

    ``tui/resources/archive-stations-1.schema.json`` describes it. Yields what takes the name of a
    station and its `archive_json`; `problems` are read at the end.
    """
    with growing(file) as write:
        write(f'{{"schema_version": {STATIONS_VERSION}, "stations": [')
        n_written = 0

        def add(station: str, answered: str) -> None:
            nonlocal n_written
            write(", " if n_written else "")
            write(f'{{"station": {json.dumps(station, ensure_ascii=False)}, "answer": {answered}}}')
            n_written += 1

        yield add
        write('], "problems": ' + json.dumps(list(problems), ensure_ascii=False) + "}\n")


def _segments(course: Course, answer: Answer) -> list[dict[str, Any]]:
    """Return the segments of a series, each with the change at its beginning."""
    return [
        {
            "first_day": day_text(int(answer.days_utc_ns[each.begin])),
            "last_day": day_text(int(answer.days_utc_ns[each.end - 1])),
            "change_db": step,
            "noise_psd": each.mean,
            "drift_db_per_year": each.drift,
            "work_minus_night_db": each.contrast,
            "work_minus_night_days": each.contrast_days,
        }
        for step, each in zip((None, *course.steps), course.segments, strict=True)
    ]


def _density(density: Density) -> dict[str, Any]:
    return {
        "stretches": density.n_stretches,
        "short_stretches": density.n_short,
        "frequency_hz": density.frequency,
        "lowest_db": LOWEST_DB,
        "counts": density.counts,
        "not_positive": density.not_positive,
        "percentile_db": {str(p): density.percentile(p / 100) for p in PERCENTILES},
    }
