"""Checks that the device that answers is the one that the bench file names."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.errors import WrongDeviceError

if TYPE_CHECKING:
    from daq.bench.model import Sensor
    from daq.drivers.interface import DeviceInformation

RATE_TOLERANCE = 0.02
"""As a fraction of the sampling rate: devices round it to what their clocks can divide."""


def check_identity(sensor: Sensor, found: DeviceInformation, *, serial_number: str = "") -> None:
    """Check serial number and sampling rate of a device.

    Parameters
    ----------
    sensor, found
        The expected sensor, and what the device reports about itself.
    serial_number
        Expected where the bench file names none: that of the device recorded before.

    Raises
    ------
    WrongDeviceError
        If serial number or sampling rate differ from what is expected.
    """
    where = f"sensor {sensor.name!r} on {sensor.port}"
    wanted = sensor.serial_number or serial_number
    if wanted and found.serial_number and found.serial_number != wanted:
        raise WrongDeviceError(
            f"{where}: expected serial number {wanted!r}, got {found.serial_number!r}",
            found=found.serial_number,
        )
    rate = found.sampling_rate
    if rate is not None and abs(rate / sensor.sampling_rate - 1) > RATE_TOLERANCE:
        raise WrongDeviceError(
            f"{where}: expected {sensor.sampling_rate:g} Hz, the device samples at {rate:g} Hz",
            found=rate,
        )
