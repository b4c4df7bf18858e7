"""All of the torture: ``python -m tests.torture``, or ``make torture``.

Writes the counts to docs/validation/torture.md. A share of the cases, as in
``python -m tests.torture 0.1``, leaves the page alone.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from tests.torture import fault_commands
from tests.torture.bench_files import bench_faults
from tests.torture.crashes import disk_faults, kill_faults
from tests.torture.damaged_files import (
    FAULTS,
    LIMIT,
    make_recording,
    tally,
)
from tests.torture.faulty_disk import FaultyDisk, library
from tests.torture.faulty_disk import torture as torture_command
from tests.torture.long_history import N_RUNS, command_faults, loop_faults, make_history
from tests.torture.power_cuts import MODELS, faults, recorded, shim
from tests.torture.service_database import database_faults
from tests.torture.service_kills import RATE, soak
from tests.torture.starved_recorder import starved_faults
from tests.tui.demo_bench import demo_devices

PAGE = Path(__file__).parents[2] / "docs" / "validation" / "torture.md"
KILLS, CUTS, DISK_ERRORS = 300, 100, 50
PLACES, SLOW_PLACES = 1000, 40
"""Most calls of a command that fail, each in a run of its own, for each kind of fault."""
CHANGES = {
    "flipped bits": ("bits", 100_000),
    "flipped bits in block tables": ("blocks", 10_000),
    "flipped bits in global heaps": ("heaps", 1000),
    "changed sectors": ("sectors", 10_000),
}
"""Kind of change, and number of cases."""
PAGES, BENCH_FILES, CLOCK_STEPS = 2000, 20_000, 24
STARVED, DAY = 300.0, 86_400.0
"""Seconds of a recorder that shares its processors, and of a service."""
STEPS_OF_DAY = 6
KEPT = PAGE.parents[2] / "build" / "torture"
"""Folder of the files in which something was not seen."""
HEAD = """# Recordings and the service under torture

Is anything acknowledged lost, or any number wrong, after kills, power cuts, disk errors or flipped
bits? `make torture`: after each crash the recording is repaired, must have every acknowledged row
and open in plain HDF5. A damaged file must be refused, have its damage named, or be read unchanged.

| torture | cases | faults |
|---|---:|---|
"""
TAIL = """
- *Kills*: after 0 to 40 commits; half of the repairs are killed, too.
- *Power cuts*: writes and fsyncs are replayed up to a random one. After the last fsync the disk has
  nothing, everything, some whole writes, 4 KiB pages or 512-byte sectors.
- *Disk errors*: ENOSPC or EIO, once or for good. One failed write must not end the recording.
- *Flipped bits*, *changed sectors*: 80 % outside of the samples. What `huddle verify` calls intact,
  plain h5py must read within ten seconds.
- *Database*: a bit or page of 300 runs, or the end, is changed; the next start must have all runs.
  SQLite has no checksums: a changed bit of a number is not seen.
- *Clocks*, *day*: the clock is set by −25 to 30 min; the day has a leap second and the end of
  summer time. Each due time has one row.
"""


@dataclass(slots=True)
class Row:
    """One row of the table."""

    name: str
    n_cases: int
    faults: list[str] = field(default_factory=list)
    remark: str = ""

    def __str__(self) -> str:
        """Return the row in Markdown."""
        said = "; ".join(self.faults) or "none"
        return f"| {self.name} | {self.n_cases} | {said}{self.remark} |"


def torture(share: float, folder: Path, only: str = "") -> list[Row]:
    """Do all of it, or a share, or what has a word in its name; return the rows of the table.

    Kinds that wait for a clock run beside the others.
    """
    chosen = [name for name in _KINDS if only in name]
    rows: dict[str, list[Row]] = {name: [] for name in chosen}
    with ThreadPoolExecutor(len(_WAITING)) as beside:
        waiting = {
            name: beside.submit(_rows_of, name, share, folder)
            for name in _WAITING
            if name in chosen
        }
        for name in chosen:
            if name not in waiting:
                rows[name] += _rows_of(name, share, folder)
        for name, found in waiting.items():
            rows[name] += found.result()
    return [row for name in chosen for row in rows[name]]


def _rows_of(name: str, share: float, folder: Path) -> list[Row]:
    """Do a kind of torture, print its rows as they come, and return them."""
    of_kind = folder / name.replace(" ", "-")
    of_kind.mkdir()
    rows = []
    for row in _KINDS[name](share, of_kind):
        print(row, flush=True)
        rows.append(row)
    return rows


def _kills(share: float, folder: Path) -> Iterator[Row]:
    n = _share(KILLS, share)
    yield Row("kills", n, kill_faults(folder, n, seed=1))


def _power_and_disk(share: float, folder: Path) -> Iterator[Row]:
    library = shim(folder)
    if library is None:
        print("no C compiler, or not Linux: no power cuts and no disk errors")
        return
    operations = recorded(library, folder, 30)
    n = _share(CUTS, share)
    for seed, model in enumerate(MODELS):
        yield Row(f"power cuts, {model}", n, faults(operations, model, n, folder, seed=seed))
    n = _share(DISK_ERRORS, share)
    yield Row("disk errors", n, disk_faults(library, folder, n, seed=2))


def _faults(share: float, folder: Path) -> Iterator[Row]:
    """Let every call of commands fail that changes a file; of devices' commands, a few."""
    built = library(folder)
    if built is None:
        print("no gcc, or not Linux: no faults of commands")
        return
    (folder / "inputs").mkdir()
    with (
        demo_devices(folder / "inputs", speed=fault_commands.SPEED) as bench,
        FaultyDisk(built, folder) as disk,
    ):
        made = fault_commands.commands(folder / "inputs")
        slow = fault_commands.device_commands(bench)
        for name, command in (made | slow).items():
            places = _share(SLOW_PLACES if name in slow else PLACES, share)
            for found in torture_command(disk, command, n_places=places):
                said = ", ".join(f"{n} {kind}" for kind, n in found.counts.items())
                remark = f" ({said}; {found.n_calls} calls)"
                yield Row(f"{name}, {found.fault}", found.n_places, found.wrong, remark)


