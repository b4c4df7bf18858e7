"""Checks that the device that answers is the one that the bench file names."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

from daq.errors import WrongDeviceError

if TYPE_CHECKING:
    from collections.abc import Sequence

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


_Error = TypeVar("_Error", bound=Exception)


def with_owner(error: _Error, sensors: Sequence[Sensor]) -> _Error | WrongDeviceError:
    """Return an error that also says which sensor of the bench the device that was found is.

    Parameters
    ----------
    error
        As a port was opened. Other errors than of wrong devices are returned unchanged.
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
