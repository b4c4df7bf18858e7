"""``huddle record``: the recorder without an estimate."""

from __future__ import annotations

import logging
import math
import subprocess
import time
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rich.live import Live

from daq.bench.end_condition import NEVER, EndCondition
from daq.devices.bench_file import load
from daq.errors import HuddleError, WrongSettingError
from daq.host_clock import SystemClock
from daq.python_process import python_command
from daq.recorder.recorder import run
from daq.recording.storage.names import recording_path
from daq.transport.wire_log import logging_to
from tui.output.console import notices, write_json
from tui.simulation.host_time import host_time
from tui.wording.formatting import clock_time, roughly, several

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.bench.model import Bench
    from daq.recorder.recorder import RecorderStatus

_LOGGER = logging.getLogger(__name__)
GAP_INTERVAL = 60.0
"""Minimum seconds between two log lines about gaps; a polled sensor can have many."""


def record_bench(
    path: Path,
    *,
    duration: float | None,
    until: EndCondition = NEVER,
    until_stopped: bool = False,
    operator: str | None = None,
    estimate: str | None = None,
    out: Path | None,
    json: str | None,
    check: bool = False,
    wire_log: Path | None = None,
) -> None:
    """Record a bench until the duration has passed, or until SIGINT or SIGTERM.

    The duration is that of the bench file, if none is given and `until_stopped` is false. With a
    condition `until` on the live estimate, a process beside the recorder makes that estimate.

    Parameters
    ----------
    path : Path
        Bench file.
    duration : float, optional
        In seconds.
    until : EndCondition
        Its duration is not used.
    until_stopped : bool
    operator : str, optional
        In place of that of the bench file.
    estimate : str, optional
        Settings of the estimate in place of those of the bench file, as its table in JSON.
    out : Path, optional
    json : str, optional
    check : bool
        Whether the check list is made first, and nothing is recorded if it fails.
    wire_log : Path, optional
        New file for every byte that ports receive and send.

    Raises
    ------
    WrongSettingError
        If the test is to be decided and the bench file has no limits.
    ExceptionGroup
        With a DeviceError for every sensor that cannot be used at the start.
    """
    bench = load(path)
    if operator is not None:
        bench = bench.model_copy(update={"operator": operator})
    if until.decided and not bench.limits:
        raise WrongSettingError(f"until decided: {path} has no limits; expected [[limits]]")
    if duration is None and not until_stopped and not until.is_estimated:
        duration = bench.recording.duration
    if out is None:
        out = recording_path(bench, SystemClock().now())
    if check:
        from tui.commands.check import check_before_test  # noqa: PLC0415 - loads the estimator

        check_before_test(bench, duration=duration, anyway=False)
    clock, loop_factory = host_time(bench)
    attributes = {"until": until.estimated.text, "estimate": estimate or ""}
    record = partial(
        run,
        bench,
        out,
        duration=duration,
        attributes={name: text for name, text in attributes.items() if text},
        clock=clock,
        loop_factory=loop_factory,
    )
    screen = notices()
    gaps = GapLog()
    wires = nullcontext() if wire_log is None else logging_to(wire_log)
    with _watched(out, until), wires:
        if screen.is_terminal:
            with Live(console=screen, refresh_per_second=2, transient=True) as live:

                def show(now: RecorderStatus) -> None:
                    gaps.look(now)
                    live.update(progress_line(now, duration))

                status = record(acknowledged=show)
        else:
            status = record(acknowledged=gaps.look)
    if status.closed:
        _sign(bench, Path(status.path))
        closed = {"recording": status.path}
        _LOGGER.info("%s closed: %s", status.path, progress_line(status), extra=closed)
    write_json(json, status.to_dict())


def _sign(bench: Bench, path: Path) -> None:
    """Sign a recording if the bench file has a key; without, it is a recording nevertheless."""
    if bench.signing is None:
        return
    from daq.recording.signing import key_of, sign  # noqa: PLC0415 - seldom needed

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
    sensors = "  ".join(
        f"{name} {sensor.samples}"
        + (f" ({several(sensor.gaps, 'gap')}, {sensor.missing} missing)" if sensor.gaps else "")
        + (f" {sensor.state}" if sensor.state.is_overdue else "")
        for name, sensor in status.sensors.items()
    )
    left = None if duration is None else max(0.0, duration - status.elapsed)
    ends = "" if left is None else f"  ends in {roughly(left)}"
    return f"{clock_time(status.elapsed)}  samples safe: {sensors}{ends}"
