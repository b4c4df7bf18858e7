"""``huddle status``: what the service of a bench does."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from daq.bench.durations import format_duration
from daq.recorder.schedule import utc_now
from tui.commands.options import BenchArgument, JsonOption, examples
from tui.output.exit_codes import ExitCode
from tui.service.records.store import RunStore

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Any


@examples("huddle status lab.toml", "huddle status lab.toml --json -")
def status(path: BenchArgument, *, json: JsonOption = None) -> None:
    """Show the state of the service of a bench: runs, sensors, disk, clock.

    The exit code is 3 if no service runs.
    """
    from daq.devices.bench_file import load
    from tui.output.console import for_people, write_json
    from tui.service.status import service_status

    bench = load(path)
    runs = RunStore(bench.recording_directory).current(bench.name)
    bench.recording_directory.mkdir(parents=True, exist_ok=True)
    found = service_status(bench, runs, utc_now())
    screen = for_people(json)
    for line in _lines(found):
        screen.print(line, soft_wrap=True)
    write_json(json, found)
    if not found["running"]:
        raise typer.Exit(ExitCode.TROUBLE)


def _lines(found: dict[str, Any]) -> Iterator[str]:
    yield f"service    {'running' if found['running'] else 'not running'}, bench {found['bench']}"
    recording = found["recording"]
    if recording is not None:
        yield f"recording  {recording['entry']} since {recording['started']}" + (
            "" if recording["ends"] is None else f", until {recording['ends']}"
        )
        if recording["elapsed"] is not None:
            yield f"           {format_duration(round(recording['elapsed']))} are safe on disk"
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
            text += f" ({run['reason']})" if run["reason"] else ""
        yield f"{key + ' run':<10} {text}"
    disk = found["disk"]
    yield (
        f"disk       {disk['free_bytes'] / 1e9:.1f} GB free; recordings end below"
        f" {disk['min_free_bytes'] / 1e9:.1f} GB"
    )
    synchronised = {True: "synchronised", False: "NOT synchronised", None: "not known to be right"}
    yield f"clock      {found['clock']['utc']}, {synchronised[found['clock']['synchronised']]}"
    if found["untold"]:
        yield f"hooks      {found['untold']} not carried out yet"
