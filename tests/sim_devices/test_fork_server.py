"""The server that forks simulated devices: each has its own process, and none outlives it."""

from __future__ import annotations

import os
import select
import signal
import sys
from pathlib import Path

import pytest

from sim_devices.errors import ServeError
from sim_devices.server.launch import DeviceServer, RunningDevice
from tests.devices import server_pids, serving
from tests.sim_devices.simulated_bench import device, spec

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="pidfd_open")


def pid_descriptors(running: tuple[RunningDevice, ...]) -> list[int]:
    """Return a descriptor for each process; it becomes readable when the process ends."""
    return [os.pidfd_open(one.pid) for one in running]


def wait_for_end(descriptors: list[int]) -> None:
    """Return when all processes have ended."""
    for descriptor in descriptors:
        assert select.select([descriptor], [], [], 60.0)[0], "a device did not end"
        os.close(descriptor)


def test_each_device_has_a_process_and_ends_with_its_specification() -> None:
    with serving(spec(device("A"), device("B"))) as running:
        assert len({str(one.pid) for one in running} | server_pids() | {str(os.getpid())}) == 4
        ports = [Path(one.port) for one in running]
        assert all(port.exists() for port in ports)
        descriptors = pid_descriptors(running)
    wait_for_end(descriptors)
    assert not any(port.exists() for port in ports)


def test_a_killed_device_leaves_the_others_and_no_file() -> None:
    with serving(spec(device("A"), device("B"))) as running:
        folder = Path(running[0].port).parent.parent
        first, second = pid_descriptors(running)
        running[0].kill()
        wait_for_end([first])
        assert not select.select([second], [], [], 0.0)[0]
    wait_for_end([second])
    assert not folder.exists()


def test_no_device_outlives_a_killed_server() -> None:
    with DeviceServer() as server, server.serve(spec(device("A"))) as running:
        descriptors = pid_descriptors(running)
        os.kill(server.pid, signal.SIGKILL)
        wait_for_end(descriptors)


def test_the_server_continues_after_an_invalid_specification() -> None:
    wrong = spec(device("A"))
    wrong["scenario"]["motion"]["spectra"] = []
    with pytest.raises(ServeError, match=r"did not start: .*spectra") as refused, serving(wrong):
        pass
    assert refused.value.is_usage_error  # the scenario is wrong, no device
    with serving(spec(device("A"))) as (one,):
        assert Path(one.port).exists()
