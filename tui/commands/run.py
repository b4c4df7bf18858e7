"""``huddle run``: starts a recorder process and estimates its recording."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import logging
import math
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.bench.durations import format_duration
from daq.bench.end_condition import EndCondition
from daq.bench.option_fit import shortest_duration
from daq.errors import HuddleError, RecordingError
from daq.recording.storage.names import recording_path
from tui.commands import options
from tui.commands.check import check_before_test
from tui.commands.estimate import exit_with, show_result
from tui.commands.report import checked, write_report
from tui.output.console import check_places, for_people, hint, progress
from tui.output.exit_codes import ExitCode

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.progress import Progress

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus
    from daq.results.result import Result
    from tui.runs.recorder_process import RecorderProcess

_LOGGER = logging.getLogger(__name__)
LINE_SHARE = 0.01
"""Share of the time that live estimates may cost where only their c.o.v. is shown."""
STATUS_INTERVAL = 1.0
"""Seconds between two looks at a recorder whose estimate has failed."""


@options.command(first="duration until_decided until_cov anyway out report json band segment unit")
@options.with_logging
@options.with_estimate_options
def run(
    path: Path,
    *,
    duration: options.DurationOption = None,
    until_cov: Annotated[float | None, typer.Option(min=0.001, max=1.0)] = None,
    until_decided: bool = False,
    anyway: bool = False,
    out: Annotated[Path | None, options.NEW_RECORDING] = None,
    diagnostics: options.DetailsOption = False,
    report: Path | None = None,
    json: str | None = None,
    csv: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Run one huddle test: record, estimate live, print the result.

    First the command reads the sensors for 10 s and makes the check list of
    huddle check. If a check fails, nothing is recorded.

    The recorder is a separate process; the estimate reads its file.
    Ctrl-C stops the recorder, and the command prints the result. Ctrl-C
    during the final estimate finishes it first; a second Ctrl-C aborts.

    Parameters
    ----------
    until_cov : COV
        Stop when the noise in the worst third of an octave of the band has this coefficient of
        variation.
    until_decided
        Stop when all limits of the bench are met, or one is not.
    report : FILE
        Write the calibration report: .html or .pdf.

    Examples
    --------
    huddle run lab.toml --duration 3h
    huddle run lab.toml --until-decided --duration 3h
    huddle run lab.toml --until-cov 0.05 --band 1:20
    huddle run lab.toml -d 20min --json result.json --report result.pdf

    Worked example
    --------------
    $ huddle run lab.toml --until-decided --duration 3h --report result.pdf

    Reads the sensors of lab.toml until all limits are met, or one is not, for
    three hours at most, shows the noise meanwhile, and writes result.pdf.
    The exit code is 0 for PASS, 1 for FAIL, 4 for not decided. Ctrl-C ends the
    test early.
    """
    from daq.devices.bench_file import load
    from daq.estimation.settings import Settings
    from daq.host_clock import SystemClock
    from daq.results.result import Result
    from tui.runs.estimate_settings import check_fit, chosen
    from tui.runs.recorder_process import RecorderProcess, defer_interrupt
    from tui.service.history.ledger import noted

    end = EndCondition(duration, until_cov, until_decided)
    bench = load(path)
    end = bench.end if end == EndCondition() else end
    settings = chosen(Settings.of(bench), **wanted)
    check_fit(settings, bench.sensors)
    check_places(json, csv)
    if end.cov is not None:
        settings = replace(settings, target_cov=end.cov)
    refuse_hopeless(bench, settings, end)
    out = recording_path(bench, SystemClock().now()) if out is None else out
    if report is not None:
        checked(report)
    elif bench.recording.report is not None:
        report = out.with_suffix(f".{bench.recording.report}")
    check_before_test(bench, duration=end.duration, anyway=anyway)
    recorder = RecorderProcess(path, out, end=end, settings=settings, anyway=anyway)
    try:
        recorder.wait_for_file()
        hint("Ctrl-C stops the recording and shows the result")
        with defer_interrupt(recorder.request_stop) as interruption:
            snapshot = result_of(recorder, settings, end=end, bench=bench)
            result = Result(snapshot, settings, bench, (out,))
            # First into the recording, whatever becomes of screens and other files.
            trouble = _stored(out, result)
            show_result(result, json=json, csv=csv, diagnostics=diagnostics)
            recorder.check()  # its error says more than one that follows from it
            for line in noted(out, result):
                for_people(json, csv).print(line, soft_wrap=True)
            if trouble is not None:
                raise trouble  # noqa: TRY301 - once all that is known has been shown
            if report is not None:
                write_report(result, report, screen=for_people(json, csv))
    except BaseException:
        recorder.request_stop()
        raise
    finally:
        recorder.close()
    if report is None:
        hint(f"For a report: huddle report {out}")
    if interruption.pressed:
        raise typer.Exit(ExitCode.INTERRUPTED)
    exit_with(result.verdict)


def _stored(out: Path, result: Result) -> RecordingError | None:
    """Write the results into the recording; return what kept it from that."""
    from daq.results.store import store_results

    try:
        store_results(out, result.snapshot, result.verdict)
    except RecordingError as error:
        return error
    return None


