"""``huddle tui``: opens the application on a bench file or a recording."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import os
import sys
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from daq.errors import BenchFileError, FileFault
from daq.foreign_files import OWN, SUFFIXES
from tui.application.terminal.ascii_text import is_ascii_only
from tui.commands.options import command, with_estimate_options, with_log_file
from tui.output.console import check_places, notices

if TYPE_CHECKING:
    from collections.abc import Sequence

    from textual.app import App
    from textual.driver import Driver

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Sensor
    from daq.estimation.settings import Settings
    from daq.recording.interface import ReadableSensor
    from tui.application.app import HuddleApp

Shown = TypeVar("Shown")
BROWSER = "TEXTUAL_DRIVER"
"""Set by ``textual serve``: the application is shown in a browser, and needs no terminal."""


@command()
@with_log_file
@with_estimate_options
def tui(
    source: Path | None = None,
    *,
    on_event: str = "",
    baud: Annotated[int | None, typer.Option(min=1200)] = None,
    port: list[str] | None = None,
    models: str = "",
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Open the application: start, watch and stop a huddle test.

    Closing the application does not stop a recording. Opening it again shows
    the running recording. Without a bench file, or with an empty or missing
    one, the first bench opens: it searches the serial ports, and the network
    on request, shows what answers live, and writes the bench file.

    Parameters
    ----------
    source : BENCH
        Bench file, or a recording to view.
    on_event : COMMAND
        Command to start when a test ends and when a sensor is lost, with the environment variables
        HUDDLE_EVENT (ended, trouble), HUDDLE_TEXT and HUDDLE_RECORDING.
    baud
        Baud rate of the line to the terminal, which limits the output (default: that of a serial
        port, otherwise unlimited).
    port : PORT
        Without a bench file: search this port (default: all serial ports); may be repeated.

    Examples
    --------
    huddle tui lab.toml
    huddle tui recordings/lab-20261121T030000Z.h5
    """
    from tui.runs.first_bench import is_first

    if source is not None and not source.exists():
        source = _meant(source)
    wanted_first = source is None and (bool(port) or not any(Path().glob("*.toml")))
    wanted_first |= source is not None and source.suffix == ".toml" and is_first(source)
    if wanted_first and _has_terminal():
        source = first_bench(Path("bench.toml") if source is None else source, port or (), baud)
        if source is None:
            return
    if source is None:
        there = sorted(path.name for path in Path().glob("*.toml"))
        here = f"; this folder has {', '.join(there)}" if there else ""
        raise typer.BadParameter(
            f"expected a bench file (huddle init writes one) or a recording{here}; huddle demo"
            " needs neither"
        )
    open_application(source, on_event=on_event, models=models, baud=baud, **wanted)


def _meant(source: Path) -> Path:
    """Return the file of the folder that a mistyped name may mean, if a person says so.

    Raises
    ------
    BenchFileError
        There is no terminal to ask at.
    """
    ours = OWN | SUFFIXES
    there = {each.name: each for each in source.parent.glob("*.*") if each.suffix in ours}
    stems = {each.stem: each for each in there.values()}
    close = get_close_matches(source.name, there, n=1) or get_close_matches(source.name, stems, n=1)
    if not close:
        return source
    found = (there | stems)[close[0]]
    if not _has_terminal():
        problem = f"file does not exist; did you mean {found}?"
        raise BenchFileError(FileFault("", problem), source=source)
    return found if typer.confirm(f"{source} does not exist. Open {found}?", True) else source


def open_application(source: Path, **asked: Any) -> None:  # noqa: ANN401 - as of open_bench
    """Open the application on a bench file, or on a recording (``.h5``).

    `asked` is what `open_bench` takes; ``baud`` is the rate of the line to the terminal; None: that
    of a serial line, else fast.

    Raises
    ------
    BenchFileError
        The file is neither, or a bench file with errors.
    typer.BadParameter
        Standard input or output is not a terminal.
    """
    if source.suffix.lower() in {".h5", ".hdf5"}:
        open_recording(source, **asked)
    elif not source.exists() and source.suffix.lower() not in SUFFIXES:
        problem = (
            f"file does not exist; huddle init -o {source} writes a bench file, and huddle demo"
            " needs none"
        )
        raise BenchFileError(FileFault("", problem), source=source)
    else:
        open_bench(source, **asked)


