"""A simulated Güralp digitizer: GCF over a serial line with block recovery, or a Scream server.

Simulated functions: one stream per channel, in blocks that start on UTC
(:mod:`daq.devices.guralp.gcf`); numbered frames, sent one at a time at the line's rate, each with
a wait of 150 ms for its acknowledgement, and repetition from a refused block on
(:mod:`daq.devices.guralp.brp`); blocks of status text. Alternatively: packets over UDP to the
client of the last minute and over TCP, and repetition of blocks by number
(:mod:`daq.devices.guralp.scream`).

GPS keeps the sampling clock on UTC, independent of the scenario's clock. Not simulated: terminal
commands, triggered streams, several taps, memory while disconnected.
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from daq.devices.guralp import gcf, scream
from daq.devices.guralp.brp import Transmitter
from daq.devices.guralp.gcf import SampleBlock, StatusBlock, SystemId, Width
from daq.devices.guralp.scream import Packet
from sim_devices.devices.interface import NEVER, DeviceSpec, Endpoint, Line, Samples, Source, whole
from sim_devices.errors import ScenarioError

FULL_SCALE = (1 << 23) - 1
MAX_SAMPLES = 248
"""Maximum number of samples per block: fits every compression, in complete records."""
MAX_BLOCK = 10
"""Maximum duration of a block, in s, at low sampling rates."""
REPLY_TIME = 0.15
STATUS_INTERVAL = 60.0
SUPPLY = 13.0
CLIENT_PATIENCE = 60.0
HISTORY = 256
_NS = 1_000_000_000
_COMPONENTS = "ZNEX1234"
_ABOVE = sorted(float(rate) for rate, _ in gcf.RATES.values() if rate > 250)


def stream_ids(device: DeviceSpec, sensor: str) -> tuple[str, ...]:
    """Return the stream ID of each channel, configured or derived from the sensor's name."""
    settings = {**device.settings, **device.sensor_settings.get(sensor, {})}
    if settings.get("streams"):
        return tuple(settings["streams"])
    serial = device.serial_number or f"{0x1000 + zlib.crc32(sensor.encode()) % 0x8000:04X}"
    n_channels = sum(not channel.auxiliary for channel in device.channels[sensor])
    return tuple(f"{serial}{component}2" for component in _COMPONENTS[:n_channels])


