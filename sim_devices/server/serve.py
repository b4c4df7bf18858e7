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

Pseudo-terminals, TCP and UDP ports on which simulated devices are served.

A line reports when a reader opens it, forwards received bytes, accepts bytes to send, and can hang
up like an unplugged cable. It stores nothing: bytes sent while no reader has the line open are
lost, and so are bytes beyond ``MAX_UNREAD`` that a reader does not read.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import select
import shutil
import signal
import socket
import ssl
import tempfile
import time
import tty
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from importlib import import_module
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sim_devices.devices import interface
from sim_devices.errors import ServeError
from sim_devices.faults import Fault, LineFaults, SampleFaults, parse
from sim_devices.world.scenario import Scenario

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from sim_devices.server.paced_clock import PacedClock


MAX_UNREAD = 1 << 20
"""Number of unread bytes above which further units are lost."""
LOOK_INTERVAL = 0.02
"""Interval of checks of a pseudo-terminal without a reader, s."""
TURNS, TURN = 10, 0.005
"""Looks, and s between them, at whether the client before has left, before another is refused."""


class Listener(Protocol):
    """Receives the events of a line."""

    def connected(self) -> None:
        """Handle a reader that opened the line."""

    def received(self, received: bytes) -> None:
        """Handle received bytes."""

    def disconnected(self) -> None:
        """Handle the last reader that closed the line."""


class DevicePort(ABC):
    """A line as its server sees it."""

    def __init__(self, listener: Listener, scheme: str = "") -> None:
        self._listener = listener
        self._scheme = scheme
        self._down = False
        self.address = ""
        self.settings: dict[str, Any] = {}
        """Settings that its driver needs."""

    @abstractmethod
    async def open(self) -> None:
        """Make the line; it can be opened from elsewhere after this."""

    @abstractmethod
    def send(self, units: Iterable[bytes]) -> list[bytes]:
        """Send each unit, or lose it whole; return those that were sent."""

    def n_unsent(self) -> int:
        """Return the number of bytes that wait in this process; a hang-up loses them.

        By default 0: a datagram does not wait.
        """
        return 0

    def hang_up(self) -> None:
        """Hang up on the reader; the line cannot be opened until :meth:`restore`."""
        self._down = True

    def restore(self) -> None:
        """Plug the cable in again."""
        self._down = False

    @abstractmethod
    async def close(self) -> None:
        """Take the line away."""


class PseudoTerminal(DevicePort):
    """A serial port. Its address survives a hang-up."""

    def __init__(self, listener: Listener) -> None:
        super().__init__(listener)
        self._folder = tempfile.mkdtemp(prefix="huddle-")
        self.address = str(Path(self._folder) / "tty")
        self._master = -1
        self._open = False
        self._waiting = bytearray()
        self._loop = asyncio.get_running_loop()
        self._look: asyncio.TimerHandle | None = None

    async def open(self) -> None:
        """Create the pseudo-terminal and wait for a reader."""
        self._make()

    def _make(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)  # otherwise the terminal echoes the device's bytes
        os.set_blocking(self._master, False)
        link = Path(self.address)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(slave))
        os.close(slave)
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)
        self._look_for_somebody()

    def _look_for_somebody(self) -> None:
        # While the slave is closed, the master reports a hang-up, and the event loop would call a
        # reader continuously: poll instead.
        events = self._poll.poll(0)
        if events and events[0][1] & select.POLLHUP and not events[0][1] & select.POLLIN:
            self._look = self._loop.call_later(LOOK_INTERVAL, self._look_for_somebody)
            return
        self._look = None
        self._open = True
        self._loop.add_reader(self._master, self._readable)
        self._listener.connected()

    def _readable(self) -> None:
        try:
            received = os.read(self._master, 65536)
        except BlockingIOError:
            return
        except OSError:  # EIO: the last reader closed the slave
            received = b""
        if received:
            self._listener.received(received)
        else:
            self._nobody()
            self._look_for_somebody()

    def _nobody(self) -> None:
        self._open = False
        self._waiting.clear()
        self._loop.remove_reader(self._master)
        self._loop.remove_writer(self._master)
        self._listener.disconnected()

    def send(self, units: Iterable[bytes]) -> list[bytes]:
        """Send each unit, or lose it whole; return those that were sent."""
        sent: list[bytes] = []
        if not self._open:
            return sent
        was_waiting = bool(self._waiting)
        for unit in units:
            if len(self._waiting) + len(unit) <= MAX_UNREAD:
                self._waiting += unit
                sent.append(unit)
        if self._waiting and not was_waiting:
            self._write()
        return sent

    def n_unsent(self) -> int:
        """Return the number of bytes that wait in this process."""
        return len(self._waiting)

    def _write(self) -> None:
        try:
            del self._waiting[: os.write(self._master, self._waiting)]
        except BlockingIOError:
            pass
        except OSError:  # the slave is closed: reading reports this
            self._waiting.clear()
        if self._waiting:
            self._loop.add_writer(self._master, self._write)
        else:
            self._loop.remove_writer(self._master)

    def hang_up(self) -> None:
        """Unplug the cable of a USB adapter: the port disappears."""
        self._destroy()

    def restore(self) -> None:
        """Plug the cable in again; a reader must open the port again."""
        self._make()

    def _destroy(self) -> None:
        if self._master < 0:
            return
        if self._look is not None:
            self._look.cancel()
        if self._open:
            self._nobody()
        # First: the system may reuse the terminal's number for any new terminal, and the address
        # would then lead to another device.
        Path(self.address).unlink()
        os.close(self._master)
        self._master = -1

    async def close(self) -> None:
        """Remove the port."""
        self._destroy()
        shutil.rmtree(self._folder)


