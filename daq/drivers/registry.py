"""Which drivers there are: entry points in the group ``huddle.drivers``.

A third-party package adds one by naming a :class:`~daq.drivers.interface.DriverType` in its
metadata:

.. code-block:: toml

    [project.entry-points."huddle.drivers"]
    mydevice = "mypackage.driver:DRIVER"

One that cannot be imported, or is no driver, is an error where it is asked for; the others are as
good as without it.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, cast

from daq.errors import DriverError

if TYPE_CHECKING:
    from daq.drivers.interface import DriverType

GROUP = "huddle.drivers"
_SEAM = ("name", "summary", "settings", "shares_clock", "counts_dtype", "open")


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
    DriverError
        Its package cannot be imported, or what it names is no driver.
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
    except Exception as error:  # it runs somebody's module
        raise DriverError(
            f"{which} cannot be imported: {type(error).__name__}: {error};"
            " reinstall or remove that package"
        ) from error
    absent = [part for part in _SEAM if not hasattr(driver, part)]
    if absent:
        raise DriverError(f"{which} is no driver: it has no {', '.join(absent)}")
    return cast("DriverType", driver)
