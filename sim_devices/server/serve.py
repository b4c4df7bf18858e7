"""Serve simulated devices: ``python -m sim_devices SPEC.json``.

The specification is one JSON object::

    {"clock": "FILE",              the clock of the bench, see sim_devices.server.paced_clock
     "epoch_ns": 123,              instant of that clock, in ns, at which world time is 0
     "speed": 1.0,                 world seconds that pass in one second of that clock
     "scenario": {...},            see sim_devices.world.scenario
     "faults": [...],              see sim_devices.faults
     "fault_log": "FILE",          log of faults, one JSON object per line
     "sent_log": "FILE",           log of units that a reader could have read, in hexadecimal
     "devices": [
       {"sensors": ["A"],          sensors of this device, as named in the scenario
        "driver": "epson",         its protocol, a key of FAMILIES
        "port": "pty",             or "tcp", "udp"
        "number": 0,               TCP port number, 0 for any free one; numbers of further ports
                                   are in the settings
        "sampling_rate": 200.0,    Hz
        "settings": {...},         as the driver's settings in the bench file
        "sensor_settings": {"A": {...}},      settings of single sensors
        "model": "", "serial_number": "",     reported identity; default: of the family
        "channels": {"A": [{"name": "x", "sensitivity": 1710800.0, "auxiliary": false}, ...]}}]}

A separate process serves each device (:mod:`sim_devices.server.fork_server`) and announces when it
accepts connections::

    {"sensors": ["A"], "driver": "epson", "port": "/tmp/huddle-x/tty", "settings": {}}

``settings`` has additions to the sensors' settings (numbers of further ports, certificates).
``python -m sim_devices`` prints one such line per device and ends when its standard input is
closed.

Device families (``FAMILIES``) are imported when served; :mod:`sim_devices.devices.interface`
describes their interface.
"""

from __future__ import annotations

import asyncio
import json
import math
import signal
import time
from collections import deque
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim_devices.devices.interface import (
    NEVER,
    ChannelSpec,
    DeviceSpec,
    Endpoint,
    Line,
    Source,
)
from sim_devices.faults import Fault, LineFaults, SampleFaults, parse
from sim_devices.server.ports import DevicePort, make_port
from sim_devices.world.scenario import Scenario

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from sim_devices.server.paced_clock import PacedClock

NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class WorldClock:
    """World time from a monotonic clock that all processes of the bench share.

    Attributes
    ----------
    epoch_ns : int
        Instant of the monotonic clock at which world time is 0.
    speed : float
        World seconds that pass in one second.
    monotonic_ns : callable
        The monotonic clock: the system's, or :meth:`PacedClock.now_ns
        <sim_devices.server.paced_clock.PacedClock.now_ns>`.
    """

    epoch_ns: int
    speed: float = 1.0
    monotonic_ns: Callable[[], int] = time.monotonic_ns

    def now(self) -> float:
        """Return the world time in s."""
        return (self.monotonic_ns() - self.epoch_ns) / NS * self.speed

    def monotonic(self, world_time: float) -> float:
        """Return the instant of the monotonic clock, in s, of a world time."""
        return self.epoch_ns / NS + world_time / self.speed


FAMILIES = {
    "epson": "sim_devices.devices.epson:create",
    "registers": "sim_devices.devices.modbus:create",
    "labjack": "sim_devices.devices.labjack:create",
    "guralp": "sim_devices.devices.guralp:create",
    "fifo": "sim_devices.devices.fifo:create",
    "text": "sim_devices.devices.text:create",
    "seedlink": "sim_devices.devices.seedlink:create",
    "iio": "sim_devices.devices.iio:create",
}
"""Driver name → ``module:function`` that creates its simulated device."""

HANG_UP_DELAY = 0.05
"""Seconds between the last unit and a hang-up, so that a reader can have read the unit: a system
discards the bytes of a terminal that were not read. Longer than the lead of the clock over a reader
(:mod:`sim_devices.server.paced_clock`)."""
MIN_INTERVAL = 0.004
"""Minimum time between two sends of one line, s: units due in between are sent together.

Replies are not delayed.
"""


