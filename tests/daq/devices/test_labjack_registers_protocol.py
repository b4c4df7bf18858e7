"""Registers of LabJack devices: feedback, Modbus messages, calibration, scan rates."""

from __future__ import annotations

import numpy as np
import pytest

from daq.devices.labjack import registers
from daq.devices.labjack.registers import Adu, AduFinder, RangeCalibration, ReadAt, WriteAt
from daq.protocols.errors import RemoteProtocolError


def test_feedback_of_the_datasheet() -> None:
    """Writes 4990 = 1 and reads it back, as clients start a stream."""
    commands: list[registers.Command] = [WriteAt(4990, b"\0\0\0\1"), ReadAt(4990, 2)]
    pdu = registers.encode_feedback(commands)
    assert pdu == bytes.fromhex("4c 01137e02 00000001 00137e02".replace(" ", ""))
    assert registers.decode_feedback(pdu) == commands
    assert registers.encode_adu(Adu(1, 255, pdu)) == bytes.fromhex("0001 0000 000e ff") + pdu
    assert registers.feedback_values(b"\x4c\0\0\0\1", 4) == b"\0\0\0\1"


@pytest.mark.parametrize(
    ("pdu", "said"),
    [
        (b"\xcc\x02", "refused"),
        (b"\x4c\0", "expected 76 with 4"),
        (b"", "expected"),
        (b"\x03\0\0\0\0", "3"),
    ],
)
def test_invalid_feedback_replies_are_refused(pdu: bytes, said: str) -> None:
    with pytest.raises(RemoteProtocolError, match=said):
        registers.feedback_values(pdu, 4)


@pytest.mark.parametrize("step", [1, 5, 1000])
def test_messages_cut_anywhere_are_decoded(step: int) -> None:
    sent = [Adu(i, 255, bytes((76, *range(i)))) for i in range(20)]
    line = b"".join(registers.encode_adu(adu) for adu in sent)
    finder = AduFinder()
    assert [
        a for i in range(0, len(line), step) for a in finder.receive(line[i : i + step])
    ] == sent


@pytest.mark.parametrize("line", [b"GET / HTTP/1.1\r\n", b"\0\0\0\0\xff\xff\1", b"\0\0\0\0\0\1\1"])
def test_bytes_that_are_not_modbus_are_refused(line: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="not Modbus TCP"):
        AduFinder().receive(line)


def test_calibration() -> None:
    """Nominal +-10 V range: centre 33523, 0.3158 mV a count."""
    flash = registers.encode_calibrations(registers.nominal_calibrations())
    assert len(flash) == 164
    high_speed = registers.decode_calibrations(flash)[0]
    assert high_speed.positive_slope == pytest.approx(3.158058e-4, rel=1e-6)
    volts = high_speed.volts([33523, 33524, 33522, 0, 65535])
    np.testing.assert_allclose(volts, [0, 3.158e-4, -3.158e-4, -10.5868, 10.1096], rtol=1e-4)
    own = (RangeCalibration(1e-3, -2e-3, 30000.0, -1.0), *registers.nominal_calibrations()[1:])
    found = registers.decode_calibrations(registers.encode_calibrations(own))[0]
    np.testing.assert_allclose(found.volts([30001, 29999]), [1e-3, -2e-3], rtol=1e-6)


def test_t8_calibration_of_the_datasheet() -> None:
    """T-series datasheet 20.0.2: ``Cal_Set ain[8][11]`` 64 bytes after 0x687000."""
    first = registers.t8_calibration_address(0, 11.0)
    assert first == 0x687000 + 64
    assert registers.t8_calibration_address(0, 0.018) == first + 16 * 10
    assert registers.t8_calibration_address(1, 11.0) == first + 16 * 11
    assert registers.t8_calibration_address(7, 0.018) == 0x687000 + 1472 - 16  # then temp[8]
    flash = registers.encode_t8_calibrations(registers.nominal_t8_calibrations())
    assert len(flash) == 1472
    at = registers.t8_calibration_address(3, 9.6) - 0x687000
    found = registers.decode_calibration(flash[at : at + 16])
    np.testing.assert_allclose(found.volts([0, 32768, 65535]), [-9.768, 0, 9.768], atol=3.1e-4)


@pytest.mark.parametrize(
    ("wanted", "actual"),
    [
        (1000.0, 1000.0),
        (333.0, 1e7 / 30030),
        (152.6, 1e7 / 65531),
        (100.0, 100.0),
        (1.0, 1.0000128),
    ],
)
def test_actual_scan_rates_are_those_of_the_device(wanted: float, actual: float) -> None:
    assert registers.actual_scan_rate(wanted) == pytest.approx(actual, rel=1e-8)
