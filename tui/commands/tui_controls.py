"""What the application asks of a bench, and of a recording: start, stop, read, write, announce."""

from __future__ import annotations

import asyncio
import logging
import os
import shlex
import subprocess
import threading
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import typer

from daq.bench.durations import format_duration
from daq.bench.editing import with_values
from daq.devices.bench_file import parse
from daq.devices.registry import present_ports
from daq.errors import BenchFileError, HuddleError, RecordingError
from daq.host_clock import SystemClock
from daq.preflight.device_check import DiscoveredDevice, discover, network_ports
from daq.preflight.findings import CheckOutcome
from daq.preflight.preview import SensorPreview, preview
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.recording.storage.names import continuations, continued_name, recording_path
from daq.results.store import store_results
from daq.whole_file import write_whole
from tui.certificate.ledger import ledger_of
from tui.commands.check import examined_bench
from tui.commands.runs import RunNotFoundError, runs_named
from tui.commands.verify import known_to_services
from tui.output.check_list import sentence
from tui.output.console import write_json
from tui.output.csv_text import write_metadata
from tui.output.extras import require
from tui.output.json_document import document, provenance
from tui.output.results import curves_csv
from tui.runs.estimate_settings import settings_for
from tui.runs.recorder_process import RecorderProcess
from tui.service.history.ledger import noted
from tui.service.records.places import NoServiceError, Place
from tui.simulation.host_time import host_time

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.results.result import Result
    from tui.application.controls import Preview
    from tui.application.plan import TestPlan

_LOGGER = logging.getLogger(__name__)
LATEST = 16
"""How many of the newest recordings are looked at: several benches may have one folder."""


def running_recording(bench: Bench) -> Path | None:
    """Return the newest recording of this bench whose recorder answers: the first of its parts."""
    found = bench.recording_directory.glob("*.h5")
    files = sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)
    return next((first_part(path) for path in files[:LATEST] if _runs(path, bench)), None)


def is_of(path: Path, bench: Bench) -> bool:
    """Return whether a recording was made with the drivers, ports and serial numbers of a bench.

    Raises
    ------
    RecordingError
        If it cannot be read.
    """
    with Recording.open(path) as recording:
        return recording.bench is not None and recording.bench.identity == bench.identity


def first_part(path: Path) -> Path:
    """Return the first of the recordings that this one continues after disk errors.

    Itself, if it continues none, or if the one that it continues is no longer in its folder.
    """
    with Recording.open(path) as recording:
        continues = recording.continues
    start = continued_name(path)
    if not continues or start is None:
        return path
    parts = dict(_part(name) for name in (start, *continuations(start)) if name != path)
    first = path
    while continues in parts:
        first, continues = parts.pop(continues)
    return first


def _part(path: Path) -> tuple[str, tuple[Path, str]]:
    """Return the run_id of a recording, with its path and the run_id that it continues."""
    try:
        with Recording.open(path) as recording:
            return recording.run_id, (path, recording.continues)
    except RecordingError:  # there is none, or another file has such a name
        return "", (path, "")


def _runs(path: Path, bench: Bench) -> bool:
    try:
        with Recording.open(path) as recording:
            is_closed = recording.closed
        if is_closed or not is_of(path, bench):
            return False
        ask(path, "status")
    except HuddleError:
        return False
    return True


COMPARISON_METHODS = ("three-sensor", "three-channel")
"""Cheap methods, shown for comparison with the chosen ones."""
HOOK_TIMEOUT = 60.0
"""Seconds after which a command for events is ended."""


