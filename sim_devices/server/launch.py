"""Start the processes that serve a specification's devices, and stop them again."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.python_process import python_command
from sim_devices.errors import ServeError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

STOP_TIMEOUT = 5.0


@dataclass(frozen=True, slots=True)
class RunningDevice:
    """One served device: where it can be connected to, and its process."""

    sensors: tuple[str, ...]
    driver: str
    port: str
    settings: dict[str, Any]
    """To be added to the settings of its sensors."""
    process: subprocess.Popen[str]


@contextmanager
def start(spec: Mapping[str, Any]) -> Iterator[tuple[RunningDevice, ...]]:
    """Serve every device of ``spec`` in a process of its own until the context ends.

    The processes start in parallel, and end with this one in any case.

    Parameters
    ----------
    spec
        As described in :mod:`sim_devices.server.serve`.

    Raises
    ------
    ServeError
        A device could not be served; the message holds what its process said.
    """
    with tempfile.TemporaryDirectory(prefix="huddle-") as folder:
        file = Path(folder) / "spec.json"
        file.write_text(json.dumps(spec), encoding="utf-8")
        started: list[subprocess.Popen[str]] = []
        try:
            started.extend(_start(file, index) for index in range(len(spec["devices"])))
            yield tuple(_running(process) for process in started)
        finally:
            _stop(started)


def _start(file: Path, index: int) -> subprocess.Popen[str]:
    return subprocess.Popen(
        python_command("sim_devices", str(file), str(index)),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(file.parent)},  # what a killed one leaves goes too
        start_new_session=True,  # a Ctrl-C at the terminal is for the parent; it ends them
    )


def _running(process: subprocess.Popen[str]) -> RunningDevice:
    said = process.stdout.readline() if process.stdout else ""
    if not said:
        process.wait()
        why = process.stderr.read().strip() if process.stderr else ""
        raise ServeError(f"a simulated device did not start: {why or 'it ended without a word'}")
    table = json.loads(said)
    return RunningDevice(
        sensors=tuple(table["sensors"]),
        driver=table["driver"],
        port=table["port"],
        settings=table["settings"],
        process=process,
    )


def _stop(processes: list[subprocess.Popen[str]]) -> None:
    for process in processes:
        if process.stdin:
            process.stdin.close()
    for process in processes:
        try:
            process.wait(STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for stream in (process.stdout, process.stderr):
            if stream:
                stream.close()
