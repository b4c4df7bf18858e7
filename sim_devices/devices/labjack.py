"""A simulated LabJack T7 or T8: registers over Modbus TCP, streams over port 702 or by command.

Simulated functions: functions 3, 4, 6, 16 and 76; exceptions with their reason in register 55000;
scan lists of analog inputs, CORE_TIMER, SYSTEM_TIMER_20HZ, and the upper half of a 32-bit channel;
scan intervals in multiples of 100 ns; the configured packet size; overflow of a buffer that is not
read (2940, then 2941 and one scan of 0xFFFF), 2943 if it lasts, 2942 if the rate is too high,
bursts (2944); calibration in flash; temperature; CORE_TIMER, which is 0 at world time 0 and after
each power failure (the fault ``reset``); SYSTEM_TIMER_20HZ, which also restarts with the process.

An analog input reads the counts of its channel relative to the centre of the converter. Settings
besides those of the driver: ``ends_with``, a fatal status that ends the first stream after
``ends_after`` scans.

A stream is a buffer of scans, read in packets. Registers have one port, spontaneous streams the
other.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from daq.devices.labjack import registers as reg
from daq.devices.labjack.packets import MAX_SAMPLES, Packet, encode_packet, encode_response
from daq.devices.labjack.registers import Adu, AduFinder, ReadAt
from daq.devices.labjack.stream import (
    AUTO_RECOVER_ACTIVE,
    AUTO_RECOVER_END,
    AUTO_RECOVER_OVERFLOW,
    BURST_COMPLETE,
    DUMMY,
    SCAN_OVERLAP,
)
from daq.protocols.errors import RemoteProtocolError
from sim_devices.devices.interface import NEVER, DeviceSpec, Endpoint, Line, Samples, Source, whole

CENTER = 33523


class Stream:
    """A buffer that is filled with scans and read in packets."""

    def __init__(
        self,
        samples: Samples,
        columns: InputColumns,
        *,
        capacity: int,
        packet_size: int,
        now: float,
    ) -> None:
        self._samples = samples
        self._columns = columns
        self._capacity = max(capacity, packet_size + 2 * columns.n)
        self._packet_size = packet_size
        self.first = self._next = samples.first_after(now)
        self._buffer = np.empty(0, np.uint16)
        self._recovering = False
        self._full_until = -NEVER
        self._skipped = 0
        self.is_due = False
        """Whether a packet is due that is not full."""
        self._mark: int | None = None  # scans skipped before the mark in the buffer
        self.wanted: int | None = None
        """Number of scans of a burst; None for a continuous stream."""
        self.breaks_off: tuple[int, int] | None = None
        """Number of scans after which the stream ends, and its status then."""
        self.ended = 0
        """Status at the end of the stream; 0 while it runs."""

    def advance(self, now: float) -> None:
        """Take the scans up to ``now``."""
        end = self._samples.end_before(now, self._next)
        if self.wanted is not None and end >= self.first + self.wanted:
            end, self.ended = self.first + self.wanted, self.ended or BURST_COMPLETE
        if self.breaks_off is not None and end >= self.first + self.breaks_off[0]:
            end, self.ended = self.first + self.breaks_off[0], self.breaks_off[1]
        while self._next < end:
            self._take(end)

    def overflow(self, until: float) -> None:
        """Take no scans before world time ``until``, as if the buffer were full.

        The scans in the buffer become due immediately, with the status of an overflow.
        """
        self._recovering = self.is_due = True
        self._full_until = until

    def _take(self, end: int) -> None:
        full = self._samples.time(self._next) < self._full_until
        if self._recovering and (full or self.n_waiting >= self._packet_size):
            if full:
                end = self._samples.end_before(
                    min(self._full_until, self._samples.time(end - 1)), self._next
                )
            self._skipped += end - self._next
            self._next = end
            if self._skipped > 65535:
                self.ended = AUTO_RECOVER_OVERFLOW
            return
        if self._recovering:
            self._put(np.full((1, self._columns.n), DUMMY, np.uint16))
            self._recovering, self._mark, self._skipped = False, self._skipped, 0
        n = min((self._capacity - self.n_waiting) // self._columns.n, end - self._next)
        self._put(self._columns.scans(self._samples, self._next, n))
        self._next += n
        self._recovering = self._next < end

    def _put(self, rows: NDArray[np.uint16]) -> None:
        self._buffer = np.concatenate((self._buffer, rows.ravel()))

    @property
    def n_waiting(self) -> int:
        """Number of samples in the buffer."""
        return len(self._buffer)

    def next_full(self) -> float:
        """Return the world time at which the next packet is full or the stream ends."""
        rows = -(-(self._packet_size - self.n_waiting) // self._columns.n)
        if self.ended or self.is_due or rows <= 0:
            return -NEVER
        last = self._next + rows - 1
        for limit in (self.wanted, self.breaks_off and self.breaks_off[0]):
            if limit is not None:
                last = min(last, self.first + limit - 1)
        return self._samples.time(max(last, self.first))

    def take_out(self, n_samples: int) -> Packet:
        """Remove at most ``n_samples`` samples; return them with their status."""
        taken, self._buffer = self._buffer[:n_samples], self._buffer[n_samples:]
        self.is_due = False
        status = information = 0
        if self._mark is not None:
            status, information, self._mark = AUTO_RECOVER_END, self._mark, None
        elif self._recovering:
            status = AUTO_RECOVER_ACTIVE
        if self.ended and not self.n_waiting:
            status = self.ended
            information = len(taken) if status == BURST_COMPLETE else 0
        return Packet(taken, 2 * self.n_waiting, status, information)


@dataclass(eq=False)
class InputColumns:
    """Values of the addresses of a scan list."""

    addresses: Sequence[int]
    inputs: Mapping[int, int]  # address of an analog input: column of the samples
    rate: float
    core_began: int = 0
    system_began: float = 0.0

    def __post_init__(self) -> None:
        self.n = len(self.addresses)
        self._ticks = round(reg.CORE_HZ / self.rate)

    def timer(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return CORE_TIMER at each scan."""
        return (index * self._ticks - self.core_began) % (1 << 32)

    def scans(self, samples: Samples, first: int, n: int) -> NDArray[np.uint16]:
        """Return ``n`` scans, shape (n, n_columns)."""
        counts = whole(samples.counts(first, n) + CENTER, 0, 65535)
        index = np.arange(first, first + n)
        rows = np.zeros((n, self.n), np.int64)
        wide = np.zeros(n, np.int64)  # the last 32-bit value, for its upper half
        for column, address in enumerate(self.addresses):
            if address == reg.STREAM_DATA_CAPTURE_16:
                rows[:, column] = wide >> 16
                continue
            if address == reg.CORE_TIMER:
                wide = self.timer(index)
            elif address == reg.SYSTEM_TIMER_20HZ:
                seconds = index / self.rate - self.system_began
                wide = (seconds * reg.SYSTEM_HZ).astype(np.int64) % (1 << 32)
            elif address in self.inputs:
                wide = counts[:, self.inputs[address]]
            else:
                wide = np.full(n, CENTER if address < 512 else column)
            rows[:, column] = wide & 0xFFFF
        return rows.astype(np.uint16)


