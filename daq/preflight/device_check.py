"""Checks of devices for ``huddle check``: identity, and one second of samples."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
from collections.abc import AsyncGenerator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np

from daq.bench.model import Bench, Sensor
from daq.devices.epson import commands
from daq.devices.epson.driver import identify
from daq.devices.interface import DeviceInformation
from daq.devices.modbus.bus import TCP, RefusedError, open_bus
from daq.devices.registry import driver_type
from daq.devices.text.format import MessageFinder
from daq.devices.text.guess import guess_settings
from daq.errors import DeviceError, NoAnswerError, NotConnectedError, WrongDeviceError
from daq.host_clock import HostClock
from daq.preflight.findings import CheckOutcome, CheckRow
from daq.preflight.preflight import check_list
from daq.preflight.preview import LENGTH, SensorPreview, arrivals
from daq.protocols.block import Block, BlockFlag, DeviceItem, Event
from daq.protocols.errors import RemoteProtocolError
from daq.recorder.device_identity import check_identity, with_owner
from daq.transport.address import USUAL_NUMBERS
from daq.transport.ports import open_port

MIN_SAMPLES = 4
TEXT_BAUD_RATES = (115200, 9600, 57600, 38400, 19200, 230400)
TEXT_ROWS, LISTEN, LISTEN_ON = 12, 1.0, 2.5
"""Rows of text to guess a format from; seconds to listen for the first row, and for later ones."""
MODBUS_BAUD_RATES = (9600, 115200, 19200, 38400, 57600)
(MODBUS_PORT,) = USUAL_NUMBERS["modbus-tcp"]
TCP_PORTS = (MODBUS_PORT, 4001, 4002, 4003, 4004, 2101, 10001)
"""Modbus, and serial servers as their makers set them: Moxa, Digi, Lantronix."""
MOST_HOSTS, MOST_CONNECTIONS, CONNECT = 1024, 256, 1.0
"""Hosts of a network to search, connections at a time, seconds to wait for one."""
FREED = 1.0
"""Seconds in which a serial server frees its line after a connection: it serves one at a time."""
MODBUS_DEVICES = (1, 2, 3, 4, 5, 0x50)


@dataclass(frozen=True, slots=True)
class ChannelCheck:
    """Statistics of one channel, in its unit."""

    name: str
    unit: str
    mean: float
    rms: float
    """Standard deviation about the mean."""
    minimum: float
    maximum: float
    is_stuck: bool
    """Whether all samples are equal: nothing is connected, or the channel is dead."""


@dataclass(frozen=True, slots=True)
class SensorCheck:
    """Information that a sensor reports, and statistics of some of its samples.

    Attributes
    ----------
    information
        As reported by the device.
    n_samples, n_missing : int
        Samples received, and samples known to be missing between them.
    measured_rate : float or None
        Samples per second by the host's clock; None if blocks were too few or arrived too unevenly.
    clipped : bool
        Whether any sample reached the end of the range.
    channels
        In the order of the bench file.
    events : tuple of Event
        Events of the device or its protocol during the check.
    jitter : float or None
        Standard deviation of the sample times about an even grid, in s; polled sensors only.
    bandwidth : float or None
        Half the reciprocal of the longest sampling interval, in Hz; polled sensors only.
    """

    information: DeviceInformation
    n_samples: int
    n_missing: int
    measured_rate: float | None
    clipped: bool
    channels: tuple[ChannelCheck, ...]
    events: tuple[Event, ...]
    jitter: float | None = None
    bandwidth: float | None = None

    @property
    def signal_to_noise_db(self) -> float | None:
        """SNR of a sine at the edge of the bandwidth, if its samples are assumed evenly spaced.

        Power of the sine over power of the error, −20 log10(2π f σ) in dB. Estimates use the
        recorded sample times and are more accurate.
        """
        if self.jitter is None or self.bandwidth is None or self.jitter <= 0:
            return None
        return float(-20 * np.log10(2 * np.pi * self.bandwidth * self.jitter))


async def _probe(
    sensors: Sequence[Sensor], clock: HostClock, *, duration: float
) -> tuple[list[SensorCheck], list[SensorPreview], list[DeviceError]]:
    """Return the checks of the sensors that deliver samples, previews of all, and the errors."""
    blocks: dict[str, list[Block]] = {sensor.name: [] for sensor in sensors}
    events: dict[str, list[Event]] = {sensor.name: [] for sensor in sensors}
    wanted = {s.name: max(MIN_SAMPLES, round(duration * s.sampling_rate)) for s in sensors}
    longest = max(wanted[s.name] / s.sampling_rate for s in sensors) / clock.speed
    async with driver_type(sensors[0].driver).open(sensors, clock) as session:
        patience, hint = session.patience, session.hint
        information = {one.sensor: one for one in session.information}
        troubles = dict(_identity_errors(sensors, information))
        awaited = {name: n for name, n in wanted.items() if not information[name].trouble}
        async with contextlib.aclosing(
            cast("AsyncGenerator[DeviceItem]", session.read())  # other iterators need no closing
        ) as stream:
            try:
                async with asyncio.timeout(patience + 3 * longest):
                    async for item in stream:
                        if isinstance(item, Event):
                            name = item.sensor if item.sensor in events else sensors[0].name
                            events[name].append(item)
                        if not isinstance(item, Block):
                            continue
                        blocks[item.sensor].append(item)
                        if all(_n_samples(blocks[name]) >= n for name, n in awaited.items()):
                            break
            except TimeoutError as error:
                if isinstance(error, DeviceError):
                    raise
    for sensor in sensors:
        if not blocks[sensor.name] and not information[sensor.name].trouble:
            reported = "; ".join(f"{event.kind}: {event.text}" for event in events[sensor.name])
            troubles.setdefault(
                sensor.name,
                NoAnswerError(
                    f"sensor {sensor.name!r} on {sensor.port}: no samples in"
                    f" {patience:g} s{hint and f'; {hint}'}"
                    f"{reported and f'; it reported: {reported}'}"
                ),
            )
    found = [
        _check(one, information[one.name], blocks[one.name], events[one.name])
        for one in sensors
        if blocks[one.name]
    ]
    previews = [
        SensorPreview.of(
            one,
            information[one.name],
            blocks[one.name],
            trouble=str(troubles.get(one.name, "")),
        )
        for one in sensors
    ]
    return found, previews, list(troubles.values())


def _identity_errors(
    sensors: Sequence[Sensor], information: Mapping[str, DeviceInformation]
) -> Iterator[tuple[str, DeviceError]]:
    """Yield the name of each sensor whose device does not reply or is another, and the error."""
    for sensor in sensors:
        found = information[sensor.name]
        if found.trouble:
            yield sensor.name, NoAnswerError(found.trouble)
            continue
        try:
            check_identity(sensor, found)
        except WrongDeviceError as error:
            yield sensor.name, error


@dataclass(frozen=True, slots=True)
class Examination:
    """What all devices of a bench are, and the check list."""

    found: tuple[SensorCheck, ...]
    errors: tuple[DeviceError, ...]
    rows: tuple[CheckRow, ...]

    @property
    def failures(self) -> tuple[CheckRow, ...]:
        """The rows that keep a test from starting."""
        return tuple(row for row in self.rows if row.outcome is CheckOutcome.FAILED)


async def examine(
    bench: Bench, clock: HostClock, *, seconds: float = LENGTH, duration: float | None = None
) -> Examination:
    """Probe all ports of a bench at the same time, and make the check list.

    Parameters
    ----------
    bench : Bench
    clock : HostClock
    seconds : float
        Of samples to read from each sensor.
    duration : float, optional
        Of the recording that is wanted, in s; default: that of the bench file.
    """
    answers = await asyncio.gather(
        *(_probe(sensors, clock, duration=seconds) for sensors in bench.ports().values()),
        return_exceptions=True,
    )
    found: list[SensorCheck] = []
    errors: list[DeviceError] = []
    previews: dict[str, SensorPreview] = {}
    for (port, sensors), answer in zip(bench.ports().items(), answers, strict=True):
        if isinstance(answer, RemoteProtocolError):
            answer = DeviceError(f"port {port}: {answer}")  # noqa: PLW2901
        if isinstance(answer, DeviceError):
            errors.append(answer)
            text = str(with_owner(answer, bench.sensors))
            previews |= {s.name: SensorPreview.of(s, None, trouble=text) for s in sensors}
        elif isinstance(answer, BaseException):
            raise answer
        else:
            found.extend(answer[0])
            previews |= {each.sensor.name: each for each in answer[1]}
            errors.extend(answer[2])
    in_order = [previews[sensor.name] for sensor in bench.sensors]
    return Examination(
        tuple(found),
        tuple(with_owner(error, bench.sensors) for error in errors),
        check_list(bench, in_order, duration=duration),
    )


@dataclass(frozen=True, slots=True)
class DiscoveredDevice:
    """A device on a port: required driver and settings, and the information it reports."""

    driver: str
    port: str
    settings: dict[str, Any]
    information: DeviceInformation | None = None
    remark: str = field(default="")


async def discover(
    port: str,
    clock: HostClock,
    *,
    baud_rates: Sequence[int] = MODBUS_BAUD_RATES,
    device_ids: Sequence[int] = MODBUS_DEVICES,
) -> list[DiscoveredDevice]:
    """Look for text, Epson accelerometers and Modbus devices on a port.

    Text is tested first, because it needs no request.

    Parameters
    ----------
    baud_rates, device_ids
        Values to try for Modbus devices. Any reply, even a refusal, proves a device.

    Raises
    ------
    NotConnectedError
        If the port cannot be opened.
    """
    if not port.startswith(TCP):
        for baud_rate in TEXT_BAUD_RATES if "://" not in port else (TEXT_BAUD_RATES[0],):
            rows = await _text_rows(port, clock, baud_rate)
            settings = guess_settings(rows)
            if settings is not None:
                remark = repr(rows[-1][:60].decode("ascii", "replace"))
                settings = {"baud_rate": baud_rate, **settings}
                return [DiscoveredDevice("text", port, settings, remark=remark)]
        for baud_rate in commands.BAUD_RATES if "://" not in port else (460800,):
            with contextlib.suppress(DeviceError):
                information = await identify(port, clock, baud_rate=baud_rate)
                return [DiscoveredDevice("epson", port, {"baud_rate": baud_rate}, information)]
    found: list[DiscoveredDevice] = []
    for baud_rate in baud_rates if "://" not in port else baud_rates[:1]:
        found += await _modbus_devices(port, clock, baud_rate, device_ids)
        if found:
            break
    return found


async def _text_rows(port: str, clock: HostClock, baud_rate: int) -> list[bytes]:
    """Return complete lines that the device sends by itself, without the first line."""
    finder = MessageFinder(b"\n")
    rows: list[bytes] = []
    loop = asyncio.get_running_loop()
    async with open_port(port, clock, label=f"port {port}", baud_rate=baud_rate) as stream:
        deadline = loop.time() + LISTEN
        with contextlib.suppress(TimeoutError, NotConnectedError):
            while len(rows) <= TEXT_ROWS:
                async with asyncio.timeout_at(deadline):
                    received, _ = await stream.read()
                rows += finder.receive(received)
                if rows and rows[-1].isascii():  # a slow device: wait longer for its next rows
                    deadline = max(deadline, loop.time() + LISTEN_ON)
    return rows[1:]


async def network_ports(target: str, *, numbers: Sequence[int] | None = None) -> list[str]:
    """Return the ports of hosts that accept connections, to be searched by `discover`.

    Parameters
    ----------
    target : str
        A host, a network such as ``192.168.0.0/24``, or a port, which is returned itself.
    numbers : sequence of int, optional
        TCP ports to try: by default those of Modbus and of common serial servers.

    Raises
    ------
    NotConnectedError
        If the network has too many hosts.
    """
    if "://" in target or target.startswith(("/", "COM")):
        return [target]
    hosts = [target]
    with contextlib.suppress(ValueError):
        network = ipaddress.ip_network(target, strict=False)
        if network.num_addresses > MOST_HOSTS:
            raise NotConnectedError(f"{target}: expected a network of at most {MOST_HOSTS} hosts")
        hosts = [str(host) for host in network.hosts()]
    few = asyncio.Semaphore(MOST_CONNECTIONS)

    async def accepts(host: str, number: int) -> bool:
        async with few:
            try:
                async with asyncio.timeout(CONNECT):
                    _, writer = await asyncio.open_connection(host, number)
            except OSError:  # also that of a time limit
                return False
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()
            return True

    pairs = [(host, number) for host in hosts for number in numbers or TCP_PORTS]
    found = await asyncio.gather(*(accepts(*pair) for pair in pairs))
    if any(found):
        await asyncio.sleep(FREED)
    return [
        f"{TCP}{host}" if number == MODBUS_PORT else f"socket://{host}:{number}"
        for (host, number), is_there in zip(pairs, found, strict=True)
        if is_there
    ]


def search_description(port: str) -> str:
    """Return a description of the devices that `discover` looks for by default."""
    devices = "Modbus device " + ", ".join(map(str, MODBUS_DEVICES))
    if port.startswith(TCP):
        return devices
    if "://" in port:
        return f"rows of text, an Epson accelerometer or {devices}"
    epsons, others = (
        ", ".join(map(str, sorted(rates))) for rates in (commands.BAUD_RATES, MODBUS_BAUD_RATES)
    )
    texts = ", ".join(map(str, sorted(TEXT_BAUD_RATES)))
    return (
        f"rows of text ({texts} baud), an Epson accelerometer ({epsons} baud) or {devices}"
        f" ({others} baud)"
    )


async def _modbus_devices(
    port: str, clock: HostClock, baud_rate: int, device_ids: Sequence[int]
) -> list[DiscoveredDevice]:
    found = []
    over_tcp = port.startswith(TCP)
    async with open_bus(
        port, clock, label=f"port {port}", reply_timeout=0.1, baud_rate=baud_rate
    ) as bus:
        for device_id in device_ids:
            settings: dict[str, Any] = {"device_id": device_id}
            if not over_tcp:
                settings["baud_rate"] = baud_rate
            try:
                await bus.read(3, device_id, 0, 1)
            except RefusedError as refused:
                if refused.code in {10, 11}:  # a gateway replies for an absent device
                    continue
                remark = "replies, but has no register 0"
            except NoAnswerError:
                continue
            except NotConnectedError:
                break
            else:
                remark = "answers"
            found.append(DiscoveredDevice("registers", port, settings, remark=remark))
    return found


def _n_samples(blocks: Sequence[Block]) -> int:
    return sum(block.n_samples for block in blocks)


def _check(
    sensor: Sensor, information: DeviceInformation, blocks: Sequence[Block], events: Sequence[Event]
) -> SensorCheck:
    counts = np.concatenate([block.counts for block in blocks]).astype(np.float64)
    known = [block.instants_ns for block in blocks if block.instants_ns is not None]
    jitter = bandwidth = None
    if len(instants := np.concatenate([np.empty(0, np.int64), *known])) > 2:
        places = np.arange(len(instants))
        grid = np.polynomial.Polynomial.fit(places, instants * 1e-9, 1)
        jitter = float(np.std(instants * 1e-9 - grid(places)))
        bandwidth = float(0.5 / (np.diff(instants) * 1e-9).max())
    return SensorCheck(
        information=information,
        n_samples=len(counts),
        n_missing=blocks[-1].end_sample - blocks[0].first_sample - len(counts),
        measured_rate=arrivals(blocks).rate,
        clipped=any(BlockFlag.CLIPPED in block.flags for block in blocks),
        channels=tuple(
            ChannelCheck(
                name=channel.name,
                unit=channel.unit,
                mean=float(values.mean()),
                rms=float(values.std()),
                minimum=float(values.min()),
                maximum=float(values.max()),
                is_stuck=bool(np.ptp(values) == 0) and not channel.auxiliary,
            )
            for channel, values in zip(
                sensor.channels,
                (counts / [channel.sensitivity for channel in sensor.channels]).T,
                strict=True,
            )
        ),
        events=tuple(events),
        jitter=jitter,
        bandwidth=bandwidth,
    )
