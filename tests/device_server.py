"""The simulated devices of all tests in one pytest process: one server forks them all."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from sim_devices.server.launch import DeviceServer, RunningDevice

_started: list[DeviceServer] = []


@contextlib.contextmanager
def serving(spec: Mapping[str, Any]) -> Iterator[tuple[RunningDevice, ...]]:
    """Serve every device of a specification until the context ends."""
    with _server().serve(spec) as running:
        yield running


def _server() -> DeviceServer:
    from sim_devices.server.launch import DeviceServer  # noqa: PLC0415  (few tests need devices)

    if not _started:
        _started.append(DeviceServer())
    return _started[0]


def server_pids() -> set[str]:
    """Process id of the server, if it runs: it outlives the test that first needed it."""
    return {str(server.pid) for server in _started}


def stop_server() -> None:
    """End the server, at the end of the session."""
    while _started:
        _started.pop().close()
