"""The bench served and recorded through the commands."""

from __future__ import annotations

import contextlib
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from daq.devices.bench_file import load
from daq.python_process import python_command
from tests.acceptance import fault_script
from tests.waiting import limit
from tui.simulation.devices import specification, with_faults


@dataclass(frozen=True, slots=True)
class Served:
    """Devices that run, and where things are."""

    bench: Path
    """Connects to them."""
    log: Path
    spec: dict[str, Any]
    """What they were told, but for the instant at which the world began."""


def command(*arguments: str) -> subprocess.Popen[str]:
    """Start ``huddle`` with these arguments."""
    return subprocess.Popen(
        python_command("tui", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@contextlib.contextmanager
def served(folder: Path, faults: list[dict[str, Any]], *, speed: float) -> Iterator[Served]:
    """Serve the acceptance bench with a fault script by ``huddle devices``."""
    bench, told, out = folder / "bench.toml", folder / "faults.toml", folder / "reachable.toml"
    text = resources.files("tests.acceptance").joinpath("bench.toml").read_text(encoding="utf-8")
    bench.write_text(text, encoding="utf-8")
    fault_script.write(told, faults)
    log = folder / "log.jsonl"
    devices = command(
        *("devices", str(bench), "--faults", str(told), "--log", str(log)),
        *("--speed", str(speed), "--out", str(out)),
    )
    try:
        said = devices.stderr.readline() if devices.stderr else ""
        if "served" not in said:
            raise RuntimeError(f"huddle devices did not start: {said}")
        spec = specification(with_faults(load(bench), told), speed=speed)
        yield Served(out, log, spec)
    finally:
        devices.send_signal(signal.SIGINT)
        devices.communicate(timeout=limit())
