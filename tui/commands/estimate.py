"""``huddle estimate``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.foreign_files import import_command, is_foreign
from tui.commands.options import DetailsOption, command, with_spanned_options
from tui.output.console import (
    STANDARD_OUTPUT,
    TESTING,
    check_places,
    counted,
    for_people,
    hint,
    write_json,
    write_text,
)
from tui.output.exit_codes import ExitCode

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console, RenderableType

    from daq.results.decision.verdict import TestVerdict
    from daq.results.noise_parameters import ChannelParameters
    from daq.results.result import Result


@command(first="methods segment band unit response start end diagnostics json csv")
@with_spanned_options
def estimate(
    files: list[Path],
    *,
    diagnostics: DetailsOption = False,
    noise_parameters: bool = False,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1)] = 1,
    json: str | None = None,
    csv: str | None = None,
    response: list[Path] | None = None,
    response_for: list[str] | None = None,
    channels: list[str] | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate the self-noise of every channel from recordings.

    Options not given come from the bench file inside the recording.

    Files of other programs are read as huddle import reads them, and nothing
    is stored. Segment, band and unit then follow from the responses and rates.

    Parameters
    ----------
    noise_parameters
        Fit white, flicker, random-walk and f² noise to every channel; show the Allan deviation, and
        compare with the data sheet in the bench file.
    jobs : N
        Number of processes that read a long recording. The result is the same. Octaves, --reject
        and some free clocks take one; so do other systems than Linux.

    Examples
    --------
    huddle estimate night.h5
    huddle estimate night.h5 --method all --band 1:20
    huddle estimate night.h5 --segment 60s --overlap 0.75 --json - --csv noise.csv
    huddle estimate night.h5 --octaves --dimension auto --details
    huddle estimate night.h5 --noise-parameters
    huddle estimate *.mseed --response station.xml

    Worked example
    --------------
    $ huddle estimate night.h5 --band 1:20
    Self-noise, mean over 1 to 20 Hz, dB re 1 (m/s²)²/Hz, with its 95 % interval
    sensor  channel    data   three-sensor
    A       X        −90.00  −114.02 ±0.13
    ▲ The c.o.v. of the noise is 13 %, wanted 5 %: record for 72 min in all

    A.X recorded −90.00 dB, mostly motion; its own noise is between −114.15 and
    −113.89 dB. A recording four times as long halves the interval.
    """
    check_places(json, csv)
    if any(map(is_foreign, files)):
        from tui.commands.import_ import assigned, selected

        asked = {
            "response": response or (),
            "response_for": [assigned(text) for text in response_for or ()],
            "selection": selected(channels=channels or ()),
        }
        result = _of_foreign_files(files, asked, json=json or csv, jobs=jobs, **wanted)
        hint(f"For a recording and reports: {import_command(files)}")
    elif response or response_for or channels:
        raise typer.BadParameter(
            f"{files[0]}: a recording holds its responses and channels; expected --response,"
            " --response-for and --channels with files of other programs"
        )
    else:
        result = estimated(files, whole=noise_parameters, jobs=jobs, **wanted)
        hint(f"For a report: huddle report {files[0]}")
    parameters = None
    if noise_parameters:
        from daq.results.noise_parameters import noise_parameters as parameters_of

        parameters = parameters_of(result, result.bench)
    show_result(result, json=json, csv=csv, diagnostics=diagnostics, parameters=parameters)
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