class _Controls:
    """What a bench and a recording have in common: messages to recorders, settings, events."""

    on_event: str
    models: tuple[Mask, ...]
    reports: Path | None = None
    """Folder of reports; None: beside their recordings."""

    def stop(self, path: Path) -> None:
        """Ask the recorder of a file to stop."""
        self._check_own(path)
        ask(path, "stop")

    def mark(self, path: Path, text: str) -> None:
        """Ask the recorder of a file to record a remark."""
        self._check_own(path)
        ask(path, "mark", text)

    def _check_own(self, path: Path) -> None:
        """Raise an error if a recording is not to be stopped or marked from here."""

    def announce(self, event: str, text: str, path: Path | None) -> None:
        """Start the command that the user gave for events."""
        announce(self.on_event, event, text, path)

    def report(self, path: Path, result: Result) -> Path:
        """Write the report."""
        require("matplotlib", "jinja2")
        from tui.report.writing import write  # noqa: PLC0415 - loads matplotlib

        out = (self.reports or path.parent) / f"{path.stem}.html"
        return write(result, out, models=self.models, taken="beside")[1]

    def save(self, path: Path, result: Result) -> tuple[Path, ...]:
        """Write CSV and JSON beside the recording, or with the reports."""
        return save_result(path, result, folder=self.reports or path.parent)

    def noted(self, path: Path, result: Result) -> list[str]:
        """Write a test into the ledger of sensors; return how they have changed."""
        return noted(path, result)

    def described(self, path: Path) -> Bench | None:
        """Return the bench that describes the parties of a certificate; None: the recorded one."""
        del path
        return None

    def certify(self, path: Path, result: Result, wanted: Mapping[str, str]) -> Path:
        """Issue a certificate beside a recording, or make a specimen.

        Raises
        ------
        HuddleError
            If a certificate is refused.
        """
        require("matplotlib", "jinja2", "fpdf", "pypdf")
        from tui.certificate import issuing  # noqa: PLC0415 - loads matplotlib

        own: dict[str, Any] = {key: wanted[key] for key in ("by", "reason", "despite")}
        order = issuing.Order(about=self.described(path), **own)
        examined = issuing.examine([path], order, known=known_to_services)
        if order.by and examined.objections:
            raise HuddleError("\n".join(each.line for each in examined.objections))
        if not order.by:
            return issuing.specimen(result, examined, path.parent)
        return issuing.issue(result, examined, ledger_of(path, examined.about))[1]

    def about(self, path: Path, changes: Mapping[str, Any]) -> tuple[Settings, Bench | None]:
        """Return the settings for a recording, with changes and methods for comparison; its bench.

        Raises
        ------
        HuddleError
            If it cannot be read, or the changes do not fit it.
        """
        try:
            settings, bench = settings_for(path, **changes)
        except typer.BadParameter as error:
            raise HuddleError(error.message) from None
        return with_comparison(settings, changes), bench


