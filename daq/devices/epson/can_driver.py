"""Driver for Epson M-A552 accelerometers on a CAN bus (CANopen); needs the extra ``can``.

All sensors of one port are devices on one bus. The first of them that answers produces the SYNC at
which all send their samples, so they share one clock and one index (see
:mod:`daq.devices.epson.canopen`). A device that boots, or is silent, is configured and started
again while the others continue (:mod:`daq.devices.shared_port`). Without SYNC nobody sends: then
the session ends, and the next one has another producer, if the first does not answer.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, PositiveFloat, PositiveInt

from daq.devices.epson import canopen as protocol
from daq.devices.epson.commands import COUNTS_PER_G, FILTERS, USUAL_FILTER, temperature
from daq.devices.interface import (
    DeviceInformation,
    Driver,
    DriverSettings,
    PresentPort,
    Session,
)
from daq.devices.port_rules import package, port_label
from daq.devices.shared_port import Presence, answering
from daq.errors import (
    BenchFileError,
    DeviceError,
    FileFault,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.protocols.block import (
    Block,
    DeviceItem,
    Event,
    EventKind,
    HostTime,
    Quantity,
    Reading,
    ReadingTimes,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock

SCHEME = "can://"
BLOCK_SECONDS = 0.1
"""Seconds of samples that are decoded together."""
ARPHRD_CAN = 280
"""Type of a network that is a CAN bus, in Linux."""
ADAPTERS = ("pcan", "kvaser", "vector", "ixxat")
"""Kinds of adapters that libraries of their vendors list."""
NOTIFIER_CYCLE = 0.1
"""Seconds after which the thread of the adapter looks whether it is to end."""
NMT_OPERATIONAL, NMT_PRE_OPERATIONAL = 1, 128
SILENT = 1.0
"""Seconds without a sample after which a device is started again, or without SYNC, the bus."""
LOOKS = 4
"""Waits for SYNC in this time: when this computer was stopped, the first one ends without it."""
HEARTBEAT_MS = 500
_Sign = tuple[int, int]
"""A node that booted or sent a heartbeat, and its state."""


class EpsonCanSettings(DriverSettings):
    """``[sensors.settings]`` of an M-A552."""

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


@dataclass(eq=False)
class EpsonCanSession(Session):
    """The devices of one bus, configured and quiet."""

    hint = "expected SYNC and TPDO messages; check power, termination and bitrate"

    bus: _Bus
    devices: Mapping[str, _Device]
    decoder: protocol.CanDecoder
    information: tuple[DeviceInformation, ...]
    clock: HostClock
    n_messages: int

    def __post_init__(self) -> None:
        self._present = {
            one.sensor: Presence(one.sensor, self.clock, trouble=one.trouble)
            for one in self.information
        }
        self._heard: dict[str, int] = {}  # SYNC messages up to the last sample of each sensor

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Start SYNC and yield blocks, events, and the temperatures once a minute, until closed."""
        devices, present = self.devices, self._present
        await self.bus.start([d.node for n, d in devices.items() if not present[n].is_gone])
        reading_times = ReadingTimes()
        self._heard = dict.fromkeys(devices, 0)
        while True:
            messages, signs, at = await self.bus.read(self.n_messages)
            n_syncs = self.bus.n_syncs
            ending = self._ending(messages, signs)
            for item in self.decoder.receive(messages, at, is_last=ending is not None):
                if isinstance(item, Block):
                    self._heard[item.sensor] = n_syncs
                yield item
            if ending is not None:
                raise ending
            for event in await self._attend(signs, n_syncs, at):
                yield event
            if reading_times.is_due(at):
                for sensor, device in devices.items():
                    if not present[sensor].is_gone:
                        for reading in await self._temperature(sensor, device.node, at):
                            yield reading

    def _ending(self, messages: list[protocol.Message], signs: set[_Sign]) -> DeviceError | None:
        """Return why the session ends with these messages: nobody produces SYNC, or no bus."""
        producer, failure = self.bus.producer, self.bus.failure
        if failure is not None and not messages:
            return NotConnectedError(f"{self.bus.label}: the bus closed ({failure})")
        if (producer, protocol.BOOTED) in signs:
            return NoAnswerError(f"{self.bus.label}: node {producer}, which sends SYNC, restarted")
        if self.bus.n_quiet >= LOOKS:
            return NoAnswerError(f"{self.bus.label}: no SYNC from node {producer} in {SILENT:g} s")
        return None

    async def _attend(self, signs: set[_Sign], n_syncs: int, at: HostTime) -> list[Event]:
        """Start devices again that booted, or have become silent.

        SYNC messages tell how long: after a stop of this computer, all messages are late alike.
        """
        found: list[Event] = []
        for sensor, device in self.devices.items():
            presence = self._present[sensor]
            seconds = (n_syncs - self._heard[sensor]) / device.sensor.sampling_rate
            silent = seconds / self.clock.speed
            has_booted = (device.node, protocol.BOOTED) in signs
            if presence.is_gone:
                if any(node == device.node for node, _ in signs):
                    presence.lose(at_once=True)
            elif has_booted or silent > SILENT:
                text = "the device restarted" if has_booted else f"silent for {SILENT:g} s"
                found.append(Event(sensor, EventKind.STALLED, text, at))
                presence.lose(at_once=True)
            if presence.is_due:
                found += await presence.try_again(partial(self._start, sensor, device))
        return found

    async def _start(self, sensor: str, device: _Device) -> None:
        boot = device.node, protocol.BOOTED
        self.bus.signs.discard(boot)  # it is configured now
        await device.prepare(self.bus)
        if boot in self.bus.signs:
            raise NoAnswerError(f"{self.bus.label}: node {device.node} restarts")
        await self.bus.start_node(device.node)
        self.decoder.started(sensor)
        self._heard[sensor] = self.bus.n_syncs

    async def _temperature(self, sensor: str, node: int, at: HostTime) -> list[Reading]:
        """Return the temperature of a device; none if it does not reply."""
        try:
            octets = await self.bus.ask(node, *protocol.TEMPERATURE)
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
        self.producer = 0
        """Node that produces SYNC."""
        self.signs: set[_Sign] = set()
        """Of devices since the last :meth:`read`."""
        self.n_syncs = 0
        self.n_quiet = 0
        """Waits since the last SYNC that was read."""
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
            for node in self._nodes:
                self._network.subscribe(protocol.HEARTBEAT + node, received)
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
        if cob_id & ~0x7F == protocol.HEARTBEAT:
            self.signs.add((cob_id & 0x7F, data[0] & 0x7F if data else protocol.BOOTED))
            if data[:1] == b"\0":
                self._arrived.set()
            return
        self.n_syncs += cob_id == protocol.SYNC
        self._messages.append((cob_id, data))
        self._at = at
        if len(self._messages) >= self._n_expected and cob_id != protocol.SYNC:
            self._arrived.set()

    @property
    def failure(self) -> Exception | None:
        """The error that ended the bus."""
        return self._network.notifier.exception if self._network.notifier else None

    async def read(self, n_messages: int) -> tuple[list[protocol.Message], set[_Sign], HostTime]:
        """Return so many messages or more, or those until a device boots, or a wait ends.

        And the signs of devices meanwhile.
        """
        self._n_expected = n_messages
        if len(self._messages) < n_messages:
            try:
                async with asyncio.timeout(SILENT / LOOKS):
                    await self._arrived.wait()
            except TimeoutError:
                self.n_quiet += 1
        self._arrived.clear()
        messages, self._messages = self._messages, []
        signs, self.signs = self.signs, set()
        if any(cob_id == protocol.SYNC for cob_id, _ in messages):
            self.n_quiet = 0
        return messages, signs, self._at if messages and self._at else self._clock.now()

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

    async def start(self, nodes: Sequence[int]) -> None:
        """Let devices send, then let the first of them start SYNC."""
        for node in nodes:  # no others: their counters are to begin when they are configured
            await self.start_node(node)
        self._messages.clear()
        self.signs.clear()
        self.n_syncs = self.n_quiet = 0
        self.producer = nodes[0]
        produces = protocol.SYNC | protocol.PRODUCES_SYNC
        await self.set(nodes[0], protocol.SYNC_COB_ID, 0, produces, 4)

    async def start_node(self, node: int) -> None:
        """Let one device send, from sample 0."""
        await self.set(node, protocol.SAMPLE_COUNTER, 0, 0, 2)
        await asyncio.to_thread(self._network.nodes[node].nmt.send_command, NMT_OPERATIONAL)

    async def quiet(self) -> None:
        """Stop all devices, and SYNC."""
        await asyncio.to_thread(self._network.nmt.send_command, NMT_PRE_OPERATIONAL)
        if self.producer:
            await self.set(self.producer, protocol.SYNC_COB_ID, 0, protocol.SYNC, 4)

    async def close(self) -> None:
        """Close the adapter."""
        if self._network is not None:
            with contextlib.suppress(Exception):  # an error that ended the bus is raised again
                await asyncio.to_thread(self._network.disconnect)


