"""The settings of an estimate: options of the command line over those of the bench file."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import typer

from daq.bench.durations import parse_duration
from daq.bench.estimate_settings import OPTIONS, misfits
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from estimator.errors import EstimatorError
from estimator.spectra.windows import get_window

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daq.bench.model import Bench, Sensor
    from daq.recording.reader import SensorRecord

_LONG_WINDOW = 4096  # samples, in which every window with a parameter that has one is possible


def settings_for(
    file: Path,
    *,
    start: str | None = None,
    end: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> tuple[Settings, Bench | None]:
    """Return the settings for a recording, and its bench.

    Raises
    ------
    RecordingError
        If the recording cannot be read.
    typer.BadParameter
        If an option does not fit the others or the sensors.
    """
    with Recording.open(file) as recording:
        bench = recording.bench
        settings = chosen(Settings.of(bench), **wanted)
        check_fit(settings, recording.sensors)
        created = recording.created
    return replace(settings, start=_instant(start, created), end=_instant(end, created)), bench


def chosen(settings: Settings, **wanted: Any) -> Settings:  # noqa: ANN401 - fields of EstimateSettings
    """Return settings with everything replaced that is not None.

    A dimension or gains without a method ask for the method that takes them.

    Raises
    ------
    typer.BadParameter
        If what was asked for does not go together.
    """
    changes = {name: value for name, value in wanted.items() if value is not None}
    settings = replace(settings, **changes)
    try:
        get_window(settings.window, _LONG_WINDOW)
    except EstimatorError as error:
        raise typer.BadParameter(str(error), param_hint="--window") from None
    for name, needed in (("dimension", "maximum-likelihood"), ("gains", "two-channel")):
        if name not in changes or {needed, "all"} & set(settings.methods):
            continue
        if "methods" in changes:
            raise typer.BadParameter(
                f"{OPTIONS[name].flags[0]} is for the {needed} method, not for"
                f" {', '.join(settings.methods)}"
            )
        settings = replace(settings, methods=(needed,))
    return settings


def check_fit(settings: Settings, sensors: Sequence[Sensor | SensorRecord]) -> None:
    """Refuse options that do not fit the sensors.

    Raises
    ------
    typer.BadParameter
        With what would fit.
    """
    if not any(not channel.auxiliary for sensor in sensors for channel in sensor.channels):
        return  # that is refused with the file's name
    for misfit in misfits(settings, sensors):
        flag = OPTIONS[misfit.name].flags[0].partition("/")[0]
        raise typer.BadParameter(f"{flag} {misfit.value}: {misfit.expected}")


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
