"""Driver for Epson M-A552 accelerometers on a CAN bus (CANopen); needs the extra ``can``.

All sensors of one port are devices on one bus. The first of them produces the SYNC at which all
send their samples, so they share one clock and one index. See :mod:`daq.devices.epson.canopen`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt

from daq.devices.epson import canopen as protocol
from daq.devices.epson.commands import COUNTS_PER_G, FILTERS, USUAL_FILTER, temperature
from daq.devices.interface import DeviceInformation, PresentPort
from daq.devices.port_rules import package, port_label, require_alike
from daq.errors import (
    BenchFileError,
    FileFault,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.protocols.block import Quantity, Reading, ReadingTimes

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.protocols.block import DeviceItem, HostTime

SCHEME = "can://"
BLOCK_SECONDS = 0.1
"""Seconds of samples that are decoded together."""
ARPHRD_CAN = 280
"""Type of a network that is a CAN bus, in Linux."""
ADAPTERS = ("pcan", "kvaser", "vector", "ixxat")
"""Kinds of adapters that libraries of their vendors list."""
OF_THE_BUS = ("interface", "bitrate", "filter")
NOTIFIER_CYCLE = 0.1
"""Seconds after which the thread of the adapter looks whether it is to end."""
NMT_OPERATIONAL, NMT_PRE_OPERATIONAL = 1, 128


class EpsonCanSettings(BaseModel):
    """``[sensors.settings]`` of an M-A552."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    node_id: Annotated[int, Field(ge=1, le=127)] = 1
    """CANopen node ID; each device of a bus has its own."""
    interface: str = "socketcan"
    """Kind of CAN adapter, as python-can names it: socketcan, pcan, kvaser, slcan, vector …"""
    bitrate: PositiveInt = 1_000_000
    """Of the bus, in bit/s. With socketcan, it is set by the system instead."""
    filter: str | None = None
    """Name of the filter, as ``K512_FC210``; default: the usual one of the sampling rate."""
    full_scale: PositiveFloat = 15.0
    """In g; samples beyond are flagged as clipped."""