@dataclass
class BenchControls(_Controls):
    """Controls of a bench file, which start recorder processes."""

    path: Path
    bench: Bench
    settings: Settings
    can_start: bool = True
    reports: Path | None = None
    on_event: str = ""
    """Command for the end of a test, and for trouble."""
    models: tuple[Mask, ...] = ()
    """Noise models in reports."""
    started: list[RecorderProcess] = field(default_factory=list)
    _own: set[Path] = field(default_factory=set)
    ports: threading.Lock = field(default_factory=threading.Lock)
    """Held by who reads the sensors."""

    @property
    def name(self) -> str:
        """The bench's name."""
        return self.bench.name

    @property
    def folder(self) -> Path:
        """Where the bench file wants recordings."""
        return self.bench.recording_directory

    def check(self, plan: TestPlan) -> list[str]:
        """Make the check list; return what fails, a sentence a row."""
        with self.ports:  # a preview has released them
            rows = examined_bench(self.bench, duration=plan.end.duration).rows
        return [
            sentence(row.finding)
            for row in rows
            if row.finding and row.outcome is CheckOutcome.FAILED
        ]

    def start(self, plan: TestPlan) -> Path:
        """Start a recorder; return its file once it exists."""
        out = recording_path(self.bench, SystemClock().now())
        with self.ports:  # a preview has released them
            recorder = RecorderProcess(
                self.path,
                out,
                end=plan.end,
                settings=without_comparison(self.settings),
                operator=plan.operator,
            )
        self.started.append(recorder)
        recorder.wait_for_file()
        try:
            self.remember(plan)
        except (BenchFileError, OSError) as error:  # a file that only root may write, say
            _LOGGER.warning("operator and end of this test are not remembered: %s", error)
        return out

    def remember(self, plan: TestPlan) -> None:
        """Write operator and end of a test into the bench file, where they differ from it."""
        values: dict[str, Any] = {}
        if plan.operator is not None:
            values["operator"] = plan.operator
        if plan.end != self.bench.usual_end:
            kept = plan.end.duration
            duration = None if kept is None else format_duration(kept)
            values["recording"] = {"duration": duration, "until": plan.end.estimated.text}
        if values:
            self.save_bench(with_values(self.read_bench(), values))

    def _check_own(self, path: Path) -> None:
        """Raise an error if a recording is another bench's: it is only shown here.

        Raises
        ------
        HuddleError
            If it has other drivers, ports or serial numbers, or cannot be read.
        """
        # A file that is followed here is not opened again: HDF5 would show it as it was before.
        is_followed = path in self._own or any(each.out == path for each in self.started)
        if not is_followed and not is_of(path, self.bench):
            raise HuddleError(
                f"{path.name} is recorded by another bench, and is only shown here: stop it from"
                f" the window of that bench, or by huddle tui {path}"
            )

    def find_running(self) -> Path | None:
        """Return the file of a running recorder of this bench, if there is one."""
        found = running_recording(self.bench)
        if found is not None:
            self._own.add(found)
        return found

    @property
    def preview(self) -> Preview | None:
        """Reads the sensors of the bench."""
        return partial(read_sensors, self.bench, self.ports)

    def pin(self, path: Path) -> str:
        """Keep a recording of the service of this bench, or no longer."""
        return pin(self.path, path)

    def read_bench(self) -> str:
        """Return the text of the bench file."""
        return self.path.read_text(encoding="utf-8")

    def save_bench(self, text: str) -> None:
        """Write the bench file, if it has no errors."""
        bench = parse(text, self.path)
        write_whole(self.path, text.encode())
        self.bench = bench

    def find_devices(self, port: str) -> Sequence[DiscoveredDevice]:
        """Look for devices on a port that nobody reads."""
        with self.ports:
            return asyncio.run(discover(port, SystemClock()))

    def keep(self, path: Path, result: Result) -> None:
        """Write the result into the recording, unless it holds one."""
        with Recording.open(path) as recording:
            if recording.results():
                return
        store_results(path, result.snapshot, result.verdict)

    def described(self, path: Path) -> Bench | None:
        """Return the bench as it is now, if the recording is of its sensors."""
        return self.bench if is_of(path, self.bench) else None

    def release(self) -> None:
        """Release the recorders, which continue."""
        for recorder in self.started:
            recorder.close()


@dataclass
class ComputerControls:
    """What the first bench asks of this computer."""

    path: Path
    ports: Sequence[str]
    text: str
    lock: threading.Lock = field(default_factory=threading.Lock)
    """Held by who reads the ports."""

    def listed_ports(self) -> Sequence[tuple[str, str]]:
        """Return ports that drivers list, such as CAN buses, and what they are."""
        found, _ = present_ports()
        return [(one.port, f"{driver}: {one.description}") for driver, one in found]

    def network_ports(self, target: str) -> Sequence[str]:
        """Return the ports to search for a port, a host or a network."""
        return asyncio.run(network_ports(target))

    def find_devices(self, port: str) -> Sequence[DiscoveredDevice]:
        """Look for devices on a port that nobody reads."""
        return asyncio.run(discover(port, SystemClock()))

    def read(
        self,
        bench: Bench,
        show: Callable[[tuple[SensorPreview, ...]], None],
        ended: threading.Event,
    ) -> None:
        """Read the sensors until `ended` is set."""
        read_sensors(bench, self.lock, show, ended)

    def save(self, text: str) -> None:
        """Write the bench file, if it has no errors."""
        parse(text, self.path)
        self.path.touch()
        write_whole(self.path, text.encode())


