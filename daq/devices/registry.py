"""The installed drivers: entry points in the group ``huddle.drivers``.

A third-party package adds a driver by naming a :class:`~daq.devices.interface.Driver` in its
metadata:

.. code-block:: toml

    [project.entry-points."huddle.drivers"]
    mydevice = "mypackage.driver:DRIVER"

A driver that cannot be imported, or that lacks parts of the interface, raises an error only when it
is requested. Other drivers are not affected.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points

from daq.devices.interface import AnyDriver, Driver, Listing, PresentPort
from daq.errors import DriverError, NotConnectedError

GROUP = "huddle.drivers"


@cache
def _entry_points() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def driver_names() -> tuple[str, ...]:
    """Return the names of all drivers without importing any."""
    return tuple(sorted(_entry_points()))


@cache
def driver_type(name: str) -> AnyDriver:
    """Return the driver called ``name``.

    Raises
    ------
    ValueError
        If no driver has this name; the message lists all names.
    DriverError
        If the driver cannot be imported, or lacks parts of the interface.
    """
    if name not in _entry_points():
        raise ValueError(
            f"no driver is called {name!r}; expected one of {', '.join(driver_names())}"
        )
    point = _entry_points()[name]
    package = f" of package {point.dist.name}" if point.dist else ""
    which = f"driver {name!r} ({point.value}{package})"
    try:
        driver = point.load()
    except Exception as error:  # third-party code may raise anything
        raise DriverError(
            f"{which} cannot be imported: {type(error).__name__}: {error};"
            " reinstall or remove that package"
        ) from error
    if not isinstance(driver, Driver):
        raise DriverError(
            f"{which} is no driver: it does not derive from {Driver.__module__}.Driver"
        )
    absent = [part for part in ("name", "summary", "settings") if not hasattr(driver, part)]
    if absent:
        raise DriverError(f"{which} is no driver: it has no {', '.join(absent)}")
    return driver


def present_ports() -> tuple[list[tuple[str, PresentPort]], dict[str, str]]:
    """Return the ports that drivers list, each with its driver, and why drivers list none."""
    found: list[tuple[str, PresentPort]] = []
    reasons: dict[str, str] = {}
    for name in driver_names():
        try:
            driver = driver_type(name)
            found += (
                [(name, port) for port in driver.ports()] if isinstance(driver, Listing) else []
            )
        except (DriverError, NotConnectedError) as error:
            reasons[name] = str(error)
    return found, reasons
