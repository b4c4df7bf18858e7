"""LabJack T7 and T8: register map, Modbus TCP frames with function 76, calibration.

Theory of operation
-------------------
The device has one flat map of 16-bit registers, big-endian, read by functions 3 and 4, written by 6
and 16 (T-series datasheet, "Protocol details"). Function 76, "Modbus feedback", combines several
reads and writes::

    request   ... unit 76 { 00 address u16 registers u8 | 01 address u16 registers u8 values }*
    reply     ... unit 76 values of the reads, in order
    refusal   ... unit CC exception u8        register 55000 then holds the reason

The T7 keeps its calibration in internal flash from 0x3C4000: for the high-speed converter at gain
1, 10, 100 and 1000, then for the high-resolution one, {positive slope, negative slope, centre,
offset} as FLOAT32. Streams use the high-speed converter. The T8 keeps such a set for each of its
eight inputs and eleven ranges, from 64 bytes after 0x687000 (T-series datasheet 20.0.2:
``ain[input][range]``).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from daq.protocols.errors import RemoteProtocolError

AIN_RANGE = 40000  # + 2 n, FLOAT32
AIN_NEGATIVE_CHANNEL = 41000  # + n, UINT16
SINGLE_ENDED = 199
STREAM_SCANRATE_HZ = 4002
STREAM_NUM_ADDRESSES = 4004
STREAM_SAMPLES_PER_PACKET = 4006
STREAM_SETTLING_US = 4008
STREAM_RESOLUTION_INDEX = 4010
STREAM_BUFFER_SIZE_BYTES = 4012
STREAM_CLOCK_SOURCE = 4014
STREAM_AUTO_TARGET = 4016
STREAM_DATATYPE = 4018
STREAM_NUM_SCANS = 4020
STREAM_EXTERNAL_CLOCK_DIVISOR = 4022
STREAM_TRIGGER_INDEX = 4024
STREAM_START_TIME_STAMP = 4026
STREAM_SCANLIST = 4100  # + 2 k
STREAM_SCANRATE_HZ_ACTUAL = 4494
"""Actual scan rate of a T8; valid after the stream starts."""
STREAM_DATA_CR = 4500
STREAM_DATA_CAPTURE_16 = 4899
STREAM_ENABLE = 4990
LAST_ERROR_DETAIL = 55000  # UINT16
TEST = 55100
PRODUCT_ID = 60000
FIRMWARE_VERSION = 60004
SERIAL_NUMBER = 60028
TEMPERATURE_DEVICE_K = 60052
CORE_TIMER = 61520
SYSTEM_TIMER_20HZ = 61522
FLASH_READ_POINTER = 61810
FLASH_READ = 61812

TARGET_ETHERNET = 1
TARGET_COMMAND_RESPONSE = 16
TEST_VALUE = 0x00112233
CALIBRATION_ADDRESS = 0x3C4000
N_CALIBRATION_VALUES = 41
T8_CALIBRATION_ADDRESS = 0x687000
T8_CALIBRATION_HEADER = 64
CORE_HZ = 40_000_000
SYSTEM_HZ = 20
STREAM_NOT_RUNNING = 2620
ILLEGAL_ADDRESS = 2

FEEDBACK = 76
_MAX_PDU = 1040
_MBAP = struct.Struct(">HHHB")


def ain(number: int) -> int:
    """Return the address of an analog input."""
    return 2 * number


def actual_scan_rate(wanted: float) -> float:
    """Return the scan rate of a T7 that is set to ``wanted``, in Hz.

    Its scan interval is a multiple of 100 ns.
    """
    return 1e7 / max(1, round(1e7 / wanted)) if wanted > 152.588 else _slow_rate(wanted)


def exact_rate(rate: float) -> float:
    """Return the nearest rate whose interval is a whole number of timer ticks, in Hz.

    FLOAT32 rounds the rate of a T7. The clock divider of a real T8 is not published: a simulated
    T8 has this rate, and the driver reads the actual one.
    """
    return CORE_HZ / max(1, round(CORE_HZ / rate))


def _slow_rate(wanted: float) -> float:
    # Assumed: the 16-bit interval counter runs at 10 MHz, halved until the interval fits. The
    # datasheet states only the limit 10 MHz / 65536 = 152.588 Hz.
    step = 1e-7
    while round(1 / (wanted * step)) > 65535:
        step *= 2
    return 1 / (step * max(1, round(1 / (wanted * step))))


# --- frames ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ReadAt:
    """Part of a feedback frame: read registers."""

    address: int
    n_registers: int


@dataclass(frozen=True, slots=True)
class WriteAt:
    """Part of a feedback frame: write registers."""

    address: int
    values: bytes


Command: TypeAlias = ReadAt | WriteAt


@dataclass(frozen=True, slots=True)
class Adu:
    """One Modbus TCP message."""

    transaction: int
    unit: int
    pdu: bytes


def encode_adu(adu: Adu) -> bytes:
    """Encode a message for Modbus TCP."""
    return _MBAP.pack(adu.transaction, 0, len(adu.pdu) + 1, adu.unit) + adu.pdu


class AduFinder:
    """Decodes the bytes of a Modbus TCP connection into messages."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def receive(self, data: bytes) -> list[Adu]:
        """Decode bytes, cut anywhere; return the completed messages.

        Raises
        ------
        RemoteProtocolError
            If the bytes are not Modbus TCP, or declare a message above the maximum length. The
            messages before these bytes are returned first: then the next call raises.
        """
        self._buffer += data
        found: list[Adu] = []
        while len(self._buffer) >= _MBAP.size:
            transaction, protocol, length, unit = _MBAP.unpack_from(self._buffer)
            if protocol or not 2 <= length <= _MAX_PDU + 1:
                if found:
                    return found
                self._buffer.clear()
                raise RemoteProtocolError(
                    f"not Modbus TCP: protocol {protocol}, length {length}; expected 0 and 2 to"
                    f" {_MAX_PDU + 1}"
                )
            if len(self._buffer) < 6 + length:
                break
            found.append(Adu(transaction, unit, bytes(self._buffer[_MBAP.size : 6 + length])))
            del self._buffer[: 6 + length]
        return found