class Served:
    """One endpoint on its line: calls the endpoint for received bytes and at due times.

    Units are sent at absolute instants of world time, so that delays do not accumulate.
    """

    def __init__(
        self,
        line: Line,
        clock: WorldClock,
        faults: LineFaults,
        tell: Callable[[float, Fault], None],
        tell_sent: Callable[[float, bytes], None] | None = None,
        *,
        number: int = 0,
    ) -> None:
        self.line = line
        self._faults = faults
        self._tell_fault = tell
        self._tell_sent = tell_sent
        self._unsent: deque[tuple[float, bytes]] = deque()
        """Time and bytes of units accepted by the port, of which some wait in this process."""
        self._endpoint: Endpoint = line.endpoint
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._last = -math.inf
        self._down = self._muted = False
        self._pending_hang_up: asyncio.TimerHandle | None = None
        self.port: DevicePort = make_port(
            line.kind, self, scheme=line.scheme, number=number, tls=line.tls
        )

    def connected(self) -> None:
        """Handle a reader that opened the line."""
        self._send(self._endpoint.connected(self._clock.now()))
        self._schedule()

    def received(self, received: bytes) -> None:
        """Handle received bytes."""
        self._last = -math.inf
        self._send(self._endpoint.receive(received, self._clock.now()))
        self._schedule()

    def disconnected(self) -> None:
        """Handle the last reader that closed the line."""
        self._unsent.clear()
        self._endpoint.disconnected(self._clock.now())
        self._schedule()

    async def close(self) -> None:
        """Remove the line."""
        if self._pending_hang_up is not None:
            self._pending_hang_up.cancel()
        await self.port.close()
        if self._timer is not None:
            self._timer.cancel()

    def _send(self, units: Sequence[bytes]) -> None:
        if units:
            self._put(self._faults.send(units, self._clock.now()))

    def _put(self, units: Sequence[bytes]) -> None:
        if self._muted:
            return
        sent = self.port.send(units)
        if self._tell_sent is not None:
            self._unsent += [(self._clock.now(), unit) for unit in sent]
            self._tell()

    def _tell(self) -> None:
        """Log the units that have left this process whole: a reader can read them."""
        n_waiting = self.port.n_unsent()
        n_logged = sum(len(unit) for _, unit in self._unsent) - n_waiting
        while self._tell_sent is not None and self._unsent:
            at, unit = self._unsent[0]
            if len(unit) > n_logged:
                return
            n_logged -= len(unit)
            self._unsent.popleft()
            self._tell_sent(at, unit)

    def _hang_up(self) -> None:
        self._pending_hang_up = None
        self._muted = False
        if self._tell_sent is not None:
            self._tell()
        self._unsent.clear()
        self.port.hang_up()

    def _strike(self) -> None:
        """Start and end the faults that are due."""
        now = self._clock.now()
        if self._down and now >= self._faults.down_until:
            self._down = False
            if self._pending_hang_up is not None:  # unplugged for less than the delay
                self._pending_hang_up.cancel()
                self._hang_up()
            self.port.restore()
        faults, units = self._faults.act(now)
        self._put(units)
        for fault in faults:
            if fault.kind == "disconnect" and not self._down:
                self._down = self._muted = True
                self._pending_hang_up = self._loop.call_later(HANG_UP_DELAY, self._hang_up)
            else:
                self._endpoint.fault(fault.kind, now, fault.duration)
        for at, fault in self._faults.struck:
            self._tell_fault(at, fault)
        self._faults.struck.clear()

    def _schedule(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        when = min(self._endpoint.next_due(), self._faults.next_due())
        if self._down:
            when = min(when, self._faults.down_until)
        if when < NEVER:
            at = max(self._clock.monotonic(when), self._last + MIN_INTERVAL)
            self._timer = self._loop.call_at(at, self._tick)

    def _tick(self) -> None:
        self._timer = None
        self._last = self._loop.time()
        self._strike()
        self._send(self._endpoint.due(self._clock.now()))
        self._schedule()


async def serve(
    spec: Mapping[str, Any],
    index: int,
    paced: PacedClock,
    *,
    announce: Callable[[Mapping[str, Any]], None],
    lifeline: int,
) -> None:
    """Serve one device until SIGTERM or SIGINT, or until the other end of ``lifeline`` is closed.

    Parameters
    ----------
    spec : mapping
        As described in this module.
    index : int
        Index of the device in the specification.
    paced : PacedClock
        Clock of the running event loop.
    announce : callable
        Called once, when the device accepts connections.
    lifeline : int
        File descriptor, open for reading.
    """
    epoch_ns = int(spec["epoch_ns"])
    utc_ns = paced.utc_of(epoch_ns)
    device = replace(device_spec(spec["devices"][index]), utc_ns=utc_ns)
    scenario = Scenario.from_dict(spec["scenario"], sampling_rate=device.sampling_rate)
    clock = WorldClock(epoch_ns, float(spec.get("speed", 1.0)), paced.now_ns)
    module, _, function = FAMILIES[device.driver].partition(":")
    faults = parse(spec.get("faults", ()), device.sensors)
    for fault in faults:
        if fault.kind == "wrap":  # the counter has 16 bits
            first = round(-fault.at * device.sampling_rate) % 65536
            device = replace(device, settings={**device.settings, "first_count": first})
    source = Source(scenario, device, faults=SampleFaults(faults))
    for sensor in device.sensors:  # the first sample is slow: compute it before clients wait
        source.counts(sensor, source.first_sample_after(sensor, clock.now()), 1)
    lines: Sequence[Line] = getattr(import_module(module), function)(device, source)
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ended.set)
    loop.add_reader(lifeline, ended.set)  # nothing is ever written to it
    name = ",".join(device.sensors)
    tell_fault, tell_sent = _Log(spec.get("fault_log"), device), _Log(spec.get("sent_log"), device)

    def tell(at: float, fault: Fault) -> None:
        tell_fault.write(at=at, **fault.model_dump(exclude={"sensors", "at"}))

    def sent(at: float, unit: bytes) -> None:
        tell_sent.write(at=at, unit=unit.hex())

    tell_sent.write(at=clock.now(), utc_ns=device.utc_ns)
    first_port = int(spec["devices"][index].get("number", 0))
    served = [
        Served(
            line,
            clock,
            LineFaults(
                [f for f in faults if line.carries_samples or f.kind == "disconnect"],
                f"{name} {k}",
                begin=clock.now(),
            ),
            tell,
            sent if line.carries_samples and tell_sent.is_wanted else None,
            number=int(device.settings.get(line.setting, 0)) if k and first_port else first_port,
        )
        for k, line in enumerate(lines)
    ]
    opened: list[Served] = []
    try:
        for one in served:
            opened.append(one)
            await one.port.open()
        announce(_announcement(device, served))
        await ended.wait()
    finally:
        loop.remove_reader(lifeline)
        for one in opened:
            await one.close()


