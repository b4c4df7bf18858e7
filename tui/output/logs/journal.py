"""Log records as entries of systemd's journal, each typed field a field of the entry."""

from __future__ import annotations

import json
import logging
import re
import socket
import struct
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

ADDRESS = "/run/systemd/journal/socket"
_PRIORITY = {
    logging.CRITICAL: 2,
    logging.ERROR: 3,
    logging.WARNING: 4,
    logging.INFO: 6,
    logging.DEBUG: 7,
}
_KEY = re.compile(r"[^A-Z0-9_]")


class JournalHandler(logging.Handler):
    """Sends records to the journal's socket.

    Parameters
    ----------
    fields_of : callable
        Returns the typed fields of a record.
    address : str
        Of the socket.

    Raises
    ------
    OSError
        If there is no journal.
    """

    def __init__(self, fields_of: Any, address: str = ADDRESS) -> None:  # noqa: ANN401 - a function
        super().__init__()
        self._fields_of = fields_of
        self._channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._channel.connect(address)
        except OSError:
            self._channel.close()
            raise

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record."""
        try:
            self._channel.send(entry(record, self._fields_of(record)))
        except Exception:  # noqa: BLE001 - a log line that cannot be written ends no command
            self.handleError(record)

    def close(self) -> None:
        """Close the socket."""
        self._channel.close()
        super().close()


def entry(record: logging.LogRecord, fields: Mapping[str, Any]) -> bytes:
    """Return a record in the journal's own format: its fields begin with ``HUDDLE_``."""
    values = {
        "MESSAGE": record.getMessage(),
        "PRIORITY": str(_PRIORITY.get(record.levelno, 6)),
        "SYSLOG_IDENTIFIER": "huddle",
        "LOGGER": record.name,
    }
    for name, value in fields.items():
        text = value if isinstance(value, str) else json.dumps(value, default=str)
        values[f"HUDDLE_{_KEY.sub('_', name.upper())}"] = text
    return b"".join(_field(name, text.encode()) for name, text in values.items())


def _field(name: str, value: bytes) -> bytes:
    if b"\n" not in value:
        return b"%s=%s\n" % (name.encode(), value)
    return b"%s\n%s%s\n" % (name.encode(), struct.pack("<Q", len(value)), value)
