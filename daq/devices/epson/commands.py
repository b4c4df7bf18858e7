"""Epson M-A352 and M-A370 quartz accelerometers over UART: registers, commands, burst frames.

Theory of operation
-------------------
Commands are three bytes. A *write* ``addr|80 byte 0D`` has no reply; a *read* ``addr 00 0D`` of an
even address is answered ``addr hi lo 0D``. Registers lie in windows, selected by writing the window
number to 7E; the same bytes ``80 xx 0D`` that ask for a burst in window 0 write SIG_CTRL in
window 1, so both ends must keep track of the window.

In sampling mode the device sends *bursts*: ``80``, the fields that BURST_CTRL selects (big-endian),
``0D``; spontaneously if UART_AUTO is set, else on request. CHECKSUM is the sum of the 16-bit words
between header and checksum, modulo 65536. Header and delimiter values also occur inside frames, so
only length, header, delimiter and checksum together identify one
(:mod:`daq.devices.epson.burst`).

This module has both roles: the driver writes commands and reads replies, the simulated device reads
commands and writes replies. Source: Seiko Epson, M-A352AD10 data sheet and the logger `esensorlib`
2.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

DELIMITER = 0x0D
BURST_HEADER = 0x80
STANDARD_GRAVITY = 9.80665
COUNTS_PER_G = 2**24
COUNTS_PER_UNIT = COUNTS_PER_G / STANDARD_GRAVITY
"""Nominal sensitivity in counts per m/s²."""
TEMPERATURE_SLOPE, TEMPERATURE_OFFSET = -0.0037918, 34.987
"""°C per count, and °C at count 0."""
DEVICE_ID = 0x5345


class Register(NamedTuple):
    """A 16-bit register: its window and the (even) address of its low byte."""

    window: int
    address: int


MODE_CTRL = Register(0, 0x02)
DIAG_STAT = Register(0, 0x04)
COUNT = Register(0, 0x0A)
TEMP_HIGH = Register(0, 0x0E)
ACCELERATION_HIGH = (Register(0, 0x30), Register(0, 0x34), Register(0, 0x38))
TILT_HIGH = (Register(0, 0x3C), Register(0, 0x40), Register(0, 0x44))
ID = Register(0, 0x4C)
SIG_CTRL = Register(1, 0x00)
MSC_CTRL = Register(1, 0x02)
SMPL_CTRL = Register(1, 0x04)
FILTER_CTRL = Register(1, 0x06)
UART_CTRL = Register(1, 0x08)
GLOB_CMD = Register(1, 0x0A)
BURST_CTRL = Register(1, 0x0C)
PROD_ID = tuple(Register(1, address) for address in (0x6A, 0x6C, 0x6E, 0x70))
VERSION = Register(1, 0x72)
SERIAL_NUM = tuple(Register(1, address) for address in (0x74, 0x76, 0x78, 0x7A))
WINDOW = 0x7E
"""Address of the window selector, in every window."""

SAMPLING, CONFIGURATION, SLEEP = 1, 2, 3
"""Values for MODE_CTRL's high byte; bits 11:10 read back one less."""
FILTER_BUSY = 0x0020
NOT_READY = 0x0400
RESET, FLASH_BACKUP, FACTORY = 0x80, 0x08, 0x04
"""Values for GLOB_CMD's low byte."""
UART_AUTO, AUTO_START = 0x01, 0x02
REDUCED_NOISE, TEMPERATURE_STABILISATION = 0x10, 0x04
"""Bits of SIG_CTRL's low byte, M-A352 only. Assumed: an M-A370 reads 0."""
FLAG_ERROR = 0x0001
"""Bit of FLAG: DIAG_STAT holds an error."""

RATES = {1000: 2, 500: 3, 200: 4, 100: 5, 50: 6}
"""Sampling rate in Hz → code in SMPL_CTRL's high byte."""
BAUD_RATES = {460800: 1, 230400: 2, 115200: 3}
_FILTERS = (
    *("K64_FC83", "K64_FC220", "K128_FC36", "K128_FC110", "K128_FC350"),
    *("K512_FC9", "K512_FC16", "K512_FC60", "K512_FC210", "K512_FC460"),
)
FILTERS = {name: code for code, name in enumerate(_FILTERS, 1)}
"""Name → code in FILTER_CTRL."""
NOT_ON_A370 = frozenset({"K64_FC220", "K128_FC350", "K512_FC460"})
USUAL_FILTER = {
    1000: "K512_FC460",
    500: "K512_FC210",
    200: "K512_FC60",
    100: "K512_FC16",
    50: "K512_FC9",
}
"""For an M-A352; an M-A370 uses at 1000 Hz the value for 500 Hz."""


@dataclass(frozen=True, slots=True)
class Read:
    """Request for the register at an even address of the current window."""

    address: int

    def encode(self) -> bytes:
        """Return its three bytes."""
        return bytes((self.address & 0x7E, 0x00, DELIMITER))


