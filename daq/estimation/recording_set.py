"""Which recordings make one estimate, and what to say where they make none."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from daq.alignment.aligned_recording import AlignedRecording
from daq.bench.durations import format_duration
from daq.errors import CannotAlignError, WrongSettingError
from daq.recording.reader import Recording

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation.segment_pass import Pass
    from daq.estimation.settings import Settings
    from daq.recording.interface import ReadableRecording


def open_another(
    path: str | Path | ReadableRecording, others: Sequence[ReadableRecording]
) -> ReadableRecording:
    """Open a recording that is none of the others, under whatever name.

    One that is open already is returned.

    Raises
    ------
    RecordingError
        If it cannot be read.
    WrongSettingError
        If it is one of them or a copy: what is counted twice is not known any better.
    """
    if not isinstance(path, (str, Path)):
        return path
    path = Path(path)
    for other in others:
        if other.path.resolve() == path.resolve():
            raise _twice(path, other)
    recording = Recording.open(path)
    for other in others:
        if other.run_id == recording.run_id:
            recording.close()
            raise _twice(path, other)
    return recording


def check_same(passes: Sequence[Pass]) -> None:
    """Refuse recordings of other sensors.

    Raises
    ------
    CannotAlignError
        With what each has.
    """
    first = passes[0]
    for other in passes[1:]:
        same = (
            other.welch == first.welch
            and other.aligned.dims == first.aligned.dims
            and _labels(other) == _labels(first)
        )
        if not same:
            raise CannotAlignError(
                f"{other.recording.path} does not match {first.recording.path}:"
                f" {_described(other)} against {_described(first)};"
                " one estimate takes recordings of the same sensors at one sampling rate"
            )


def check_span(passes: Sequence[Pass], settings: Settings) -> None:
    """Refuse a start and an end between which no recording has a segment.

    Raises
    ------
    WrongSettingError
        With what the recordings cover.
    """
    wanted = [
        f"{name} {_utc(instant.timestamp())}"
        for name, instant in (("start", settings.start), ("end", settings.end))
        if instant is not None
    ]
    covered = [_covered(each) for each in passes if each.aligned.clocks]
    if wanted and covered and not any(each.n_complete for each in passes):
        raise WrongSettingError(
            f"{', '.join(wanted)}: not one segment of {settings.segment:g} s lies there: "
            + "; ".join(covered)
        )


def _twice(path: Path, other: ReadableRecording) -> WrongSettingError:
    return WrongSettingError(
        f"{path} and {other.path} are the same recording (run {other.run_id});"
        " give it once: twice the same samples say no more than once"
    )


def _covered(each: Pass) -> str:
    whole = AlignedRecording(each.recording, nominal_clocks=True)
    start, seconds = whole.start_utc_ns * 1e-9, whole.n_available / whole.sampling_rate
    return (
        f"{each.recording.path} covers {_utc(start)} to {_utc(start + seconds)} UTC"
        f" ({format_duration(round(seconds, 1))})"
    )


def _utc(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}"


def _labels(each: Pass) -> list[tuple[str, str, str]]:
    return [(sensor, channel.name, channel.unit) for sensor, channel in each.aligned.channels]


def _described(each: Pass) -> str:
    names = ", ".join(f"{sensor} {channel} in {unit}" for sensor, channel, unit in _labels(each))
    return f"{names} at {each.welch.sampling_rate:g} Hz"