class _Log:
    """Lines of JSON that all processes of a bench append to one file; optional."""

    def __init__(self, path: str | None, device: DeviceSpec) -> None:
        self._path = path
        self._sensors = list(device.sensors)

    @property
    def is_wanted(self) -> bool:
        """Whether the log has a file."""
        return bool(self._path)

    def write(self, **fields: object) -> None:
        """Append one line atomically."""
        if self._path:
            line = json.dumps({"sensors": self._sensors, **fields}) + "\n"
            with Path(self._path).open("ab", buffering=0) as file:
                file.write(line.encode())


def _announcement(device: DeviceSpec, served: Sequence[Served]) -> dict[str, Any]:
    return {
        "sensors": list(device.sensors),
        "driver": device.driver,
        "port": served[0].port.address,
        "settings": served[0].port.settings
        | {one.line.setting: int(one.port.address.rpartition(":")[2]) for one in served[1:]},
    }


def device_spec(table: Mapping[str, Any]) -> DeviceSpec:
    """Parse one entry of ``devices``."""
    return DeviceSpec(
        sensors=tuple(table["sensors"]),
        driver=table["driver"],
        port=table.get("port", "pty"),
        sampling_rate=float(table["sampling_rate"]),
        channels={
            sensor: tuple(ChannelSpec(**channel) for channel in channels)
            for sensor, channels in table["channels"].items()
        },
        settings=table.get("settings", {}),
        sensor_settings=table.get("sensor_settings", {}),
        model=table.get("model", ""),
        serial_number=table.get("serial_number", ""),
    )
