"""What a port must be, and its sensors must agree on, told from the bench file alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.errors import BenchFileError
from daq.transport.address import host_and_port

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from pydantic import BaseModel

    from daq.bench.model import Sensor

NETWORK = ("socket://", "tcp://", "udp://", "modbus-tcp://")


def only(sensors: Sequence[Sensor], why: str) -> Sensor:
    """Return the one sensor of a port that takes no more.

    Raises
    ------
    BenchFileError
        There are several; or the port is no address.
    """
    sensor = sensors[0]
    if len(sensors) > 1:
        names = ", ".join(repr(other.name) for other in sensors)
        raise BenchFileError(f"port {sensor.port} is given to {names}; {why}")
    require_address(sensor)
    return sensor


def require_alike(
    sensors: Sequence[Sensor], settings: Mapping[str, BaseModel], keys: Collection[str]
) -> None:
    """Refuse what a later sensor of a port says otherwise than the first, of which it is taken.

    Raises
    ------
    BenchFileError
        Naming the sensor, its key, the value and what was expected.
    """
    first = sensors[0]
    for sensor in sensors[1:]:
        own = settings[sensor.name]
        for key in (k for k in type(own).model_fields if k in keys and k in own.model_fields_set):
            value, expected = getattr(own, key), getattr(settings[first.name], key)
            if value != expected:
                raise BenchFileError(
                    f"sensor {sensor.name!r}: settings.{key} = {value!r}; expected {expected!r}, as"
                    f" of {first.name!r}, the first on port {sensor.port}"
                )


def require_address(sensor: Sensor) -> None:
    """Refuse a network port that is no address.

    Raises
    ------
    BenchFileError
        Naming the sensor, the port as it was written and what was expected.
    """
    if sensor.port.startswith(NETWORK):
        try:
            host_and_port(sensor.port)
        except ValueError as error:
            raise BenchFileError(f"sensor {sensor.name!r}: port {error}") from error
