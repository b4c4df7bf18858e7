"""Starts and stops the processes that serve a specification's devices."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from daq.python_process import python_command
from sim_devices.errors import ServeError
from sim_devices.server.paced_clock import PacedClock

HEAD_START_NS = 200_000_000
"""Delay of world time 0, in ns, so that every device has started by then."""


@dataclass(frozen=True, slots=True)
class RunningDevice:
    """One served device: its address and its process."""

    sensors: tuple[str, ...]
    driver: str
    port: str
    settings: dict[str, Any]
    """To be added to the settings of its sensors."""
    pid: int
    clock: str
    """File of the clock by which the device runs (:mod:`sim_devices.server.paced_clock`)."""

    def kill(self) -> None:
        """Kill the device's process, like a power failure."""
        os.kill(self.pid, signal.SIGKILL)


class DeviceServer:
    """A process that serves simulated devices (:mod:`sim_devices.server.fork_server`).

    It serves several specifications concurrently, and is thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process = subprocess.Popen(
            python_command("sim_devices.server.fork_server"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            # A device multiplies no large matrices, so more threads would only compete for cores.
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C reaches only the parent, which ends the devices
        )

    @property
    def pid(self) -> int:
        """Process id of the process that forks the devices."""
        return self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the process and every device."""
        with self._process:  # closes its standard input and waits for its end
            pass

    @contextmanager
    def serve(self, spec: Mapping[str, Any]) -> Iterator[tuple[RunningDevice, ...]]:
        """Serve every device of a specification until the context ends.

        Parameters
        ----------
        spec
            As described in :mod:`sim_devices.server.serve`. Without ``clock``, the devices get a
            new clock; without ``epoch_ns``, their world begins when all devices have started.

        Raises
        ------
        ServeError
            If a device cannot be served; the message has the cause.
        """
        with tempfile.TemporaryDirectory(prefix="huddle-") as folder:
            path = spec.get("clock") or f"{folder}/clock"
            clock = PacedClock(path) if "clock" in spec else PacedClock.create(path)
            epoch = {"clock": path, "epoch_ns": clock.now_ns() + HEAD_START_NS}
            file = Path(folder) / "spec.json"
            file.write_text(json.dumps({**epoch, **spec}), encoding="utf-8")
            with clock.participate():  # the clock waits until the devices have started
                answer = self._ask({"serve": str(file)})
            clock.close()
            if "error" in answer:
                message = f"a simulated device did not start: {answer['error']}"
                raise ServeError(message, is_usage_error=answer["is_usage_error"])
            about = {"speed": spec["speed"], "clock": path}
            ports = {device["port"]: about for device in answer["devices"]}
            # whoever records these ports, with a bench file of any origin, learns what they are
            (Path(folder) / "simulated-ports.json").write_text(json.dumps(ports), encoding="utf-8")
            try:
                yield tuple(
                    RunningDevice(**{**device, "sensors": tuple(device["sensors"])}, clock=path)
                    for device in answer["devices"]
                )
            finally:
                if self._process.poll() is None:  # otherwise the devices ended with the process
                    self._ask({"stop": str(file)})

    def _ask(self, request: Mapping[str, str]) -> dict[str, Any]:
        with self._lock:
            if self._process.stdin is None or self._process.stdout is None:
                raise ServeError("the server of simulated devices has no pipes")
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        if not line:
            raise ServeError(f"the server of simulated devices ended with {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextmanager
def start(spec: Mapping[str, Any]) -> Iterator[tuple[RunningDevice, ...]]:
    """Serve every device of ``spec`` until the context ends; see :meth:`DeviceServer.serve`."""
    with DeviceServer() as server, server.serve(spec) as running:
        yield running
