"""``huddle history``: the noise of each channel over months."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tui.commands.options import CsvOption, JsonOption, examples
from tui.output.csv_text import csv_text
from tui.output.extras import require
from tui.service.records.run_state import utc_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rich.table import Table

    from tui.service.history.series import Found, Series

_WIDTH, _HEIGHT = 8.0, 2.4
"""Inches, of one sensor."""
PICTURES = (".png", ".svg", ".pdf")
_COLUMNS = (
    *("serial_number", "sensor", "channel", "model", "bench", "due", "method", "unit"),
    *("low_hz", "high_hz", "psd", "low", "high"),
)


def _band(text: str) -> tuple[float, float]:
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise typer.BadParameter(f"{text!r}: expected LOW:HIGH in Hz, as in 1:10") from None
    return low, high


@examples(
    "huddle history lab.toml",
    "huddle history lab.toml --band 1:10 --since 2026-01-01 --out noise.png",
    "huddle history --sensor S4254475 --band 1:2   (its tests on all benches)",
    "huddle history lab/recordings office/recordings --csv -   (sensors by serial number)",
)
def history(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(metavar="BENCH", help="Bench files, or folders of recordings."),
    ] = None,
    *,
    sensor: Annotated[
        str,
        typer.Option(
            "--sensor",
            metavar="SERIAL",
            help="Show this sensor only; without BENCH, its tests on all benches, by the ledger.",
        ),
    ] = "",
    band: Annotated[
        str | None,
        typer.Option(
            "--band",
            metavar="LOW:HIGH",
            help="Band in Hz that the runs have stored (default: all).",
        ),
    ] = None,
    since: Annotated[
        datetime | None,
        typer.Option(
            "--since",
            formats=["%Y-%m-%d", "%Y-%m-%dT%H:%M"],
            metavar="DATE",
            help="Leave out earlier runs (UTC, such as 2026-11-21).",
        ),
    ] = None,
    scatter: Annotated[
        float,
        typer.Option(
            "--scatter",
            min=0.0,
            metavar="DB",
            help="Standard deviation between runs that does not count as change, in dB.",
        ),
    ] = 0.1,
    false_alarms: Annotated[
        float,
        typer.Option(
            "--false-alarms",
            min=1e-9,
            max=0.5,
            metavar="SHARE",
            help="Probability of any false alarm in the whole history.",
        ),
    ] = 0.01,
    json: JsonOption = None,
    csv: CsvOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Picture: .png, .svg or .pdf."),
    ] = None,
) -> None:
    """Show the noise of every channel from run to run, and whether it has changed.

    Serial numbers identify a sensor across benches and ports. The test
    allows for the uncertainty of each run; its false-alarm rate holds for the whole history.
    """
    from tui.output.console import check_places, for_people, write_json, write_text
    from tui.service.history.series import bands_of, history

    wanted = None if band is None else _band(band)
    since = None if since is None else since.replace(tzinfo=UTC)
    check_places(json, csv, None if out is None else str(out))
    if out is not None:
        require("matplotlib")
        if out.suffix.lower() not in PICTURES:
            raise typer.BadParameter(f"{out}: expected a name that ends in {', '.join(PICTURES)}")
    noise = _noise(sources or [], sensor, since)
    found = history(noise, band=wanted, scatter=scatter, false_alarms=false_alarms)
    if wanted is not None and not found:
        kept = ", ".join(f"{low:g}:{high:g}" for low, high in bands_of(noise)) or "none"
        raise typer.BadParameter(
            f"band {wanted[0]:g}:{wanted[1]:g}: no run has its noise; kept are {kept} (Hz)."
            " [history] bands in the bench file adds bands"
        )
    screen = for_people(json, csv)
    screen.print(_table(found))
    n_changed = 0
    for series in found:
        for line in change_lines(series):
            n_changed += 1
            screen.print(line, style="yellow")
        left_out = len(series.noise) - len(series.usable)
        if left_out:
            screen.print(f"{series.name}: {left_out} runs not tested: their interval reaches zero")
    if found:
        screen.print(
            f"{'No change' if not n_changed else 'Changes'} beyond uncertainty and"
            f" {scatter:g} dB of scatter from run to run. The test gives a false alarm in"
            f" {false_alarms:.2g} of all histories without a change, however long they become.",
            soft_wrap=True,
        )
    write_json(
        json,
        {
            "false_alarms": false_alarms,
            "scatter_db": scatter,
            "series": [series.document() for series in found],
        },
    )
    if csv is not None:
        write_text(csv, csv_text(_COLUMNS, _rows(found)))
    if out is not None:
        write_figure(found, out)


def _noise(sources: list[Path], sensor: str, since: datetime | None) -> list[Found]:
    """Return the noise that the runs of benches have stored, or that the ledger has of a sensor."""
    from tui.service.history.ledger import ledger_path, noise_of
    from tui.service.records.places import Place

    if sources:
        places = [Place.of(source) for source in sources]
        noise = [found for place in places for found in place.store.noise(place.bench_name, since)]
        return [found for found in noise if not sensor or found[2].serial_number == sensor]
    if not sensor:
        raise typer.BadParameter("expected BENCH, or --sensor SERIAL")
    noise = [found for found in noise_of(sensor) if since is None or found[1] >= since]
    if not noise:
        raise typer.BadParameter(
            f"--sensor {sensor}: no test in the ledger of sensors ({ledger_path() or 'off'})"
        )
    return noise


def write_figure(found: Sequence[Series], out: Path) -> None:
    """Write a picture with a panel for each sensor and band, and lines where noise has changed.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    from matplotlib.figure import Figure

    from daq.bench.units import decibels
    from tui.report.figures.drawing import look

    panels: dict[tuple[str, float, float, str], list[Series]] = {}
    for series in found:
        last = series.last
        sensor = f"{last.sensor} {last.serial_number}".strip()
        panels.setdefault((sensor, last.low_hz, last.high_hz, last.unit), []).append(series)
    with look():
        figure = Figure(figsize=(_WIDTH, 0.8 + _HEIGHT * max(1, len(panels))), layout="constrained")
        axes = figure.subplots(max(1, len(panels)), squeeze=False, sharex=True)[:, 0]
        for panel, ((sensor, low, high, unit), own) in zip(axes, panels.items(), strict=False):
            for number, series in enumerate(own):
                colour = f"C{number}"
                used = series.usable
                dates = [series.runs[n][1] for n in used]
                noise = [series.noise[n] for n in used]
                middle = [decibels(each.psd) for each in noise]
                below = [decibels(each.psd) - decibels(each.low) for each in noise]
                above = [decibels(each.high) - decibels(each.psd) for each in noise]
                panel.errorbar(
                    dates,
                    middle,
                    yerr=[below, above],
                    fmt="o-",
                    markersize=3,
                    linewidth=0.7,
                    color=colour,
                    label=series.last.channel,
                )
                for change in series.changes:
                    panel.axvline(series.due_of(change.first), color=colour, linestyle="--")
            panel.set_title(f"{sensor}, {low:.3g} to {high:.3g} Hz", loc="left")
            panel.set_ylabel(f"noise, dB re 1 ({unit})²/Hz")
            panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        axes[-1].set_xlabel("date (UTC); bars: 95 % intervals; dashed: change")
        figure.savefig(out, dpi=150)