def encode_feedback(commands: Sequence[Command]) -> bytes:
    """Encode a request of function 76."""
    pdu = bytes((FEEDBACK,))
    for command in commands:
        if isinstance(command, ReadAt):
            pdu += struct.pack(">BHB", 0, command.address, command.n_registers)
        else:
            pdu += struct.pack(">BHB", 1, command.address, len(command.values) // 2)
            pdu += command.values
    return pdu


def decode_feedback(pdu: bytes) -> list[Command]:
    """Decode a request of function 76.

    Raises
    ------
    RemoteProtocolError
        If a command is incomplete, or neither a read nor a write.
    """
    commands: list[Command] = []
    at = 1
    while at < len(pdu):
        if len(pdu) < at + 4 or pdu[at] > 1:
            raise RemoteProtocolError(f"a feedback command {pdu[at : at + 4].hex()}")
        kind, address, n_registers = struct.unpack_from(">BHB", pdu, at)
        at += 4
        if not kind:
            commands.append(ReadAt(address, n_registers))
            continue
        values = pdu[at : at + 2 * n_registers]
        if len(values) != 2 * n_registers:
            raise RemoteProtocolError(f"{len(values)} bytes to write to {n_registers} registers")
        commands.append(WriteAt(address, values))
        at += len(values)
    return commands


def feedback_values(pdu: bytes, expected_bytes: int) -> bytes:
    """Return the values of a reply to function 76.

    Raises
    ------
    RemoteProtocolError
        If the reply is a refusal, has another function, or has another length.
    """
    if len(pdu) == 2 and pdu[0] == FEEDBACK | 0x80:
        raise RemoteProtocolError(f"the device refused a feedback frame (exception {pdu[1]})")
    if not pdu or pdu[0] != FEEDBACK or len(pdu) - 1 != expected_bytes:
        raise RemoteProtocolError(
            f"a reply of function {pdu[0] if pdu else None} with {len(pdu) - 1} bytes;"
            f" expected {FEEDBACK} with {expected_bytes}"
        )
    return pdu[1:]


# --- calibration -----------------------------------------------------------------------------


class RangeCalibration(NamedTuple):
    """Conversion from counts of one range to volts."""

    positive_slope: float = 3.158058e-4
    negative_slope: float = -3.158058e-4
    center: float = 33523.0
    offset: float = -10.58695

    def volts(self, counts: ArrayLike) -> NDArray[np.float64]:
        """Return volts, of the shape of ``counts``."""
        above = np.asarray(counts, np.float64) - self.center
        return np.where(above >= 0, above * self.positive_slope, -above * self.negative_slope)


GAINS = {10.0: 1, 1.0: 10, 0.1: 100, 0.01: 1000}
"""Gain by range in volts, peak."""


T8_RANGES = (11.0, 9.6, 4.8, 2.4, 1.2, 0.6, 0.3, 0.15, 0.075, 0.036, 0.018)
"""Ranges in volts, peak, in the order of the T8's calibration."""
T8_SPANS = (11.0, 9.768, 4.884, 2.442, 1.221, 0.611, 0.305, 0.153, 0.076, 0.038, 0.019)
"""Span of the converter in each range, in volts, peak (T-series datasheet 20.0.2)."""
T8_INPUTS = 8
_SET = 4  # values per calibration


def t8_calibration_address(number: int, range_: float) -> int:
    """Return the flash address of a T8's calibration of an input in a range."""
    index = number * len(T8_RANGES) + T8_RANGES.index(range_)
    return T8_CALIBRATION_ADDRESS + T8_CALIBRATION_HEADER + 4 * _SET * index


def nominal_t8_calibrations() -> tuple[RangeCalibration, ...]:
    """Return the nominal calibration of every input and range of a T8.

    Assumed: a stream holds the upper 16 of the converter's 24 bits, with 0 V in their middle.
    """
    at_input = tuple(
        RangeCalibration(span / 32768, -span / 32768, 32768.0, -span) for span in T8_SPANS
    )
    return at_input * T8_INPUTS


def encode_t8_calibrations(calibrations: Sequence[RangeCalibration]) -> bytes:
    """Encode the flash of a T8, from its header to the last input."""
    sets = b"".join(struct.pack(f">{_SET}f", *one) for one in calibrations)
    return bytes(T8_CALIBRATION_HEADER) + sets


def decode_calibration(flash: bytes) -> RangeCalibration:
    """Decode one calibration of four values."""
    if len(flash) != 4 * _SET:
        raise RemoteProtocolError(f"{len(flash)} bytes of calibration; expected {4 * _SET}")
    return RangeCalibration(*struct.unpack(f">{_SET}f", flash))


def nominal_calibrations() -> tuple[RangeCalibration, ...]:
    """Return the nominal calibration of the eight converters and gains."""
    at_gain = tuple(
        RangeCalibration(3.158058e-4 / gain, -3.158058e-4 / gain, 33523.0, -10.58695 / gain)
        for gain in GAINS.values()
    )
    return at_gain * 2


def encode_calibrations(calibrations: Sequence[RangeCalibration]) -> bytes:
    """Encode the flash of a T7: eight calibrations, then nominal values for the rest."""
    values = [value for one in calibrations for value in one]
    values += [13200.0, 0.0, 13200.0, 0.0, -92.6, 467.6, 1e-5, 2e-4, 1.5e-8]
    return struct.pack(f">{N_CALIBRATION_VALUES}f", *values)


def decode_calibrations(flash: bytes) -> tuple[RangeCalibration, ...]:
    """Decode the eight calibrations of a T7 from its flash."""
    if len(flash) < 4 * 32:
        raise RemoteProtocolError(f"{len(flash)} bytes of calibration; expected 128 or more")
    values = np.frombuffer(flash[: 4 * 32], ">f4").reshape(8, 4).tolist()
    return tuple(RangeCalibration(*row) for row in values)
