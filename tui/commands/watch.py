"""``huddle watch``: look on while somebody else records."""

from __future__ import annotations

import json as json_text
import math
import sys
from typing import TYPE_CHECKING, Any

from daq.estimation.follow import follow
from daq.results.band_summary import band_of, channel_means, reached_cov
from tui.commands.estimate import show_result
from tui.output.console import console, finite, write_text
from tui.output.formatting import clock_time, time_left
from tui.output.json_values import plain
from tui.runs.estimate_settings import settings_for

if TYPE_CHECKING:
    from pathlib import Path

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus


def watch_recording(
    file: Path,
    *,
    start: str | None,
    end: str | None,
    json: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Show a recording while it grows: on a screen, as lines, or as lines of JSON.

    Raises
    ------
    RecordingError
        The recording cannot be read (any more).
    """
    if json is None and sys.stdout.isatty() and sys.stdin.isatty():
        from tui.commands.tui import open_recording  # noqa: PLC0415 - Textual where it is shown

        open_recording(file, start=start, end=end, **wanted)
        return
    settings, _ = settings_for(file, start=start, end=end, **wanted)
    lines = _Lines(json)
    try:
        follow(file, settings, lines)
    finally:
        if lines.last is not None and lines.last.results and json is None:
            show_result(lines.last, settings, json=None, csv=None, bench=None)


class _Lines:
    """Writes a line when a segment or an event has come: for people, or as JSON."""

    def __init__(self, json: str | None) -> None:
        self._json = json
        self._now: RecordingStatus | None = None
        self._n_events = 0
        self.last: Snapshot | None = None

    def status(self, status: RecordingStatus) -> None:
        before, self._now = self._now, status
        events = status.events[self._n_events :]
        self._n_events = len(status.events)
        if before is None:  # what was before we came
            return
        for event in events:
            at = (event.received.utc_ns - status.started_utc_ns) * 1e-9
            if self._json is None:
                said = " ".join(part for part in (event.sensor, event.kind, event.text) if part)
                console().print(f"{clock_time(at)}  {said}", soft_wrap=True)
            else:
                document = {
                    "at": at,
                    "sensor": event.sensor,
                    "kind": event.kind,
                    "text": event.text,
                }
                self._write({"event": document})

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        before, self.last = self.last, snapshot
        if before is not None and not snapshot.closed and snapshot.n_segments == before.n_segments:
            return
        if self._json is None:
            console().print(_line(snapshot, settings))
        else:
            self._write(_update(snapshot, settings, self._now))

    def progress(self, done: int, total: int) -> None:
        pass

    def _write(self, document: dict[str, Any]) -> None:
        if self._json is not None:
            line = json_text.dumps(finite(document), ensure_ascii=False) + "\n"
            write_text(self._json, line, append=True)


def _line(snapshot: Snapshot, settings: Settings) -> str:
    state = "ended" if snapshot.closed else time_left(snapshot.time_left)
    cov = reached_cov(snapshot, settings)
    known = "" if math.isnan(cov) else f"c.o.v. {cov:.3f}  "
    return f"{clock_time(snapshot.elapsed)}  {snapshot.n_segments} segments  {known}{state}"


def _update(snapshot: Snapshot, settings: Settings, now: RecordingStatus | None) -> dict[str, Any]:
    """Return what has changed, for a program: states, and the noise of each channel in the band."""
    document: dict[str, Any] = {
        "elapsed": snapshot.elapsed,
        "segments": snapshot.n_segments,
        "effective_averages": snapshot.n_effective,
        "cov": reached_cov(snapshot, settings),
        "time_left": snapshot.time_left,
        "closed": snapshot.closed,
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
        "left_out": plain(snapshot.left_out),
    }
    if snapshot.results:
        band = band_of(settings, snapshot)
        document["band_hz"] = band
        document["noise"] = {
            method: {
                label.name: {
                    "psd": float(mean.mean[0]),
                    "low": float(mean.low[0]),
                    "high": float(mean.high[0]),
                }
                for label, mean in zip(
                    snapshot.channels,
                    channel_means(noise, snapshot.frequency, settings, band),
                    strict=True,
                )
            }
            for method, noise in snapshot.results.items()
        }
    return document
