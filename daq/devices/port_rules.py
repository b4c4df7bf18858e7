"""What drivers share: checks of ports and settings of a bench file, and optional packages."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

from daq.errors import NotConnectedError, toml_value
from daq.python_process import install_command
from daq.transport.address import USUAL_NUMBERS, check_serial, host_and_port

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

    from pydantic import BaseModel

    from daq.bench.model import Sensor

_Input = TypeVar("_Input")
NETWORK = ("socket://", "tcp://", "udp://", "modbus-tcp://")


def only(sensors: Sequence[Sensor], why: str) -> Sensor:
    """Return the only sensor of a port.

    Raises
    ------
    BenchFileError
        If there are several sensors, or the port is no address.
    """
    sensor = sensors[0]
    if len(sensors) > 1:
        names = ", ".join(repr(other.name) for other in sensors)
        expected = f"is the port of {names}; {why}"
        raise sensor.fault("port", expected, sensor.port)
    require_address(sensor)
    return sensor


def inputs_of(
    sensors: Sequence[Sensor],
    given: Callable[[Sensor, Collection[_Input]], Sequence[_Input]],
    *,
    key: str = "inputs",
    what: str = "an input",
    label: str = "{}",
) -> dict[str, tuple[_Input, ...]]:
    """Return the inputs of each sensor of a device.

    Parameters
    ----------
    sensors : sequence of Sensor
    given : callable
        Takes a sensor and the inputs of the sensors before it; returns the inputs of the sensor.
    key : str
        Of the setting.
    what, label : str
        What an input is called in messages, and the form of its name.

    Raises
    ------
    BenchFileError
        If a sensor does not have one input for each channel, or an input is used twice.
    """
    found: dict[str, tuple[_Input, ...]] = {}
    used: dict[_Input, str] = {}
    for sensor in sensors:
        inputs, expected = tuple(given(sensor, used.keys())), ""
        if len(inputs) != len(sensor.channels):
            expected = f"expected one for each of the sensor's {len(sensor.channels)} channels"
        for one in inputs:
            if one in used and not expected:
                expected = f"{label.format(one)} is already {what} of sensor {used[one]!r}"
            used[one] = sensor.name
        if expected:
            raise sensor.fault(f"settings.{key}", expected, list(inputs))
        found[sensor.name] = inputs
    return found


def package(name: str, extra: str, label: str, further: str = "") -> Any:  # noqa: ANN401 -- module
    """Import a package of an extra, or raise NotConnectedError that says how to install it."""
    try:
        return import_module(name)
    except (ImportError, OSError) as error:  # OSError: a library that the package loads
        how = f"{install_command(extra)}{further}"
        raise NotConnectedError(f"{label}: {error}; {how}") from error


def port_label(sensors: Sequence[Sensor]) -> str:
    """Return the name of a port and its sensors in messages."""
    names = ", ".join(repr(sensor.name) for sensor in sensors)
    return f"sensor{'s' * (len(sensors) > 1)} {names} on {sensors[0].port}"


def require_alike(
    sensors: Sequence[Sensor], settings: Mapping[str, BaseModel], keys: Collection[str]
) -> None:
    """Check that all sensors of a port have the same common settings.

    Raises
    ------
    BenchFileError
        If a sensor's value differs from that of the first sensor, which applies.
    """
    first = sensors[0]
    for sensor in sensors[1:]:
        own = settings[sensor.name]
        for key in (k for k in type(own).model_fields if k in keys and k in own.model_fields_set):
            value, expected = getattr(own, key), getattr(settings[first.name], key)
            if value != expected:
                wanted = "no value" if expected is None else toml_value(expected)
                problem = (
                    f"expected {wanted}, as of {first.name!r}, the first on port {sensor.port}"
                )
                raise sensor.fault(f"settings.{key}", problem, value)


def host_of(
    sensor: Sensor, scheme: str, usual: int | None = None, *, bare: bool = False
) -> tuple[str, int]:
    """Return host and number of a port ``scheme://host``, the usual number if it states none.

    Parameters
    ----------
    sensor : Sensor
    scheme : str
    usual : int, optional
        Default: that of the scheme.
    bare : bool
        Whether the scheme may be absent, or another.

    Raises
    ------
    BenchFileError
        The port has another form.
    """
    is_bare = bare and "://" not in sensor.port
    try:
        parts = urlsplit(f"{scheme}://{sensor.port}" if is_bare else sensor.port)
        host, number = parts.hostname or "", parts.port or usual or USUAL_NUMBERS[scheme][0]
    except ValueError:
        host = ""
    if not host or not (bare or parts.scheme == scheme):
        expected = f"expected {scheme}://host, or {scheme}://host:port"
        raise sensor.fault("port", expected, sensor.port)
    return f"[{host}]" if ":" in host else host, number


def require_address(sensor: Sensor) -> None:
    """Check that the port of a sensor is a network address or a serial device.

    Raises
    ------
    BenchFileError
        If it is neither.
    """
    if sensor.port.startswith(NETWORK):
        try:
            host_and_port(sensor.port)
        except ValueError as error:
            expected = f"expected {sensor.port.partition('://')[0]}://host:port"
            raise sensor.fault("port", expected, sensor.port) from error
    else:
        try:
            check_serial(sensor.port)
        except ValueError as error:
            expected = "expected a device such as /dev/ttyUSB0, or socket://host:port"
            raise sensor.fault("port", expected, sensor.port) from error
