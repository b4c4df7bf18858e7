"""The process that serves simulated devices: ``python -m sim_devices.server.fork_server``.

It imports modules once and forks a process for each device: importing takes most of a second,
forking a few milliseconds. It reads requests from standard input, one JSON object per line, and
writes one line to standard output for each:

- ``{"serve": FILE}``: serve every device of a specification. The reply has ``devices``: the
  announcement of each device (see :mod:`sim_devices.server.serve`) and its ``pid``. If the reply is
  ``{"error": TEXT}``, none of the devices is served.
- ``{"stop": FILE}``: end the devices of a specification. The reply is ``{}``.

All devices end when standard input is closed, and when this process is killed.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from sim_devices.errors import ServeError, SimulationError
from sim_devices.server.paced_clock import PacedClock, PacedLoop
from sim_devices.server.serve import FAMILIES, serve

STOP_TIMEOUT = 5.0
"""Seconds after which a device that does not end is killed."""


class ForkServer:
    """The devices of several specifications, each device in its own process."""

    def __init__(self) -> None:
        self._devices: dict[str, list[int]] = {}
        # Every device reads one end. The system closes the other end when this process ends.
        self._lifeline, self._held = os.pipe()

    def answer(self, request: Mapping[str, str]) -> dict[str, Any]:
        """Serve or stop the devices of a specification."""
        if "stop" in request:
            self.stop(request["stop"])
            return {}
        file = request["serve"]
        try:
            return {"devices": self._serve(file)}
        except ServeError as error:
            self.stop(file)
            return {"error": str(error), "is_usage_error": error.is_usage_error}

    def stop(self, file: str) -> None:
        """End the devices of a specification and wait until they have ended."""
        devices = self._devices.pop(file, [])
        for pid in devices:
            os.kill(pid, signal.SIGTERM)
        deadline = time.monotonic() + STOP_TIMEOUT
        for pid in devices:
            while os.waitpid(pid, os.WNOHANG) == (0, 0):
                if time.monotonic() > deadline:
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)
                    break
                time.sleep(0.002)

    def close(self) -> None:
        """End all devices."""
        for file in list(self._devices):
            self.stop(file)

    def _serve(self, file: str) -> list[dict[str, Any]]:
        spec = json.loads(Path(file).read_text(encoding="utf-8"))
        for device in spec["devices"]:
            import_module(FAMILIES[device["driver"]].partition(":")[0])
        gc.collect()
        gc.freeze()  # otherwise a collection in a device would copy the shared pages
        self._devices[file] = pids = []
        pipes = []
        for index in range(len(spec["devices"])):
            reading, writing = os.pipe()
            pid = os.fork()
            if pid == 0:
                os.close(reading)
                self._run(spec, index, Path(file).parent, writing)
            os.close(writing)
            pids.append(pid)
            pipes.append(reading)
        announced = [_read_all(pipe) for pipe in pipes]
        devices = [
            json.loads(text or '{"error": "it ended without a message"}') for text in announced
        ]
        for device, pid in zip(devices, pids, strict=True):
            if "error" in device:
                wrong = device.get("is_usage_error", False)
                raise ServeError(device["error"], is_usage_error=wrong)
            device["pid"] = pid
        return devices

    def _run(self, spec: Mapping[str, Any], index: int, folder: Path, writing: int) -> NoReturn:
        """Serve one device in this forked process; never return."""
        with os.fdopen(writing, "w", encoding="utf-8") as pipe:

            def announce(table: Mapping[str, Any]) -> None:
                json.dump(table, pipe)
                pipe.close()

            os.close(self._held)
            os.dup2(self._lifeline, 0)
            tempfile.tempdir = str(folder)  # the caller removes it, also if the device is killed
            code = 0
            try:
                clock = PacedClock(spec["clock"])
                factory = partial(PacedLoop, clock, only_answers=True)
                with asyncio.Runner(loop_factory=factory) as runner:
                    runner.run(serve(spec, index, clock, announce=announce, lifeline=0))
            except BaseException as error:  # noqa: BLE001 -- nothing may return to the server's loop
                code = 1
                expected = isinstance(error, (OSError, SimulationError))
                wrong = isinstance(error, SimulationError) and error.is_usage_error
                if not pipe.closed:
                    message = str(error) if expected else traceback.format_exc()
                    announce({"error": message, "is_usage_error": wrong})
                elif not expected:
                    traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(code)  # without flushing the server's buffered output


def _read_all(pipe: int) -> bytes:
    with os.fdopen(pipe, "rb") as reader:
        return reader.read()


def main() -> None:
    """Process requests until standard input is closed."""
    server = ForkServer()
    try:
        for line in sys.stdin:
            print(json.dumps(server.answer(json.loads(line))), flush=True)
    finally:
        server.close()


if __name__ == "__main__":
    main()
