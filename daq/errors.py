"""Errors of acquisition and of everything that reads recordings.

Each is a `HuddleError`, and also of the standard kind that it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

ABSENT: object = object()
"""In place of a value that a file does not give."""
_SHOWN_LENGTH = 60


class HuddleError(Exception):
    """Root of every error that huddle raises on purpose; its message says what to do."""

    is_usage_error = False
    """Whether a command line, a setting or a file that a person wrote is wrong; otherwise a device
    or a recording is in trouble."""


@dataclass(frozen=True, slots=True)
class FileFault:
    """One thing wrong with a bench file or a fault script.

    Attributes
    ----------
    key : str
        Such as ``estimate.segment``; within a sensor's table where `sensor` is given; empty for
        the file, or the sensor, as a whole.
    expected : str
        What was expected, and what is wrong where the value does not show it.
    value : object
        What the file gives; `ABSENT` if nothing.
    sensor : str
        Name of the sensor that the key belongs to, if to one.
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
    """Return a value on one line, as a TOML file has it, cut where it is long."""
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
    """A bench file or a fault script is wrong; the message has a line for each fault.

    Parameters
    ----------
    faults : FileFault
    source : path or str
        Name of the file, for the message; drivers do not know it.
    """

    is_usage_error = True

    def __init__(self, *faults: FileFault, source: str | Path = "") -> None:
        self.faults = tuple(fault for n, fault in enumerate(faults) if fault not in faults[:n])
        self.source = str(source)
        head = f"{source}: " if self.source else ""
        super().__init__("\n".join(f"{head}{fault}" for fault in self.faults))


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


class DiskError(RecordingError):
    """The disk refused to take a recording, again and again."""


class NotARecordingError(RecordingError):
    """The file is not a huddle recording, or of a format newer than this program."""


class ArchiveError(HuddleError, OSError):
    """A store of spectra cannot be read or written."""


class WrongArchiveError(ArchiveError):
    """A store is not one, of a newer format, or of other settings or sensors than asked for."""

    is_usage_error = True


class CannotAlignError(HuddleError, ValueError):
    """The sensors of a recording cannot be brought onto one grid."""


class WrongSettingError(CannotAlignError):
    """An option of an estimate does not fit the recording's sensors or units."""

    is_usage_error = True


class ImportFormatError(HuddleError, ValueError):
    """A foreign file cannot be understood."""


class ArrayError(HuddleError, ValueError):
    """An array of samples, or its labels, cannot be understood."""

    is_usage_error = True
