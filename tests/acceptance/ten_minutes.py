"""The acceptance run at life's pace: ``python -m tests.acceptance.ten_minutes [MINUTES] [FOLDER]``.

Nine channels of three sensors, each on its own protocol and clock, through the commands, with a
fault of every kind at every device twice; then every sample is accounted for, and the estimate
compared with the noise that was put in. Exit code 1 where something does not hold.
"""

from __future__ import annotations

import signal
import sys
import tempfile
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from daq.bench.model import Bench
from daq.devices.bench_file import load
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.results.result import Result
from tests.acceptance import fault_script
from tests.acceptance.run_bench import command, served
from tests.acceptance.sample_accounting import Account, Log, accounts
from tui.commands.demo import compare
from tui.simulation.devices import scenario_of
from tui.wording.formatting import level

BEGIN = 30.0
"""World time of the first fault, s."""


def main(minutes: float, folder: Path) -> int:
    """Run, print what was found, return the exit code."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    n_faults = max(len(kinds) for kinds in fault_script.KINDS.values())
    cycle = (minutes * 60 - BEGIN) / 2
    faults = fault_script.script(begin=BEGIN, spacing=cycle / n_faults, every=cycle)
    out = folder / "recording.h5"
    with served(folder, faults, speed=1.0) as devices:
        run = command(
            *("record", str(devices.bench), "--duration", f"{minutes * 60:g}s", "--out", str(out))
        )
        said, notes = run.communicate(timeout=minutes * 60 + 120)
        spec, bench = devices.spec, load(devices.bench)
    screen = Console(width=150)
    screen.print(said, markup=False)
    if run.returncode:
        screen.print(notes, markup=False)
    log = Log.read(folder / "log.jsonl")
    return max(run.returncode, _samples(screen, spec, log, out), _estimate(screen, bench, out))


def _samples(screen: Console, spec: dict[str, Any], log: Log, out: Path) -> int:
    found = accounts(spec, log, out)
    table = Table(title="samples", box=None)
    for name in fields(Account):
        table.add_column(name.name.replace("_", " "), justify="right")
    for one in found:
        table.add_row(*map(str, astuple(one)))
    screen.print(table)
    for sensor, kinds in fault_script.KINDS.items():
        struck = [told["kind"] for told in log.struck if told["sensors"] == [sensor]]
        wanted = set(kinds) - set(fault_script.SAMPLES_ONLY)
        screen.print(
            f"{sensor}: {len(struck)} faults struck; not: {wanted - set(struck) or 'none'}"
        )
    with Recording.open(out) as recording:
        for event in recording.events:
            if event.kind in {"connected", "disconnected", "stalled", "reset", "refused"}:
                screen.print(f"  {event.sensor} {event.kind}: {event.text}", markup=False)
    return int(not all(one.holds for one in found))


def _estimate(screen: Console, bench: Bench, out: Path) -> int:
    settings = replace(
        Settings.of(bench), methods=("three-sensor", "maximum-likelihood"), reject=True
    )
    snapshot = estimate([out], settings)
    table = Table(
        title=f"noise, {snapshot.n_segments} segments, "
        "left out: " + ", ".join(f"{n} {why}" for why, n in snapshot.left_out.items()),
        box=None,
    )
    for name in ("method", "channel", "true", "estimate", "95 % interval", "covers"):
        table.add_column(name, justify="right")
    compared = compare(Result(snapshot, settings), scenario_of(bench))
    for one in compared:
        table.add_row(
            one.method,
            f"{one.sensor}.{one.channel}",
            level(one.true_noise_psd),
            level(one.noise_psd),
            f"{level(one.noise_psd_low)} … {level(one.noise_psd_high)}",
            "yes" if one.covers else "NO",
        )
    screen.print(table)
    return int(not all(one.covers for one in compared))


if __name__ == "__main__":
    length = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    if len(sys.argv) > 2:
        Path(sys.argv[2]).mkdir(parents=True, exist_ok=True)
        sys.exit(main(length, Path(sys.argv[2])))
    with tempfile.TemporaryDirectory(prefix="huddle-acceptance-") as name:
        sys.exit(main(length, Path(name)))
