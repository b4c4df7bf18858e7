"""What a service does at this moment, as seen from another process."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from daq.bench.durations import format_duration
from daq.bench.model import Bench
from daq.caveats import Caveats
from daq.errors import HuddleError
from daq.recording.control import ask
from tui.service.clock import SystemTime
from tui.service.processes.locks import is_held
from tui.service.records.places import service_lock
from tui.service.records.run_state import UNFINISHED, Run, RunState, utc_text


def service_status(bench: Bench, runs: list[Run], now: datetime) -> dict[str, Any]:
    """Return the status of the service of a bench as JSON (docs/service.md).

    Parameters
    ----------
    bench : Bench
    runs : list of Run
        Of the bench, by their time.
    now : datetime
        UTC.
    """
    folder = bench.recording_directory
    by_state = {state: [run for run in runs if run.state is state] for state in RunState}
    recording = by_state[RunState.RECORDING][:1]
    planned = by_state[RunState.DUE]
    over = [run for run in runs if run.is_over]
    return {
        "bench": bench.name,
        "running": is_held(service_lock(bench)),
        "recording": _recording(recording[0], folder) if recording else None,
        "estimating": [run.document() for run in by_state[RunState.ESTIMATING]],
        "waiting": [run.document() for run in planned if run.due <= now],
        "next": next((run.document() for run in planned if run.due > now), None),
        "last": max(over, key=lambda run: run.due).document() if over else None,
        "unfinished": sum(run.state in UNFINISHED for run in runs),
        "untold": sum(len(run.pending_hooks) for run in over),
        "disk": _disk(folder, bench.storage.min_free),
        "clock": {"utc": utc_text(now), "synchronised": SystemTime().is_synchronised()},
    }


def _recording(run: Run, folder: Path) -> dict[str, Any]:
    found = run.document() | {"ends": utc_text(run.window_end), "elapsed": None, "sensors": {}}
    if run.parts:
        try:
            answer = ask(folder / run.parts[-1], "status")
        except (HuddleError, OSError, ValueError):
            return found  # it starts or ends just now
        found |= {"elapsed": answer.get("elapsed"), "sensors": answer.get("sensors", {})}
    return found


def _disk(folder: Path, least: int) -> dict[str, Any]:
    usage = shutil.disk_usage(folder)
    return {"free_bytes": usage.free, "total_bytes": usage.total, "min_free_bytes": least}


def status_lines(found: dict[str, Any]) -> Iterator[str]:
    """Yield what `service_status` has found, for people."""
    yield f"service    {'running' if found['running'] else 'not running'}, bench {found['bench']}"
    recording = found["recording"]
    if recording is not None:
        yield f"recording  {recording['entry']} since {recording['started']}" + (
            "" if recording["ends"] is None else f", until {recording['ends']}"
        )
        if recording["elapsed"] is not None:
            yield f"           {format_duration(round(recording['elapsed']))} are safe on disk"
        if recording["reason"]:
            yield f"           {recording['reason']}"
        for name, sensor in recording["sensors"].items():
            missing = f", {sensor['missing']} missing" if sensor["missing"] else ""
            yield f"  sensor   {name}: {sensor['state']}, {sensor['samples']} samples{missing}"
    for key, title in (("estimating", "estimating"), ("waiting", "waiting")):
        for run in found[key]:
            yield f"{title:<10} {run['entry']} of {run['due']}"
    for key in ("last", "next"):
        run = found[key]
        text = "none" if run is None else f"{run['entry']} of {run['due']}"
        if run is not None and key == "last":
            text += f": {run['state']}" + (f", {run['verdict']}" if run["verdict"] else "")
            text = Caveats.of(run).after(text)
            text += f" ({run['reason']})" if run["reason"] else ""
        yield f"{key + ' run':<10} {text}"
    disk = found["disk"]
    yield (
        f"disk       {disk['free_bytes'] / 1e9:.3g} GB free; recordings end below"
        f" {disk['min_free_bytes'] / 1e9:.3g} GB"
    )
    synchronised = {True: "synchronised", False: "NOT synchronised", None: "not known to be right"}
    yield f"clock      {found['clock']['utc']}, {synchronised[found['clock']['synchronised']]}"
    if found["untold"]:
        yield f"hooks      {found['untold']} not carried out yet"