def _of_foreign_files(
    files: Sequence[Path],
    asked: Mapping[str, Any],
    *,
    json: str | None,
    jobs: int,
    start: str | None,
    end: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> Result:
    """Estimate files of other programs as if they were imported, without a recording."""
    from tempfile import TemporaryDirectory

    from daq.errors import ImportFormatError
    from daq.estimation.estimation import estimate
    from daq.formats.defaults import from_files, still_chosen
    from daq.formats.importer import open_files
    from daq.results.result import Result
    from tui.commands.import_ import show_chosen, show_taken
    from tui.runs.estimate_settings import check_fit, chosen_for_files, spanned

    screen = for_people(json)
    with (
        TemporaryDirectory(prefix="huddle-") as folder,
        counted("segments", then=TESTING) as count,
    ):
        try:
            recording, imported = open_files(files, Path(folder), **asked)
        except ImportFormatError as error:
            more = f"for options of such files: {import_command(files)}"
            raise ImportFormatError(f"{error}\n{more}") from None
        show_taken(imported, screen)
        lengths = (each.n_samples / each.sampling_rate for each in recording.sensors)
        suggested, reasons = from_files(recording.sensors, min(lengths))
        settings = chosen_for_files(suggested, **wanted)
        show_chosen(still_chosen(reasons, suggested, settings), screen)
        check_fit(settings, recording.sensors)
        began = datetime.fromtimestamp(recording.created_at.utc_ns / 1e9, tz=UTC)
        settings = spanned(settings, began, start=start, end=end)
        return Result(estimate([recording], settings, progress=count, jobs=jobs), settings)


def estimated(
    files: Sequence[Path],
    *,
    start: str | None,
    end: str | None,
    whole: bool = False,
    calibrates: bool = False,
    jobs: int = 1,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> Result:
    """Estimate recordings, showing the progress.

    The whole bench takes as long to read as to estimate: without limits only where it is wanted.
    `calibrates` is that of `Settings`.
    """
    from daq.errors import NotARecordingError
    from daq.estimation.estimation import estimate
    from daq.recording.reader import Recording
    from daq.results.result import Result
    from tui.runs.estimate_settings import settings_of

    if any(map(is_foreign, files)):
        raise NotARecordingError(
            f"{files[0]}: not a huddle recording; convert it: {import_command(files)}"
        )
    with (
        Recording.open(files[0]) as first,  # once, for its settings and for the estimate
        counted("segments", then=TESTING) as count,
    ):
        settings = settings_of(first, start=start, end=end, **wanted)
        settings = replace(settings, calibrates=calibrates)
        snapshot = estimate([first, *files[1:]], settings, progress=count, jobs=jobs)
    outline = first.outline
    bench = first.bench if whole or (outline is not None and outline.has_limits) else None
    return Result(snapshot, settings, bench, tuple(files))


def show_result(
    result: Result,
    *,
    json: str | None,
    csv: str | None,
    diagnostics: bool = False,
    parameters: Sequence[ChannelParameters] | None = None,
) -> None:
    """Print the table, and write JSON and CSV if requested."""
    from daq.results.noise_parameters import quantisation_shares
    from estimator.decision.verdict import Verdict
    from tui.output.noise_parameters import quantisation_notes
    from tui.output.results import averages_line, curves_csv, result_table, result_title
    from tui.wording.verdict_text import STYLES, Decision, facts_below, limit_line

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
    for part in _details(result, screen.width) if diagnostics else facts_below(result):
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


def _details(result: Result, width: int) -> Sequence[RenderableType]:
    """Return the whole diagnosis, and how the sensors stand."""
    from tui.output.diagnosis import details
    from tui.output.standing import standing

    return details(result.snapshot, result.facts) + standing(result, width=width)


def _show_parameters(screen: Console, found: Sequence[ChannelParameters], unit: str) -> None:
    """Print the noise parameters as tables."""
    from tui.output.noise_parameters import allan_table, notes, sheet_table, term_table
    from tui.page.terminal import terminal_table

    for title, table in (
        (f"Noise terms at 1 Hz, dB re 1 ({unit})²/Hz, with standard errors", term_table(found)),
        (f"Allan deviation of the self-noise in {unit}, with 95 % intervals", allan_table(found)),
        ("Data sheet", sheet_table(found)),
    ):
        if table.rows:
            screen.print(title, style="bold")
            screen.print(terminal_table(table, wraps=False))
    for line in notes(found):
        screen.print(line)
