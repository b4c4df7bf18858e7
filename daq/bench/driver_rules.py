"""The part of a driver that the bench file uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from pydantic import BaseModel

    from daq.bench.model import Sensor


class DriverRules(Protocol):
    """Used by the validation of a bench file and by the layout of a recording."""

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the sensor's ``settings`` table in the bench file."""
        ...

    @property
    def shares_clock(self) -> bool:
        """Whether all sensors on one port are sampled by one clock."""
        ...

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Type of the raw counts in the blocks of a sensor."""
        ...


@runtime_checkable
class Checking(Protocol):
    """A driver with further checks of the bench file."""

    def check(self, sensors: Sequence[Sensor]) -> None:
        """Refuse settings that no such device accepts; ``sensors`` are all those of one port.

        Raises
        ------
        BenchFileError
            Naming the sensor, its key, the value and what was expected.
        """
        ...


@runtime_checkable
class Ranged(Protocol):
    """A driver that knows the full scale of a sensor before the port is opened."""

    def full_scale(self, sensor: Sensor) -> float | None:
        """Return the largest count of the sensor's channels; None if unknown."""
        ...