def result_of(
    recorder: RecorderProcess,
    settings: Settings,
    *,
    end: EndCondition,
    bench: Bench | None = None,
) -> Snapshot:
    """Follow the recording of a recorder to its end, and return its result.

    A recording that its recorder left open is repaired and estimated. If the estimate fails while
    the recorder runs, the recorder continues to its end; then the whole recording is estimated.

    Raises
    ------
    HuddleError, EstimatorError
        The recorder failed, or the recording gives no result.
    """
    from daq.estimation.estimation import estimate
    from daq.estimation.follow import RecordingLeftOpenError, follow
    from daq.recording.repair import repair

    with _progress(end.duration, bench) as observer:
        try:
            snapshot = follow(
                recorder.out,
                settings,
                observer,
                recorder=recorder,
                states_every=None,
                share=LINE_SHARE,
            )
        except RecordingLeftOpenError:
            snapshot = None
        except Exception as error:
            recorder.check()  # its error says more than one that follows from it
            if recorder.ended or getattr(error, "is_usage_error", False):
                raise
            reason = str(error) or type(error).__name__
            _LOGGER.error(  # noqa: TRY400 - the final estimate raises it again if it stays
                "the live estimate failed (%s); the recording continues, and is estimated when it"
                " has ended. Ctrl-C ends it now",
                reason,
            )
            snapshot = _estimate_at_end(recorder, settings)
    if snapshot is None:
        _LOGGER.error("%s: the recorder ended without closing the recording", recorder.out)
        try:
            repair(recorder.out)
        except HuddleError as error:  # a full disk; the file can be read all the same
            _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all
        snapshot = estimate([recorder.out], settings)
    recorder.wait()
    return snapshot


def _estimate_at_end(recorder: RecorderProcess, settings: Settings) -> Snapshot | None:
    """Wait for the recorder, and estimate its recording; None if it was left open."""
    from daq.estimation.estimation import estimate
    from daq.recording.reader import Recording

    while not recorder.ends_within(STATUS_INTERVAL):
        pass
    recorder.check()
    with Recording.open(recorder.out) as recording:
        closed = recording.closed
    return estimate([recorder.out], settings) if closed else None


def refuse_hopeless(bench: Bench, settings: Settings, end: EndCondition) -> None:
    """Refuse a test that cannot end as wanted: too short for any estimate, or without limits.

    Raises
    ------
    typer.BadParameter
        With what was expected.
    """
    if end.decided and not bench.limits:
        raise typer.BadParameter(
            "--until-decided: the bench file has no limits; expected [[limits]], or --until-cov"
        )
    duration = end.duration
    n_segments, shortest = shortest_duration(settings, bench.sensors)
    if duration is not None and duration < shortest:
        raise typer.BadParameter(
            f"a duration of {format_duration(duration)} has fewer than {n_segments} segments of"
            f" {format_duration(settings.segment)}, too few for an estimate; expected at least"
            f" {format_duration(math.ceil(shortest))}, or shorter segments"
        )


class _Run:
    """Shows the progress of a run in a line: time, segments, c.o.v., how long it takes."""

    def __init__(self, bar: Progress, duration: float | None, bench: Bench | None) -> None:
        self._bar, self._bench = bar, bench
        self._task = bar.add_task("0:00", total=None, state="")
        self._end = duration
        self._cov = math.nan
        self._left = ""
        self._says_why = False
        self._now: RecordingStatus | None = None

    def status(self, status: RecordingStatus) -> None:
        """Keep it for the progress line."""
        self._now = status

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Show the progress of the recording with the precision of its estimate."""
        from daq.results.result import Result
        from tui.wording.facts import why_no_estimate
        from tui.wording.verdict_text import how_long

        if snapshot.closed:
            return
        result, now = Result(snapshot, settings, self._bench), self._now
        self._cov = result.precision().cov
        if now is not None and not self._bar.disable:
            left = result.remaining(now.until, now.elapsed)
            self._end = None if left.seconds is None else snapshot.elapsed + left.seconds
            self._left = how_long(left, now.in_local_time(left.seconds))
        self.segments(snapshot.n_segments, snapshot.elapsed)
        reason = why_no_estimate(result)
        if reason and not self._says_why:
            self._says_why = True
            _LOGGER.warning("%s", reason)

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Show the progress of the recording."""
        from estimator.wording import clock_time, percent

        parts = [f"{n_segments} segments"]
        if not math.isnan(self._cov):
            parts.append(f"worst c.o.v. {percent(self._cov)}")
        state = " · ".join([*parts, *filter(None, [self._left])])
        self._show(clock_time(elapsed), elapsed, self._end, state)

    def progress(self, done: int, total: int) -> None:
        """Show the progress of the final estimate."""
        self._show("result", done, total, f"{done / total:.0%}")

    def _show(self, what: str, done: float, total: float | None, state: str) -> None:
        task = self._task
        self._bar.update(task, description=what, completed=done, total=total, state=state)


@contextmanager
def _progress(duration: float | None, bench: Bench | None) -> Iterator[_Run]:
    from rich.progress import BarColumn, TextColumn

    with progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[state]}"),
        per_second=1,
    ) as bar:
        yield _Run(bar, duration, bench)
