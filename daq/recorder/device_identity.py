"""Checks that the connected device is the one in the bench file."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from daq.errors import WrongDeviceError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.bench.model import Sensor
    from daq.devices.interface import DeviceInformation

RATE_TOLERANCE = 0.02
"""Tolerance as a fraction of the sampling rate: devices round it to divisors of their clocks."""


def check_identity(sensor: Sensor, found: DeviceInformation, *, serial_number: str = "") -> None:
    """Check serial number and sampling rate of a device.

    Parameters
    ----------
    sensor, found
        The expected sensor, and the device's information.
    serial_number
        Serial number of the device recorded before; expected if the bench file names none.

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


_Error = TypeVar("_Error", bound=Exception)


def with_owner(error: _Error, sensors: Sequence[Sensor]) -> _Error | WrongDeviceError:
    """Return an error that also names the sensor of the bench that the found device belongs to.

    Parameters
    ----------
    error
        Raised when a port was opened. Errors other than of wrong devices are returned unchanged.
    sensors
        All sensors of the bench.
    """
    if not isinstance(error, WrongDeviceError):
        return error
    found = error.found if isinstance(error.found, tuple) else (error.found,)
    owner = next((s for s in sensors if s.serial_number in {str(one) for one in found}), None)
    if owner is None or not owner.serial_number:
        return error
    text = f"{error}; that is sensor {owner.name!r} of port {owner.port}: the ports are swapped"
    return WrongDeviceError(text, found=error.found)
