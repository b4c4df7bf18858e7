"""``huddle archive``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import zoneinfo
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tui.commands.options import OutOption, command, with_estimate_options, with_logging
from tui.output.console import check_places, notices
from tui.output.extras import load, require

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.archive.stations import Run
    from daq.archive.waveforms import FileReading
    from daq.formats.assembly import Overlap


@command(first="store stretch jobs out band segment response channels json csv")
@with_logging
@with_estimate_options
def archive(
    sources: list[str] | None = None,
    *,
    store: Path | None = None,
    stretch: str | None = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1)] = 1,
    scheduler: str | None = None,
    thin_after: Annotated[int | None, typer.Option(min=0)] = None,
    thin_hours: bool = False,
    out: OutOption = None,
    models: str = "",
    time_zone: str = "UTC",
    false_alarm: Annotated[float, typer.Option(min=0.0001, max=0.5)] = 0.01,
    response: list[Path] | None = None,
    response_for: list[str] | None = None,
    channels: list[str] | None = None,
    net: str = "*",
    sta: str = "*",
    loc: str = "*",
    group: list[str] | None = None,
    start: str | None = None,
    end: str | None = None,
    file_overlap: str = "refuse",
    json: str | None = None,
    csv: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Keep the spectra of months of recordings, and show the noise over time.

    The spectra of every hour (or day) are stored in the archive. Recordings
    that it holds are not read again: an interrupted command continues, and a
    later one adds new recordings only. The result is the noise of all
    recordings together and of every day, its drift, changes beyond
    uncertainty, and the difference between working hours and nights.

    Of waveform files, each station has an archive of its own in the folder,
    and a day of a station is the unit of work.

    Options that shape spectra (--segment, …) cannot be changed later.

    Parameters
    ----------
    sources : SRC
        Recordings, miniSEED files, folders of either, or sds://ROOT for an archive of day files.
        Without SRC, show what the archive holds.
    store : FOLDER
        Folder of the archive (default: huddle-archive beside the recordings).
    stretch : LENGTH
        Length of time of each stored spectrum: hour or day, in UTC (default: hour).
    jobs : N
        Number of processes.
    scheduler : ADDRESS
        Use the workers of this Dask scheduler, such as tcp://host:8786. They must see recordings
        and archive under the same paths.
    thin_after : DAYS
        Keep the matrices of hours for so many days before the last recording; of older ones those
        of days, in single precision.
    thin_hours
        With --thin-after: keep also the matrices of older hours, in single precision.
    out : FOLDER
        Folder for figures (PNG, SVG, PDF) and their numbers.
    time_zone : ZONE
        Time zone of working hours and nights, such as Europe/London.
    false_alarm : SHARE
        Probability of a false alarm of the test for changes, over all channels, bands and days.

    Files of other programs
    -----------------------
    group : NAME=PATTERN
        Sensors of several stations that stand together, as in 'LAB=XX.TST?.*'; repeatable. Default:
        the sensors of a station.
    start : UTC
        First time to take, such as 2026-11-21; its day is taken whole.
    end : UTC
        End of the time to take; the day before it is taken whole.
    file_overlap : refuse|first|last
        Where files overlap with different samples: refuse the channel of this day, or keep the
        samples of the file that starts first or last.

    Examples
    --------
    huddle archive recordings/ --jobs 4 --out figures
    huddle archive recordings/ --stretch day --segment 100s --store slow
    huddle archive day-*.h5 --scheduler tls://10.0.0.1:8786 --store /shared/archive
    huddle archive --store recordings/huddle-archive --band 1:20 --json - --csv days.csv
    huddle archive sds:///data/sds --net XX --response stations.xml --jobs 4 --store archive
    """
    from daq.archive.plan import STRETCHES
    from daq.archive.sources import are_waveforms, folder_for
    from daq.bench.masks.mask_file import masks_named
    from daq.estimation.settings import Settings
    from tui.commands.archive_answers import Asked, watched
    from tui.commands.import_ import selected
    from tui.runs.archives import Filling
    from tui.runs.estimate_settings import chosen, settings_for

    sources = sources or []
    check_places(json, csv)
    if stretch not in {None, *STRETCHES}:
        raise typer.BadParameter(f"--stretch {stretch}: expected hour or day")
    if thin_hours and thin_after is None:
        raise typer.BadParameter("--thin-hours: give --thin-after DAYS also")
    if out is not None:
        require("matplotlib")
    if scheduler is not None:
        require("distributed")
    asked = Asked(
        wanted=wanted,
        stretch=stretch,
        masks=masks_named(models),
        zone=_zone(time_zone),
        false_alarm=false_alarm,
        thin=(thin_after, thin_hours),
        json=json,
        csv=csv,
        out=out,
        run=_runner(jobs, scheduler),
    )
    folder = folder_for(sources) if store is None else store
    options = {
        "--response": response,
        "--response-for": response_for,
        "--channels": channels,
        "--net": net != "*",
        "--sta": sta != "*",
        "--loc": loc != "*",
        "--group": group,
        "--start": start,
        "--end": end,
        "--file-overlap": file_overlap != "refuse",
    }
    filling = Filling(
        folder,
        stretch,
        asked.run,
        asked.checked,
        refuse=typer.BadParameter,
        asked="codes and times; check the folder, --start and --end",
        grouped=". If they are of several stations, say so: --group 'LAB=XX.TST?.*'",
        say=partial(notices().print, soft_wrap=True),
        watched=watched,
    )
    if are_waveforms(sources):
        if file_overlap not in {"refuse", "first", "last"}:
            expected = "expected refuse, first or last"
            raise typer.BadParameter(f"--file-overlap {file_overlap}: {expected}")
        codes, wanted_channels = (net, sta, loc), channels or []
        selection = selected(
            channels=wanted_channels, start=start, end=end, overlap=file_overlap, codes=codes
        )
        reading = _reading(response or [], response_for or [], selection.overlap)
        settings, groups = chosen(Settings(), **wanted), [_group(text) for text in group or []]
        with notices().status("looking for files"):
            found = filling.look(sources, selection, settings, groups)
        stores, failures = filling.by_days(*found, settings, reading)
    elif given := [flag for flag, value in options.items() if value]:
        raise typer.BadParameter(f"{', '.join(given)}: for waveform files, such as sds://ROOT")
    else:
        stores, failures = filling.by_recordings(
            list(map(Path, sources)), lambda path: settings_for(path, **wanted)[0]
        )
    asked.show(list(stores.values()), failures)