class EpsonCanSession:
    """The devices of one bus, configured and quiet."""

    def __init__(
        self,
        bus: _Bus,
        nodes: Mapping[str, int],
        decoder: protocol.CanDecoder,
        information: tuple[DeviceInformation, ...],
        n_messages: int,
    ) -> None:
        self.information = information
        self.hint = "expected SYNC and TPDO messages; check power, termination and bitrate"
        self.patience = 10.0
        self._bus, self._nodes = bus, nodes
        self._decoder = decoder
        self._n_messages = n_messages

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Start SYNC and yield blocks, events, and the temperatures once a minute, until closed."""
        await self._bus.start()
        reading_times = ReadingTimes()
        while True:
            messages, at = await self._bus.read(self._n_messages)
            for item in self._decoder.receive(messages, at):
                yield item
            if reading_times.is_due(at):
                for sensor, node in self._nodes.items():
                    for reading in await self._temperature(sensor, node, at):
                        yield reading

    async def _temperature(self, sensor: str, node: int, at: HostTime) -> list[Reading]:
        """Return the temperature of a device; none if it does not reply."""
        try:
            octets = await self._bus.ask(node, *protocol.TEMPERATURE)
        except (NoAnswerError, WrongDeviceError):
            return []
        count = int.from_bytes(octets, "little", signed=True)
        return [Reading(sensor, Quantity.TEMPERATURE, temperature(count), at)]


class _Bus:
    """The bus: SDO in a thread, because the library blocks; messages through the event loop."""

    def __init__(self, label: str, clock: HostClock, nodes: Sequence[int]) -> None:
        self.label = label
        self._clock = clock
        self._nodes = tuple(nodes)
        self._wanted = {protocol.SYNC}
        self._wanted |= {base + node for base in protocol.TPDO_COB_IDS for node in nodes}
        self._messages: list[protocol.Message] = []
        self._at: HostTime | None = None
        self._arrived = asyncio.Event()
        self._n_expected = 1
        self._network: Any = None

    async def open(self, channel: str, settings: EpsonCanSettings) -> None:
        """Open the adapter."""
        can, canopen = (package(name, "can", self.label) for name in ("can", "canopen"))
        loop = asyncio.get_running_loop()

        def connect() -> None:
            bus = can.Bus(channel, interface=settings.interface, bitrate=settings.bitrate)
            self._network = canopen.Network(bus)
            self._network.NOTIFIER_CYCLE = NOTIFIER_CYCLE
            for cob_id in self._wanted:
                self._network.subscribe(cob_id, received)
            self._network.connect()

        def received(cob_id: int, data: bytearray, timestamp: float) -> None:  # in a thread
            del timestamp  # of the adapter's clock
            at = self._clock.now()
            with contextlib.suppress(RuntimeError):  # the loop was closed
                loop.call_soon_threadsafe(self._receive, cob_id, bytes(data), at)

        try:
            await asyncio.to_thread(connect)
        except (can.CanError, OSError, ValueError, NotImplementedError) as error:
            raise NotConnectedError(
                f"{self.label}: {error}; check the adapter, settings.interface and the channel"
            ) from error
        for node in self._nodes:
            dictionary = canopen.ObjectDictionary()
            self._network.add_node(node, dictionary)

    def _receive(self, cob_id: int, data: bytes, at: HostTime) -> None:
        self._messages.append((cob_id, data))
        self._at = at
        if len(self._messages) >= self._n_expected and cob_id != protocol.SYNC:
            self._arrived.set()

    async def read(self, n_messages: int) -> tuple[list[protocol.Message], HostTime]:
        """Return at least so many messages, or what has come in a second."""
        self._n_expected = n_messages
        while True:
            if len(self._messages) >= n_messages:
                self._arrived.set()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1.0):
                    await self._arrived.wait()
            self._arrived.clear()
            failure = self._network.notifier.exception if self._network.notifier else None
            if self._at is not None and self._messages:
                messages, self._messages = self._messages, []
                return messages, self._at
            if failure is not None:
                raise NotConnectedError(f"{self.label}: the bus closed ({failure})")

    async def ask(self, node: int, index: int, subindex: int = 0) -> bytes:
        """Read an object of a device."""
        return bytes(await self._sdo(node, "upload", index, subindex))

    async def set(self, node: int, index: int, subindex: int, value: int, size: int) -> None:
        """Write an object of a device."""
        await self._sdo(node, "download", index, subindex, value.to_bytes(size, "little"))

    async def _sdo(self, node: int, call: str, index: int, subindex: int, *data: bytes) -> bytes:
        import canopen  # noqa: PLC0415

        what = f"object {index:04X}h:{subindex} of node {node}"
        try:
            sdo = self._network.nodes[node].sdo
            return await asyncio.to_thread(getattr(sdo, call), index, subindex, *data) or b""
        except canopen.SdoAbortedError as error:
            raise WrongDeviceError(f"{self.label}: {what}: refused ({error})") from error
        except canopen.SdoCommunicationError as error:
            raise NoAnswerError(
                f"{self.label}: {what}: {error}; check power, node_id and bitrate"
            ) from error

    async def start(self) -> None:
        """Let all devices send, then start SYNC."""
        for node in self._nodes:
            await self.set(node, protocol.SAMPLE_COUNTER, 0, 0, 2)
        self._messages.clear()
        await asyncio.to_thread(self._network.nmt.send_command, NMT_OPERATIONAL)
        produces = protocol.SYNC | protocol.PRODUCES_SYNC
        await self.set(self._nodes[0], protocol.SYNC_COB_ID, 0, produces, 4)

    async def quiet(self) -> None:
        """Stop SYNC and all devices."""
        await asyncio.to_thread(self._network.nmt.send_command, NMT_PRE_OPERATIONAL)
        for node in self._nodes:
            await self.set(node, protocol.SYNC_COB_ID, 0, protocol.SYNC, 4)

    async def close(self) -> None:
        """Close the adapter."""
        if self._network is not None:
            with contextlib.suppress(Exception):  # an error that ended the bus is raised again
                await asyncio.to_thread(self._network.disconnect)


class EpsonCanDriver:
    """See :class:`daq.devices.interface.DriverType`."""

    name = "epson-can"
    summary = "Epson M-A552 quartz accelerometers on a CAN bus (CANopen), one clock for all"
    settings = EpsonCanSettings
    shares_clock = True
    states_temperature = True

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Return int32."""
        del sensor
        return np.dtype(np.int32)

    def check(self, sensors: Sequence[Sensor]) -> None:
        """See :meth:`daq.devices.interface.Checking.check`."""
        _settings(sensors)

    def ports(self, *, folder: Path = Path("/sys/class/net")) -> list[PresentPort]:
        """See :class:`daq.devices.interface.Listing`; ``folder`` is where Linux lists networks."""
        found = []
        for network in sorted(folder.glob("*")):
            with contextlib.suppress(OSError):  # removed meanwhile
                if int((network / "type").read_text(encoding="utf-8")) == ARPHRD_CAN:
                    state = (network / "operstate").read_text(encoding="utf-8").strip()
                    found.append(PresentPort(f"{SCHEME}{network.name}", f"socketcan, {state}"))
        can = package("can", "can", "CAN buses")
        logger = logging.getLogger("can")
        level = logger.level
        logger.setLevel(logging.ERROR)  # it warns of each library that is not installed
        try:
            others = can.detect_available_configs(ADAPTERS)
        finally:
            logger.setLevel(level)
        return found + [
            PresentPort(f"{SCHEME}{one['channel']}", str(one["interface"])) for one in others
        ]

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[EpsonCanSession]:
        """Open the bus, identify and configure all devices."""
        settings = _settings(sensors)
        first, common = sensors[0], settings[sensors[0].name]
        nodes = {name: one.node_id for name, one in settings.items()}
        bus = _Bus(port_label(sensors), clock, tuple(nodes.values()))
        try:
            await bus.open(first.port.removeprefix(SCHEME), common)
            await bus.quiet()
            information = [await _identified(bus, sensor, nodes[sensor.name]) for sensor in sensors]
            for node in nodes.values():
                await _configure(bus, node, common, first.sampling_rate)
            period = round(1e6 / first.sampling_rate)
            await bus.set(common.node_id, protocol.SYNC_PERIOD, 0, period, 4)
            decoder = protocol.CanDecoder(
                nodes,
                first.sampling_rate,
                full_scale_counts=min(round(common.full_scale * COUNTS_PER_G), 2**31 - 1),
            )
            n_syncs = max(1, round(BLOCK_SECONDS * first.sampling_rate))
            try:
                yield EpsonCanSession(
                    bus, nodes, decoder, tuple(information), n_syncs * (1 + 2 * len(nodes))
                )
            finally:
                with contextlib.suppress(NoAnswerError, WrongDeviceError):
                    await bus.quiet()
        finally:
            await bus.close()


