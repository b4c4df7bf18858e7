"""Every mode of every driver, its simulated device, and what its sensors felt."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from daq.bench.model import Sensor
from daq.conformance.suite import Sent
from daq.devices.epson import commands
from daq.host_clock import SystemClock
from sim_devices.devices.interface import Source
from sim_devices.server.launch import RunningDevice
from sim_devices.server.serve import WorldClock, device_spec
from sim_devices.world.scenario import Scenario
from tests.devices import paced_clock, serving
from tests.sim_devices.simulated_bench import device, sensors, spec

RATE = 100.0
XYZ = ("x", "y", "z")
POLLED: dict[str, Any] = {"driver": "registers", "sampling_rate": 20.0}
SEEDLINK: dict[str, Any] = {"driver": "seedlink", "port": "tcp"}
STATION: dict[str, Any] = {
    "network": "XX",
    "station": "S1",
    "location": "00",
    "channels": ["HNZ", "HNN", "HNE"],
    "late": 4.0,
    "patience": 20.0,
}
LABJACK: dict[str, Any] = {"driver": "labjack", "port": "tcp"}
CASES: dict[str, dict[str, Any]] = {
    "epson": {"driver": "epson", "sensitivity": commands.COUNTS_PER_UNIT, "settings": {}},
    "registers rtu": {**POLLED, "settings": {"address": 0, "timeout": 1.0}},
    "registers tcp": {**POLLED, "port": "tcp", "settings": {"address": 0, "timeout": 1.0}},
    "labjack": {**LABJACK, "sensors": ["labjack 1", "labjack 2"], "settings": {}},
    "labjack polled": {**LABJACK, "settings": {"mode": "command-response"}},
    "guralp serial": {"driver": "guralp", "settings": {"patience": 2.0}},
    "scream udp": {"driver": "guralp", "port": "udp", "settings": {"patience": 2.0}},
    "scream tcp": {
        "driver": "guralp",
        "port": "tcp",
        "settings": {"link": "scream", "patience": 2.0},
    },
    "fifo": {"driver": "fifo", "settings": {}},
    "fifo tcp": {"driver": "fifo", "port": "tcp", "settings": {}},
    "seedlink 4": {**SEEDLINK, "settings": {**STATION}},
    "seedlink 3": {
        **SEEDLINK,
        "settings": {**STATION, "station": "S2", "protocol": "3", "channels": ["HN?"]},
    },
    "seedlink tls": {
        **SEEDLINK,
        "settings": {
            **STATION,
            "station": "S3",
            "tls": True,
            "credentials": str(Path(__file__).with_name("seedlink_credentials.txt")),
        },
    },
    "iio": {"driver": "iio", "port": "tcp", "settings": {}},
    "text serial": {
        "driver": "text",
        "settings": {
            "columns": [1, 2, 3],
            "counter_column": 0,
            "nmea_checksum": True,
            "baud_rate": 115200,
        },
    },
    "text tcp": {"driver": "text", "port": "tcp", "settings": {"time_column": 3}},
    "text udp": {"driver": "text", "port": "udp", "settings": {"preset": "raspberry-shake"}},
}
MOVING = {"cycle": {"ppm": 30.0, "period": 20.0}}
"""Clock of every sensor: its rate moves with the temperature."""
OFFSETS = {"labjack": 33523}
"""Counts where a sensor feels nothing."""
RANGES = {"labjack": (0, 65535), "fifo": (-32768, 32767), "registers": (-32768, 32767)}
"""Of counts, where the motion goes beyond them."""


def table(mode: str) -> dict[str, Any]:
    """Return the simulated device of a mode."""
    case = {"sensors": [f"{mode} 1"], "sampling_rate": RATE, **CASES[mode]}
    sensitivity = case.pop("sensitivity", 1e6)
    channels = [{"name": axis, "sensitivity": sensitivity} for axis in XYZ]
    return device("", **case, channels=dict.fromkeys(case["sensors"], channels))


@dataclass(frozen=True)
class Served:
    """Devices of all modes that run."""

    devices: dict[str, RunningDevice]
    world: dict[str, Any]
    log: Path

    def device(self, mode: str) -> RunningDevice:
        """Return the running device."""
        return self.devices[mode]

    def sensors(self, mode: str, **changes: Any) -> list[Sensor]:  # noqa: ANN401
        """Return the sensors of a bench file that connects to it."""
        one = self.devices[mode]
        settings = {**CASES[mode]["settings"], **one.settings}
        return sensors(one, table(mode), settings=settings, **changes)

    def assert_felt(
        self, mode: str, name: str, index: NDArray[np.int64], counts: NDArray[Any]
    ) -> NDArray[np.int64]:
        """See that counts are what the sensor felt: each sample once, and in its place.

        Returns which sample of the world each is.
        """
        driver = CASES[mode]["driver"]
        felt = np.clip(self._felt[name] + OFFSETS.get(driver, 0), *RANGES.get(driver, (None, None)))
        if driver == "registers":  # each poll is the latest reading
            which = np.asarray(KDTree(felt).query(counts, p=np.inf)[1], np.int64)
            assert np.abs(felt[which] - counts).max() <= 0.5, mode
            assert (np.diff(which) >= 0).all(), mode
            return which
        start = int(np.abs(felt - counts[0]).max(axis=1).argmin())
        which = index + (start - int(index[0]))
        expected = felt[which]
        assert np.abs(expected - counts).max() <= 0.5 + 1e-8 * np.abs(expected).max(), mode
        return which

    def sent(self, mode: str, name: str, clock: SystemClock, *, speed: float) -> Sent:
        """Return what the device has sampled so far, due by the host clock of its reader."""
        driver = CASES[mode]["driver"]
        felt = np.clip(self._felt[name] + OFFSETS.get(driver, 0), *RANGES.get(driver, (None, None)))
        now, host_now = world_clock(self.world).now(), clock.now().monotonic_ns * 1e-9
        since = (now - self._felt.times[name]) * speed / self.world["speed"]
        return Sent(felt, host_now - since)

    def struck(self, mode: str) -> list[dict[str, Any]]:
        """Return the faults that struck a mode's device so far."""
        told = _lines(self.log.with_name("faults"))
        return [one for one in told if one["sensors"][0] in self.devices[mode].sensors]

    @cached_property
    def _felt(self) -> _Felt:
        return _Felt(self.world, _lines(self.log))


