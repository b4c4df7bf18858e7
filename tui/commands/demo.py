"""``huddle demo``: a whole huddle test on a simulated bench, beside the truth."""

from __future__ import annotations

import logging
import shutil
import sys
import tempfile
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from daq.bench.durations import format_duration
from daq.bench.loading import dump
from daq.drivers.bench_file import parse
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.results.band_summary import band_of, correlation_of
from daq.results.clock_effect import effect
from estimator.self_noise.band_means import band_edges, band_means
from tui.commands.run import result_of
from tui.output.console import check_places, for_people, notices, write_json
from tui.output.exit_codes import ExitCode
from tui.output.formatting import level, level_with_error
from tui.runs.interrupt import defer_interrupt
from tui.runs.recorder_process import RecorderProcess
from tui.simulation.devices import scenario_of, simulated

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot
    from estimator.self_noise.band_means import FloatArray
    from sim_devices.world.scenario import Scenario

_LOGGER = logging.getLogger(__name__)
METHODS = ("three-channel", "three-sensor")
ALL_AT_ONCE = 2.773
"""Standard deviations within which nine errors lie together 95 times in 100 (Bonferroni)."""
CLOCK_MARGIN = 4.0
"""What clocks add goes with the square of what is left between them: twice its rms is allowed."""
TOLD = 0.01
"""Share of the noise from which on the table says what the clocks may have added."""


@dataclass(frozen=True, slots=True)
class Compared:
    """One channel's noise in the band by one method, beside the truth; PSD in unit²/Hz."""

    sensor: str
    channel: str
    method: str
    true_psd: float
    noise_psd: float
    low: float
    high: float
    clocks: float = 0.0
    """What the clocks may have added; taken off the interval's lower end."""

    @property
    def covers(self) -> bool:
        """Whether the truth lies in the interval."""
        return self.low <= self.true_psd <= self.high


def run_demo(
    *,
    duration: float | None,
    speed: float | None,
    keep: Path | None,
    table: bool,
    json: str | None,
) -> None:
    """Serve the demo's bench, record it, estimate, and compare; or open the application on it."""
    check_places(None if keep is None else str(keep))
    text = resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8")
    bench = parse(text, "demo")
    if duration is not None:
        bench = bench.model_copy(
            update={"recording": bench.recording.model_copy(update={"duration": duration})}
        )
    speed = bench.speed if speed is None else speed
    terminal = all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr))
    on_screen = terminal and not table and json is None
    interrupted = False
    with tempfile.TemporaryDirectory(prefix="huddle-demo-") as folder:
        with simulated(bench, speed=speed) as reachable:
            path = Path(folder) / "demo.toml"
            path.write_text(dump(reachable), encoding="utf-8")
            settings = replace(Settings.of(reachable), methods=METHODS[::-1])
            if on_screen:
                out = _show(path, settings)
            else:
                out = path.with_suffix(".h5")
                interrupted = _record(path, out, settings, bench.recording.duration or 60.0, speed)
        if out is None or not out.exists():
            return
        snapshot = estimate([out], settings)
        if keep is not None:
            shutil.copyfile(out, keep)
            _LOGGER.info("recording kept as %s", keep, extra={"recording": str(keep)})
    scenario = scenario_of(bench)
    compared = compare(snapshot, settings, scenario)
    screen = for_people(json)
    low, high = band_of(settings, snapshot)
    added = max(entry.clocks / entry.true_psd for entry in compared)
    screen.print(
        Text.assemble(
            (f"Self-noise from {low:g} to {high:g} Hz", "bold"),
            f" in dB re 1 ({snapshot.unit})²/Hz, {snapshot.n_segments} segments;\n"
            "± is the 95 % interval of all nine at once, ✓ where it covers the truth",
            f"\nand what its clocks may add: up to {_percent(added)}" if added >= TOLD else "",
        )
    )
    screen.print(comparison_table(compared, snapshot, settings))
    for line in verdict(compared):
        screen.print(line)
    write_json(json, _document(compared, snapshot))
    if interrupted:
        raise typer.Exit(ExitCode.INTERRUPTED)


def _show(path: Path, settings: Settings) -> Path | None:
    from tui.commands.tui import show_demo  # noqa: PLC0415 - Textual only where it is shown

    return show_demo(path, settings)


def _record(path: Path, out: Path, settings: Settings, duration: float, speed: float) -> bool:
    """Record without a screen; return whether Ctrl-C ended it."""
    notices().print(
        "Three simulated accelerometers on their serial protocol, "
        f"{format_duration(duration)} at {speed:g} times real time: it takes "
        f"{format_duration(duration / speed)}."
    )
    recorder = RecorderProcess(path, out, duration=duration)
    try:
        recorder.wait_for_file()
        with defer_interrupt(recorder.request_stop) as interruption:
            result_of(recorder, settings, duration=duration)
        recorder.check()
    except KeyboardInterrupt:
        recorder.stop()
        raise
    finally:
        recorder.close()
    return interruption.pressed


