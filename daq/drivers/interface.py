"""The seam between devices and the recorder.

A driver serves one *port*, and all sensors of the bench file that name it: one sensor on a serial
line, three on a digitizer with nine inputs, several slaves on one Modbus bus. It is a thin shell of
I/O around a sans-IO protocol: open, configure, read, hand over. It does not retry, keep indices
across sessions, or write files; the recorder does (``daq.acquisition.recorder``,
``daq.acquisition.sample_index``).

A third-party package adds a driver by an entry point in the group ``huddle.drivers`` that names a
:class:`DriverType`. A driver that can check its part of the bench file has the method ``check`` as
well (:class:`daq.bench.driver_rules.Checking`).
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
    from daq.protocols.block import Block, Event


DEFAULT_PATIENCE = 10.0
"""Seconds without a block after which a port is lost, if its session states nothing else."""


@dataclass(frozen=True, slots=True)
class DeviceInformation:
    """What a device says about itself; empty or None where it does not say."""

    sensor: str
    model: str = ""
    serial_number: str = ""
    firmware: str = ""
    sampling_rate: float | None = None
    """Actual sampling rate in Hz as read back from the device."""
    temperature: float | None = None
    """In °C."""
    details: dict[str, str] = field(default_factory=dict)
    trouble: str = ""
    """Why nothing is known: one of several on its port that does not answer. The driver goes on
    asking; a run does not begin without it."""


class Session(Protocol):
    """An open, identified device, configured and ready to sample."""

    @property
    def information(self) -> tuple[DeviceInformation, ...]:
        """One entry per sensor, as read when the session was opened."""
        ...

    def read(self) -> AsyncIterator[Block | Event]:
        """Start sampling and yield what comes, until closed.

        Raises
        ------
        NotConnectedError
            The port went away.
        NoAnswerError
            The device stopped sending.
        RemoteProtocolError
            The device sends what its protocol does not allow.
        """
        ...


class DriverType(DriverRules, Protocol):
    """What an entry point in ``huddle.drivers`` names."""

    @property
    def name(self) -> str:
        """As in the bench file's ``driver = "…"``."""
        ...

    @property
    def summary(self) -> str:
        """One line for ``huddle init`` and ``--help``."""
        ...

    def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AbstractAsyncContextManager[Session]:
        """Open the port, identify and configure the device; leave it quiet and closed on exit.

        Raises
        ------
        NotConnectedError, NoAnswerError, WrongDeviceError
            Each naming sensor, port, what was expected and what came.
        """
        ...


class PatientSession(Session, Protocol):
    """A session that states how long its device may be silent without being lost.

    The recorder alone decides that a silent port is lost; :meth:`Session.read` sets no time limit
    of its own. A sensor is *late* two block periods after its last block. Its port is *lost*, and
    is opened again, after the longest of ``patience``, twice the longest recent interval between
    blocks, and what earlier sessions on the port have taught. A device that pauses for less and
    then delivers everything has lost nothing, and neither has the recording.

    A driver that can tell a silent device from one that has stopped (one that answers and says that
    it does not sample) ends the session at once with ``NoAnswerError``.
    """

    @property
    def patience(self) -> float:
        """Seconds of the device's time without a block after which the port is lost.

        The length of the buffer in the device, if longer than ``DEFAULT_PATIENCE``, or the user's
        own setting. Sessions that state nothing have ``DEFAULT_PATIENCE``.
        """
        ...

    @property
    def hint(self) -> str:
        """What to check if no block comes; the end of the error message. May be missing."""
        ...

    @property
    def recovers(self) -> bool:
        """Whether the device recovers from an overflow, and is not stalled. May be missing."""
        ...


class ResumedSession(Session, Protocol):
    """A session that may go on where another ended."""

    @property
    def resumed(self) -> bool:
        """Whether its blocks are in the index of the session before."""
        ...


@runtime_checkable
class Resuming(Protocol):
    """A driver (:class:`DriverType`) of devices that count on while nobody can hear them.

    With a counter that runs on, what is missing is known exactly. The driver decides whether it
    does: where the device was restarted, or may have been, it opens it as at first.
    """

    def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: Session
    ) -> AbstractAsyncContextManager[ResumedSession]:
        """Open a port again after ``before``, the last session there, was lost.

        As :meth:`DriverType.open`; ``before`` is over.
        """
        ...
