"""Interface between devices and the recorder.

A driver serves one *port*, and all sensors of the bench file on this port: one sensor on a serial
line, three on a digitizer with nine inputs, several slaves on one Modbus bus. It is a thin layer of
I/O around a sans-IO protocol: it opens, configures, reads, and yields blocks. The recorder retries,
keeps indices across sessions, and writes files (``daq.recorder.recorder``,
``daq.recorder.sample_index``).

A third-party package adds a driver by an entry point in the group ``huddle.drivers`` that names a
:class:`Driver`. :class:`Driver` and :class:`Session` have the defaults: a driver states only what
is particular to its device.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import (
    TYPE_CHECKING,
    Any,
    Generic,
    Protocol,
    TypeAlias,
    TypeVar,
    runtime_checkable,
)

import numpy as np
from pydantic import BaseModel, ConfigDict

from daq.devices.port_rules import require_alike

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.protocols.block import DeviceItem


DEFAULT_PATIENCE = 10.0
"""Default of :attr:`Session.patience`, in s."""


@dataclass(frozen=True, slots=True)
class DeviceInformation:
    """Information that a device reports; empty or None if it reports none."""

    sensor: str
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    sampling_rate: float | None = None
    """Actual sampling rate in Hz, read from the device."""
    temperature: float | None = None
    """Temperature in °C."""
    details: dict[str, str] = field(default_factory=dict)
    trouble: str = ""
    """Why no information is available: one of several devices on the port does not reply. The
    driver keeps polling; a run does not start without the device."""


class Session(ABC):
    """An open, identified device, configured and ready to sample.

    Only the recorder decides that a silent port is lost; :meth:`read` has no time limit. A sensor
    is *late* two block periods after its last block. Its port is *lost*, and opened again, after
    the longest of ``patience``, twice the longest recent interval between blocks, and the interval
    learned from earlier sessions on the port. A device that pauses for less and then delivers all
    samples causes no gap.

    If the driver can distinguish a silent device from one that stopped (one that replies that it
    does not sample), it ends the session immediately with ``NoAnswerError``.
    """

    information: tuple[DeviceInformation, ...]
    """One entry per sensor, read when the session was opened."""
    patience: float = DEFAULT_PATIENCE
    """Seconds of the device without a block after which the port is lost.

    Use the user's setting, else the length of the device's buffer if that is longer than
    ``DEFAULT_PATIENCE``.
    """
    resumed: bool = False
    """Whether the blocks continue the index of the session before (:meth:`Driver.resume`)."""

    @property
    def hint(self) -> str:
        """Advice if no block arrives; ends the error message."""
        return ""

    @property
    def recovers(self) -> bool:
        """Whether the device is recovering from an overflow, and not stalled."""
        return False

    @abstractmethod
    def read(self) -> AsyncIterator[DeviceItem]:
        """Start sampling and yield blocks, events and readings, until closed.

        Raises
        ------
        NotConnectedError
            If the port disappears.
        NoAnswerError
            If the device stops sending.
        RemoteProtocolError
            If the device violates its protocol.
        """


class DriverSettings(BaseModel):
    """Base of the table ``[sensors.settings]`` of a driver: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


SettingsT = TypeVar("SettingsT", bound=BaseModel)


class Driver(ABC, Generic[SettingsT]):
    """A driver, the target of an entry point in ``huddle.drivers``."""

    name: str
    """Name in the bench file: ``driver = "…"``."""
    summary: str
    """One line for ``huddle init`` and ``--help``."""
    settings: type[SettingsT]
    """Model of the sensor's ``settings`` table in the bench file."""
    of_the_port: Collection[str] = ()
    """Settings that all sensors of a port have in common."""
    shares_clock: bool = False
    """Whether all sensors on one port are sampled by one clock."""
    states_temperature: bool = False
    """Whether sessions yield the temperature as readings. Of other drivers, an auxiliary channel in
    °C is recorded as the temperature of its sensor."""
    dtype: type[np.generic] = np.int32
    """Type of the raw counts in the blocks, if it is the same for all sensors."""

    def typed(self, sensors: Sequence[Sensor]) -> dict[str, SettingsT]:
        """Return the settings of each sensor of a port, by its name.

        Raises
        ------
        BenchFileError
            If sensors differ in a setting of :attr:`of_the_port`.
        """
        found = {one.name: self.settings.model_validate(one.settings) for one in sensors}
        require_alike(sensors, found, self.of_the_port)
        return found

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Return the type of the raw counts in the blocks of a sensor."""
        del sensor
        return np.dtype(self.dtype)

    def full_scale(self, sensor: Sensor) -> float | None:
        """Return the largest count of the sensor's channels before its port is opened.

        None if unknown; by default the largest of :class:`numpy.int16`, if counts have this type.
        """
        return float(np.iinfo(np.int16).max) if self.counts_dtype(sensor) == np.int16 else None

    def check(self, sensors: Sequence[Sensor]) -> object:
        """Refuse settings that no such device accepts; return what :meth:`open` makes of them.

        Parameters
        ----------
        sensors : sequence of Sensor
            All sensors of one port, each with valid ``settings``.

        Raises
        ------
        BenchFileError
            Naming the sensor, its key, the value and what was expected.
        """
        return self.typed(sensors)

    @abstractmethod
    def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AbstractAsyncContextManager[Session]:
        """Open the port, identify and configure the device; on exit, leave it idle and closed.

        Raises
        ------
        NotConnectedError, NoAnswerError, WrongDeviceError
            With sensor, port, expected and received values.
        """

    def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: Session
    ) -> AbstractAsyncContextManager[Session]:
        """Open a port again, as :meth:`open`; ``before`` is its last session, lost and ended.

        For devices that continue to count while disconnected: the counter then gives the exact
        number of missing samples. The driver decides whether the count continued
        (:attr:`Session.resumed`): if the device was restarted, or may have been, the driver opens
        it as at the start, which is the default.
        """
        del before
        return self.open(sensors, clock)


AnyDriver: TypeAlias = Driver[Any]


@dataclass(frozen=True, slots=True)
class PresentPort:
    """A port of this computer: its name in a bench file, and what the system says of it."""

    port: str
    description: str


@runtime_checkable
class Listing(Protocol):
    """A driver whose ports the system can list without opening them."""

    def ports(self) -> list[PresentPort]:
        """Return the ports that are present; may take seconds.

        Raises
        ------
        NotConnectedError
            If the library is not installed.
        """