def open_bench(
    path: Path,
    *,
    on_event: str = "",
    models: str = "",
    baud: int | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Open the application on a bench file."""
    from daq.devices.bench_file import load
    from daq.estimation.settings import Settings
    from tui.application.app import HuddleApp
    from tui.commands.tui_controls import BenchControls, with_comparison
    from tui.runs.estimate_settings import check_fit, chosen

    bench = load(path)
    settings = chosen(Settings.of(bench), **wanted)
    check_fit(settings, bench.sensors)
    settings = with_comparison(settings, wanted)
    masks = _models(models, settings, bench.sensors)
    controls = BenchControls(path, bench, settings, on_event=on_event, models=masks)
    try:
        _run(HuddleApp(controls, models=masks, driver=_driver(baud)), again=path)
    finally:
        controls.release()


def _driver(baud: int | None = None) -> type[Driver] | None:
    """Return the driver that the terminal needs; None: Textual's own, or the one of a browser."""
    if sys.platform == "win32" or BROWSER in os.environ or not sys.stdin.isatty():
        return None
    from tui.application.terminal.driver import (
        driver_for,
        speed_of_terminal,
    )

    speed = baud or speed_of_terminal(sys.stdin.fileno())
    return driver_for(baud=speed, is_ascii=is_ascii_only(os.environ))


def first_bench(path: Path, ports: Sequence[str], baud: int | None = None) -> Path | None:
    """Find sensors and write a bench file; None if that was left."""
    from daq.transport.serial_ports import serial_ports
    from tui.application.first_bench import FirstBenchApp
    from tui.commands.tui_controls import ComputerControls
    from tui.runs.first_bench import draft

    check_places(str(path))
    searched = list(ports) or [each.path for each in serial_ports()]
    return _shown(FirstBenchApp(ComputerControls(path, searched, draft(path)), _driver(baud)))


def _has_terminal() -> bool:
    return BROWSER in os.environ or all(
        stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)
    )


def _run(app: HuddleApp, *, again: Path) -> None:
    """Run the application; print the name of its recording, and whether it continues."""
    if not _has_terminal():
        raise typer.BadParameter(
            "the application needs a terminal, for standard input, output and error; huddle watch"
            " RECORDING and huddle run BENCH need none"
        )
    _shown(app)
    if app.state.path is None:
        return
    if app.state.is_recording:
        notices().print(
            f"The recording continues: {app.state.path}\nTo view or stop it: huddle tui {again}",
            soft_wrap=True,
        )
    else:
        notices().print(f"Recording: {app.state.path}", soft_wrap=True)


def _shown(app: App[Shown]) -> Shown | None:
    """Run an application in the colour theme that HUDDLE_THEME names; return its result.

    Raises
    ------
    typer.BadParameter
        There is no theme of this name.
    """
    from tui.application.themes import THEMES, USUAL
    from tui.output.logs.lines import screen_taken

    name = os.environ.get("HUDDLE_THEME", USUAL)
    if name not in THEMES:
        raise typer.BadParameter(
            f"HUDDLE_THEME = {name!r}: no such theme; expected {', '.join(THEMES)}"
        )
    app.theme = name
    with screen_taken():
        return app.run()


def show_demo(path: Path, settings: Settings) -> Path | None:
    """Open the application on a simulated bench and start recording; stop with the application.

    Returns
    -------
    Path or None
        The last recording, closed.
    """
    from daq.devices.bench_file import load
    from tui.application.app import HuddleApp
    from tui.commands.tui_controls import BenchControls

    # The recording of the demo is deleted when the demo ends; reports are kept.
    controls = BenchControls(path, load(path), settings, reports=Path.cwd())
    try:
        _shown(HuddleApp(controls, start=True, driver=_driver()))
        for recorder in controls.started:
            recorder.stop()
    finally:
        controls.release()
    return controls.started[-1].out if controls.started else None


def open_recording(
    path: Path,
    *,
    start: str | None = None,
    end: str | None = None,
    on_event: str = "",
    models: str = "",
    baud: int | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Open the application on a recording, growing or closed."""
    from daq.recording.reader import Recording
    from tui.application.app import HuddleApp
    from tui.commands.tui_controls import RecordingControls, with_comparison
    from tui.runs.estimate_settings import settings_for

    settings, bench = settings_for(path, start=start, end=end, **wanted)
    settings = with_comparison(settings, wanted)
    with Recording.open(path) as recording:
        masks = _models(models, settings, recording.sensors)
    controls = RecordingControls(path, settings, bench, on_event=on_event, models=masks)
    _run(HuddleApp(controls, path=path, models=masks, driver=_driver(baud)), again=path)


def _models(
    names: str, settings: Settings, sensors: Sequence[Sensor | ReadableSensor]
) -> tuple[Mask, ...]:
    """Return noise models that can be turned into the unit of the estimate.

    Raises
    ------
    WrongSettingError
        If one cannot.
    """
    from daq.bench.masks.mask_file import masks_named

    masks = masks_named(names)
    units = [c.unit for sensor in sensors for c in sensor.channels if not c.auxiliary]
    for mask in masks:
        mask.check_unit(settings.unit or units[0])
    return masks
