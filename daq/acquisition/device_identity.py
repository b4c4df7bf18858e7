"""Whether what answers is the device the bench file names."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.errors import WrongDeviceError

if TYPE_CHECKING:
    from daq.bench.model import Sensor
    from daq.drivers.interface import DeviceInformation

RATE_TOLERANCE = 0.02
"""Of the sampling rate: devices round theirs to what their clocks can divide."""


def require(sensor: Sensor, found: DeviceInformation, *, serial_number: str = "") -> None:
    """Refuse another device than the bench file names.

    Parameters
    ----------
    sensor, found
        Who is expected, and what answers.
    serial_number
        Of the device that was there before, where the bench file names none.

    Raises
    ------
    WrongDeviceError
        Its serial number or its sampling rate is another.
    """
    where = f"sensor {sensor.name!r} on {sensor.port}"
    wanted = sensor.serial_number or serial_number
    if wanted and found.serial_number and found.serial_number != wanted:
        raise WrongDeviceError(
            f"{where}: expected serial number {wanted!r}, got {found.serial_number!r}"
        )
    rate = found.sampling_rate
    if rate is not None and abs(rate / sensor.sampling_rate - 1) > RATE_TOLERANCE:
        raise WrongDeviceError(
            f"{where}: expected {sensor.sampling_rate:g} Hz, the device samples at {rate:g} Hz"
        )
