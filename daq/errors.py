"""Errors of acquisition and of all modules that read recordings.

Each is a `HuddleError`, and also an instance of the matching standard exception.
"""

from __future__ import annotations

from pathlib import Path

from estimator.records import dataclass

ABSENT: object = object()
"""Stands for a value that is missing in a file."""
_SHOWN_LENGTH = 60


class HuddleError(Exception):
    """Base class of all errors that huddle raises on purpose; the message has the remedy."""

    is_usage_error = False
    """Whether the cause is a command line, a setting or a file written by the user, not a device or
    a recording."""


@dataclass(frozen=True, slots=True)
class FileFault:
    """One error in a bench file or a fault script.

    Attributes
    ----------
    key : str
        Such as ``estimate.segment``; relative to the sensor's table if `sensor` is given; empty for
        the whole file or sensor.
    expected : str
        The expected value, and the error if `value` does not show it.
    value : object
        The value in the file, or `ABSENT`.
    sensor : str
        Name of the sensor that the key belongs to; empty otherwise.
    """

    key: str
    expected: str
    value: object = ABSENT
    sensor: str = ""

    def __str__(self) -> str:
        table = f'sensors["{self.sensor}"]' if self.sensor else ""
        place = ".".join(part for part in (table, self.key) if part)
        if self.value is not ABSENT:
            place += f" = {toml_value(self.value)}"
        return f"{place}: {self.expected}" if place else self.expected


def toml_value(value: object) -> str:
    """Return a value as TOML on one line, shortened if long."""
    if isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, str):
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in f'"{value}"')
    elif isinstance(value, (list, tuple)):
        text = f"[{', '.join(map(toml_value, value))}]"
    else:
        text = str(value)
    return text if len(text) <= _SHOWN_LENGTH else f"{text[: _SHOWN_LENGTH - 3]}…"


class BenchFileError(HuddleError, ValueError):
    """A bench file or a fault script is wrong; the message has one line per error.

    Parameters
    ----------
    faults : FileFault
    source : path or str
        Name of the file, for the message; empty if unknown, as in drivers.
    """

    is_usage_error = True

    def __init__(self, *faults: FileFault, source: str | Path = "") -> None:
        self.faults = tuple(fault for n, fault in enumerate(faults) if fault not in faults[:n])
        self.source = str(source)
        head = f"{source}: " if self.source else ""
        super().__init__("\n".join(f"{head}{fault}" for fault in self.faults))


class DriverError(HuddleError, ImportError):
    """An installed driver cannot be used; the message names driver, package and cause."""


class DeviceError(HuddleError):
    """A device cannot be used; the message has sensor, port, expected and received values."""


class NotConnectedError(DeviceError, ConnectionError):
    """The port cannot be opened, or closed by itself."""


class NoAnswerError(DeviceError, TimeoutError):
    """The port is open, but no device replies."""


class WrongDeviceError(DeviceError, ValueError):
    """The device that replies is not the one in the bench file."""

    def __init__(self, message: str, *, found: object = None) -> None:
        super().__init__(message)
        self.found = found
        """Identity of the device found, such as a serial number, to distinguish wrong devices."""


class ReplayError(HuddleError, ValueError):
    """A driver does not do what a log of its port has; the message has both."""


class RecordingError(HuddleError, OSError):
    """A recording cannot be read or written."""


class DiskError(RecordingError):
    """The disk repeatedly refused to store a recording."""


class RemovedError(DiskError):
    """A recording was removed while it grew, with all that was safe in it."""


class NotARecordingError(RecordingError):
    """The file is not a huddle recording, or has a newer format than this version reads."""


class ArchiveError(HuddleError, OSError):
    """A store of spectra cannot be read or written."""


class EndedProcessError(HuddleError, ChildProcessError):
    """A process that worked for this one was ended."""


class WrongArchiveError(ArchiveError):
    """A file is no store, has a newer format, or has other settings or sensors than requested."""

    is_usage_error = True


class CannotAlignError(HuddleError, ValueError):
    """The sensors of a recording cannot be aligned on one grid."""


class WrongSettingError(CannotAlignError):
    """An option of an estimate does not fit the recording's sensors or units."""

    is_usage_error = True


class ImportFormatError(HuddleError, ValueError):
    """A file of another program cannot be read."""


class ArrayError(HuddleError, ValueError):
    """An array of samples, or its labels, are invalid."""

    is_usage_error = True
