"""A simulated Epson M-A352 or M-A370: registers in, bursts out.

Simulated functions: two register windows (``80 xx 0D`` is a burst request in one and a register
write in the other), modes and their state bits, rates, filters, burst fields, tilt, UART_AUTO and
bursts on request, no replies to reads while streaming, software reset, flash backup, factory
defaults, AUTO_START, busy and not-ready bits with their durations, wraps of COUNT, transmission
time of each burst on the UART, external trigger, and on an M-A370 synchronisation with 1PPS. An
M-A370 has neither reduced noise nor temperature stabilisation, and lacks three filters: it ignores
their bits and codes (assumed).

The setting ``external`` defines the signal at the EXT pin: a trigger generator at the sampling
rate, or the seconds of UTC. Without a signal, a triggered device takes no samples, and a device
with 1PPS uses its own clock.

Not simulated: attenuation and delay of the filters, and sleep mode, which only a reset ends.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.devices.epson import commands
from daq.devices.epson.commands import BurstFormat, CommandDecoder, Read, Register, Write
from sim_devices.devices.interface import NEVER, DeviceSpec, Endpoint, Line, Source

FULL_SCALE = 15 * commands.COUNTS_PER_G
RESET_TIME, FLASH_TIME, FILTER_TIME, TEST_TIME = 0.97, 0.31, 0.005, 0.2
"""Durations for which the device is not ready or busy, s."""
TRIGGER, PPS = 0x40, 0x80
"""Bits of MSC_CTRL: sampling by triggers, or synchronised with 1PPS (M-A370)."""
_NOT_ON_A370 = {commands.FILTERS[name] for name in commands.NOT_ON_A370}
AHEAD = 1.0
"""Duration simulated per call, s of world time."""

_DEFAULTS = {
    commands.SIG_CTRL: 0x8E04,
    commands.MSC_CTRL: 0x0006,
    commands.SMPL_CTRL: 0x0400,
    commands.FILTER_CTRL: 0x0008,
    commands.UART_CTRL: 0x0100,
    commands.BURST_CTRL: 0x4702,
}
_PENDING = {commands.FLASH_BACKUP: 0x0008, commands.FACTORY: 0x0010}


def temperature_counts(celsius: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return temperature counts."""
    return np.rint((celsius - commands.TEMPERATURE_OFFSET) / commands.TEMPERATURE_SLOPE).astype(
        np.int64
    )


