"""Kills of the recorder and of the repair, and errors of the disk, at random moments."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np

from daq.errors import RecordingError
from daq.python_process import python_command
from tests.torture.after_crash import fault_after_repair, last_acknowledged
from tests.torture.power_cuts import run_program

CALLS = ("pwrite", "fsync", "write", "ftruncate")
_CALLS_MADE = {"pwrite": (60, 500), "fsync": (1, 60), "write": (3, 33), "ftruncate": (1, 4)}
"""Which call fails first; a recording that cannot be created is not repeated."""
ERRORS = (errno.ENOSPC, errno.EIO)
REPEATED = ("pwrite", "write")
"""Calls of which one that fails once must not end the recording."""
COMMITS = 30
MANY = 1_000_000
"""Commits of a program that is killed before."""


def killed(folder: Path, n_acknowledged: int, rng: np.random.Generator) -> str:
    """Kill the recording program after so many commits; return what is wrong after the repair.

    Every second repair is killed as well, and done again.
    """
    folder.mkdir()
    recording, said = folder / "r.h5", folder / "acknowledged"
    said.touch()
    command = [sys.executable, "-m", "tests.torture.recording_program"]
    with subprocess.Popen([*command, str(recording), str(said), str(MANY)]) as program:
        while said.read_bytes().count(b"\n") < n_acknowledged and program.poll() is None:
            os.sched_yield()
        program.send_signal(signal.SIGKILL)
    if rng.random() < 0.5:
        repair = subprocess.Popen(
            python_command("tui", "repair", str(recording)),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            repair.wait(float(rng.uniform(0.3, 1.5)))
        except subprocess.TimeoutExpired:
            repair.kill()
            repair.wait()
    return _fault(folder, said.read_bytes())


def kill_faults(folder: Path, n: int, *, seed: int) -> list[str]:
    """Kill this often; return what was wrong, in each case of a fault."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(n):
        n_acknowledged = int(rng.integers(0, 40))
        fault = killed(folder / f"kill-{number}", n_acknowledged, rng)
        if fault:
            found.append(f"killed after {n_acknowledged} commits: {fault}")
    return found


def disk_faults(library: Path, folder: Path, n: int, *, seed: int) -> list[str]:
    """Make calls of the recording program fail, each time from another one on, for ever or once."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(n):
        call, error = CALLS[number % len(CALLS)], ERRORS[number // len(CALLS) % len(ERRORS)]
        first = int(rng.integers(*_CALLS_MADE[call]))
        last = first if rng.random() < 0.5 else MANY
        disk = folder / f"disk-{number}"
        disk.mkdir()
        case = f"{call} {first} to {last}: {errno.errorcode[error]}"
        said = folder / f"acknowledged-{number}"
        failing = f"{call}:{error}:{first}:{last}"
        done = run_program(library, disk, COMMITS, said=said, SHIM_FAIL=failing)
        if done.returncode not in {0, 3} or "Traceback" in done.stderr:
            found.append(f"{case}: exit {done.returncode}: {done.stderr[-300:]}")
            continue
        content = said.read_bytes() if said.exists() else b""
        n_commits = content.count(b"\n")
        fault = _fault(disk, content)
        if first == last and call in REPEATED and n_commits <= COMMITS:
            fault = fault or f"ended after {n_commits} commits: {done.stdout}"
        if fault:
            found.append(f"{case}: {fault}")
    return found


def _fault(folder: Path, acknowledged: bytes) -> str:
    try:
        return fault_after_repair(folder / "r.h5", last_acknowledged(acknowledged))
    except RecordingError as error:
        return str(error)