def _zone(name: str) -> zoneinfo.ZoneInfo:
    """Return a time zone by its name."""
    try:
        return zoneinfo.ZoneInfo(name)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError):
        raise typer.BadParameter(
            f"--time-zone {name}: expected a name such as Europe/London"
        ) from None


def _runner(jobs: int, scheduler: str | None) -> Run:
    """Return what carries out tasks: processes here, or the workers of a cluster."""
    from daq.archive.execution import carried_out, on_cluster

    if scheduler is None:
        return lambda tasks: carried_out(tasks, jobs=jobs)
    from estimator.wording import several

    address, told = scheduler, set[str]()

    def connected(dashboard: str, n_workers: int) -> None:
        waiting = "" if n_workers else "; work begins when there is one"
        if not told:
            workers = f"{several(n_workers, 'worker')}{waiting}"
            notices().print(f"{workers}; dashboard: {dashboard}", soft_wrap=True)
        told.add(dashboard)

    return lambda tasks: on_cluster(tasks, address, load("distributed"), connected=connected)


def _reading(
    responses: Sequence[Path], response_for: Sequence[str], overlap: Overlap
) -> FileReading:
    """Return how files are read."""
    from tui.commands.import_ import assigned
    from tui.runs.archives import reading_of

    pairs = [assigned(text) for text in response_for]
    for path in [*responses, *(path for _, path in pairs)]:
        if not path.exists():
            raise typer.BadParameter(f"--response {path}: no such file or folder")
    return reading_of(responses, pairs, overlap)


def _group(text: str) -> tuple[str, str]:
    """Return name and pattern of ``NAME=PATTERN``."""
    name, equals, pattern = text.partition("=")
    if not equals or not pattern or not all(c.isalnum() or c in "._-" for c in name.strip(".")):
        raise typer.BadParameter(f"--group {text}: expected NAME=PATTERN, as in 'LAB=XX.TST?.*'")
    return name, pattern
