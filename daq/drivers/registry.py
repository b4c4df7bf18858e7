"""Which drivers there are: entry points in the group ``huddle.drivers``.

A third-party package adds one by naming a :class:`~daq.drivers.base.DriverType` in its metadata:

.. code-block:: toml

    [project.entry-points."huddle.drivers"]
    mydevice = "mypackage.driver:DRIVER"
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from daq.drivers.base import DriverType

GROUP = "huddle.drivers"


@cache
def _entry_points() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def driver_names() -> tuple[str, ...]:
    """Return the names of all drivers without importing any."""
    return tuple(sorted(_entry_points()))


@cache
def driver_type(name: str) -> DriverType:
    """Return the driver called ``name``.

    Raises
    ------
    ValueError
        Saying which drivers there are.
    """
    if name not in _entry_points():
        raise ValueError(
            f"no driver is called {name!r}; expected one of {', '.join(driver_names())}"
        )
    return cast("DriverType", _entry_points()[name].load())


def driver_types() -> dict[str, DriverType]:
    """Return all drivers by name."""
    return {name: driver_type(name) for name in driver_names()}
