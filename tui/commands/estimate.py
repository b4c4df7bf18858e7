"""``huddle estimate``."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

from daq.bench.durations import format_duration, parse_duration
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.results.limits import exceeded
from estimator.errors import EstimatorError
from estimator.likelihood.factor_analysis import max_factors
from estimator.spectra.windows import get_window
from tui.output.console import check_places, for_people, hint, progress, write_json, write_text
from tui.output.diagnostics import details, summary
from tui.output.results import curves_csv, document, limit_line, remarks, result_table, result_title

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daq.bench.model import Bench, Sensor
    from daq.estimation.snapshot import Snapshot
    from daq.recording.reader import SensorRecord

LIMIT_NOT_MET = 1
_LONG_WINDOW = 4096  # samples, in which every window with a parameter that has one is possible
_MIN_SAMPLES = 4  # of a segment: one frequency between 0 and half the rate


def estimate_recordings(
    files: Sequence[Path],
    *,
    start: str | None,
    end: str | None,
    diagnostics: bool = False,
    json: str | None,
    csv: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of Settings
) -> None:
    """Estimate, with settings from the first recording where none are given, and show the result.

    ``wanted`` holds method and fields of Settings, each None where not given. ``diagnostics``
    shows all of them and not only what applies.
    """
    check_places(json, csv)
    snapshot, settings, bench = estimated(files, start=start, end=end, **wanted)
    met = show_result(snapshot, settings, json=json, csv=csv, bench=bench, diagnostics=diagnostics)
    hint(f"for a report of it: huddle report {files[0]}")
    if not met:
        raise typer.Exit(LIMIT_NOT_MET)


def estimated(
    files: Sequence[Path],
    *,
    start: str | None,
    end: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of Settings
) -> tuple[Snapshot, Settings, Bench | None]:
    """Estimate, showing how far it is; return also the settings used and the first bench."""
    with Recording.open(files[0]) as recording:
        bench = recording.bench
        settings = chosen(Settings.of(bench), **wanted)
        check_fit(settings, recording.sensors)
        settings = replace(
            settings,
            start=_instant(start, recording.created),
            end=_instant(end, recording.created),
        )
    with progress(
        TextColumn("segments"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total}"),
        TimeRemainingColumn(),
    ) as bar:
        task = bar.add_task("")
        snapshot = estimate(
            files,
            settings,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    return snapshot, settings, bench


def chosen(settings: Settings, *, method: str | None = None, **wanted: Any) -> Settings:  # noqa: ANN401 - fields of Settings
    """Return settings with everything replaced that is not None.

    A dimension or gains without a method ask for the method that takes them.

    Raises
    ------
    typer.BadParameter
        If what was asked for does not go together.
    """
    changes = {key: value for key, value in wanted.items() if value is not None}
    if method is not None:
        changes["methods"] = (str(method),)
    settings = replace(settings, **changes)
    try:
        get_window(settings.window, _LONG_WINDOW)
    except EstimatorError as error:
        raise typer.BadParameter(
            f"--{error}; expected one of scipy.signal.get_window, as in hann or, with a parameter,"
            " kaiser,8"
        ) from None
    for option, needed in (("dimension", "maximum-likelihood"), ("gains", "two-channel")):
        if option not in changes or {needed, "all"} & set(settings.methods):
            continue
        if method is not None:
            name = "--gain" if option == "gains" else f"--{option}"
            raise typer.BadParameter(f"{name} is for the {needed} method, not for {method}")
        settings = replace(settings, methods=(needed,))
    return settings


def check_fit(settings: Settings, sensors: Sequence[Sensor | SensorRecord]) -> None:
    """Refuse gains, a dimension and segments that are not for these sensors.

    Raises
    ------
    typer.BadParameter
        With what would be.
    """
    taking_part = [
        (sensor, n_channels)
        for sensor in sensors
        if (n_channels := sum(not channel.auxiliary for channel in sensor.channels))
    ]
    if not taking_part:  # which is told with the file's name
        return
    rate = min(sensor.sampling_rate for sensor, _ in taking_part)
    if round(settings.segment * rate) < _MIN_SAMPLES:
        raise typer.BadParameter(
            f"--segment {format_duration(settings.segment)}: expected at least"
            f" {format_duration(_MIN_SAMPLES / rate)}, {_MIN_SAMPLES} samples at"
            f" {rate:g} Hz"
        )
    n_channels = sum(n for _, n in taking_part)
    most = max_factors(n_channels)
    by_factors = {"maximum-likelihood", "all"} & set(settings.methods)
    if by_factors and isinstance(settings.dimension, int) and settings.dimension > most:
        raise typer.BadParameter(
            f"--dimension {settings.dimension}: expected at most {most}: more cannot be told from"
            f" the noise of {n_channels} channels"
        )
    known = {sensor.name for sensor in sensors}
    known |= {f"{sensor.name}.{channel.name}" for sensor in sensors for channel in sensor.channels}
    for name, gain in settings.gains.items():
        if name not in known or gain == 0 or not math.isfinite(gain):
            names = ", ".join(sensor.name for sensor in sensors)
            raise typer.BadParameter(
                f"--gain {name}={gain:g}: expected one of the sensors {names}, or a channel of "
                f"them as in {sensors[0].name}.{sensors[0].channels[0].name}, and a number not 0"
            )


def show_result(
    snapshot: Snapshot,
    settings: Settings,
    *,
    json: str | None,
    csv: str | None,
    bench: Bench | None,
    diagnostics: bool = False,
) -> bool:
    """Print the table for people, and write what programs asked for.

    Returns
    -------
    bool
        Whether every channel meets the limits of the bench file.
    """
    screen = for_people(json, csv)
    table = result_table(snapshot, settings)  # refuses a band without frequencies
    screen.print(result_title(snapshot, settings))
    screen.print(table)
    for line in remarks(snapshot):
        screen.print(line)
    for part in details(snapshot) if diagnostics else summary(snapshot):
        screen.print(part)
    write_json(json, document(snapshot))
    if csv is not None:
        write_text(csv, curves_csv(snapshot))
    failures = exceeded(bench, snapshot, settings)
    for failure in failures:
        screen.print(f"[red]{limit_line(failure)}[/]")
    if bench is not None and bench.limits and not failures:
        names = ", ".join(limit.name for limit in bench.limits)
        screen.print(f"[green]every channel meets {names}[/]")
    return not failures


def _instant(text: str | None, created: datetime) -> datetime | None:
    """Return a UTC time, or a time after the start of the recording, as an instant."""
    if text is None:
        return None
    try:
        return created + timedelta(seconds=parse_duration(text, zero=True))
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise typer.BadParameter(
            f"{text!r}: expected UTC as in 2026-11-21T03:00:00, or a time after the start as in 2h"
        ) from None
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