class TcpPort(DevicePort):
    """A TCP port that serves one connection at a time, as serial servers do.

    ``number`` is the port number; 0 for any free one. With ``tls`` it has a certificate of its own.
    """

    def __init__(
        self, listener: Listener, scheme: str, number: int = 0, *, tls: bool = False
    ) -> None:
        super().__init__(listener, scheme)
        self._tls = tls
        self._folder = ""
        self._number = number
        self._server: asyncio.Server | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def open(self) -> None:
        """Listen on a port of this machine."""
        context = None
        if self._tls:
            folder = self._folder = tempfile.mkdtemp(prefix="huddle-")
            context, self.settings["ca_file"] = self_signed(Path(folder))
        try:
            self._server = await asyncio.start_server(
                self._serve, "127.0.0.1", self._number, ssl=context
            )
        except OSError as error:
            raise ServeError(
                f"cannot listen on port {self._number} of this machine: {error.strerror};"
                " in the bench file, set another port number, or a host that is not this machine"
            ) from error
        self.address = f"{self._scheme}://127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for _ in range(TURNS):  # a client may connect again before its end is read
            if self._writer is not None:
                await asyncio.sleep(TURN)
        if self._writer is not None or self._down:
            writer.transport.abort()
            return
        writer.transport.get_extra_info("socket").setsockopt(
            socket.IPPROTO_TCP, socket.TCP_NODELAY, 1
        )
        self._writer = writer
        self._listener.connected()
        try:
            while received := await reader.read(65536):
                self._listener.received(received)
        except ConnectionError:
            pass
        finally:
            self._writer = None
            self._listener.disconnected()
            writer.transport.abort()

    def send(self, units: Iterable[bytes]) -> list[bytes]:
        """Send each unit, or lose it whole; return those that were sent."""
        sent: list[bytes] = []
        if self._writer is None or self._writer.is_closing():
            return sent
        room = MAX_UNREAD - self.n_unsent()
        for unit in units:
            if len(unit) <= room:
                room -= len(unit)
                sent.append(unit)
        if sent:
            self._writer.write(b"".join(sent))
        return sent

    def n_unsent(self) -> int:
        """Return the number of bytes that wait in this process."""
        return 0 if self._writer is None else self._writer.transport.get_write_buffer_size()

    def hang_up(self) -> None:
        """Reset the connection, and every new one."""
        self._down = True
        if self._writer is not None:
            self._writer.transport.abort()

    async def close(self) -> None:
        """Stop listening."""
        self.hang_up()
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
        if self._folder:
            shutil.rmtree(self._folder)


