"""Opens the application on a bench or on a recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from rich.table import Table

from daq.bench import load
from daq.clock import SystemClock
from daq.control import ask
from daq.errors import HuddleError
from daq.estimation import Settings
from daq.recorder import recording_path
from daq.recording.reader import Recording
from tui.application.app import HuddleApp
from tui.estimating import chosen
from tui.finding import running_recording
from tui.recorder_process import RecorderProcess

if TYPE_CHECKING:
    from pathlib import Path

    from daq.bench import Bench

ALWAYS = ("three-sensor", "three-channel")
"""Estimates that cost little: shown beside the bench's own, for comparison."""


@dataclass
class BenchControls:
    """Controls of a bench file: recorders are started as processes of their own."""

    path: Path
    bench: Bench
    settings: Settings
    can_start: bool = True
    started: list[RecorderProcess] = field(default_factory=list)

    @property
    def name(self) -> str:
        """The bench's name."""
        return self.bench.name

    def description(self) -> Table:
        """Return the sensors that will be recorded."""
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold #9aa5b8")
        for column in ("sensor", "model", "driver", "port", "channels"):
            table.add_column(column, no_wrap=True)
        for sensor in self.bench.sensors:
            channels = " ".join(channel.name for channel in sensor.channels)
            table.add_row(sensor.name, sensor.model, sensor.driver, sensor.port, channels)
        return table

    def start(self) -> Path:
        """Start a recorder; returns its file once that is there."""
        out = recording_path(self.bench, SystemClock().now())
        recorder = RecorderProcess(self.path, out, duration=self.bench.recording.duration)
        self.started.append(recorder)
        recorder.wait_for_file()
        return out

    def find_running(self) -> Path | None:
        """Return the file of a recorder of this bench that runs already."""
        return running_recording(self.bench)

    def stop(self, path: Path) -> None:
        """Ask the recorder of a file to stop."""
        ask(path, "stop")

    def mark(self, path: Path, text: str) -> None:
        """Ask the recorder of a file to record a remark."""
        ask(path, "mark", text)

    def release(self) -> None:
        """Forget the recorders; they go on."""
        for recorder in self.started:
            recorder.close()


@dataclass(frozen=True)
class RecordingControls:
    """Controls of a recording that is looked at: it can be stopped and marked while it grows."""

    path: Path
    settings: Settings
    can_start: bool = False

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.stem

    def description(self) -> str:
        """Return what to show until the first snapshot is there."""
        return "opening …"

    def start(self) -> Path:
        """Refuse."""
        raise HuddleError("this is a recording; huddle tui BENCH starts one")

    def find_running(self) -> Path:
        """Return the recording itself."""
        return self.path

    def stop(self, path: Path) -> None:
        """Ask the recorder to stop."""
        ask(path, "stop")

    def mark(self, path: Path, text: str) -> None:
        """Ask the recorder to record a remark."""
        ask(path, "mark", text)


def open_application(source: Path, *, method: str | None) -> None:
    """Open the application on a bench file, or on a recording (``.h5``)."""
    if source.suffix == ".h5":
        open_recording(source, method=method)
    else:
        open_bench(source, methods=None if method is None else (str(method),))


def open_bench(path: Path, *, methods: tuple[str, ...] | None = None) -> None:
    """Open the application on a bench file."""
    bench = load(path)
    settings = Settings.of(bench)
    settings = replace(settings, methods=methods or _beside(settings.methods))
    controls = BenchControls(path, bench, settings)
    try:
        HuddleApp(controls).run()
    finally:
        controls.release()


def show_demo(path: Path, settings: Settings) -> Path | None:
    """Open the application on a simulated bench, recording at once; stop with the application.

    Returns
    -------
    Path or None
        The last recording, closed.
    """
    controls = BenchControls(path, load(path), settings)
    try:
        HuddleApp(controls, start=True).run()
        for recorder in controls.started:
            recorder.stop()
    finally:
        controls.release()
    return controls.started[-1].out if controls.started else None


def open_recording(path: Path, *, method: str | None = None) -> None:
    """Open the application on a recording, growing or closed."""
    with Recording.open(path) as recording:
        settings = chosen(Settings.of(recording.bench), method=method)
    if method is None:
        settings = replace(settings, methods=_beside(settings.methods))
    HuddleApp(RecordingControls(path, settings), path=path).run()


def _beside(methods: tuple[str, ...]) -> tuple[str, ...]:
    if "all" in methods:
        return methods
    return tuple(dict.fromkeys((*methods, *ALWAYS)))