async def _identified(bus: _Bus, sensor: Sensor, node: int) -> DeviceInformation:
    name, hardware, software = [
        (await bus.ask(node, index)).rstrip(b"\0").decode("ascii", "replace")
        for index in (protocol.DEVICE_NAME, protocol.HARDWARE, protocol.SOFTWARE)
    ]
    if "A552" not in name:
        raise WrongDeviceError(f"{bus.label}: node {node} is {name!r}; expected an M-A552")
    return DeviceInformation(
        sensor.name,
        model=f"M-{name}{hardware}",
        firmware=software,
        sampling_rate=sensor.sampling_rate,
        details={"node": str(node)},
    )


async def _configure(bus: _Bus, node: int, settings: EpsonCanSettings, rate: float) -> None:
    await bus.set(node, protocol.TPDO1, 2, protocol.EVERY_SYNC, 1)
    name = settings.filter or USUAL_FILTER[round(rate)]
    await bus.set(node, protocol.FILTER, 1, FILTERS[name], 1)
    for index, base in zip((protocol.TPDO1, protocol.TPDO2), protocol.TPDO_COB_IDS, strict=True):
        cob_id = int.from_bytes(await bus.ask(node, index, 1), "little")
        if cob_id & protocol.PDO_IS_OFF or cob_id & 0x7FF != base + node:
            await bus.set(node, index, 1, 0x40000000 | (base + node), 4)


def _settings(sensors: Sequence[Sensor]) -> dict[str, EpsonCanSettings]:
    settings = {s.name: EpsonCanSettings.model_validate(s.settings) for s in sensors}
    require_alike(sensors, settings, OF_THE_BUS)
    seen: dict[int, str] = {}
    for sensor in sensors:
        one = settings[sensor.name]
        faults: list[tuple[str, str, object]] = []
        if not sensor.port.startswith(SCHEME):
            faults.append(("port", "expected can:// and a channel, as can://can0", sensor.port))
        if sensor.sampling_rate not in protocol.RATES:
            expected = f"expected one of {', '.join(f'{rate:g}' for rate in protocol.RATES)} Hz"
            faults.append(("sampling_rate", expected, sensor.sampling_rate))
        if len(sensor.channels) != 3:
            faults.append(("channels", "expected 3: x, y and z", len(sensor.channels)))
        if one.filter is not None and one.filter not in FILTERS:
            faults.append(("settings.filter", f"expected one of {', '.join(FILTERS)}", one.filter))
        if one.node_id in seen:
            expected = f"is the node of {seen[one.node_id]!r}; each device needs its own"
            faults.append(("settings.node_id", expected, one.node_id))
        seen[one.node_id] = sensor.name
        if faults:
            raise BenchFileError(*(FileFault(k, e, v, sensor.name) for k, e, v in faults))
    return settings


DRIVER = EpsonCanDriver()