def _table(found: Sequence[Series]) -> Table:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("serial number", "sensor", "channel", "band (Hz)", "unit²/Hz of"):
        table.add_column(name)
    for name in ("runs", "first (dB)", "last (dB)"):
        table.add_column(name, justify="right")
    table.add_column("changed")
    for series in found:
        last = series.last
        table.add_row(
            *(last.serial_number or "-", last.sensor, last.channel),
            *(f"{last.low_hz:.3g} to {last.high_hz:.3g}", last.unit, str(len(series.noise))),
            *(level(series.noise[0].psd, *_ends(series, 0)), level(last.psd, *_ends(series, -1))),
            f"{len(series.changes)} ×" if series.changes else "no",
        )
    return table


def _ends(series: Series, position: int) -> tuple[float, float]:
    noise = series.noise[position]
    return noise.low, noise.high


def level(psd: float, low: float, high: float) -> str:
    """Return a PSD in dB with half the width of its interval."""
    from daq.bench.units import decibels

    if not psd > 0:
        return "below 0"
    if not 0 < low <= high:
        return f"below {decibels(high):.2f}"
    return f"{decibels(psd):.2f} ±{(decibels(high) - decibels(low)) / 2:.2f}".replace("-", "−")


def change_lines(series: Series) -> Iterator[str]:
    """Yield a sentence for each change of a channel."""
    from daq.results.change_test import DECIBEL, NORMAL_95

    for change in series.changes:
        first, found = series.due_of(change.first), series.due_of(change.found)
        shift, width = change.shift / DECIBEL, NORMAL_95 * change.deviation / DECIBEL
        serial = f" ({series.last.serial_number})" if series.last.serial_number else ""
        yield (
            f"{series.name}{serial}, {series.last.low_hz:.3g} to {series.last.high_hz:.3g} Hz:"
            f" {shift:+.2f} ±{width:.2f} dB since {first:%Y-%m-%d %H:%M}, decided by the run of"
            f" {found:%Y-%m-%d %H:%M}"
        )


def _rows(found: Sequence[Series]) -> Iterator[list[object]]:
    for series in found:
        for (bench, due), noise in zip(series.runs, series.noise, strict=True):
            own = {"bench": bench, "due": utc_text(due)}
            yield [own[name] if name in own else getattr(noise, name) for name in _COLUMNS]