MAX_SAMPLE_RATE = 100_000
_READ, _WRITE_ONE, _WRITE_MANY = (3, 4), 6, 16
_FLOATS = {reg.STREAM_SCANRATE_HZ: 1000.0, reg.STREAM_SETTLING_US: 0.0}
_WORDS = {
    reg.STREAM_NUM_ADDRESSES: 0,
    reg.STREAM_SAMPLES_PER_PACKET: MAX_SAMPLES,
    reg.STREAM_RESOLUTION_INDEX: 0,
    reg.STREAM_BUFFER_SIZE_BYTES: 4096,
    reg.STREAM_CLOCK_SOURCE: 0,
    reg.STREAM_AUTO_TARGET: 1,
    reg.STREAM_DATATYPE: 0,
    reg.STREAM_NUM_SCANS: 0,
    reg.STREAM_EXTERNAL_CLOCK_DIVISOR: 1,
    reg.STREAM_TRIGGER_INDEX: 0,
    reg.STREAM_START_TIME_STAMP: 0,
    reg.STREAM_ENABLE: 0,
    reg.TEST: reg.TEST_VALUE,
    reg.FLASH_READ_POINTER: 0,
    43903: 0,
}
_READ_ONLY = range(55000, 61810)


class RequestError(Exception):
    """The device replies with an exception; register 55000 gets the reason."""

    def __init__(self, exception: int, reason: int = 0) -> None:
        super().__init__(exception, reason)
        self.exception = exception
        self.reason = reason