class EpsonCanDriver(Driver[EpsonCanSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "epson-can"
    summary = "Epson M-A552 quartz accelerometers on a CAN bus (CANopen), one clock for all"
    settings = EpsonCanSettings
    of_the_port = ("interface", "bitrate", "filter")
    shares_clock = True
    states_temperature = True

    def full_scale(self, sensor: Sensor) -> float | None:
        """See :meth:`daq.bench.driver_rules.DriverRules.full_scale`."""
        return self.typed([sensor])[sensor.name].full_scale * COUNTS_PER_G

    def check(self, sensors: Sequence[Sensor]) -> dict[str, EpsonCanSettings]:
        """Return the settings of each sensor."""
        settings = self.typed(sensors)
        _check_devices(sensors, settings)
        return settings

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
        settings = self.check(sensors)
        first, common = sensors[0], settings[sensors[0].name]
        nodes = {name: one.node_id for name, one in settings.items()}
        bus = _Bus(port_label(sensors), clock, tuple(nodes.values()))
        try:
            await bus.open(first.port.removeprefix(SCHEME), common)
            await bus.quiet()
            devices = {
                sensor.name: _Device(sensor, nodes[sensor.name], settings[sensor.name])
                for sensor in sensors
            }
            information = await answering(
                {name: partial(one.prepare, bus) for name, one in devices.items()}
            )
            decoder = protocol.CanDecoder(
                nodes,
                first.sampling_rate,
                full_scale_counts=min(round(common.full_scale * COUNTS_PER_G), 2**31 - 1),
            )
            n_syncs = max(1, round(BLOCK_SECONDS * first.sampling_rate))
            n_messages = n_syncs * (1 + 2 * len(nodes))
            try:
                yield EpsonCanSession(
                    bus, devices, decoder, information, clock, n_messages=n_messages
                )
            finally:
                with contextlib.suppress(NoAnswerError, WrongDeviceError):
                    await bus.quiet()
        finally:
            await bus.close()


@dataclass(frozen=True, slots=True)
class _Device:
    """One device of the bus."""

    sensor: Sensor
    node: int
    settings: EpsonCanSettings

    async def prepare(self, bus: _Bus) -> DeviceInformation:
        """Identify and configure the device; another one may be the producer of SYNC."""
        await bus.set(self.node, protocol.SYNC_COB_ID, 0, protocol.SYNC, 4)
        name, hardware, software = [
            (await bus.ask(self.node, index)).rstrip(b"\0").decode("ascii", "replace")
            for index in (protocol.DEVICE_NAME, protocol.HARDWARE, protocol.SOFTWARE)
        ]
        if "A552" not in name:
            raise WrongDeviceError(f"{bus.label}: node {self.node} is {name!r}; expected an M-A552")
        await self._configure(bus)
        return DeviceInformation(
            self.sensor.name,
            model=f"M-{name}{hardware}",
            firmware=software,
            sampling_rate=self.sensor.sampling_rate,
            details={"node": str(self.node)},
        )

    async def _configure(self, bus: _Bus) -> None:
        node, rate = self.node, self.sensor.sampling_rate
        await bus.set(node, protocol.TPDO1, 2, protocol.EVERY_SYNC, 1)
        name = self.settings.filter or USUAL_FILTER[round(rate)]
        await bus.set(node, protocol.FILTER, 1, FILTERS[name], 1)
        for index, base in zip(
            (protocol.TPDO1, protocol.TPDO2), protocol.TPDO_COB_IDS, strict=True
        ):
            cob_id = int.from_bytes(await bus.ask(node, index, 1), "little")
            if cob_id & protocol.PDO_IS_OFF or cob_id & 0x7FF != base + node:
                await bus.set(node, index, 1, 0x40000000 | (base + node), 4)
        await bus.set(node, protocol.SYNC_PERIOD, 0, round(1e6 / rate), 4)
        with contextlib.suppress(WrongDeviceError):  # a device without heartbeat
            await bus.set(node, protocol.HEARTBEAT_TIME, 0, HEARTBEAT_MS, 2)


def _check_devices(sensors: Sequence[Sensor], settings: Mapping[str, EpsonCanSettings]) -> None:
    """Raise BenchFileError for what no M-A552 accepts, and nodes that are used twice."""
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


DRIVER = EpsonCanDriver()
