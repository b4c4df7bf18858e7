"""``huddle import``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import math
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from tui.commands.options import (
    NEW_RECORDING,
    command,
    read_option,
    with_estimate_options,
    with_logging,
)
from tui.output.console import for_people, notices, write_json
from tui.output.exit_codes import ExitCode
from tui.page.table import Table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from daq.formats.importer import ImportResult
    from daq.formats.sources import Selection

_ORIGINS = {
    "response": "response",
    "bench": "bench file",
    "file": "the file's own",
    "none": "no calibration: counts",
}


@command(first="out response response_for channels bench start end columns sample_unit json")
@with_logging
@with_estimate_options
def import_(
    sources: list[str],
    *,
    out: Annotated[Path, NEW_RECORDING],
    bench: Path | None = None,
    response: list[Path] | None = None,
    response_for: list[str] | None = None,
    sampling_rates: Annotated[list[str] | None, typer.Option("--sampling-rate")] = None,
    channels: list[str] | None = None,
    start: str | None = None,
    end: str | None = None,
    columns: str = "",
    sample_unit: str = "",
    overlap: str | None = None,
    net: str = "*",
    sta: str = "*",
    loc: str = "*",
    json: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Convert files of other programs into a recording.

    A sensor may be in several files. Memory does not depend on their length. A file or channel that
    cannot be used is listed at the end; the others are imported, and the exit code is 3.

    miniSEED: a sensor is network.station.location, a channel is its code.

    .npz, .mat: sampling_rate (Hz), start_time (UTC, optional), and for each sensor an array of
    counts (n_samples, n_channels) under its name.

    .csv, .lvm: a header such as: time (s), A.X (m/s²), A.Y (m/s²), B.X
    (m/s²); or --columns.

    .wav: a file is a sensor, its channels are numbered.

    Also SAC, GSE2, GCF, SEG-2, SEG-Y (extra: formats), UFF 58 and TDMS (extra: vibration).

    Parameters
    ----------
    sources : SRC
        Files, sds://ROOT for an archive of day files, or fdsn://CENTRE/NET.STA.LOC.CHA for a data
        centre.
    out : FILE
        Recording to write (.h5).
    bench : BENCH
        Bench file with sensitivities, names and settings.
    sampling_rates : HZ|SENSOR=HZ
        Sampling rate, if the files do not give it; or that of a sensor, in place of the recorded
        one (B=100.9), which may be repeated.
    start : UTC
        First time to import: 2026-11-21T03:00:00.
    end : UTC
        End of the time to import.
    columns : NAMES
        Names of the columns of CSV files, in place of their headers; - leaves one out: 'time [s],X
        [m/s²],Y [m/s²],-'.
    sample_unit : UNIT
        Unit of the samples, such as m/s², where files have none and no --response.
    overlap : refuse|first|last
        Where files overlap with different samples: refuse the channel (default), or keep the
        samples of the file that starts first or last. A number, such as 0.75, is the overlap of
        segments.

    Examples
    --------
    huddle import *.mseed --response RESP.XX.ABC.00.HNZ --out lab.h5
    huddle import day*.mseed --channels 'HH?' --overlap first --out month.h5
    huddle import sds://archive --net XX --start 2026-11-01 --end 2026-11-08 --out week.h5
    huddle import 'fdsn://EARTHSCOPE/IU.ANMO.{00,10}.BH?' --start 2026-11-01 --end 2026-11-02
        --out anmo.h5
    huddle import samples.csv --bench lab.toml --out lab.h5
    huddle import corrected.mseed --sample-unit m/s² --out lab.h5

    Worked example
    --------------
    $ huddle import *.mseed --response station.xml --out lab.h5
    all channels: response, 1.2655e+09 counts per m/s; 11 poles, 6 zeros
    chosen for the estimate: segment 16m40s (lower corner 120 s); unit m/s²
    lab.h5 written; next: huddle estimate lab.h5
    """
    from daq.bench.loading import parse
    from daq.formats.importer import import_files
    from tui.runs.estimate_settings import chosen_for_files

    if overlap not in {None, "refuse", "first", "last"}:
        wanted["overlap"], overlap = read_option("overlap", overlap), None
    rates = sampling_rates or []
    of_sensors = [each for each in rates if "=" in each]
    wanted["sampling_rates"] = read_option("sampling_rates", of_sensors)
    given = any(value is not None for value in wanted.values())
    result = import_files(
        sources,
        out,
        bench=None if bench is None else parse(bench.read_text(encoding="utf-8"), bench),
        estimate=partial(chosen_for_files, **wanted) if given else None,
        response=response or [],
        response_for=[assigned(text) for text in response_for or []],
        sampling_rate=_rate([each for each in rates if each not in of_sensors]),
        selection=selected(
            channels=channels or [],
            start=start,
            end=end,
            overlap=overlap,
            codes=(net, sta, loc),
            columns=columns,
            unit=sample_unit,
        ),
    )
    _show(result, out, json)
    write_json(json, {"recording": str(out), **asdict(result)})
    if result.problems:
        raise typer.Exit(ExitCode.TROUBLE)


