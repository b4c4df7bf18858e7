"""``huddle watch``: look on while somebody else records."""

from __future__ import annotations

import json as json_text
import math
import sys
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.errors import RecordingError
from daq.estimation import Settings
from daq.recording.reader import Recording
from tui.estimating import chosen, show_result
from tui.following import follow
from tui.output import STANDARD_OUTPUT, console, finite
from tui.results import band_of, channel_means, reached_cov
from tui.text import clock_time, time_left

if TYPE_CHECKING:
    from daq.estimation import Snapshot


def watch_recording(file: Path, *, method: str | None, json: str | None) -> None:
    """Show a recording while it grows: on a screen, as lines, or as lines of JSON.

    Raises
    ------
    RecordingError
        The recording cannot be read (any more).
    """
    if json is None and sys.stdout.isatty() and sys.stdin.isatty():
        from tui.application.main import open_recording  # noqa: PLC0415 - Textual where it is shown

        open_recording(file, method=method)
        return
    with Recording.open(file) as recording:
        settings = chosen(Settings.of(recording.bench), method=method)
    last: list[Snapshot] = []
    trouble: list[str] = []

    def tell(snapshot: Snapshot, settings: Settings) -> None:
        if last and not snapshot.closed and snapshot.n_segments == last[0].n_segments:
            return
        if json is None:
            console().print(_line(snapshot, settings))
        else:
            _append(json, json_text.dumps(finite(_update(snapshot, settings))) + "\n")
        last[:] = [snapshot]

    follow(file, settings, on_snapshot=tell, on_trouble=trouble.append, ended=threading.Event())
    if trouble:
        raise RecordingError(trouble[0])
    if json is None and last and last[0].results:
        show_result(last[0], settings, json=None, csv=None, bench=None)


def _line(snapshot: Snapshot, settings: Settings) -> str:
    state = "ended" if snapshot.closed else time_left(snapshot.time_left)
    cov = reached_cov(snapshot, settings)
    known = "" if math.isnan(cov) else f"c.o.v. {cov:.3f}  "
    return f"{clock_time(snapshot.elapsed)}  {snapshot.n_segments} segments  {known}{state}"


def _update(snapshot: Snapshot, settings: Settings) -> dict[str, Any]:
    """Return what has changed, for a program: states, and the noise of each channel in the band."""
    document: dict[str, Any] = {
        "elapsed": snapshot.elapsed,
        "segments": snapshot.n_segments,
        "effective_averages": snapshot.n_effective,
        "cov": reached_cov(snapshot, settings),
        "time_left": snapshot.time_left,
        "closed": snapshot.closed,
        "sensors": {
            sensor.name: {"samples": sensor.n_samples, "gaps": sensor.n_gaps}
            for sensor in snapshot.sensors
        },
    }
    if snapshot.results:
        band = band_of(settings, snapshot.frequency)
        document["band_hz"] = band
        document["noise"] = {
            method: {
                f"{label.sensor}.{label.channel}": {
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


def _append(file: str, line: str) -> None:
    if file == STANDARD_OUTPUT:
        sys.stdout.write(line)
        sys.stdout.flush()
    else:
        with Path(file).open("a", encoding="utf-8") as lines:
            lines.write(line)
