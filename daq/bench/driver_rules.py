"""The part of a driver that the bench file uses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from pydantic import BaseModel

    from daq.bench.model import Sensor


class DriverRules(Protocol):
    """Used by the validation of a bench file, the check list and the layout of a recording.

    :class:`daq.devices.interface.Driver` has the defaults.
    """

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the sensor's ``settings`` table in the bench file."""

    @property
    def shares_clock(self) -> bool:
        """Whether all sensors on one port are sampled by one clock."""

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Type of the raw counts in the blocks of a sensor."""

    def check(self, sensors: Sequence[Sensor]) -> object:
        """Refuse settings that no such device accepts; ``sensors`` are all those of one port.

        Raises
        ------
        BenchFileError
            Naming the sensor, its key, the value and what was expected.
        """

    def full_scale(self, sensor: Sensor) -> float | None:
        """Return the largest count of the sensor's channels, before the port is opened, or None."""
