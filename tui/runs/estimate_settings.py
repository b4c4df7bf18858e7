"""The settings of an estimate: options of the command line over those of the bench file."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import typer

from daq.bench.durations import instant
from daq.bench.estimate_settings import OPTIONS, EstimateSettings
from daq.estimation import settings as rules
from daq.estimation.settings import ConflictingOptionError, Settings
from daq.recording.reader import Recording

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime
    from pathlib import Path

    from daq.bench.model import Bench, Sensor
    from daq.recording.interface import ReadableSensor


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
        settings = settings_of(recording, start=start, end=end, **wanted)
        return settings, recording.bench


def settings_of(
    recording: Recording,
    *,
    start: str | None = None,
    end: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> Settings:
    """Return the settings for an open recording.

    Raises
    ------
    typer.BadParameter
        If an option does not fit the others or the sensors.
    """
    settings = chosen(Settings.of(recording.outline), **wanted)
    check_fit(settings, recording.sensors)
    return spanned(settings, recording.created, start=start, end=end)


def spanned(
    settings: Settings, created: datetime, *, start: str | None, end: str | None
) -> Settings:
    """Return settings of a part of a recording.

    Raises
    ------
    typer.BadParameter
        If a time is not understood.
    """
    return replace(settings, start=_instant(start, created), end=_instant(end, created))


def chosen_for_files(suggested: EstimateSettings, **wanted: Any) -> Settings:  # noqa: ANN401
    """Return the settings of foreign files: options over what responses and rates suggest.

    With octaves, the segment is that of the highest octave; a lower corner does not decide it.

    Raises
    ------
    typer.BadParameter
        The options contradict each other.
    """
    settings = Settings(**{each: getattr(suggested, each) for each in OPTIONS})
    if wanted.get("octaves"):
        settings = replace(settings, segment=EstimateSettings().segment)
    return chosen(settings, **wanted)


def chosen(settings: Settings, **wanted: Any) -> Settings:  # noqa: ANN401 - fields of EstimateSettings
    """Return settings, replacing each field that is not None.

    Raises
    ------
    typer.BadParameter
        The options contradict each other.
    """
    try:
        return rules.with_changes(settings, wanted, called=_flag)
    except ConflictingOptionError as error:
        hint = "--window" if error.option == "window" else None
        raise typer.BadParameter(str(error), param_hint=hint) from None


def check_fit(settings: Settings, sensors: Sequence[Sensor | ReadableSensor]) -> None:
    """Refuse options that do not fit the sensors.

    Raises
    ------
    typer.BadParameter
        With what would fit.
    """
    try:
        rules.check_fit(settings, sensors, called=_flag)
    except ConflictingOptionError as error:
        raise typer.BadParameter(str(error)) from None


def _flag(name: str) -> str:
    return OPTIONS[name].flags[0].partition("/")[0]


def _instant(text: str | None, created: datetime) -> datetime | None:
    try:
        return None if text is None else instant(text, created)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
