"""Errors of protocols: of received bytes, and of settings."""

from __future__ import annotations


class RemoteProtocolError(ValueError):
    """The other end sent what its protocol does not allow, and decoding cannot continue.

    The only error that received bytes may raise. Garbage and incomplete frames do not raise it:
    they are skipped, counted and reported as events.
    """


class DeviceSettingError(ValueError):
    """A setting of a device is wrong.

    Parameters
    ----------
    key : str
        Of the setting; empty where several do not go together.
    expected : str
        What was expected, and what is wrong.
    """

    def __init__(self, key: str, expected: str) -> None:
        super().__init__(f"{key}: {expected}" if key else expected)
        self.key, self.expected = key, expected
