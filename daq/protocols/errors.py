"""Errors in received bytes and in settings, and counts with their nouns for messages."""

from __future__ import annotations


class RemoteProtocolError(ValueError):
    """The other end violated its protocol, and decoding cannot continue.

    Received bytes raise no other error. Garbage and incomplete frames do not raise it: they are
    skipped, counted and reported as events.
    """


class DeviceSettingError(ValueError):
    """A setting of a device is wrong.

    Parameters
    ----------
    key : str
        Key of the setting; empty if several settings conflict.
    expected : str
        The expected value, and the fault.
    """

    def __init__(self, key: str, expected: str) -> None:
        super().__init__(f"{key}: {expected}" if key else expected)
        self.key, self.expected = key, expected


def several(count: int, one: str, rest: str = "") -> str:
    """Return a count with its noun, such as "1 frame lost" or "2 frames lost"."""
    return f"{count} {one}{'s' * (count != 1)}{' ' * bool(rest)}{rest}"


def shortened(text: str, n_bytes: int = 200) -> str:
    """Return a text of at most so many bytes, as that of an event."""
    return text.encode()[:n_bytes].decode(errors="ignore")