class UdpPort(DevicePort):
    """Sends each unit as a datagram to its own address, on which the driver must listen."""

    async def open(self) -> None:
        """Select a free port of this machine and start to send to it."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self._to = probe.getsockname()
        self.address = f"{self._scheme}://127.0.0.1:{self._to[1]}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._listener.connected()

    def send(self, units: Iterable[bytes]) -> list[bytes]:
        """Send each unit as a datagram; return those that somebody could have received."""
        sent: list[bytes] = []
        for unit in () if self._down else units:
            with contextlib.suppress(OSError):
                self._socket.sendto(unit, self._to)
                sent.append(unit)
        return sent

    async def close(self) -> None:
        """Stop sending."""
        self._socket.close()
        self._listener.disconnected()


class UdpServer(DevicePort, asyncio.DatagramProtocol):
    """A UDP port that receives requests and sends each unit to the last client."""

    def __init__(self, listener: Listener, scheme: str) -> None:
        super().__init__(listener, scheme)
        self._transport: asyncio.DatagramTransport | None = None
        self._to: tuple[str, int] | None = None

    async def open(self) -> None:
        """Listen on a free port of this machine."""
        self._transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: self, local_addr=("127.0.0.1", 0)
        )
        number = self._transport.get_extra_info("sockname")[1]
        self.address = f"{self._scheme}://127.0.0.1:{number}"
        self._listener.connected()

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Forward a received datagram."""
        if self._down:
            return
        self._to = addr
        self._listener.received(data)

    def send(self, units: Iterable[bytes]) -> list[bytes]:
        """Send each unit as a datagram to the last client, which may be closed."""
        if self._transport is None or self._to is None:
            return []
        sent = list(units)
        for unit in sent:
            self._transport.sendto(unit, self._to)
        return sent

    def hang_up(self) -> None:
        """Ignore datagrams, and forget the last client."""
        self._down, self._to = True, None

    async def close(self) -> None:
        """Stop listening."""
        if self._transport is not None:
            self._transport.close()
        self._listener.disconnected()


def self_signed(folder: Path) -> tuple[ssl.SSLContext, str]:
    """Return a context with a new certificate for this machine, and its file for clients."""
    try:
        from cryptography import x509  # noqa: PLC0415 -- an extra
        from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415 -- an extra
        from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415 -- an extra
    except ImportError as error:
        raise ServeError(f"tls needs cryptography: {error}") from error
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "simulated device")])
    names = [x509.IPAddress(ip_address("127.0.0.1")), x509.DNSName("localhost")]
    today = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(today - timedelta(days=1))
        .not_valid_after(today + timedelta(days=365))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    public, private = folder / "certificate.pem", folder / "key.pem"
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    public.write_bytes(certificate.public_bytes(pem))
    private.write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain))
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(public, private)
    return context, str(public)


def make_port(
    kind: interface.Kind, listener: Listener, *, scheme: str, number: int = 0, tls: bool = False
) -> DevicePort:
    """Return a line of this kind, not yet open; ``number`` is that of a TCP port."""
    if kind == "pty":
        return PseudoTerminal(listener)
    if kind == "udp-server":
        return UdpServer(listener, scheme)
    return (
        TcpPort(listener, scheme, number, tls=tls) if kind == "tcp" else UdpPort(listener, scheme)
    )


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