@dataclass(frozen=True, slots=True)
class Write:
    """Command that sets one byte of the current window; address 0 in window 0 requests a burst."""

    address: int
    value: int

    def encode(self) -> bytes:
        """Return its three bytes."""
        return bytes((self.address | 0x80, self.value, DELIMITER))


SIZE = 3
"""Bytes of a command. A real device needs 350 µs between two commands."""


def read(register: Register) -> bytes:
    """Return the bytes that select the window and request a register."""
    return Write(WINDOW, register.window).encode() + Read(register.address).encode()


def write(register: Register, value: int, *, high: bool = False) -> bytes:
    """Return the bytes that select the window and set the low or high byte of a register."""
    selected = Write(WINDOW, register.window).encode()
    return selected + Write(register.address + high, value).encode()


def encode_reply(address: int, value: int) -> bytes:
    """Return a device's reply to :class:`Read`."""
    return bytes((address, value >> 8, value & 0xFF, DELIMITER))


def find_reply(received: bytes, address: int) -> int | None:
    """Return the value in the last complete reply for ``address``, or None.

    Other bytes are ignored: they belong to bursts sent before the command.
    """
    for start in range(len(received) - 4, -1, -1):
        if received[start] == address and received[start + 3] == DELIMITER:
            return received[start + 1] << 8 | received[start + 2]
    return None


class CommandDecoder:
    """Decoder of the device: bytes in, commands out. A stray delimiter resynchronises it."""

    def __init__(self) -> None:
        self._waiting = bytearray()

    def receive(self, received: bytes) -> list[Read | Write]:
        """Return the commands completed by these bytes."""
        commands: list[Read | Write] = []
        for octet in received:
            self._waiting.append(octet)
            if self._waiting[0] == DELIMITER:
                self._waiting.clear()
            elif len(self._waiting) == 3:
                address, value, end = self._waiting
                if end != DELIMITER:
                    del self._waiting[0]
                    continue
                self._waiting.clear()
                commands.append(
                    Write(address & 0x7F, value) if address & 0x80 else Read(address & 0x7E)
                )
        return commands


_FIELDS = (
    ("flag", 15, ">u2"),
    ("temperature", 14, ">i4"),
    ("x", 10, ">i4"),
    ("y", 9, ">i4"),
    ("z", 8, ">i4"),
    ("count", 1, ">u2"),
    ("checksum", 0, ">u2"),
)
_BIT = {name: bit for name, bit, _ in _FIELDS}


@dataclass(frozen=True, slots=True)
class BurstFormat:
    """Fields of a burst, as selected by the value of BURST_CTRL."""

    burst_ctrl: int

    @classmethod
    def of(cls, *fields: str) -> BurstFormat:
        """Return the format with these fields, of flag, temperature, x, y, z, count, checksum."""
        return cls(sum(1 << _BIT[field] for field in fields))

    def __contains__(self, field: str) -> bool:
        return bool(self.burst_ctrl >> _BIT[field] & 1)

    @property
    def dtype(self) -> np.dtype[np.void]:
        """Dtype of one frame as a packed structure: header, fields, delimiter."""
        present = [(name, kind) for name, bit, kind in _FIELDS if self.burst_ctrl >> bit & 1]
        return np.dtype([("header", "u1"), *present, ("delimiter", "u1")])

    @property
    def size(self) -> int:
        """Length of a frame in bytes."""
        return self.dtype.itemsize


def encode_bursts(burst: BurstFormat, **values: NDArray[np.integer[Any]] | int) -> bytes:
    """Return frames as a device sends them.

    Parameters
    ----------
    burst
        The format; values of fields that it lacks are ignored.
    **values
        For each field except the checksum, one value for all frames or an array with one per frame.
    """
    n_frames = max(np.size(value) for value in values.values())
    frames = np.zeros(n_frames, dtype=burst.dtype)
    frames["header"], frames["delimiter"] = BURST_HEADER, DELIMITER
    for field, value in values.items():
        if field in burst:
            frames[field] = value
    if "checksum" in burst:
        octets = frames.view(np.uint8).reshape(n_frames, burst.size)
        frames["checksum"] = word_sums(octets[:, 1:-3])
    return frames.tobytes()


def word_sums(octets: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return sums of big-endian 16-bit words modulo 65536: octets (n, 2 k) → (n,)."""
    words = np.ascontiguousarray(octets).view(">u2")
    sums: NDArray[np.uint16] = words.sum(axis=1, dtype=np.uint16)
    return sums


def are_sums_right(octets: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which rows, octets (n, 2 k), end in the sum of the words before."""
    words = np.ascontiguousarray(octets).view(">u2")
    right: NDArray[np.bool_] = words[:, :-1].sum(axis=1, dtype=np.uint16) == words[:, -1]
    return right


def text(values: tuple[int, ...]) -> str:
    """Return the ASCII text in consecutive registers, low byte first."""
    octets = b"".join(value.to_bytes(2, "little") for value in values)
    return octets.decode("ascii", "replace").strip("\x00 ")


def temperature(count: int) -> float:
    """Return °C from a temperature count."""
    return TEMPERATURE_SLOPE * count + TEMPERATURE_OFFSET
