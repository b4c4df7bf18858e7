"""``huddle history``: the noise of each channel over months."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import io
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.caveats import Caveat
from tui.commands.options import OutOption, command
from tui.output.console import check_places, for_people, write_json, write_text
from tui.output.csv_text import csv_text
from tui.output.extras import require
from tui.service.records.run_state import utc_text

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from tui.service.history.series import Found, NoiseSeries

PICTURES = (".png", ".svg", ".pdf")
_COLUMNS = (
    *("serial_number", "sensor", "channel", "model", "bench", "due", "method", "unit"),
    *("low_hz", "high_hz", "psd", "low", "high", *Caveat),
)


def _band(text: str) -> tuple[float, float]:
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise typer.BadParameter(f"{text!r}: expected LOW:HIGH in Hz, as in 1:10") from None
    return low, high


@command()
def history(
    sources: list[Path] | None = None,
    *,
    sensor: str = "",
    band: str | None = None,
    since: Annotated[datetime | None, typer.Option(formats=["%Y-%m-%d", "%Y-%m-%dT%H:%M"])] = None,
    scatter: Annotated[float, typer.Option(min=0.0)] = 0.1,
    false_alarms: Annotated[float, typer.Option(min=1e-09, max=0.5)] = 0.01,
    json: str | None = None,
    csv: str | None = None,
    label: Path | None = None,
    out: OutOption = None,
) -> None:
    """Show the noise of every channel from run to run, and whether it has changed.

    Serial numbers identify a sensor across benches and ports. The test
    allows for the uncertainty of each run; its false-alarm rate holds for the whole history.

    Parameters
    ----------
    sources : BENCH
        Bench files, or folders of recordings.
    sensor : SERIAL
        Show this sensor only; without BENCH, its tests on all benches, by the ledger.
    band : LOW:HIGH
        Band in Hz that the runs have stored (default: all).
    since : DATE
        Leave out earlier runs (UTC, such as 2026-11-21).
    scatter : DB
        Standard deviation between runs that does not count as change, in dB.
    false_alarms : SHARE
        Probability of any false alarm in the whole history.
    label : FILE
        With --sensor: a label to print (.svg, 62 × 29 mm) with its serial number as QR code, and
        its last noise.
    out : FILE
        Picture: .png, .svg or .pdf.

    Examples
    --------
    huddle history lab.toml
    huddle history lab.toml --band 1:10 --since 2026-01-01 --out noise.png
    huddle history --sensor S4254475 --band 1:2   (its tests on all benches)
    huddle history --sensor S4254475 --label S4254475.svg   (a label to print)
    huddle history lab/recordings office/recordings --csv -   (sensors by serial number)
    """
    from tui.service.history import shown
    from tui.service.history.ledger import sensor_tests
    from tui.service.history.series import bands_of, history

    wanted = None if band is None else _band(band)
    since = None if since is None else since.replace(tzinfo=UTC)
    check_places(json, csv, None if out is None else str(out))
    if out is not None:
        require("matplotlib")
        if out.suffix.lower() not in PICTURES:
            raise typer.BadParameter(f"{out}: expected a name that ends in {', '.join(PICTURES)}")
    if label is not None:
        require("segno")
        check_places(str(label))
        if not sensor or label.suffix.lower() != ".svg":
            raise typer.BadParameter(f"--label {label}: expected --sensor, and a name in .svg")
    noise = _noise(sources or [], sensor, since)
    found = history(noise, band=wanted, scatter=scatter, false_alarms=false_alarms)
    if wanted is not None and not found:
        kept = ", ".join(f"{low:g}:{high:g}" for low, high in bands_of(noise)) or "none"
        raise typer.BadParameter(
            f"band {wanted[0]:g}:{wanted[1]:g}: no run has its noise; kept are {kept} (Hz)."
            " [history] bands in the bench file adds bands"
        )
    screen = for_people(json, csv)
    tests = sensor_tests(sensor) if sensor and not sources else []
    if tests:
        screen.print(shown.tests_table(tests))
        screen.print()
    screen.print(shown.history_table(found))
    for line in shown.history_lines(found, scatter=scatter, false_alarms=false_alarms):
        screen.print(line, soft_wrap=True)
    write_json(
        json,
        {
            "false_alarms": false_alarms,
            "scatter_db": scatter,
            "series": [series.document() for series in found],
            "tests": [each.document() for each in tests],
        },
    )
    if csv is not None:
        write_text(csv, csv_text(_COLUMNS, _rows(found)))
    if label is not None:
        write_text(str(label), shown.label_svg(sensor, shown.label_lines(found)))
    if out is not None:
        from daq.whole_file import write_whole

        content = io.BytesIO()
        shown.history_figure(found).savefig(content, format=out.suffix.removeprefix("."), dpi=150)
        write_whole(out, content.getvalue())


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


def _rows(found: Sequence[NoiseSeries]) -> Iterator[list[object]]:
    for series in found:
        for (bench, due), noise in zip(series.runs, series.noise, strict=True):
            own = {"bench": bench, "due": utc_text(due), **series.caveats.keys}
            yield [own[name] if name in own else getattr(noise, name) for name in _COLUMNS]
