"""Interface between devices and the recorder.

A driver serves one *port*, and all sensors of the bench file on this port: one sensor on a serial
line, three on a digitizer with nine inputs, several slaves on one Modbus bus. It is a thin layer of
I/O around a sans-IO protocol: it opens, configures, reads, and yields blocks. The recorder retries,
keeps indices across sessions, and writes files (``daq.recorder.recorder``,
``daq.recorder.sample_index``).

A third-party package adds a driver by an entry point in the group ``huddle.drivers`` that names a
:class:`DriverType`. A driver that can check its part of the bench file also has the method
``check`` (:class:`daq.bench.driver_rules.Checking`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from daq.bench.driver_rules import DriverRules

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.protocols.block import DeviceItem


DEFAULT_PATIENCE = 10.0
"""Default of :attr:`PatientSession.patience`, in s."""


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


class Session(Protocol):
    """An open, identified device, configured and ready to sample."""

    @property
    def information(self) -> tuple[DeviceInformation, ...]:
        """One entry per sensor, read when the session was opened."""
        ...

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
        ...


class DriverType(DriverRules, Protocol):
    """A driver, the target of an entry point in ``huddle.drivers``.

    A driver whose sessions yield the temperature as readings has ``states_temperature = True``. Of
    other drivers, an auxiliary channel in °C is recorded as the temperature of its sensor.
    """

    @property
    def name(self) -> str:
        """Name in the bench file: ``driver = "…"``."""
        ...

    @property
    def summary(self) -> str:
        """One line for ``huddle init`` and ``--help``."""
        ...

    def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AbstractAsyncContextManager[Session]:
        """Open the port, identify and configure the device; on exit, leave it idle and closed.

        Raises
        ------
        NotConnectedError, NoAnswerError, WrongDeviceError
            With sensor, port, expected and received values.
        """
        ...


@dataclass(frozen=True, slots=True)
class PresentPort:
    """A port of this computer: its name in a bench file, and what the system says of it."""

    port: str
    description: str


@runtime_checkable
class Listing(Protocol):
    """A driver (:class:`DriverType`) whose ports the system can list without opening them."""

    def ports(self) -> list[PresentPort]:
        """Return the ports that are present; may take seconds.

        Raises
        ------
        NotConnectedError
            If the library is not installed.
        """
        ...


class PatientSession(Session, Protocol):
    """A session that states how long its device may be silent before it counts as lost.

    Only the recorder decides that a silent port is lost; :meth:`Session.read` has no time limit. A
    sensor is *late* two block periods after its last block. Its port is *lost*, and opened again,
    after the longest of ``patience``, twice the longest recent interval between blocks, and the
    interval learned from earlier sessions on the port. A device that pauses for less and then
    delivers all samples causes no gap.

    If the driver can distinguish a silent device from one that stopped (one that replies that it
    does not sample), it ends the session immediately with ``NoAnswerError``.
    """

    @property
    def patience(self) -> float:
        """Seconds without a block after which the port is lost; ``DEFAULT_PATIENCE`` if missing.

        Use the user's setting, else the length of the device's buffer if that is longer than
        ``DEFAULT_PATIENCE``.
        """
        ...

    @property
    def hint(self) -> str:
        """Advice if no block arrives; ends the error message. Optional."""
        ...

    @property
    def recovers(self) -> bool:
        """Whether the device is recovering from an overflow, and not stalled. Optional."""
        ...


class ResumedSession(Session, Protocol):
    """A session that may continue an earlier one."""

    @property
    def resumed(self) -> bool:
        """Whether its blocks continue the index of the session before."""
        ...


@runtime_checkable
class Resuming(Protocol):
    """A driver (:class:`DriverType`) of devices that continue to count while disconnected.

    The counter then gives the exact number of missing samples. The driver decides whether the count
    continued: if the device was restarted, or may have been, the driver opens it as at the start.
    """

    def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: Session
    ) -> AbstractAsyncContextManager[ResumedSession]:
        """Open a port again, as :meth:`DriverType.open`.

        ``before`` is the last session on the port; it was lost and has ended.
        """
        ...