@dataclass(eq=False)
class Served:
    """One endpoint on its line: calls the endpoint for received bytes and at due times.

    Units are sent at absolute instants of world time, so that delays do not accumulate.
    """

    line: interface.Line
    clock: WorldClock
    faults: LineFaults
    tell: Callable[[float, Fault], None]
    tell_sent: Callable[[float, bytes], None] | None = None
    number: int = 0

    def __post_init__(self) -> None:
        self._unsent: deque[tuple[float, bytes]] = deque()
        """Time and bytes of units accepted by the port, of which some wait in this process."""
        self._endpoint: interface.Endpoint = self.line.endpoint
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._last = -math.inf
        self._down = self._muted = False
        self._pending_hang_up: asyncio.TimerHandle | None = None
        self.port: DevicePort = make_port(
            self.line.kind, self, scheme=self.line.scheme, number=self.number, tls=self.line.tls
        )

    def connected(self) -> None:
        """Handle a reader that opened the line."""
        self._send(self._endpoint.connected(self.clock.now()))
        self._schedule()

    def received(self, received: bytes) -> None:
        """Handle received bytes."""
        self._last = -math.inf
        self._send(self._endpoint.receive(received, self.clock.now()))
        self._schedule()

    def disconnected(self) -> None:
        """Handle the last reader that closed the line."""
        self._unsent.clear()
        self._endpoint.disconnected(self.clock.now())
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
            self._put(self.faults.send(units, self.clock.now()))

    def _put(self, units: Sequence[bytes]) -> None:
        if self._muted:
            return
        sent = self.port.send(units)
        if self.tell_sent is not None:
            self._unsent += [(self.clock.now(), unit) for unit in sent]
            self._tell()

    def _tell(self) -> None:
        """Log the units that have left this process whole: a reader can read them."""
        n_waiting = self.port.n_unsent()
        n_logged = sum(len(unit) for _, unit in self._unsent) - n_waiting
        while self.tell_sent is not None and self._unsent:
            at, unit = self._unsent[0]
            if len(unit) > n_logged:
                return
            n_logged -= len(unit)
            self._unsent.popleft()
            self.tell_sent(at, unit)

    def _hang_up(self) -> None:
        self._pending_hang_up = None
        self._muted = False
        if self.tell_sent is not None:
            self._tell()
        self._unsent.clear()
        self.port.hang_up()

    def _strike(self) -> None:
        """Start and end the faults that are due."""
        now = self.clock.now()
        if self._down and now >= self.faults.down_until:
            self._down = False
            if self._pending_hang_up is not None:  # unplugged for less than the delay
                self._pending_hang_up.cancel()
                self._hang_up()
            self.port.restore()
        faults, units = self.faults.act(now)
        self._put(units)
        for fault in faults:
            if fault.kind == "disconnect" and not self._down:
                self._down = self._muted = True
                self._pending_hang_up = self._loop.call_later(HANG_UP_DELAY, self._hang_up)
            else:
                self._endpoint.fault(fault.kind, now, fault.duration)
        for at, fault in self.faults.struck:
            self.tell(at, fault)
        self.faults.struck.clear()

    def _schedule(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        when = min(self._endpoint.next_due(), self.faults.next_due())
        if self._down:
            when = min(when, self.faults.down_until)
        if when < interface.NEVER:
            at = max(self.clock.monotonic(when), self._last + MIN_INTERVAL)
            self._timer = self._loop.call_at(at, self._tick)

    def _tick(self) -> None:
        self._timer = None
        self._last = self._loop.time()
        self._strike()
        self._send(self._endpoint.due(self.clock.now()))
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
    source = interface.Source(scenario, device, faults=SampleFaults(faults))
    for sensor in device.sensors:  # the first sample is slow: compute it before clients wait
        source.counts(sensor, source.first_sample_after(sensor, clock.now()), 1)
    lines: Sequence[interface.Line] = getattr(import_module(module), function)(device, source)
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
    served = []
    for k, line in enumerate(lines):
        own = [f for f in faults if line.carries_samples or f.kind == "disconnect"]
        of_line = LineFaults(own, f"{name} {k}", begin=clock.now())
        told = sent if line.carries_samples and tell_sent.is_wanted else None
        port = int(device.settings.get(line.setting, 0)) if k and first_port else first_port
        served.append(Served(line, clock, of_line, tell, told, port))
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

    def __init__(self, path: str | None, device: interface.DeviceSpec) -> None:
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


def _announcement(device: interface.DeviceSpec, served: Sequence[Served]) -> dict[str, Any]:
    return {
        "sensors": list(device.sensors),
        "driver": device.driver,
        "port": served[0].port.address,
        "settings": served[0].port.settings
        | {one.line.setting: int(one.port.address.rpartition(":")[2]) for one in served[1:]},
    }


def device_spec(table: Mapping[str, Any]) -> interface.DeviceSpec:
    """Parse one entry of ``devices``."""
    given: dict[str, Any] = {"port": "pty", **table}
    given.pop("number", None)
    given["sensors"] = tuple(table["sensors"])
    given["channels"] = {
        sensor: tuple(interface.ChannelSpec(**channel) for channel in channels)
        for sensor, channels in table["channels"].items()
    }
    return interface.DeviceSpec(**given)
