"""What the bench file asks of a driver, so that the bench needs to know no driver."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from pydantic import BaseModel

    from daq.bench.model import Sensor


class DriverRules(Protocol):
    """The part of a driver that validation of a bench file and the layout of a recording need."""

    @property
    def settings(self) -> type[BaseModel]:
        """Model of the sensor's ``settings`` table in the bench file."""
        ...

    @property
    def shares_clock(self) -> bool:
        """Whether all sensors on one port are sampled by one clock."""
        ...

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Type of the raw counts this sensor's blocks hold."""
        ...


@runtime_checkable
class Checking(Protocol):
    """A driver that can tell from the bench file what would not work."""

    def check(self, sensors: Sequence[Sensor]) -> None:
        """Refuse what no device of this kind does; ``sensors`` are all those of one port.

        Raises
        ------
        BenchFileError
            Naming the sensor, its key, the value and what was expected.
        """
        ...