class Digitizer:
    """Source of the blocks of all streams."""

    def __init__(self, device: DeviceSpec, source: Source) -> None:
        self._rate = Fraction(device.sampling_rate).limit_denominator(1000)
        self._parts = next((parts for rate, parts in gcf.RATES.values() if rate == self._rate), 0)
        if not self._parts:
            raise ScenarioError(
                f"sensor {device.sensors[0]!r}: sampling_rate = {device.sampling_rate:g}; GCF has"
                f" {', '.join(f'{rate:g}' for rate in _ABOVE)} Hz and whole Hz up to 250"
            )
        self._utc_ns = -(-device.utc_ns // _NS) * _NS  # UTC of sample 0: a full second
        offset = (self._utc_ns - device.utc_ns) / _NS
        self._source, self._sensor = source, device.sensors[0]
        self._samples = Samples(source.disciplined(offset), device.sensors)
        self._streams = [s for sensor in device.sensors for s in stream_ids(device, sensor)]
        self._system = SystemId(str(device.settings.get("system_id", "SIM")))
        self._width: Width | None = device.settings.get("width")
        self._block_samples = self._length_of_block()
        self._next = 0
        self._next_status = 0.0

    def _length_of_block(self) -> int:
        unit = self._rate / self._parts  # samples per permitted interval between block starts
        if unit.denominator > 1:
            return max(1, round(MAX_BLOCK * float(self._rate)))
        most = min(MAX_SAMPLES, int(MAX_BLOCK * self._rate))
        return max(1, most // int(unit)) * int(unit)

    def start(self, now: float) -> None:
        """Start with the next complete block."""
        first = self._samples.first_after(now)
        self._next = -(-first // self._block_samples) * self._block_samples
        self._next_status = now

    def next_due(self) -> float:
        """Return the world time at which the next blocks are complete."""
        return self._samples.time(self._next + self._block_samples - 1)

    def blocks(self, now: float) -> list[SampleBlock | StatusBlock]:
        """Return the blocks completed by ``now``, in order of time."""
        found: list[SampleBlock | StatusBlock] = []
        while self.next_due() <= now:
            if self.next_due() >= self._next_status:
                found.append(self._status())
                self._next_status = self.next_due() + STATUS_INTERVAL
            counts = whole(
                self._samples.counts(self._next, self._block_samples), -FULL_SCALE, FULL_SCALE
            )
            start_ns = self._utc_ns + round(self._next * _NS / self._rate)
            found += [
                SampleBlock(self._system, stream, start_ns, self._rate, column.astype(np.int32))
                for stream, column in zip(self._streams, counts.T, strict=True)
            ]
            self._next += self._block_samples
        return found

    def encoded(self, block: SampleBlock | StatusBlock) -> bytes:
        """Encode a block."""
        if isinstance(block, StatusBlock):
            return gcf.encode_status(block)
        return gcf.encode_block(block, width=self._width)

    def _status(self) -> StatusBlock:
        stream = self._streams[0][:-2] + "00"
        start_ns = self._utc_ns + round(self._next * _NS / self._rate) // _NS * _NS
        celsius = float(self._source.temperature(self._sensor, self.next_due()))
        text = (
            "GPS: 3D fix\r\nClock: locked\r\n"
            f"External supply : {SUPPLY:.1f}V Temperature {celsius:.2f}'C\r\n"
            "Mass positions: 0 0 0\r\n"
        )
        return StatusBlock(self._system, stream, start_ns, text)


class GcfPort(Endpoint):
    """The digitizer's serial line; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(self, device: DeviceSpec, digitizer: Digitizer) -> None:
        self._digitizer = digitizer
        self._byte_time = 10 / float(device.settings.get("baud_rate", 115200))
        self._transmitter = Transmitter()
        self._frame: bytes | None = None
        self._until = NEVER  # end of the frame's transmission, or of the wait for its reply

    def connected(self, now: float) -> Sequence[bytes]:
        """Start to send."""
        self._digitizer.start(now)
        self._until = now
        return ()

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Discard queued frames; sequence numbers continue."""
        self._transmitter.clear()
        self._frame, self._until = None, NEVER

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process acknowledgements and refusals."""
        sent = list(self.due(now))
        if self._transmitter.receive(received) and self._frame is None:
            self._until = min(self._until, now)
            sent += self.due(now)
        return sent

    def reset(self, now: float) -> None:
        """Simulate a power failure: sequence numbers restart."""
        if self._until != NEVER:
            self._transmitter = Transmitter()
            self._frame = None
            self.connected(now)

    def due(self, now: float) -> Sequence[bytes]:
        """Return the frames completely transmitted by ``now``."""
        sent: list[bytes] = []
        if self._until == NEVER:
            return sent
        for block in self._digitizer.blocks(now):
            self._transmitter.queue(self._digitizer.encoded(block))
        while self._until <= now:
            if self._frame is not None:
                sent.append(self._frame)
                self._frame = None
                self._until += REPLY_TIME
            else:
                self._frame = self._transmitter.take_frame()
                if self._frame is None:
                    break
                self._until = max(self._until, now) + len(self._frame) * self._byte_time
        return sent

    def next_due(self) -> float:
        """Return the world time of the next action."""
        if self._until == NEVER:
            return NEVER
        if self._frame is None and not self._transmitter.waiting:
            return max(self._until, self._digitizer.next_due())
        return self._until


class ScreamServer(Endpoint):
    """A Scream server on one kind of wire; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(
        self, device: DeviceSpec, digitizer: Digitizer, sent: deque[tuple[int, bytes]], *, udp: bool
    ) -> None:
        self._digitizer = digitizer
        self._version = int(device.settings.get("version", 40))
        self._sent = sent
        self._udp = udp
        self._until = 0.0  # end of the client's request
        self._sequence = 0
        self._received = bytearray()

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Stop sending."""
        self._until = 0.0
        self._received.clear()

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process a request."""
        if self._udp:
            return self._datagram(received, now)
        answers: list[bytes] = []
        self._received += received
        while self._received:
            command = bytes(self._received[:1])
            if command == scream.TCP_AGAIN:
                if len(self._received) < 3:
                    break
                sequence = int.from_bytes(self._received[1:3], "big")
                answers.append(dict(self._sent).get(sequence, scream.NOT_AVAILABLE))
                del self._received[:3]
                continue
            if command == scream.TCP_SEND:
                self._begin(now, NEVER)
            elif command == scream.TCP_IDENTIFY:
                answers.append(b"\x10Scream simulated\0")
            elif command == scream.TCP_OLDEST:
                oldest = self._sent[0][0] if self._sent else 0
                answers.append(oldest.to_bytes(2, "big"))
            del self._received[0]
        return answers

    def _datagram(self, received: bytes, now: float) -> Sequence[bytes]:
        if received.startswith(b"GCFSEND"):
            self._begin(now, now + CLIENT_PATIENCE)
        elif received.startswith(b"GCFSTOP"):
            self._until = 0.0
        elif not received.startswith(b"GCFPING"):
            return ()
        return (scream.ACKNOWLEDGED, *self.due(now))

    def reset(self, now: float) -> None:
        """Simulate a power failure: packet numbers restart, and old packets are lost."""
        self._sequence = 0
        self._sent.clear()
        if self._until > now:
            self._digitizer.start(now)

    def _begin(self, now: float, until: float) -> None:
        if self._until <= now:
            self._digitizer.start(now)
        self._until = until

    def due(self, now: float) -> Sequence[bytes]:
        """Return the packets of the blocks completed by ``now``."""
        if self._until <= now:  # the client's request has expired
            self._until = 0.0
            return ()
        packets: list[bytes] = []
        for block in self._digitizer.blocks(now):
            packet = Packet(self._sequence, f"{block.stream_id}/COM1/simulated", block)
            packets.append(scream.encode_packet(packet, version=self._version))
            self._sent.append((self._sequence, packets[-1]))
            self._sequence = (self._sequence + 1) % 65536
        return packets

    def next_due(self) -> float:
        """Return the world time at which the next block is complete."""
        return self._digitizer.next_due() if self._until else NEVER


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return a serial line, or a Scream server on UDP, with recovery over TCP, or on TCP."""
    digitizer = Digitizer(device, source)
    sent: deque[tuple[int, bytes]] = deque(maxlen=HISTORY)
    if device.port == "udp":
        server = ScreamServer(device, digitizer, sent, udp=True)
        again = ScreamServer(device, digitizer, sent, udp=False)
        recovery = Line(again, "tcp", setting="recovery_port", carries_samples=False)
        return [Line(server, "udp-server", scheme="udp"), recovery]
    if device.port == "tcp" and device.settings.get("link") == "scream":
        return [Line(ScreamServer(device, digitizer, sent, udp=False), "tcp")]
    return [Line(GcfPort(device, digitizer), device.port)]