def compare(snapshot: Snapshot, settings: Settings, scenario: Scenario) -> list[Compared]:
    """Return every channel's noise in the band by each method, with the truth."""
    edges = band_edges(snapshot.frequency, band_of(settings, snapshot))
    inside = snapshot.frequency[slice(*edges)]
    correlation = correlation_of(settings)
    clocks = _added_by_clocks(snapshot, settings)
    compared = []
    for method, noise in snapshot.results.items():
        places: dict[str, int] = {}
        for column, label in enumerate(snapshot.channels):
            place = places.get(label.sensor, 0)
            places[label.sensor] = place + 1
            mean = band_means(
                noise.noise_psd[:, column],
                noise.cov[:, column],
                edges,
                correlation,
                quantile=ALL_AT_ONCE,
            )
            compared.append(
                Compared(
                    sensor=label.sensor,
                    channel=label.channel,
                    method=method,
                    true_psd=float(scenario.true_noise_psd(label.sensor, place, inside).mean()),
                    noise_psd=float(mean.mean[0]),
                    low=float(mean.low[0] - clocks[column]),
                    high=float(mean.high[0]),
                    clocks=float(clocks[column]),
                )
            )
    return compared


def _added_by_clocks(snapshot: Snapshot, settings: Settings) -> FloatArray:
    """Return what clocks may have added to each channel's mean noise in the band, in unit²/Hz."""
    first = next(iter(snapshot.results.values()), None)
    if first is None:
        return np.zeros(len(snapshot.channels))
    edges = band_edges(snapshot.frequency, band_of(settings, snapshot))
    noise = np.abs(first.noise_psd[slice(*edges)].mean(axis=0))
    share = CLOCK_MARGIN * np.nan_to_num(effect(snapshot, settings))
    return np.asarray(np.minimum(share, 1.0) * noise)


def _percent(share: float) -> str:
    return "all of it (this demo is too short to know them)" if share >= 1 else f"{share:.0%} of it"


def comparison_table(compared: list[Compared], snapshot: Snapshot, settings: Settings) -> Table:
    """Return a row per channel: truth, each method's estimate, and whether that covers it."""
    band = band_of(settings, snapshot)
    edges = band_edges(snapshot.frequency, band)
    data = snapshot.data_psd[slice(*edges)].mean(axis=0)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("channel", "data", "true noise"):
        table.add_column(name, justify="left" if name == "channel" else "right")
    for method in METHODS:
        table.add_column(method, justify="right")
    for column, label in enumerate(snapshot.channels):
        found = {
            entry.method: entry
            for entry in compared
            if (entry.sensor, entry.channel) == (label.sensor, label.channel)
        }
        row = [Text(label.name), Text(level(float(data[column])))]
        row.append(Text(level(found[METHODS[0]].true_psd)))
        for method in METHODS:
            entry = found[method]
            colour, mark = ("green", "✓") if entry.covers else ("red", "✗")
            estimate = level_with_error(entry.noise_psd, entry.high)
            row.append(Text(f"{estimate} {mark}", colour))
        table.add_row(*row)
    return table


def verdict(compared: list[Compared]) -> list[str]:
    """Say in plain words what the table shows."""
    lines = []
    for method in METHODS:
        entries = [entry for entry in compared if entry.method == method]
        covered = sum(entry.covers for entry in entries)
        above = sum(entry.low > entry.true_psd for entry in entries)
        below = sum(entry.high < entry.true_psd for entry in entries)
        lines.append(
            f"{method}: the 95 % interval covers the truth in "
            f"{covered} of {len(entries)} channels"
            + (f"; {above} too high, {below} too low" if covered < len(entries) else "")
            + "."
        )
    lines.append(
        "The sensors do not point the same way, so the motion they share leaks into the "
        "three-channel estimate: it reads too high, or even below zero, which no noise can be. "
        "The three-sensor estimate needs no alignment."
    )
    return lines


def _document(compared: list[Compared], snapshot: Snapshot) -> dict[str, Any]:
    return {
        "segments": snapshot.n_segments,
        "unit": snapshot.unit,
        "channels": [
            {
                "sensor": entry.sensor,
                "channel": entry.channel,
                "method": entry.method,
                "true_noise_psd": entry.true_psd,
                "noise_psd": entry.noise_psd,
                "noise_psd_low": entry.low,
                "noise_psd_high": entry.high,
                "added_by_clocks": entry.clocks,
                "covers": entry.covers,
            }
            for entry in compared
        ],
    }
