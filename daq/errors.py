"""Errors of acquisition. Each is a HuddleError and of the standard kind it is."""

from __future__ import annotations


class HuddleError(Exception):
    """Root of every error huddle raises on purpose; its message says what to do."""


class BenchFileError(HuddleError, ValueError):
    """The bench file is wrong; the message lists every fault with file, key, value, expectation."""


class DriverError(HuddleError, ImportError):
    """An installed driver cannot be used; the message names it, its package and why."""


class DeviceError(HuddleError):
    """A device cannot be used; the message names sensor, port, what was expected and what came."""


class NotConnectedError(DeviceError, ConnectionError):
    """The port cannot be opened, or closed by itself."""


class NoAnswerError(DeviceError, TimeoutError):
    """The port is there, but no device answers."""


class WrongDeviceError(DeviceError, ValueError):
    """Something answers, but it is not the device that the bench file names."""

    def __init__(self, message: str, *, found: object = None) -> None:
        super().__init__(message)
        self.found = found
        """What was found instead, such as a serial number, to tell wrong devices apart."""


class RecordingError(HuddleError, OSError):
    """A recording cannot be read or written."""


class NotARecordingError(RecordingError):
    """The file is not a huddle recording, or of a format newer than this program."""


class CannotAlignError(HuddleError, ValueError):
    """The sensors of a recording cannot be brought onto one grid."""


class WrongSettingError(CannotAlignError):
    """What an estimate was asked for does not fit the recording's sensors or units."""


class ImportFormatError(HuddleError, ValueError):
    """A foreign file cannot be understood."""
