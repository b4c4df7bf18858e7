"""``huddle estimate``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tui.commands.options import (
    CsvOption,
    DiagnosticsOption,
    EndOption,
    FilesArgument,
    JsonOption,
    StartOption,
    examples,
    with_estimate_options,
)
from tui.output.exit_codes import ExitCode

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rich.console import Console

    from daq.estimation.estimation import Progress
    from daq.results.decision.verdict import TestVerdict
    from daq.results.noise_parameters import ChannelNoise
    from daq.results.result import Result


@examples(
    "huddle estimate night.h5",
    "huddle estimate night.h5 --method all --band 1:20",
    "huddle estimate night.h5 --segment 60s --overlap 0.75 --json - --csv noise.csv",
    "huddle estimate night.h5 --octaves --dimension auto --details",
    "huddle estimate night.h5 --noise-parameters",
)
@with_estimate_options
def estimate(
    files: FilesArgument,
    *,
    start: StartOption = None,
    end: EndOption = None,
    diagnostics: DiagnosticsOption = False,
    noise_parameters: Annotated[
        bool,
        typer.Option(
            "--noise-parameters",
            help="Fit white, flicker, random-walk and f² noise to every channel; show the Allan "
            "deviation, and compare with the data sheet in the bench file.",
        ),
    ] = False,
    json: JsonOption = None,
    csv: CsvOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate the self-noise of every channel from recordings.

    Options not given come from the bench file inside the recording.
    """
    from tui.output.console import check_places, hint

    check_places(json, csv)
    result = estimated(files, start=start, end=end, whole=noise_parameters, **wanted)
    parameters = None
    if noise_parameters:
        from daq.results.noise_parameters import noise_parameters as parameters_of

        parameters = parameters_of(result, result.bench)
    show_result(result, json=json, csv=csv, diagnostics=diagnostics, parameters=parameters)
    hint(f"For a report: huddle report {files[0]}")
    exit_with(result.verdict)


def exit_with(found: TestVerdict | None) -> None:
    """End the command with the exit code of the verdict.

    Raises
    ------
    typer.Exit
        With 1 if a limit is not met, with 4 if that is not decided.
    """
    if found is None:
        return
    from estimator.decision.verdict import Verdict

    if found.verdict is Verdict.FAIL:
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)
    if found.verdict is Verdict.NOT_DECIDED:
        raise typer.Exit(ExitCode.NOT_DECIDED)


def estimated(
    files: Sequence[Path],
    *,
    start: str | None,
    end: str | None,
    whole: bool = False,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> Result:
    """Estimate recordings, showing the progress.

    The whole bench takes as long to read as to estimate: without limits only where it is wanted.
    """
    from daq.estimation.estimation import estimate
    from daq.recording.reader import Recording
    from daq.results.result import Result
    from tui.runs.estimate_settings import settings_of

    with (
        Recording.open(files[0]) as first,  # once, for its settings and for the estimate
        _counted_segments() as count,
    ):
        settings = settings_of(first, start=start, end=end, **wanted)
        snapshot = estimate([first, *files[1:]], settings, progress=count)
    outline = first.outline
    bench = first.bench if whole or (outline is not None and outline.has_limits) else None
    return Result(snapshot, settings, bench, tuple(files))


@contextmanager
def _counted_segments() -> Iterator[Progress | None]:
    """Show how many segments of all are taken; None where that is not shown."""
    from tui.output.console import progress, shows_progress

    if not shows_progress():
        yield None
        return
    from rich.progress import (
        BarColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    with progress(
        TextColumn("segments"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total}"),
        TimeRemainingColumn(),
    ) as bar:
        task = bar.add_task("")
        yield lambda done, total: bar.update(task, completed=done, total=total)


def show_result(
    result: Result,
    *,
    json: str | None,
    csv: str | None,
    diagnostics: bool = False,
    parameters: Sequence[ChannelNoise] | None = None,
) -> None:
    """Print the table, and write JSON and CSV if requested."""
    from daq.results.noise_parameters import quantisation_shares
    from estimator.decision.verdict import Verdict
    from tui.output.console import STANDARD_OUTPUT, for_people, write_json, write_text
    from tui.output.diagnosis import details
    from tui.output.noise_parameters import quantisation_notes
    from tui.output.results import averages_line, curves_csv, result_table, result_title
    from tui.wording.facts import NOTHING_TO_DO, brief, known
    from tui.wording.verdict_text import STYLES, Decision, limit_line

    snapshot, screen = result.snapshot, for_people(json, csv)
    table = result_table(result)  # refuses a band without frequencies
    decision = Decision.of(result)
    if decision is not None:
        screen.print(str(decision), style=STYLES[decision.state])
    screen.print(result_title(result))
    screen.print(averages_line(snapshot))
    screen.print(table)
    for line in quantisation_notes(snapshot.channels, quantisation_shares(result)):
        screen.print(line)
    if parameters is not None:
        _show_parameters(screen, parameters, snapshot.unit)
    facts = known(result)
    is_open = decision is not None and decision.next_step != NOTHING_TO_DO
    for part in details(snapshot, facts) if diagnostics else brief(facts, is_open=is_open):
        screen.print(part)
    for each in () if result.verdict is None else result.verdict.limits:
        if each.verdict is not Verdict.PASS:
            screen.print(limit_line(each), style=STYLES[each.verdict].removeprefix("bold "))
    for line in () if decision is None else decision.remarks:
        screen.print(line)
    if json is not None:
        from tui.output.json_document import document

        write_json(json, document(result, parameters))
    if csv is not None:
        write_text(csv, curves_csv(snapshot))
        if csv != STANDARD_OUTPUT:
            from tui.output.csv_text import write_metadata
            from tui.output.json_document import provenance

            write_metadata(Path(csv), provenance(result))


def _show_parameters(screen: Console, found: Sequence[ChannelNoise], unit: str) -> None:
    """Print the noise parameters as tables."""
    from rich.table import Table
    from rich.text import Text

    from tui.output.noise_parameters import allan_table, notes, sheet_table, term_table

    for title, (header, rows) in (
        (f"Noise terms at 1 Hz, dB re 1 ({unit})²/Hz, with standard errors", term_table(found)),
        (f"Allan deviation of the self-noise in {unit}, with 95 % intervals", allan_table(found)),
        ("Data sheet", sheet_table(found)),
    ):
        if rows:
            table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
            for number, name in enumerate(header):
                table.add_column(name, justify="right" if number else "left", no_wrap=True)
            for row in rows:
                table.add_row(*map(Text, row))
            screen.print(Text(title, "bold"))
            screen.print(table)
    for line in notes(found):
        screen.print(line)