def selected(
    *,
    channels: Sequence[str],
    start: str | None = None,
    end: str | None = None,
    overlap: str | None = None,
    codes: tuple[str, str, str] = ("*", "*", "*"),
    columns: str = "",
    unit: str = "",
) -> Selection:
    """Return what is to be taken from files.

    Raises
    ------
    typer.BadParameter
        A time is not understood, or the end is not after the start.
    """
    from daq.formats.sources import Selection

    start_ns, end_ns = _instant_ns("--start", start), _instant_ns("--end", end)
    if start_ns is not None and end_ns is not None and end_ns <= start_ns:
        raise typer.BadParameter(f"--end {end}: expected a time after --start {start}")
    networks, stations, locations = codes
    return Selection(
        channels=[part.strip() for each in channels for part in each.split(",") if part.strip()],
        start_ns=start_ns,
        end_ns=end_ns,
        overlap=cast("Any", overlap or "refuse"),
        networks=networks,
        stations=stations,
        locations=locations,
        columns=columns,
        unit=unit,
    )


def _instant_ns(flag: str, text: str | None) -> int | None:
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise typer.BadParameter(
            f"{flag} {text!r}: expected UTC as in 2026-11-21 or 2026-11-21T03:00:00"
        ) from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    since = moment - datetime(1970, 1, 1, tzinfo=UTC)
    return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1000


def _rate(given: Sequence[str]) -> float | None:
    """Return a sampling rate in Hz, if one is given."""
    try:
        (rate,) = map(float, given) if given else (None,)
    except ValueError:
        rate = 0.0
    if rate is not None and not 0 < rate < math.inf:
        raise typer.BadParameter(
            f"--sampling-rate {', '.join(given)}: expected one rate in Hz such as 100, or B=100.9"
        )
    return rate


def assigned(text: str) -> tuple[str, Path]:
    """Return pattern and file of ``PATTERN=FILE``."""
    pattern, equals, path = text.partition("=")
    if not pattern or not equals or not path:
        raise typer.BadParameter(
            f"--response-for {text}: expected PATTERN=FILE, as in 'XX.ABC.*=RESP.file'"
        )
    return pattern, Path(path)


def _calibrations(result: ImportResult) -> list[str]:
    """Return a line for each kind of calibration that was taken, with the channels it is of."""
    alike: dict[str, list[str]] = {}
    for each in result.calibrations:
        text = _ORIGINS[each.origin]
        if each.origin != "none":
            text += f", {each.sensitivity:.6g} counts per {each.unit}"
        alike.setdefault("; ".join([text, *each.notes]), []).append(each.channel)
    if len(alike) == 1:
        return [f"all channels: {text}" for text in alike]
    return [f"{_by_sensor(names)}: {text}" for text, names in alike.items()]


def _by_sensor(names: Sequence[str]) -> str:
    """Return names of channels with that of their sensor once: ``XX.ABC.00 HHZ HHN``."""
    found: dict[str, list[str]] = {}
    for name in names:
        sensor, _, channel = name.rpartition(".")
        found.setdefault(sensor, []).append(channel)
    return ", ".join(f"{sensor} {' '.join(channels)}" for sensor, channels in found.items())


def _show(result: ImportResult, out: Path, json: str | None) -> None:
    from daq.bench.durations import format_duration
    from estimator.wording import several
    from tui.wording.formatting import utc

    rows = (
        (
            *(entry.sensor, " ".join(entry.channels), f"{entry.sampling_rate:g} Hz"),
            *("no date" if entry.undated else utc(entry.start_utc_ns), entry.n_samples),
            f"{entry.n_gaps} ({several(entry.missing, 'sample')})" if entry.n_gaps else "none",
        )
        for entry in result.sensors
    )
    titles = ("sensor", "channels", "rate", "start (UTC)", "samples", "gaps")
    screen = for_people(json)
    screen.print(Table.of(titles, rows, right=titles[-2:]))
    for entry in result.sensors:
        if entry.resampled:
            screen.print(
                f"{entry.sensor}: resampled to the instants of {entry.channels[0]}:"
                f" {' '.join(entry.resampled)}"
            )
        if entry.absent:
            lacking = ", ".join(
                f"{name} {format_duration(round(n / entry.sampling_rate, 3))}"
                + (f" in {n_stretches} pieces" if n_stretches > 1 else "")
                for name, n, n_stretches in entry.absent
            )
            screen.print(
                f"{entry.sensor}: missing where other channels have samples: {lacking}",
                soft_wrap=True,
            )
    show_taken(result, screen)
    show_chosen(result.chosen, screen)
    screen.print(f"{out} written; next: huddle estimate {out}")


def show_taken(result: ImportResult, screen: Console) -> None:
    """Print the calibration of every channel, and what was assumed, left aside or not imported."""
    for line in _calibrations(result):
        screen.print(line, soft_wrap=True)
    for reason in sorted(set(result.left_aside.values())):
        names = [name for name, why in result.left_aside.items() if why == reason]
        screen.print(f"left aside ({reason}): {' '.join(sorted(names))}")
    undated = {each.undated: each.sensor for each in result.sensors if each.undated}
    who = ", ".join(undated.values())
    if undated and not all(each.undated for each in result.sensors):
        text = "taken to begin in 1970, where the others have no samples; give all files dates"
        notices().print(f"no date in the files of {who}: {text}", soft_wrap=True)
    elif len(undated) > 1:
        notices().print(
            f"no date in the files of {who}: taken to begin at the same instant; otherwise give"
            " each a column of times with dates",
            soft_wrap=True,
        )
    for problem in result.problems:
        notices().print(f"not imported: {problem}", soft_wrap=True)


def show_chosen(reasons: Mapping[str, str], screen: Console) -> None:
    """Print the settings that were chosen from responses and rates."""
    if reasons:
        screen.print(f"chosen for the estimate: {'; '.join(reasons.values())}", soft_wrap=True)
