"""Which recordings make one estimate, and the error messages where they do not."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from daq.bench.durations import format_duration
from daq.caveats import Caveat
from daq.clocks.aligned_recording import AlignedRecording
from daq.errors import CannotAlignError, RecordingError, WrongSettingError
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.recording.interface import FIRST_DATE_NS, ReadableRecording
from daq.recording.reader import Recording
from daq.recording.storage.locking import is_being_written
from daq.recording.storage.names import continuation_names

_COMPARED = 1000  # samples of each sensor


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


def continuations(
    recording: ReadableRecording, others: Sequence[ReadableRecording]
) -> Iterator[Recording]:
    """Open and yield the recordings that continue this one, but for `others` and empty ones.

    A recorder continues in another file if writing the first one fails. The caller closes them.
    """
    known = {other.run_id for other in others}
    for found in _following(recording):
        if found.run_id in known or not any(sensor.n_samples for sensor in found.sensors):
            found.close()
        else:
            yield found


def is_continued(recording: ReadableRecording) -> bool:
    """Return whether a recorder is writing a file that continues this recording."""
    written = False
    for found in _following(recording):
        found.close()
        written |= is_being_written(found.path)
    return written


def is_left(recording: ReadableRecording) -> bool:
    """Return whether nobody writes a recording that was not closed; it may go on in another."""
    return (
        isinstance(recording, Recording)
        and not recording.closed
        and not is_being_written(recording.path)
    )


def is_complete(recording: ReadableRecording, following: ReadableRecording | None) -> bool:
    """Return whether a recording was closed, or is continued by the one that follows."""
    continues = following.continues if isinstance(following, Recording) else ""
    return recording.closed or continues == recording.run_id


def left_open(recordings: Sequence[ReadableRecording]) -> tuple[str, ...]:
    """Return the names of recordings whose recorder was killed."""
    return tuple(
        recording.path.name
        for recording, following in zip(recordings, (*recordings[1:], None), strict=True)
        if isinstance(recording, Recording)
        and is_left(recording)
        and not is_complete(recording, following)
    )


def _following(recording: ReadableRecording) -> Iterator[Recording]:
    """Open and yield the recordings that continue this one, in their order."""
    if not isinstance(recording, Recording):
        return
    run_id = recording.run_id
    names = continuation_names(recording.path)
    for path in itertools.takewhile(lambda each: each.exists(), names):
        try:
            found = Recording.open(path)
        except RecordingError:  # another file that has such a name
            continue
        if found.continues == run_id:
            run_id = found.run_id
            yield found
        else:
            found.close()


def that_sent(recordings: Sequence[ReadableRecording]) -> tuple[str, ...] | None:
    """Return the sensors with samples; None if that is all or none, or if more may come."""
    last, names = recordings[-1], [one.name for one in recordings[0].sensors]
    if isinstance(last, Recording) and not (last.closed or is_left(last)):
        return None
    sent = {one.name for each in recordings for one in each.sensors if one.n_samples}
    return tuple(name for name in names if name in sent) if 0 < len(sent) < len(names) else None


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


def leave_out_repeated(each: Pass, before: Sequence[Pass]) -> None:
    """Exclude from a recording the time that others cover: segments do not count twice.

    Recordings without a date share a start, and simulated ones are written faster than their time
    passes: these cover one time only if their samples are equal.
    """
    for other in before:
        span, own, shift = other.span_ns, each.span_ns, 0
        if span is None or own is None:
            continue
        simulated = Caveat.SIMULATED in each.recording.caveats
        if simulated or min(span[0], own[0]) < FIRST_DATE_NS:
            if not _begin_alike(each.recording, other.recording):
                continue
            shift = own[0] - span[0]
        each.leave_to(other.recording.path.name, span[0] + shift, span[1] + shift)


def _begin_alike(one: ReadableRecording, other: ReadableRecording) -> bool:
    """Return whether the first samples of two recordings are equal."""
    pairs = [
        [sensor.intact_counts(0, min(_COMPARED, sensor.n_samples))[0] for sensor in each.sensors]
        for each in (one, other)
    ]
    return all(map(np.array_equal, *pairs)) and any(np.ptp(counts) for counts in pairs[0])


def check_span(passes: Sequence[Pass], settings: Settings) -> None:
    """Refuse a start and an end between which no recording has a segment; exclusion of nothing.

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
    begun = [each for each in passes if each.aligned.clocks]
    if wanted and begun and not any(each.n_complete for each in passes):
        raise WrongSettingError(
            f"{', '.join(wanted)}: not one segment of {settings.segment:g} s lies there:"
            f" {_covered(begun)}"
        )
    for number, text in enumerate(settings.exclude):
        spans = [(each.excluded()[number], each.aligned.n_available) for each in passes]
        if begun and all(after <= 0 or first >= n for (first, after), n in spans):
            begin, end = (_utc(datetime.fromisoformat(at).timestamp()) for at in text.split("/"))
            raise WrongSettingError(f"exclude {begin}/{end}: nothing there: {_covered(begun)}")


def _twice(path: Path, other: ReadableRecording) -> WrongSettingError:
    return WrongSettingError(
        f"{path} and {other.path} are the same recording (run {other.run_id});"
        " give it once: the same samples do not count twice"
    )


def _covered(passes: Sequence[Pass]) -> str:
    """Return what the recordings cover, for a message: their arrival times are read once more."""
    found = []
    for each in passes:
        whole = AlignedRecording(each.recording, nominal_clocks=True)
        start, seconds = whole.start_utc_ns * 1e-9, whole.n_available / whole.sampling_rate
        found.append(
            f"{each.recording.path} covers {_utc(start)} to {_utc(start + seconds)} UTC"
            f" ({format_duration(round(seconds, 1))})"
        )
    return "; ".join(found)


def _utc(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}"


def _labels(each: Pass) -> list[tuple[str, str, str]]:
    return [(sensor, channel.name, channel.unit) for sensor, channel in each.aligned.channels]


def _described(each: Pass) -> str:
    names = ", ".join(f"{sensor} {channel} in {unit}" for sensor, channel, unit in _labels(each))
    return f"{names} at {each.welch.sampling_rate:g} Hz"
