"""``huddle status``: what the service of a bench does."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path

import typer

from daq.errors import BenchFileError
from daq.recorder.schedule import utc_now
from tui.commands.options import command
from tui.output.console import for_people, notices, write_json
from tui.output.exit_codes import ExitCode
from tui.service.records.store import RunStore


@command()
def status(path: Path, *, json: str | None = None) -> None:
    """Show the state of the service of a bench: runs, sensors, disk, clock.

    The exit code is 3 if no service runs.

    Examples
    --------
    huddle status lab.toml
    huddle status lab.toml --json -
    """
    from daq.devices.bench_file import load
    from tui.service.records.places import served_file
    from tui.service.status import service_status, status_lines

    try:
        bench = load(path)
    except BenchFileError:
        if path.is_file():
            notices().print("a running service goes on with the bench file that it accepted before")
        raise
    runs = RunStore(bench.recording_directory).current(bench.name)
    bench.recording_directory.mkdir(parents=True, exist_ok=True)
    found = service_status(bench, runs, utc_now())
    screen = for_people(json)
    for line in status_lines(found):
        screen.print(line, soft_wrap=True)
    served = served_file(bench)
    if found["running"] and served.exists() and served.read_text("utf-8") != bench.text:
        notices().print(
            f"{path} has changed, and the service runs on what it accepted before: send SIGHUP;"
            " if that was refused, its log says why",
            soft_wrap=True,
        )
    write_json(json, found)
    if not found["running"]:
        raise typer.Exit(ExitCode.TROUBLE)
