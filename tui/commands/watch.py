"""``huddle watch``: shows the live estimate of a recording that another process writes."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tui.commands.estimate import exit_with, show_result
from tui.commands.options import command, with_logging, with_spanned_options
from tui.output.console import console, write_text

if TYPE_CHECKING:
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus
    from daq.results.result import Result


@command()
@with_logging
@with_spanned_options
def watch(
    file: Path,
    *,
    json: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Show the live estimate of a recording that another process writes.

    Examples
    --------
    huddle watch night.h5
    huddle watch night.h5 --json -   (one line of JSON per update)
    """
    from daq.estimation.follow import follow
    from tui.runs.estimate_settings import settings_for

    if json is None and sys.stdout.isatty() and sys.stdin.isatty():
        from tui.commands.tui import open_recording

        open_recording(file, **wanted)
        return
    settings, bench = settings_for(file, **wanted)
    lines = _Lines(file, json, bench)
    try:
        follow(file, settings, lines)
    finally:
        if lines.last is not None and lines.last.snapshot.results and json is None:
            show_result(lines.last, json=None, csv=None)
    if lines.last is not None:
        exit_with(lines.last.verdict)


class _Lines:
    """Writes a line for each new segment and event, as text or as JSON."""

    def __init__(self, file: Path, json: str | None, bench: Bench | None) -> None:
        self._file, self._json, self._bench = file, json, bench
        self._now: RecordingStatus | None = None
        self._n_events = 0
        self.last: Result | None = None
        self._says_why = False

    def status(self, status: RecordingStatus) -> None:
        from estimator.wording import clock_time

        before, self._now = self._now, status
        events = status.events[self._n_events :]
        self._n_events = len(status.events)
        if before is None:  # events from before
            for caveat in status.caveats if self._json is None else ():
                console().print(caveat.words.sentence, soft_wrap=True)
            return
        for event in events:
            at = (event.received.utc_ns - status.started_utc_ns) * 1e-9
            if self._json is None:
                line = " ".join(part for part in (event.sensor, event.kind, event.text) if part)
                console().print(f"{clock_time(at)}  {line}", soft_wrap=True)
            else:
                document = {
                    "at": at,
                    "sensor": event.sensor,
                    "kind": event.kind,
                    "text": event.text,
                }
                self._write({"event": document})

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        from daq.results.result import Result
        from estimator.wording import clock_time
        from tui.wording.facts import why_no_estimate

        result = Result(snapshot, settings, self._bench, (self._file,))
        before, self.last = self.last, result
        reason = why_no_estimate(result)
        if reason and not self._says_why:
            self._says_why = True
            if self._json is None:
                console().print(f"{clock_time(snapshot.elapsed)}  {reason}", soft_wrap=True)
            else:
                self._write({"no_segment": snapshot.no_segment, "text": reason})
        if (
            before is not None
            and not snapshot.closed
            and snapshot.n_segments == before.snapshot.n_segments
        ):
            return
        if self._json is None:
            console().print(_line(result, self._now), soft_wrap=True)
        else:
            self._write(_update(result, self._now))

    def segments(self, n_segments: int, elapsed: float) -> None:
        pass

    def progress(self, done: int, total: int) -> None:
        pass

    def _write(self, document: dict[str, Any]) -> None:
        from tui.output.json_values import json_text

        if self._json is not None:
            write_text(self._json, json_text(document) + "\n", append=True)


def _line(result: Result, now: RecordingStatus | None) -> str:
    from estimator.wording import clock_time, percent
    from tui.wording.verdict_text import how_long

    snapshot, state = result.snapshot, "ended"
    if not snapshot.closed and now is not None:
        left = result.remaining(now.until, now.elapsed)
        state = how_long(left, now.in_local_time(left.seconds))
    cov = result.precision().cov
    known = "" if math.isnan(cov) else f"worst c.o.v. {percent(cov)}  "
    return f"{clock_time(snapshot.elapsed)}  {snapshot.n_segments} segments  {known}{state}"


def _update(result: Result, now: RecordingStatus | None) -> dict[str, Any]:
    """Return the update for programs: states, noise in the band, verdict."""
    from daq.bench.end_condition import NEVER
    from tui.output.json_document import verdict_document

    snapshot, until = result.snapshot, NEVER if now is None else now.until
    elapsed = snapshot.elapsed if now is None else now.elapsed
    left = result.remaining(until, elapsed)
    document: dict[str, Any] = {
        "elapsed": snapshot.elapsed,
        "segments": snapshot.n_segments,
        "effective_averages": snapshot.n_effective,
        "cov": result.precision().cov,
        "time_left": left.seconds,
        "time_left_for": left.goal,
        "ends_too_early_for": left.short_of,
        "closed": snapshot.closed,
        **snapshot.caveats.keys,
        "sensors": {
            sensor.name: {
                "state": sensor.state,
                "samples": sensor.n_samples,
                "gaps": sensor.n_gaps,
                "missing": sensor.n_missing,
                "clipped_blocks": sensor.n_clipped,
                "standing_still": sensor.stuck,
            }
            for sensor in (() if now is None else now.sensors)
        },
        "left_out": snapshot.left_out,
        **verdict_document(result),
    }
    if snapshot.results:
        document["band_hz"] = result.band
        document["noise"] = {
            method: {
                label.name: {
                    "psd": float(mean.estimate[0]),
                    "low": float(mean.low[0]),
                    "high": float(mean.high[0]),
                }
                for label, mean in zip(
                    snapshot.channels,
                    result.means(method),
                    strict=True,
                )
            }
            for method in snapshot.results
        }
    return document