def _changed_files(share: float, folder: Path) -> Iterator[Row]:
    for name, (kind, n_cases) in CHANGES.items():
        yield _changes(name, kind, _share(n_cases, share), folder)


def _database(share: float, folder: Path) -> Iterator[Row]:
    n = _share(PAGES, share)
    found, remark = database_faults(folder / "history", n, seed=5)
    yield Row("bits and pages of the database of runs", n, found, f" ({remark})")


def _bench_files(share: float, folder: Path) -> Iterator[Row]:
    n = _share(BENCH_FILES, share)
    found, remark = bench_faults(folder, n, seed=6)
    yield Row("bench files with errors", n, found, f" ({remark})")


def _history(share: float, folder: Path) -> Iterator[Row]:
    n = max(1000, round(N_RUNS * share))
    bench = make_history(folder / "history", n, seed=4)
    found, remark = command_faults(folder / "history")
    yield Row(f"commands with {n} runs of a service", 3, found, f" ({remark})")
    found, remark = loop_faults(bench)
    yield Row(f"hours of a service with {n} runs", 1, found, f" ({remark})")


def _clocks(share: float, _: Path) -> Iterator[Row]:
    n = _share(CLOCK_STEPS, share)
    found, remarks = soak(60.0 * n, n_steps=n)
    yield Row("clock set while a service runs", n, found, f" ({_brief(remarks)})")


def _starved(share: float, _: Path) -> Iterator[Row]:
    seconds = max(60, round(STARVED * share))  # it takes half of one to connect
    found, remark = starved_faults(seconds)
    yield Row(f"64 × 3 channels at 1 kHz, starved, {seconds} s", 1, found, f" ({remark})")


def _day(share: float, _: Path) -> Iterator[Row]:
    seconds = DAY / RATE * share
    found, remarks = soak(seconds, n_steps=round(STEPS_OF_DAY * share))
    hours = seconds * RATE / 3600
    yield Row(f"service of {hours:.1f} h, accelerated", 1, found, f" ({_brief(remarks)})")


_KINDS = {
    "kills": _kills,
    "power cuts and disk errors": _power_and_disk,
    "faults of commands": _faults,
    "changed files": _changed_files,
    "database": _database,
    "bench files": _bench_files,
    "history": _history,
    "clocks": _clocks,
    "starved recorder": _starved,
    "accelerated day": _day,
}
_WAITING = ("clocks", "accelerated day")


def _brief(remarks: list[str]) -> str:
    """Return the remarks of a service that the page shows."""
    return "; ".join(each for each in remarks if not each.startswith("kills"))


def _share(n: int, share: float) -> int:
    return max(1, round(n * share))


def _changes(name: str, kind: str, n: int, folder: Path) -> Row:
    """Return the row of one kind of damage to a closed recording."""
    whole = folder / "whole.h5"
    if not whole.exists():
        make_recording(whole, "b")  # of one sensor, in half the time
    counts = tally(kind, whole, n, seed=3, limit=LIMIT, keep=KEPT)
    wrong = [what for what in counts.elements() if what in FAULTS]
    good = ", ".join(f"{n} {what}" for what, n in counts.items() if what not in FAULTS)
    return Row(name, n, wrong, f" ({good})")


def main() -> int:
    """Do it, and write the page if it was all of it."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.torture",
        description="Kills recorders, cuts the power, lets the disk fail, and flips bits.",
        epilog=f"The counts of all cases are written to {PAGE.name}; those of a share are not.",
    )
    parser.add_argument(
        "share", nargs="?", type=float, default=1.0, help="share of all cases, above 0 (default 1)"
    )
    parser.add_argument("--only", default="", help=f"a word of: {', '.join(_KINDS)}")
    given = parser.parse_args()
    share = given.share
    if not 0 < share <= 100:
        parser.error(f"share {share}; expected a number above 0, such as 0.1")
    with tempfile.TemporaryDirectory(prefix="huddle-torture-") as folder:
        rows = torture(share, Path(folder), given.only)
    if share == 1.0 and not given.only:
        _, mark, by_hand = PAGE.read_text(encoding="utf-8").partition("\n## ")
        table = "\n".join(map(str, rows))
        PAGE.write_text(f"{HEAD}{table}\n{TAIL}{mark}{by_hand}", encoding="utf-8")
    return 1 if any(row.faults for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
