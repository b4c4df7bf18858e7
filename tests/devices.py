"""Simulated devices in tests: one server that forks them, and one clock for all who take part.

Tests that are marked ``devices`` run in an event loop by that clock. It waits for the processes of
the devices, for recorders that were started with a bench file of these devices, and for the test's
own loop: a busy machine makes such a test slow and never wrong.
"""

from __future__ import annotations

import asyncio
import functools
import tempfile
from collections.abc import Coroutine, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from daq.host_clock import SystemClock
from sim_devices.server.launch import DeviceServer, RunningDevice
from sim_devices.server.paced_clock import PacedClock, PacedLoop
from tests.virtual_time import VirtualTimeLoop

RATE = 3.0
"""How fast the clock runs while nobody is behind: no test waits for long, and the limits of what
may be late are the clock's, whatever its rate."""
NO_PROCESS = 2**22 + 1
"""No process has such an id on Linux."""
_Result = TypeVar("_Result")
_until_the_end = ExitStack()
_servers: list[DeviceServer] = []


@functools.cache
def paced_clock() -> PacedClock:
    """Return the clock of this pytest process."""
    folder = _until_the_end.enter_context(tempfile.TemporaryDirectory(prefix="huddle-clock-"))
    return PacedClock.create(Path(folder) / "clock", rate=RATE)


def device_loop() -> PacedLoop:
    """Return a new event loop by the devices' clock."""
    return PacedLoop(paced_clock())


def host_clock(speed: float = 1.0) -> SystemClock:
    """Return the host clock of who reads devices in a test: it goes with the test's event loop."""
    with suppress(RuntimeError):  # no loop runs
        loop = asyncio.get_running_loop()
        if isinstance(loop, VirtualTimeLoop):
            return SystemClock(speed, monotonic_ns=loop.time_ns, always_ns=loop.time_ns)
        if not isinstance(loop, PacedLoop):  # who is read is a program that knows no such clock
            return SystemClock(speed)
    clock = paced_clock()
    return SystemClock(
        speed, monotonic_ns=clock.now_ns, always_ns=clock.now_ns, utc_ns=clock.utc_ns
    )


def run(coroutine: Coroutine[object, object, _Result]) -> _Result:
    """Run a coroutine by the devices' clock, from a test that is none itself."""
    with asyncio.Runner(loop_factory=device_loop) as runner:
        return runner.run(coroutine)


@contextmanager
def serving(spec: Mapping[str, Any]) -> Iterator[tuple[RunningDevice, ...]]:
    """Serve every device of a specification until the context ends."""
    if not _servers:
        _servers.append(_until_the_end.enter_context(DeviceServer()))
    with _servers[0].serve({**spec, "clock": str(paced_clock().path)}) as running:
        yield running


def device_at(port: str, sensor: str, driver: str, **settings: Any) -> RunningDevice:  # noqa: ANN401
    """Return what connects to a port as to a device that runs, though none of ours is there."""
    clock = str(paced_clock().path)
    return RunningDevice((sensor,), driver, port, settings, pid=NO_PROCESS, clock=clock)


def server_pids() -> set[str]:
    """Process id of the server, if it runs: it outlives the test that first needed it."""
    return {str(server.pid) for server in _servers}


def stop() -> None:
    """End the server and the clock, at the end of the session."""
    _servers.clear()
    _until_the_end.close()