class LabJack:
    """Registers and stream of one device, shared by its two ports."""

    def __init__(self, device: DeviceSpec, source: Source) -> None:
        self._source = source
        self._sensors = device.sensors
        self._inputs: dict[int, int] = {}
        for sensor in device.sensors:
            settings = {**device.settings, **device.sensor_settings.get(sensor, {})}
            n_channels = sum(not channel.auxiliary for channel in device.channels[sensor])
            usual = range(len(self._inputs), len(self._inputs) + n_channels)
            for number in settings.get("inputs") or usual:
                text = str(number).upper().removeprefix("AIN")
                self._inputs[reg.ain(int(text))] = len(self._inputs)
        self._ends_with = device.settings.get("ends_with")
        self._ends_after = int(device.settings.get("ends_after", 0))
        self._memory: dict[int, int] = {}
        self._is_t8 = "T8" in device.model.upper()
        self._flash_begins = reg.T8_CALIBRATION_ADDRESS if self._is_t8 else reg.CALIBRATION_ADDRESS
        self._flash = (
            reg.encode_t8_calibrations(_t8_calibrations())
            if self._is_t8
            else reg.encode_calibrations(reg.nominal_calibrations())
        )
        serial = device.serial_number or str(
            470_000_000 + zlib.crc32(device.sensors[0].encode()) % 10**6
        )
        self._store(reg.SERIAL_NUMBER, struct.pack(">I", int(serial)))
        product = 8.0 if self._is_t8 else 7.0
        for address, value in {
            reg.PRODUCT_ID: product,
            reg.FIRMWARE_VERSION: 1.0292,
            reg.TEMPERATURE_DEVICE_K: 0.0,  # as `_read` returns it
            **_FLOATS,
        }.items():
            self._store(address, struct.pack(">f", value))
        for address, value in _WORDS.items():
            self._store(address, struct.pack(">I", value))
        self._store(reg.LAST_ERROR_DETAIL, bytes(2))
        self._rate_now = reg.exact_rate if self._is_t8 else reg.actual_scan_rate
        if self._is_t8:
            self._store(reg.STREAM_SCANRATE_HZ_ACTUAL, bytes(4))
        for k in range(128):
            self._store(reg.STREAM_SCANLIST + 2 * k, bytes(4))
        for n in range(14):
            self._store(reg.AIN_RANGE + 2 * n, struct.pack(">f", 10.0))
            self._store(reg.AIN_NEGATIVE_CHANNEL + n, struct.pack(">H", reg.SINGLE_ENDED))
            self._store(41500 + n, bytes(2))  # AINn_RESOLUTION_INDEX
        self.stream: Stream | None = None
        self.stream_started = 0  # number of starts
        self._core_began = 0  # CORE_TIMER at world time 0, zero or negative, in ticks
        self._system_began: float | None = None  # world time of the first request

    # --- registers ---------------------------------------------------------------------------

    def answer(self, adu: Adu, now: float) -> bytes:
        """Return the reply to a request."""
        if self._system_began is None:
            self._system_began = now
        function = adu.pdu[0] if adu.pdu else 0
        try:
            pdu = bytes((function,)) + self._function(function, adu.pdu, now)
        except RequestError as refused:
            self._store(reg.LAST_ERROR_DETAIL, struct.pack(">H", refused.reason))
            pdu = bytes((function | 0x80, refused.exception))
        except (RemoteProtocolError, struct.error):
            pdu = bytes((function | 0x80, 3))
        return reg.encode_adu(Adu(adu.transaction, adu.unit, pdu))

    def _function(self, function: int, pdu: bytes, now: float) -> bytes:
        if function in _READ:
            address, n_registers = struct.unpack(">HH", pdu[1:5])
            if not 1 <= n_registers <= 125:
                raise RequestError(3)
            values = self._read(address, n_registers, now)
            return bytes((len(values),)) + values
        if function == _WRITE_ONE:
            self._write(struct.unpack_from(">H", pdu, 1)[0], pdu[3:5], now)
            return pdu[1:5]
        if function == _WRITE_MANY:
            address, n_registers, size = struct.unpack_from(">HHB", pdu, 1)
            if size != 2 * n_registers or len(pdu) != 6 + size:
                raise RequestError(3)
            self._write(address, pdu[6:], now)
            return pdu[1:5]
        if function == reg.FEEDBACK:
            values = b""
            for command in reg.decode_feedback(pdu):
                if isinstance(command, ReadAt):
                    values += self._read(command.address, command.n_registers, now)
                else:
                    self._write(command.address, command.values, now)
            return values
        raise RequestError(1)

    def _store(self, address: int, values: bytes) -> None:
        for k, word in enumerate(np.frombuffer(values, ">u2").tolist()):
            self._memory[address + k] = word

    def _value(self, address: int) -> int:
        return self._memory[address] << 16 | self._memory[address + 1]

    def _real(self, address: int) -> float:
        return float(struct.unpack(">f", self._value(address).to_bytes(4, "big"))[0])

    def _read(self, address: int, n_registers: int, now: float) -> bytes:
        if address == reg.TEMPERATURE_DEVICE_K:
            celsius = float(self._source.temperature(self._sensors[0], now))
            self._store(address, struct.pack(">f", celsius + 273.15))
        if address == reg.STREAM_DATA_CR:
            return self._read_stream(n_registers, now)
        if address == reg.FLASH_READ:
            start = self._value(reg.FLASH_READ_POINTER) - self._flash_begins
            values = self._flash[max(0, start) : max(0, start) + 2 * n_registers]
            return values.ljust(2 * n_registers, b"\xff")
        if address < 28:
            return b"".join(self._volts(a, now) for a in range(address, address + n_registers, 2))
        if address == reg.CORE_TIMER:
            ticks = (int(now * reg.CORE_HZ) - self._core_began) % (1 << 32)
            return ticks.to_bytes(4, "big")[: 2 * n_registers]
        if address == reg.SYSTEM_TIMER_20HZ:
            seconds = now - (self._system_began or 0.0)
            return int(seconds * reg.SYSTEM_HZ).to_bytes(4, "big")[: 2 * n_registers]
        words = [self._memory.get(a) for a in range(address, address + n_registers)]
        if None in words:
            raise RequestError(reg.ILLEGAL_ADDRESS)
        return np.array(words, ">u2").tobytes()

    def _volts(self, address: int, now: float) -> bytes:
        samples = Samples(self._source, self._sensors)
        counts = CENTER
        if address in self._inputs:
            row = samples.counts(samples.first_after(now), 1) + CENTER
            counts = int(whole(row, 0, 65535)[0, self._inputs[address]])
        calibration = (
            reg.nominal_t8_calibrations() if self._is_t8 else reg.decode_calibrations(self._flash)
        )[0]
        return struct.pack(">f", float(calibration.volts(counts)))

    def _write(self, address: int, values: bytes, now: float) -> None:
        if len(values) % 2 or address in _READ_ONLY:
            raise RequestError(reg.ILLEGAL_ADDRESS)
        if any(address + k not in self._memory for k in range(len(values) // 2)):
            raise RequestError(reg.ILLEGAL_ADDRESS)
        if address == reg.STREAM_ENABLE:
            self._enable(int.from_bytes(values, "big"), now)
            return
        self._store(address, values)
        if address == reg.STREAM_SCANRATE_HZ:
            wanted = self._real(address)
            if not 0.01 <= wanted <= MAX_SAMPLE_RATE:
                raise RequestError(3, 2608)
            if not self._is_t8:
                self._store(address, struct.pack(">f", reg.actual_scan_rate(wanted)))

    # --- stream ------------------------------------------------------------------------------

    @property
    def targets(self) -> int:
        """Targets of stream samples (register STREAM_AUTO_TARGET)."""
        return self._value(reg.STREAM_AUTO_TARGET)

    @property
    def packet_size(self) -> int:
        """Number of samples per packet."""
        return min(max(1, self._value(reg.STREAM_SAMPLES_PER_PACKET)), MAX_SAMPLES)

    def _enable(self, value: int, now: float) -> None:
        if not value:
            if self.stream is None:
                raise RequestError(4, reg.STREAM_NOT_RUNNING)
            self.stop()
            return
        n_columns = self._value(reg.STREAM_NUM_ADDRESSES)
        if not 1 <= n_columns <= 128 or self.stream is not None:
            raise RequestError(4, 2605)
        addresses = [self._value(reg.STREAM_SCANLIST + 2 * k) for k in range(n_columns)]
        rate = self._rate_now(self._real(reg.STREAM_SCANRATE_HZ))
        overlap = rate * n_columns > MAX_SAMPLE_RATE
        as_is = overlap or rate == self._source.sampling_rate
        source = self._source if as_is else self._source.at_rate(rate)
        began = self._core_began, self._system_began or 0.0
        columns = InputColumns(addresses, self._inputs, rate, *began)
        capacity = (self._value(reg.STREAM_BUFFER_SIZE_BYTES) or 4096) // 2
        size = self.packet_size if self.targets & reg.TARGET_ETHERNET else 1
        samples = Samples(source, self._sensors)
        stream = Stream(samples, columns, capacity=capacity, packet_size=size, now=now)
        stream.wanted = self._value(reg.STREAM_NUM_SCANS) or None
        if overlap:
            stream.breaks_off = (1, SCAN_OVERLAP)
        elif self._ends_with and not self.stream_started:
            stream.breaks_off = (self._ends_after, int(self._ends_with))
        # with a trigger index, the stream waits for a trigger that never occurs
        self.stream = None if self._value(reg.STREAM_TRIGGER_INDEX) else stream
        self.stream_started += 1
        self._store(reg.STREAM_ENABLE, struct.pack(">I", 1))
        if self._is_t8:
            self._store(reg.STREAM_SCANRATE_HZ_ACTUAL, struct.pack(">f", rate))
        started = int(columns.timer(np.array([stream.first]))[0])
        self._store(reg.STREAM_START_TIME_STAMP, started.to_bytes(4, "big"))

    def fault(self, kind: str, now: float, duration: float) -> None:
        """Simulate a power failure, or an overflow of ``duration`` s."""
        if kind == "reset":
            self.stop()
            first = self._source.first_sample_after(self._sensors[0], now)
            self._core_began = first * round(reg.CORE_HZ / self._source.sampling_rate)
            self._system_began = now
        elif self.stream is not None:
            self.stream.advance(now)
            self.stream.overflow(now + duration)

    def stop(self) -> None:
        """Stop the stream."""
        self.stream = None
        self._store(reg.STREAM_ENABLE, bytes(4))

    def _read_stream(self, n_registers: int, now: float) -> bytes:
        if self.stream is None:
            raise RequestError(4, reg.STREAM_NOT_RUNNING)
        if n_registers < 4:
            raise RequestError(3)
        self.stream.advance(now)
        packet = self.stream.take_out(n_registers - 4)
        return encode_response(packet, n_registers=n_registers)


def _t8_calibrations() -> list[reg.RangeCalibration]:
    """Return the calibrations of a T8 with a small error in each input."""
    return [
        one._replace(positive_slope=one.positive_slope * (1 + 1e-4 * (k // len(reg.T8_RANGES))))
        for k, one in enumerate(reg.nominal_t8_calibrations())
    ]


class ControlPort(Endpoint):
    """Port 502; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(self, labjack: LabJack) -> None:
        self._labjack = labjack
        self._finder = AduFinder()

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Forget the request; a stream continues."""
        self._finder = AduFinder()

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process requests; return the replies."""
        try:
            requests = self._finder.receive(received)
        except RemoteProtocolError:
            return ()
        return [self._labjack.answer(adu, now) for adu in requests]

    def fault(self, kind: str, now: float, duration: float) -> None:
        """Pass a fault of its own on to the device."""
        self._labjack.fault(kind, now, duration)


class StreamPort(Endpoint):
    """Port 702; an :class:`~sim_devices.devices.interface.Endpoint`."""

    LOOK_INTERVAL = 0.05
    """Interval of checks for a stream started over another port, s of world time."""

    def __init__(self, labjack: LabJack) -> None:
        self._labjack = labjack
        self._connected = False
        self._transaction = 0
        self._looked = 0.0

    def connected(self, now: float) -> Sequence[bytes]:
        """Send the samples in the buffer."""
        self._connected = True
        return self.due(now)

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Keep the samples: the buffer may overflow."""
        self._connected = False

    def fault(self, kind: str, now: float, duration: float) -> None:
        """Pass a fault of its own on to the device."""
        self._labjack.fault(kind, now, duration)

    def due(self, now: float) -> Sequence[bytes]:
        """Return the full packets."""
        self._looked = now
        stream = self._labjack.stream
        if stream is None or not self._connected or not self._labjack.targets & reg.TARGET_ETHERNET:
            return ()
        stream.advance(now)
        size, sent = self._labjack.packet_size, []
        while stream.n_waiting >= size or stream.is_due or stream.ended:
            packet = replace(stream.take_out(size), transaction=self._transaction)
            sent.append(encode_packet(packet))
            self._transaction = (self._transaction + 1) % 65536
            if stream.ended and not stream.n_waiting:
                self._labjack.stop()
                break
        return sent

    def next_due(self) -> float:
        """Return the world time of the next full packet, or of the next check for a stream."""
        stream = self._labjack.stream
        if not self._connected:
            return NEVER
        if stream is None or not self._labjack.targets & reg.TARGET_ETHERNET:
            return self._looked + self.LOOK_INTERVAL
        return max(self._looked, stream.next_full())


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the device's control port and its stream port."""
    labjack = LabJack(device, source)
    by_command = device.settings.get("mode") == "command-response"
    control, stream = ControlPort(labjack), StreamPort(labjack)
    return [
        Line(control, "tcp", scheme="modbus-tcp", carries_samples=by_command),
        Line(stream, "tcp", setting="stream_port", carries_samples=not by_command),
    ]
