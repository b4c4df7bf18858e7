"""Devices that share a port: which of them answer, and when the others are tried again.

The contract, of every driver whose port serves several devices: `open` yields the sensors that
answer, and states ``trouble`` for each other one; it raises only if none answers. While the session
lasts, a device that is missing, or becomes silent, costs the others nothing, is tried again for
ever, and is configured again before it is read: it may have lost its settings.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping

from daq.devices.interface import DeviceInformation
from daq.errors import DeviceError, NoAnswerError, NotConnectedError, WrongDeviceError
from daq.host_clock import HostClock
from daq.protocols.block import Event, EventKind
from daq.protocols.errors import shortened

FIRST_RETRY, MAX_RETRY = 1.0, 30.0
"""Delay in s of the next attempt; doubled after each one, because the others wait meanwhile."""


async def answering(
    attempts: Mapping[str, Callable[[], Awaitable[DeviceInformation]]],
) -> tuple[DeviceInformation, ...]:
    """Return the information of each sensor, with ``trouble`` for those that do not answer.

    Parameters
    ----------
    attempts : mapping of str to callable
        Identifies and configures the device of each sensor.

    Raises
    ------
    NoAnswerError, WrongDeviceError
        The first error, if no device answers.
    """
    found: list[DeviceInformation] = []
    errors: list[DeviceError] = []
    for sensor, attempt in attempts.items():
        try:
            found.append(await attempt())
        except (NoAnswerError, WrongDeviceError) as error:
            errors.append(error)
            found.append(DeviceInformation(sensor=sensor, trouble=str(error)))
    if len(errors) == len(found):
        raise errors[0]
    return tuple(found)


class Presence:
    """Whether one device of a shared port answers, and when it is tried again.

    Parameters
    ----------
    sensor : str
    clock : HostClock
    trouble : str
        Why it did not answer when the port was opened; empty if it did.
    """

    def __init__(self, sensor: str, clock: HostClock, *, trouble: str = "") -> None:
        self.sensor = sensor
        self.is_gone = False
        self.due_ns = 0.0
        """Host time of the next attempt, if the device is gone."""
        self._clock = clock
        self._delay = FIRST_RETRY
        self._n_attempts = 0
        self._said = trouble
        if trouble:
            self.lose()

    @property
    def is_due(self) -> bool:
        """Whether the device is gone, and is to be tried again now."""
        return self.is_gone and self._clock.now().monotonic_ns >= self.due_ns

    def lose(self, *, at_once: bool = False) -> None:
        """Note that the device does not answer; try it again later, or ``at_once``."""
        self.is_gone = True
        self.due_ns = float(self._clock.now().monotonic_ns)
        if at_once:
            self._delay = FIRST_RETRY
        else:
            self.due_ns += self._delay * 1e9
            self._delay = min(2 * self._delay, MAX_RETRY)

    async def try_again(self, attempt: Callable[[], Awaitable[object]]) -> list[Event]:
        """Try a device that is gone; return what is to be reported.

        Parameters
        ----------
        attempt : callable
            Identifies, configures and starts the device.
        """
        self._n_attempts += 1
        try:
            await attempt()
        except (NoAnswerError, NotConnectedError, WrongDeviceError) as error:
            self.lose()
            is_new, self._said = str(error) != self._said, str(error)
            if not isinstance(error, WrongDeviceError) or not is_new:
                return []
            return [self._event(EventKind.REFUSED, str(error))]
        text = f"answers again, after {self._n_attempts} attempts"
        self.is_gone, self._n_attempts, self._delay, self._said = False, 0, FIRST_RETRY, ""
        return [self._event(EventKind.CONNECTED, text)]

    def _event(self, kind: EventKind, text: str) -> Event:
        return Event(self.sensor, kind, shortened(text), self._clock.now())