class EpsonDevice(Endpoint):
    """One accelerometer on a UART; an :class:`~sim_devices.devices.interface.Endpoint`.

    Parameters
    ----------
    device
        Sensor and settings; the setting ``first_count`` is the first COUNT.
    source
        Readings of the sensor.
    """

    def __init__(self, device: DeviceSpec, source: Source) -> None:
        (self._sensor,) = device.sensors
        fields = device.settings.get("fields") or ("x", "y", "z")
        self._axes = [field for field in fields if field != "temperature"]
        self._first_count = int(device.settings.get("first_count", 0))
        connected = str(device.settings.get("external", ""))
        self._trigger_rate = device.sampling_rate if connected.startswith("trigger") else 0.0
        self._pps = connected.startswith("pps")
        self._utc_ns = device.utc_ns
        self._baud_rate = int(device.settings.get("baud_rate", 460800))
        serial_number = device.serial_number or f"S{zlib.crc32(self._sensor.encode()) % 10**7:07d}"
        self._fixed: dict[Register, int] = {
            commands.ID: commands.DEVICE_ID,
            commands.VERSION: 0x0104,
        }
        self._is_a370 = "370" in device.model
        self._fixed |= _text(commands.PROD_ID, "A370AD10" if self._is_a370 else "A352AD10")
        self._fixed |= _text(commands.SERIAL_NUM, serial_number)
        self._source = source
        self._sampled = source
        self._commands = CommandDecoder()
        self._defaults = _DEFAULTS | ({commands.SIG_CTRL: 0x8E00} if self._is_a370 else {})
        self._flash = dict(self._defaults)
        self._times: NDArray[np.float64] = np.empty(0)  # of the samples in _frames, world time
        self._frames = b""
        self._first = self._sent = self._begin = 0
        self._burst = BurstFormat(0)
        self._latency = 0.0
        self.reset(0.0)

    # --- Endpoint -------------------------------------------------------------------------

    def connected(self, now: float) -> Sequence[bytes]:
        """Do nothing: a UART has no connections."""
        self.due(now)
        return ()

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Execute commands; return the replies to reads."""
        answers = list(self.due(now))
        for command in self._commands.receive(received):
            if isinstance(command, Read):
                answers += self._read(command, now)
            else:
                answers += self._write(command, now)
        return answers

    def due(self, now: float) -> Sequence[bytes]:
        """Return the bursts that have left the UART up to ``now``."""
        if self._starts <= now:
            self._start_sampling(self._starts)
        if not self._streaming:
            return ()
        size = self._burst.size
        sent: list[bytes] = []
        while True:
            stop = int(np.searchsorted(self._times, now - self._latency, side="right"))
            sent += [self._frames[row * size : (row + 1) * size] for row in range(self._sent, stop)]
            self._sent = stop
            if stop < self._times.size:
                return sent
            self._simulate(self._first + self._times.size)

    def next_due(self) -> float:
        """World time at which the next burst will have left the UART."""
        if self._starts < NEVER:
            return self._starts
        return float(self._times[self._sent]) + self._latency if self._streaming else NEVER

    # --- commands -------------------------------------------------------------------------

    def reset(self, now: float) -> None:
        """Simulate a power failure."""
        self._window = 0
        self._mode = commands.CONFIGURATION
        self._registers = dict(self._flash)
        self._busy: dict[Register, tuple[int, float]] = {}
        self._not_ready_until = now + RESET_TIME
        self._starts = NEVER
        if self._registers[commands.UART_CTRL] & commands.AUTO_START:
            self._starts = self._not_ready_until

    @property
    def _streaming(self) -> bool:
        automatic = self._registers[commands.UART_CTRL] & commands.UART_AUTO
        never = self._registers[commands.MSC_CTRL] & TRIGGER and not self._trigger_rate
        return self._mode == commands.SAMPLING and bool(automatic) and not never

    def _read(self, command: Read, now: float) -> Iterable[bytes]:
        if self._streaming or self._mode == commands.SLEEP:
            return ()
        value = self._value(Register(self._window, command.address), now)
        return (commands.encode_reply(command.address, value & 0xFFFF),)

    def _value(self, register: Register, now: float) -> int:
        if register in self._fixed:
            return self._fixed[register]
        value = self._registers.get(register, 0)
        bits, until = self._busy.get(register, (0, 0.0))
        if now < until:
            value |= bits
        if register == commands.GLOB_CMD and now < self._not_ready_until:
            value |= commands.NOT_READY
        elif register == commands.MODE_CTRL:
            value = (self._mode - 1) << 10
        elif register.address == commands.WINDOW:
            value = self._window
        elif register.window == 0:
            value = self._measured(register, now)
        return value

    def _measured(self, register: Register, now: float) -> int:
        """Return a register of window 0 with a measured value."""
        if register == commands.COUNT:
            return self._count(self._latest(now)) if self._mode == commands.SAMPLING else 0
        high = (
            Register(0, register.address & ~2) if register.address != 0x10 else commands.TEMP_HIGH
        )
        value = 0
        if high == commands.TEMP_HIGH:
            value = int(temperature_counts(self._source.temperature(self._sensor, now)))
        elif high in (*commands.ACCELERATION_HIGH, *commands.TILT_HIGH):
            axis = [*commands.ACCELERATION_HIGH, *commands.TILT_HIGH].index(high) % 3
            index = self._sampled.first_sample_after(self._sensor, now)
            value = int(self._axis_counts(index, 1)["xyz"[axis]][0])
        return value >> 16 if register == high else value

    def _write(self, command: Write, now: float) -> Iterable[bytes]:
        low = command.address & ~1
        register = Register(self._window, low)
        if self._mode == commands.SLEEP:
            return ()
        if low == commands.WINDOW:
            self._window = command.value & 1
        elif self._window == 0 and command.address == 0:
            if self._mode == commands.SAMPLING and not self._streaming:
                return (self._burst_on_request(now),)
        elif register == commands.MODE_CTRL and command.address & 1:
            self._set_mode(command.value & 3, now)
        elif self._mode == commands.CONFIGURATION and register == commands.GLOB_CMD:
            self._global_command(command.value, now)
        elif self._mode == commands.CONFIGURATION and register in self._registers:
            self._set(register, command, now)
        return ()

    def _set(self, register: Register, command: Write, now: float) -> None:
        shift = 8 if command.address & 1 else 0
        if register == commands.MSC_CTRL and shift:  # self-tests: bits clear on completion
            self._busy[register] = (command.value << 8, now + TEST_TIME)
            return
        value = command.value
        if register == commands.MSC_CTRL and not self._is_a370:
            value &= ~PPS
        if register == commands.SIG_CTRL and not shift and self._is_a370:
            value &= ~(commands.REDUCED_NOISE | commands.TEMPERATURE_STABILISATION)
        if register == commands.FILTER_CTRL and self._is_a370 and value in _NOT_ON_A370:
            return
        kept = self._registers[register] & (0xFF00 if shift == 0 else 0x00FF)
        self._registers[register] = kept | value << shift
        if register == commands.FILTER_CTRL:
            self._registers[register] &= ~commands.FILTER_BUSY
            self._busy[register] = (commands.FILTER_BUSY, now + FILTER_TIME)

    def _global_command(self, command: int, now: float) -> None:
        if command == commands.RESET:
            self.reset(now)
        elif command == commands.FLASH_BACKUP:
            self._flash = dict(self._registers)
        elif command == commands.FACTORY:
            self._flash = dict(self._defaults)
        if command in _PENDING:
            self._busy[commands.GLOB_CMD] = (_PENDING[command], now + FLASH_TIME)

    def _set_mode(self, mode: int, now: float) -> None:
        if mode == commands.SAMPLING:
            if self._mode == commands.CONFIGURATION:
                self._start_sampling(now)
        elif mode:
            self._mode = mode
            self._starts = NEVER

    # --- sampling -------------------------------------------------------------------------

    def _start_sampling(self, now: float) -> None:
        self._starts = NEVER
        self._mode = commands.SAMPLING
        code = self._registers[commands.SMPL_CTRL] >> 8
        rate: float = next((rate for rate, c in commands.RATES.items() if c == code), 200)
        external = self._registers[commands.MSC_CTRL]
        if external & TRIGGER:
            rate = self._trigger_rate
        if rate != self._sampled.sampling_rate:
            self._sampled = self._source.at_rate(float(rate)) if rate else self._source
        if external & TRIGGER:
            self._sampled = self._sampled.disciplined(0.0)
        elif external & PPS and self._pps:
            self._sampled = self._sampled.disciplined(-self._utc_ns % 10**9 / 1e9)
        self._burst = BurstFormat(self._registers[commands.BURST_CTRL])
        self._latency = self._burst.size * 10 / self._baud_rate
        self._begin = self._sampled.first_sample_after(self._sensor, now)
        self._simulate(self._begin)

    def _simulate(self, first: int) -> None:
        """Simulate the bursts of the next second, from sample ``first`` on."""
        n = max(1, math.ceil(AHEAD * self._sampled.sampling_rate))
        self._first, self._sent = first, 0
        self._times = self._sampled.times(self._sensor, first, n)
        self._frames = commands.encode_bursts(
            self._burst,
            flag=0x8E00,
            temperature=temperature_counts(self._source.temperature(self._sensor, self._times)),
            count=self._count(np.arange(first, first + n)),
            **self._axis_counts(first, n),
        )

    def _axis_counts(self, first: int, n: int) -> dict[str, NDArray[np.int64]]:
        counts = self._sampled.counts(self._sensor, first, n)
        whole = np.clip(np.rint(counts), -FULL_SCALE, FULL_SCALE).astype(np.int64)
        still: dict[str, NDArray[np.int64]] = dict.fromkeys("xyz", np.zeros(n, np.int64))
        return still | dict(zip(self._axes, whole.T, strict=False))  # others are not recorded

    def _count(self, index: Any) -> Any:  # noqa: ANN401 -- one index or an array of them
        return (index - self._begin + self._first_count) % 65536

    def _latest(self, now: float) -> int:
        return max(self._begin, self._sampled.first_sample_after(self._sensor, now) - 1)

    def _burst_on_request(self, now: float) -> bytes:
        index = self._latest(now)
        if not self._first <= index < self._first + self._times.size:
            self._simulate(index)
        row = index - self._first
        return self._frames[row * self._burst.size : (row + 1) * self._burst.size]


def _text(registers: tuple[Register, ...], text: str) -> dict[Register, int]:
    octets = text.encode("ascii")[: 2 * len(registers)].ljust(2 * len(registers))
    return {
        register: int.from_bytes(octets[2 * k : 2 * k + 2], "little")
        for k, register in enumerate(registers)
    }


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the accelerometer's one line."""
    return [Line(EpsonDevice(device, source), device.port)]
