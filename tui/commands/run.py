"""``huddle run``: a recorder in a process of its own, and the estimate that follows its file."""

from __future__ import annotations

import math
import time
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, TextColumn

from daq.acquisition.recorder import recording_path
from daq.bench.durations import format_duration
from daq.drivers.bench_file import load
from daq.errors import HuddleError
from daq.estimation.estimation import Estimation
from daq.estimation.settings import Settings
from daq.estimation.throttle import Throttle
from daq.host_clock import SystemClock
from daq.recording.repair import heal
from daq.results.band_summary import reached_cov
from daq.results.store import store_results
from tui.commands.estimate import LIMIT_NOT_MET, check_fit, chosen, show_result
from tui.commands.report import checked, write_report
from tui.output.console import check_places, for_people, notices, progress
from tui.output.formatting import clock_time, time_left
from tui.runs.interrupt import defer_interrupt
from tui.runs.recorder_process import RecorderProcess

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.estimation.snapshot import Snapshot

INTERRUPTED = 130
INTERVAL = 0.25
LONGEST_INTERVAL = 5.0
BEHIND = 2.0
"""Seconds by which a recording that is looked at may lie behind its sensors, at most."""
MAX_CPU_SHARE = 0.03
"""Of one core, at most, that following may take, by fewer looks."""


def run_test(
    path: Path,
    *,
    duration: float | None,
    until_cov: float | None,
    out: Path | None,
    json: str | None,
    csv: str | None,
    diagnostics: bool = False,
    report: Path | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of Settings
) -> None:
    """Run one huddle test and show its result.

    Raises
    ------
    HuddleError
        Whatever kept the recorder from going on; the result of what was recorded is shown before.
    typer.Exit
        130 after Ctrl-C, 1 where a limit is not met: when the result has been shown.
    """
    bench = load(path)
    settings = chosen(Settings.of(bench), **wanted)
    check_fit(settings, bench.sensors)
    check_places(json, csv)
    if until_cov is not None:
        settings = replace(settings, target_cov=until_cov)
    duration = bench.recording.duration if duration is None and until_cov is None else duration
    refuse_hopeless(bench, settings, duration)
    out = recording_path(bench, SystemClock().now()) if out is None else out
    if report is not None:
        checked(report)
    elif bench.recording.report is not None:
        report = out.with_suffix(f".{bench.recording.report}")
    recorder = RecorderProcess(path, out, duration=duration)
    try:
        recorder.wait_for_file()
        notices().print(f"recording to {out}; Ctrl-C stops and shows the result")
        snapshot, interrupted = follow_to_end(
            recorder, settings, duration=duration, until_cov=until_cov
        )
        with defer_interrupt(spent=interrupted) as interruption:
            met = show_result(
                snapshot, settings, json=json, csv=csv, bench=bench, diagnostics=diagnostics
            )
            try:
                store_results(out, snapshot)
            finally:
                recorder.check()  # its trouble says more than what follows from it
            if report is not None:
                write_report(
                    snapshot,
                    report,
                    recordings=[out],
                    settings=settings,
                    screen=for_people(json, csv),
                )
    except BaseException:
        recorder.request_stop()
        raise
    finally:
        recorder.close()
    if report is None:
        notices().print(
            f"[dim]for a report of it: huddle report {escape(str(out))}", soft_wrap=True
        )
    if interruption.pressed:
        raise typer.Exit(INTERRUPTED)
    if not met:
        raise typer.Exit(LIMIT_NOT_MET)


def follow_to_end(
    recorder: RecorderProcess,
    settings: Settings,
    *,
    duration: float | None,
    until_cov: float | None = None,
) -> tuple[Snapshot, bool]:
    """Follow a recorder's file until it is closed; Ctrl-C stops the recorder, not us.

    Returns
    -------
    snapshot : Snapshot
        The result, from the whole recording.
    interrupted : bool
        Whether Ctrl-C was pressed.
    """
    interrupted, snapshot, news = False, None, False
    spacing = Throttle()
    with Estimation([recorder.out], settings) as estimation, _progress() as show:
        bench = estimation.recordings[0].bench
        speed = 1.0 if bench is None else bench.speed
        while True:
            try:
                began = time.process_time()
                gone = recorder.ended  # looked at first: what it wrote last is then seen
                news = estimation.update() or news
                if gone or snapshot is None or (news and spacing.due):
                    with spacing:
                        snapshot = estimation.snapshot()
                    news = False
                    show(snapshot, settings, duration)
                    if gone:
                        break
                    if until_cov is not None and reached_cov(snapshot, settings) <= until_cov:
                        recorder.request_stop()
                pause = (time.process_time() - began) / MAX_CPU_SHARE
                coming = (estimation.lacking - BEHIND) / speed  # before, there is nothing to see
                recorder.ends_within(min(max(INTERVAL, pause, coming), LONGEST_INTERVAL))
            except KeyboardInterrupt:
                if interrupted:
                    raise
                interrupted = True
                recorder.request_stop()
        if not snapshot.closed:
            notices().print("[red]the recorder ended without closing its recording")
            try:
                heal(recorder.out)
            except HuddleError as error:  # a full disk; the file can be read all the same
                notices().print(f"[red]{error}")
    with defer_interrupt(spent=interrupted) as interruption:
        with Estimation([recorder.out], settings) as estimation:
            snapshot = estimation.finish()
        return snapshot, interruption.pressed


def refuse_hopeless(bench: Bench, settings: Settings, duration: float | None) -> None:
    """Say before the run that a duration is too short for any estimate.

    Raises
    ------
    typer.BadParameter
        With how long it must be.
    """
    needed = max(sensor.n_main_channels for sensor in bench.sensors) + 1
    shortest = settings.segment * (1 + (needed - 1) * (1 - settings.overlap))
    if duration is not None and duration < shortest:
        raise typer.BadParameter(
            f"{format_duration(duration)} hold fewer than {needed} segments of "
            f"{format_duration(settings.segment)}, too few for {needed - 1} channels per sensor; "
            f"expected {format_duration(math.ceil(shortest))} at least, or shorter segments"
        )


@contextmanager
def _progress() -> Iterator[Callable[[Snapshot, Settings, float | None], None]]:
    """Show a line that follows a run: time, segments, c.o.v., time left."""
    with progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[state]}"),
    ) as bar:
        task = bar.add_task("0:00", total=None, state="")

        def show(snapshot: Snapshot, settings: Settings, duration: float | None) -> None:
            left = None if duration is None else max(0.0, duration - snapshot.elapsed)
            if settings.target_cov is not None and duration is None:
                left = snapshot.time_left
            cov = reached_cov(snapshot, settings)
            parts = [f"{snapshot.n_segments} segments"]
            if not math.isnan(cov):
                parts.append(f"c.o.v. {cov:.3f}")
            parts.append(time_left(left))
            total = None if left is None else snapshot.elapsed + left
            bar.update(
                task,
                description=clock_time(snapshot.elapsed),
                completed=snapshot.elapsed,
                total=total,
                state=" · ".join(parts),
            )

        yield show