@dataclass(frozen=True)
class RecordingControls(_Controls):
    """Controls of a recording: while it grows it can be stopped and marked."""

    path: Path
    settings: Settings
    bench: Bench | None = None
    can_start: bool = False
    on_event: str = ""
    models: tuple[Mask, ...] = ()

    @property
    def name(self) -> str:
        """The file's name."""
        return self.path.stem

    @property
    def folder(self) -> Path:
        """The folder of the recording."""
        return self.path.parent

    def check(self, plan: TestPlan) -> tuple[str, ...]:
        """Return nothing: there is nothing to be started."""
        del plan
        return ()

    def start(self, plan: TestPlan) -> Path:
        """Raise an error: a recording cannot be started again."""
        del plan
        raise HuddleError("this is a recording; huddle tui BENCH starts one")

    def find_running(self) -> Path:
        """Return the recording itself."""
        return self.path

    @property
    def preview(self) -> None:
        """Return nothing: the sensors of a recording may be anywhere."""

    def pin(self, path: Path) -> str:
        """Keep a recording of the service in its folder, or no longer."""
        return pin(path.parent, path)

    def read_bench(self) -> str:
        """Raise an error: what a recording was made with is not to be changed."""
        raise HuddleError("this is a recording; huddle tui BENCH changes a bench file")

    def save_bench(self, text: str) -> None:
        """Raise an error."""
        del text
        self.read_bench()

    def find_devices(self, port: str) -> Sequence[DiscoveredDevice]:
        """Return none."""
        del port
        return ()

    def keep(self, path: Path, result: Result) -> None:
        """Do nothing: the process that records writes the result."""


def pin(source: Path, path: Path) -> str:
    """Keep a recording of a service, or no longer where it is pinned; return which.

    Raises
    ------
    HuddleError
        If no service has made it.
    """
    place = Place.of(source)
    try:
        runs = runs_named(place.runs(), path.name)
    except (NoServiceError, RunNotFoundError):
        message = f"{path.name} was not made by huddle serve: nothing removes it by itself"
        raise HuddleError(message) from None
    pinned = not all(run.pinned for run in runs)
    place.store.pin([run.key for run in runs], pinned=pinned)
    kept = "is kept whatever the limits of storage" if pinned else "is no longer pinned"
    return f"{path.name} {kept}"


def read_sensors(
    bench: Bench,
    ports: threading.Lock,
    show: Callable[[tuple[SensorPreview, ...]], None],
    ended: threading.Event,
) -> None:
    """Read the sensors of a bench until `ended` is set; holds the lock of the ports meanwhile.

    Raises
    ------
    HuddleError
        If they cannot be read.
    """
    clock, loop_factory = host_time(bench)
    with ports, asyncio.Runner(loop_factory=loop_factory) as runner:
        try:
            runner.run(preview(bench, clock, show, ended=ended))
        except* HuddleError as errors:
            raise HuddleError("; ".join(map(str, errors.exceptions))) from errors


def announce(command: str, event: str, text: str, path: Path | None) -> None:
    """Start a command with the environment variables HUDDLE_EVENT, _TEXT and _RECORDING.

    Raises
    ------
    HuddleError
        If it cannot be started, or ends with an error.
    """
    if not command:
        return
    about = {"HUDDLE_EVENT": event, "HUDDLE_TEXT": text, "HUDDLE_RECORDING": str(path or "")}
    try:
        ended = subprocess.run(
            shlex.split(command),
            env=os.environ | about,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=HOOK_TIMEOUT,
            check=False,
        )
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        raise HuddleError(f"--on-event {command}: {error}") from error
    if ended.returncode:
        message = ended.stderr.strip() or f"exit code {ended.returncode}"
        raise HuddleError(f"--on-event {command}: {message}")


def save_result(path: Path, result: Result, *, folder: Path) -> tuple[Path, ...]:
    """Write an estimate as CSV and JSON; that of a growing recording has no entry for its file.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    csv, json = (folder / f"{path.stem}{suffix}" for suffix in (".csv", ".json"))
    write_whole(csv, curves_csv(result.snapshot).encode())
    write_metadata(csv, provenance(result))
    write_json(str(json), document(result))
    return csv, json


def without_comparison(settings: Settings) -> Settings:
    """Return settings without methods that are only shown, unless they were chosen alone."""
    chosen = tuple(name for name in settings.methods if name not in COMPARISON_METHODS)
    return replace(settings, methods=chosen or settings.methods)


def with_comparison(settings: Settings, wanted: Mapping[str, Any]) -> Settings:
    """Add cheap methods for comparison, unless the user chose the methods."""
    if wanted.get("methods") is not None or "all" in settings.methods:
        return settings
    return replace(settings, methods=tuple(dict.fromkeys((*settings.methods, *COMPARISON_METHODS))))
