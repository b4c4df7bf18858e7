"""``huddle record``: the recorder without an estimate."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import logging
import math
import subprocess
import time
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.bench.end_condition import EndCondition
from daq.errors import HuddleError, WrongSettingError
from daq.python_process import python_command
from daq.recording.storage.names import recording_path
from tui.commands.options import NEW_RECORDING, DurationOption, command, with_logging
from tui.output.console import notices, write_json

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.bench.model import Bench
    from daq.recorder.recorder import RecorderStatus

_LOGGER = logging.getLogger(__name__)
GAP_INTERVAL = 60.0
"""Minimum seconds between two log lines about gaps; a polled sensor can have many."""


@command(first="duration until until_stopped out check anyway operator json wire_log")
@with_logging
def record(
    path: Path,
    *,
    duration: DurationOption = None,
    operator: str | None = None,
    until: str = "",
    estimate: Annotated[str | None, typer.Option(hidden=True)] = None,
    until_stopped: bool = False,
    check: bool = False,
    anyway: bool = False,
    wire_log: Path | None = None,
    out: Annotated[Path | None, NEW_RECORDING] = None,
    json: str | None = None,
) -> None:
    """Record without estimating, until the duration has passed or Ctrl-C.

    Parameters
    ----------
    operator : NAME
        Operator (default: from the bench file).
    until : CONDITION
        Stop by the live estimate: 'decided' once all limits are met or one is not, '5 %' once the
        noise in the worst third of an octave of the band has a c.o.v. of 5 %, or both, separated by
        a comma: the first of them.
    until_stopped
        Ignore the duration of the bench file.
    check
        Make the check list first; record nothing if a check fails.
    wire_log : FILE
        Also log every byte received and sent, for tests of drivers.

    Examples
    --------
    huddle record lab.toml --duration 3h --out night.h5

    Worked example
    --------------
    $ huddle record lab.toml --duration 20min --out night.h5
    $ huddle estimate night.h5

    Records for 20 minutes. Ctrl-C ends earlier, and what was recorded is kept.
    """
    from rich.live import Live

    from daq.devices.bench_file import load
    from daq.host_clock import SystemClock
    from daq.recorder.recorder import record as recorded
    from daq.recorder.recorder import run
    from daq.transport.wire_log import logging_to
    from estimator.checks.count_limits import share_of_repeats
    from tui.simulation.host_time import host_time

    if until_stopped and duration is not None:
        raise typer.BadParameter("--duration and --until-stopped exclude each other; expected one")
    try:
        condition = EndCondition.of_text(until)
    except ValueError as error:
        raise typer.BadParameter(f"--until {error}") from None
    if condition.duration is not None:
        raise typer.BadParameter(f"--until {until!r}: expected a time as --duration")
    bench = load(path)
    if operator is not None:
        bench = bench.model_copy(update={"operator": operator})
    if condition.decided and not bench.limits:
        raise WrongSettingError(f"until decided: {path} has no limits; expected [[limits]]")
    if duration is None and not until_stopped and not condition.is_estimated:
        condition, duration = bench.end.estimated, bench.recording.duration
    if out is None:
        out = recording_path(bench, SystemClock().now())
    if check:
        from tui.commands.check import check_before_test

        check_before_test(bench, duration=duration, anyway=anyway)
    clock, loop_factory = host_time(bench)
    attributes = {"until": condition.estimated.text, "estimate": estimate or ""}
    made = partial(
        recorded,
        bench,
        out,
        duration=duration,
        attributes={name: text for name, text in attributes.items() if text},
        anyway=anyway,
        share_of_repeats=share_of_repeats,
        clock=clock,
    )
    screen = notices()
    gaps = GapLog()
    wires = nullcontext() if wire_log is None else logging_to(wire_log)
    with _watched(out, condition), wires:
        if screen.is_terminal:
            with Live(console=screen, refresh_per_second=2, transient=True) as live:

                def show(now: RecorderStatus) -> None:
                    gaps.look(now)
                    live.update(progress_line(now, duration))

                status = run(partial(made, acknowledged=show), loop_factory)
        else:
            status = run(partial(made, acknowledged=gaps.look), loop_factory)
    if status.closed:
        _sign(bench, Path(status.path))
        closed = {"recording": status.path}
        _LOGGER.info("%s closed: %s", status.path, progress_line(status), extra=closed)
    write_json(json, status.to_dict())


def _sign(bench: Bench, path: Path) -> None:
    """Sign a recording if the bench file has a key; without, it is a recording nevertheless."""
    if bench.signing is None:
        return
    from daq.recording.signing import key_of, sign

    try:
        key = key_of(bench)
        if key is not None:
            _LOGGER.info("%s: signed with key %s", path, sign(path, key).key_id)
    except HuddleError as error:
        _LOGGER.error("not signed: %s", error)  # noqa: TRY400 - its message says all


@contextmanager
def _watched(out: Path, until: EndCondition) -> Iterator[None]:
    """Run the process that stops the recorder, for as long as the recorder runs."""
    if not until.is_estimated:
        yield
        return
    watching = subprocess.Popen(
        python_command("tui.runs.end_watch", str(out)),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    try:
        yield
    finally:  # it has nothing to lose
        watching.kill()
        watching.wait()


class GapLog:
    """Logs the number of missing samples when it has grown, once a minute at most."""

    def __init__(self) -> None:
        self._next = -math.inf
        self._known: dict[str, int] = {}

    def look(self, status: RecorderStatus) -> None:
        """Log new gaps of a recorder's status."""
        from estimator.wording import several

        if time.monotonic() < self._next and not status.closed:
            return
        for name, sensor in status.sensors.items():
            if sensor.gaps > self._known.get(name, 0):
                self._known[name] = sensor.gaps
                self._next = time.monotonic() + GAP_INTERVAL
                _LOGGER.warning(
                    "%s: %s so far, %d samples missing",
                    *(name, several(sensor.gaps, "gap"), sensor.missing),
                    extra={"sensor": name, "gaps": sensor.gaps, "missing": sensor.missing},
                )


def progress_line(status: RecorderStatus, duration: float | None = None) -> str:
    """Return the safe samples of every sensor, and the time until a run of this duration ends."""
    from estimator.wording import clock_time, roughly, several

    sensors = "  ".join(
        f"{name} {sensor.samples}"
        + (f" ({several(sensor.gaps, 'gap')}, {sensor.missing} missing)" if sensor.gaps else "")
        + (f" {sensor.state}" if sensor.state.is_overdue else "")
        for name, sensor in status.sensors.items()
    )
    left = None if duration is None else max(0.0, duration - status.elapsed)
    ends = "" if left is None else f"  ends in {roughly(left)}"
    return f"{clock_time(status.elapsed)}  samples safe: {sensors}{ends}"
