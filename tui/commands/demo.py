"""``huddle demo``: a complete huddle test on simulated sensors, compared with the truth."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import logging
import shutil
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from daq.bench.durations import format_duration
from daq.bench.end_condition import EndCondition
from tui.commands.options import DurationOption, SpeedOption, command, with_logging
from tui.commands.run import result_of
from tui.output.console import check_places, for_people, notices, write_json
from tui.output.exit_codes import ExitCode
from tui.page.table import Cell, Table

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.results.result import Result
    from sim_devices.world.scenario import Scenario

_LOGGER = logging.getLogger(__name__)
METHODS = ("three-channel", "three-sensor")
SIMULTANEOUS_95 = 2.773
"""Half width of a simultaneous 95 % interval of nine values in standard deviations, Bonferroni."""
SHOWN_SHARE = 0.01
"""Share of the noise above which the table states the effect of the clocks."""


@command()
@with_logging
def demo(
    *,
    duration: DurationOption = None,
    speed: SpeedOption = None,
    keep: Path | None = None,
    table: bool = False,
    json: str | None = None,
) -> None:
    """Run a complete huddle test on simulated sensors.

    The recorder reads three simulated triaxial accelerometers over their
    real protocol. They point in different directions. Their noise is known,
    so the table shows which estimate is right.

    On a terminal the command opens the application.

    Parameters
    ----------
    duration : TIME
        Length of the recording, such as 90s, 20min or 3h (default 5min).
    speed : FACTOR
        Speed of the simulation relative to real time (default 4).
    keep : FILE
        Copy the recording to this file.
    table
        Print the table instead of opening the application.

    Examples
    --------
    huddle demo
    huddle demo --duration 10min --speed 10 --keep demo.h5
    """
    from rich.text import Text

    from daq.bench.loading import dump
    from daq.devices.bench_file import parse
    from daq.estimation.estimation import estimate
    from daq.estimation.settings import Settings
    from daq.results.result import Result
    from tui.simulation.devices import scenario_of, simulated

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
                from tui.commands.tui import show_demo

                out = show_demo(path, settings)
            else:
                out = path.with_suffix(".h5")
                interrupted = _record(path, out, settings, bench.recording.duration or 60.0, speed)
        if out is None or not out.exists():
            return
        result = Result(estimate([out], settings), settings)
        if keep is not None:
            shutil.copyfile(out, keep)
            _LOGGER.info("recording kept as %s", keep, extra={"recording": str(keep)})
    scenario = scenario_of(bench)
    compared = compare(result, scenario)
    screen = for_people(json)
    snapshot, (low, high) = result.snapshot, result.band
    added = max(entry.added_by_clocks / entry.true_noise_psd for entry in compared)
    screen.print(
        Text.assemble(
            (f"Self-noise, mean over {low:g} to {high:g} Hz", "bold"),
            f", dB re 1 ({snapshot.unit})²/Hz, {snapshot.n_segments} segments\n"
            "± simultaneous 95 % interval of all channels; ✓ it covers the truth",
            f"\nThe interval includes the effect of the clocks, up to {_percent(added)}."
            if added >= SHOWN_SHARE
            else "",
        )
    )
    screen.print(comparison_table(compared, result))
    for line in verdict(compared):
        screen.print(line)
    channels = [
        asdict(entry) | {"covers": entry.covers, "withdrawn": entry.withdrawn} for entry in compared
    ]
    about = {"segments": snapshot.n_segments, "unit": snapshot.unit, "channels": channels}
    write_json(json, about)
    if interrupted:
        raise typer.Exit(ExitCode.INTERRUPTED)


@dataclass(frozen=True, slots=True)
class NoiseComparison:
    """Noise of one channel in the band by one method, and the truth; PSD in unit²/Hz."""

    sensor: str
    channel: str
    method: str
    true_noise_psd: float
    noise_psd: float
    noise_psd_low: float
    noise_psd_high: float
    added_by_clocks: float = 0.0
    """Largest effect of the clocks; the lower limit allows for it."""

    @property
    def withdrawn(self) -> bool:
        """Whether the estimate is above what the other sensors leave unpredicted."""
        return self.noise_psd > self.noise_psd_high

    @property
    def covers(self) -> bool:
        """Whether the truth lies in the interval of an estimate that is not withdrawn."""
        is_inside = self.noise_psd_low <= self.true_noise_psd <= self.noise_psd_high
        return is_inside and not self.withdrawn


def _record(path: Path, out: Path, settings: Settings, duration: float, speed: float) -> bool:
    """Record; return whether Ctrl-C ended it."""
    from tui.runs.recorder_process import RecorderProcess, defer_interrupt

    notices().print(
        f"Recording three simulated accelerometers for {format_duration(duration)} at {speed:g} "
        f"times real time, which takes at least {format_duration(duration / speed)}."
    )
    recorder = RecorderProcess(path, out, end=EndCondition(duration))
    try:
        recorder.wait_for_file()
        with defer_interrupt(recorder.request_stop) as interruption:
            result_of(recorder, settings, end=EndCondition(duration))
        recorder.check()
    except KeyboardInterrupt:
        recorder.stop()
        raise
    finally:
        recorder.close()
    return interruption.pressed


def compare(result: Result, scenario: Scenario) -> list[NoiseComparison]:
    """Return the noise of every channel in the band by each method, with the truth."""
    from estimator.levels.bands import band_edges
    from estimator.levels.contributions import Source

    snapshot, compared = result.snapshot, []
    inside = snapshot.frequency[slice(*band_edges(snapshot.frequency, result.band))]
    for method in snapshot.results:
        found = result.levels(method, result.band)
        clocks = [each.below[0] for each in found.contributions if each.source is Source.CLOCKS]
        means = [found.of_channel(n, SIMULTANEOUS_95) for n in range(len(snapshot.channels))]
        places: dict[str, int] = {}
        for column, (label, mean) in enumerate(zip(snapshot.channels, means, strict=True)):
            place = places.get(label.sensor, 0)
            places[label.sensor] = place + 1
            truth = scenario.true_noise_psd(label.sensor, place, inside)
            numbers = (truth.mean(), mean.mean[0], mean.low[0], mean.high[0])
            added = sum(each[column] for each in clocks)
            own = (label.sensor, label.channel, method)
            compared.append(NoiseComparison(*own, *map(float, (*numbers, added))))
    return compared


def _percent(share: float) -> str:
    return (
        "100 % of the noise (too short to measure the clocks)"
        if share >= 1
        else f"{share:.0%} of the noise"
    )


def comparison_table(compared: list[NoiseComparison], result: Result) -> Table:
    """Return a row per channel: truth, each method's estimate, and whether that covers it."""
    from tui.wording.formatting import level, level_with_error

    rows = []
    for column, label in enumerate(result.snapshot.channels):
        found = {
            entry.method: entry
            for entry in compared
            if (entry.sensor, entry.channel) == (label.sensor, label.channel)
        }
        truth = found[METHODS[0]].true_noise_psd
        row = [label.name, level(float(result.data[column])), level(truth)]
        for method in METHODS:
            entry = found[method]
            mark = "✓" if entry.covers else "✗"
            estimate = (
                f"{level(entry.noise_psd)} withdrawn"
                if entry.withdrawn
                else level_with_error(entry.noise_psd, entry.noise_psd_high)
            )
            row.append(Cell(f"{estimate} {mark}", "good" if entry.covers else "bad"))
        rows.append(tuple(row))
    return Table(("channel", "data", "true noise", *METHODS), tuple(rows))


def verdict(compared: list[NoiseComparison]) -> list[str]:
    """Return the conclusions from the table."""
    lines = []
    for method in METHODS:
        entries = [entry for entry in compared if entry.method == method]
        covered = sum(entry.covers for entry in entries)
        withdrawn = sum(entry.withdrawn for entry in entries)
        above = sum(entry.noise_psd_low > entry.true_noise_psd for entry in entries)
        below = sum(entry.noise_psd_high < entry.true_noise_psd for entry in entries)
        lines.append(
            f"{method}: the 95 % interval covers the truth in "
            f"{covered} of {len(entries)} channels"
            + (f"; {above} too high, {below} too low" if covered < len(entries) else "")
            + (f", {withdrawn} withdrawn" if withdrawn else "")
            + "."
        )
    lines.append(
        "The sensors point in different directions, so motion leaks into the three-channel "
        "estimate, which is too high or below zero. The three-sensor estimate needs no alignment."
    )
    if any(entry.withdrawn for entry in compared):
        lines.append(
            "An estimate is withdrawn where it is above what the other sensors do not predict of "
            "the channel. The noise is below that, whatever the motion."
        )
    return lines
