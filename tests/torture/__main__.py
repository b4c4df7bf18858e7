"""All of the torture: ``python -m tests.torture``, or ``make torture``.

Writes the counts to docs/validation/torture.md. A share of the cases, as in
``python -m tests.torture 0.1``, leaves the page alone.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from tests.torture.crashes import disk_faults, kill_faults
from tests.torture.damaged_files import (
    FAULTS,
    LIMIT,
    make_recording,
    tally,
)
from tests.torture.long_history import N_RUNS, command_faults, loop_faults, make_history
from tests.torture.power_cuts import MODELS, faults, recorded, shim

PAGE = Path(__file__).parents[2] / "docs" / "validation" / "torture.md"
KILLS, CUTS, DISK_ERRORS = 300, 100, 50
CHANGES = {
    "flipped bits": ("bits", 100_000),
    "flipped bits in block tables": ("blocks", 10_000),
    "flipped bits in global heaps": ("heaps", 1000),
    "changed sectors": ("sectors", 10_000),
}
"""Kind of change, and number of cases."""
KEPT = PAGE.parents[2] / "build" / "torture"
"""Folder of the files in which something was not seen."""
HEAD = """# Recordings under torture

`make torture` records with the writer of the product, and lets the process be killed, the power be
cut, the disk fail, or a bit of the file flip. After each crash the recording is repaired. It must
then have every acknowledged row, with the right samples, and open in plain HDF5. A damaged file
must be refused, have its damage named, or be read as it was. The table is the outcome of one
complete run.

| torture | cases | good | faults |
|---|---:|---:|---|
"""
TAIL = """
- *Kills*: SIGKILL after 0 to 40 commits. Half of the repairs are killed too, and repeated.
- *Power cuts*: a preloaded library records all writes and fsyncs of the recorder. They are replayed
  up to a random one. Of what was written after the last fsync of a file the disk then has nothing
  (synced), everything (prefix), some whole writes, some 4 KiB pages of them, or some 512-byte
  sectors.
- *Disk errors*: from a random call on, once or permanently, `pwrite`, `fsync`, `write` or
  `ftruncate` fails with ENOSPC or EIO. One `pwrite` or `write` that fails must not end the
  recording; otherwise the recorder must end with an error message.
- *Flipped bits*: one bit of a closed recording, in 80 % of the cases outside of the samples; or
  one bit of a row of a table of blocks. *Changed sectors*: 512 bytes that become zero, random, or
  those of another sector. Reader and `huddle verify` may take ten seconds at most; whatever they
  call intact, a program with plain h5py must be able to read.
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
        return (
            f"| {self.name} | {self.n_cases} | {self.n_cases - len(self.faults)} |"
            f" {said}{self.remark} |"
        )


def torture(share: float, folder: Path) -> list[Row]:
    """Do all of it, or a share; return the rows of the table."""
    rows = []

    def add(row: Row) -> None:
        print(row, flush=True)
        rows.append(row)

    n = max(1, round(KILLS * share))
    add(Row("kills", n, kill_faults(folder, n, seed=1)))
    library = shim(folder)
    if library is None:
        print("no C compiler, or not Linux: no power cuts and no disk errors")
    else:
        operations = recorded(library, folder, 30)
        n = max(1, round(CUTS * share))
        for seed, model in enumerate(MODELS):
            add(Row(f"power cuts, {model}", n, faults(operations, model, n, folder, seed=seed)))
        n = max(1, round(DISK_ERRORS * share))
        add(Row("disk errors", n, disk_faults(library, folder, n, seed=2)))
    for name, (kind, n_cases) in CHANGES.items():
        add(_changes(name, kind, max(1, round(n_cases * share)), folder))
    n = max(1000, round(N_RUNS * share))
    bench = make_history(folder / "history", n, seed=4)
    found, remark = command_faults(folder / "history")
    add(Row(f"commands with {n} runs of a service", 3, found, f" ({remark})"))
    found, remark = loop_faults(bench)
    add(Row(f"start of a service with {n} runs", 1, found, f" ({remark})"))
    return rows


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
    share = parser.parse_args().share
    if not 0 < share <= 100:
        parser.error(f"share {share}; expected a number above 0, such as 0.1")
    with tempfile.TemporaryDirectory(prefix="huddle-torture-") as folder:
        rows = torture(share, Path(folder))
    if share == 1.0:
        _, mark, by_hand = PAGE.read_text(encoding="utf-8").partition("\n## ")
        table = "\n".join(map(str, rows))
        PAGE.write_text(f"{HEAD}{table}\n{TAIL}{mark}{by_hand}", encoding="utf-8")
    return 1 if any(row.faults for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