def _lines(log: Path) -> list[dict[str, Any]]:
    """Read a log that may be being written."""
    lines = log.read_text(encoding="utf-8").splitlines(keepends=True) if log.exists() else []
    return [json.loads(line) for line in lines if line.endswith("\n")]


class _Felt(dict[str, "NDArray[np.float64]"]):
    """What each sensor has felt since world time 0, in counts, worked out when asked for."""

    def __init__(self, world: dict[str, Any], told: list[dict[str, Any]]) -> None:
        super().__init__()
        self._world = world
        self.times: dict[str, NDArray[np.float64]] = {}
        """World times of the samples of each sensor."""
        self._utc_ns = {n: x["utc_ns"] for x in told if "utc_ns" in x for n in x["sensors"]}

    def __missing__(self, name: str) -> NDArray[np.float64]:
        one = next(one for one in self._world["devices"] if name in one["sensors"])
        described = replace(device_spec(one), utc_ns=self._utc_ns[name])
        rate = described.sampling_rate
        world = Scenario.from_dict(self._world["scenario"], sampling_rate=rate)
        source = Source(world, described)
        if described.driver in {"guralp", "seedlink"}:  # on whole seconds of UTC
            source = source.disciplined(-described.utc_ns % 10**9 / 1e9)
        n_samples = round((world_clock(self._world).now() + 1.0) * rate)
        self[name] = source.counts(name, 0, n_samples)
        self.times[name] = source.times(name, 0, n_samples)
        return self[name]


def world_clock(world: dict[str, Any]) -> WorldClock:
    """Return the clock of a specification's world."""
    return WorldClock(world["epoch_ns"], world["speed"], paced_clock().now_ns)


@contextlib.contextmanager
def serving_all(*, speed: float, faults: list[dict[str, Any]] | None = None) -> Iterator[Served]:
    """Serve the devices of all modes, with a fault script.

    Rates move with the temperature, and stated UTC comes in steps of 0.1 ms.
    """
    tables = [table(mode) for mode in CASES]
    world = spec(*tables, speed=speed)
    for one in tables:
        for name in one["sensors"]:
            sensor = world["scenario"]["sensors"][name]
            sensor["sampling_rate"], sensor["clock"] = one["sampling_rate"], MOVING
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "sent"
        world |= {
            "faults": [{"kind": "coarse", "at": 0.0, "level": 1e-4}, *(faults or [])],
            "sent_log": str(log),
            "fault_log": str(log.with_name("faults")),
        }
        with serving(world) as running:
            yield Served(dict(zip(CASES, running, strict=True)), world, log)
