"""Log lines on standard error: one event a line, with its UTC time, as text or as JSON.

Library modules log through ``logging.getLogger(__name__)`` and pass typed fields as ``extra``.
Handlers and formats are set here and nowhere else. A child process logs JSON; `record_of` turns its
lines into records again, which the parent then writes in its own format and by its own level. For
systemd's journal, each typed field is a field of the entry.
"""

# ruff: noqa: PLC0415 - rich is loaded when something is written

from __future__ import annotations

import json
import logging
import re
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tui.output.console import notices, reserve_standard_error
from tui.output.logs.options import LogFormat, LogLevel
from tui.page.table import SHOWN_CONTROLS

OWN_LOGGERS = ("daq", "estimator", "sim_devices", "tui", "huddle")
"""Packages that log from the chosen level on; others log from WARNING on."""
SILENCED = ("pymodbus",)
"""Libraries whose messages repeat errors of our own."""
COMMAND = logging.getLogger("huddle")
"""The logger of the command itself."""
_RESERVED = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}
_CONTROL = SHOWN_CONTROLS | {ord("\n"): "\\n", ord("\t"): "\\t"}


class TextFormatter(logging.Formatter):
    """``2026-11-21T03:00:00.123Z INFO daq.recorder.recorder: message``."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one line, followed by the traceback of an error."""
        message = record.getMessage().translate(_CONTROL)
        line = f"{_time(record)} {record.levelname} {record.name}: {message}"
        trace = _traceback(self, record)
        return f"{line}\n{trace}" if trace else line


class JsonFormatter(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one line."""
        entry: dict[str, Any] = {
            "time": _time(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        text = json.dumps(entry | fields_of(record), default=str)
        return json.dumps(json.loads(text, parse_constant=lambda _: None))  # NaN is no JSON


def fields_of(record: logging.LogRecord) -> dict[str, Any]:
    """Return the typed fields of a record, and its traceback where it has one."""
    fields = {key: value for key, value in vars(record).items() if key not in _RESERVED}
    trace = _traceback(logging.Formatter(), record)
    return fields | {"traceback": trace} if trace else fields


class _ConsoleHandler(logging.Handler):
    """Writes to standard error, above a progress bar where one is shown there."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            line = self.format(record)
            if notices().is_terminal and not notices().quiet:
                notices().print(line, soft_wrap=True)
            else:
                sys.stderr.write(f"{line}\n")
                sys.stderr.flush()
        except Exception:  # noqa: BLE001 - a log line that cannot be written ends no command
            self.handleError(record)


def configure(
    level: LogLevel = LogLevel.WARNING,
    style: LogFormat = LogFormat.TEXT,
    *,
    file: Path | None = None,
    screen: bool = True,
) -> None:
    """Set level, format and destination of all log lines of this process.

    Parameters
    ----------
    level : LogLevel
        Of our own packages.
    style : LogFormat
    file : Path, optional
        Appended to, in place of standard error.
    screen : bool
        Whether lines go to standard error where there is no file; the application has the screen.

    Raises
    ------
    OSError
        The file cannot be opened, or there is no journal.
    """
    handler: logging.Handler
    if file is not None:
        handler = logging.FileHandler(file, encoding="utf-8")
    elif style is LogFormat.JOURNAL:
        handler = JournalHandler()
    else:
        handler = _ConsoleHandler() if screen else logging.NullHandler()
    handler.setFormatter(JsonFormatter() if style is LogFormat.JSON else TextFormatter())
    root = logging.getLogger()
    for before in [each for each in root.handlers if each.get_name() == COMMAND.name]:
        root.removeHandler(before)
        before.close()
    handler.set_name(COMMAND.name)
    root.addHandler(handler)
    root.setLevel(logging.WARNING)
    for name in OWN_LOGGERS:
        logging.getLogger(name).setLevel(_number(level))
    for name in SILENCED:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    reserve_standard_error(for_json=style is not LogFormat.TEXT and file is None)
    logging.raiseExceptions = False  # a full disk below standard error
    logging.captureWarnings(True)


@contextmanager
def screen_taken() -> Iterator[None]:
    """Write no log lines to standard error while an application has the screen."""
    root = logging.getLogger()
    silenced = [each for each in root.handlers if isinstance(each, _ConsoleHandler)]
    for handler in silenced:
        root.removeHandler(handler)
    try:
        yield
    finally:
        for handler in silenced:
            root.addHandler(handler)


def arguments_for_child() -> tuple[str, ...]:
    """Return options that make a child command log for `record_of`, at our own level."""
    least = COMMAND.getEffectiveLevel()
    level = next((each for each in LogLevel if _number(each) >= least), LogLevel.ERROR)
    return ("--log-format", LogFormat.JSON, "--log-level", level)


def record_of(line: str) -> logging.LogRecord | None:
    """Return the record that a child process logged as JSON; None for any other line."""
    try:
        entry = json.loads(line)
        level = logging.getLevelNamesMapping()[entry["level"].upper()]
        created = datetime.fromisoformat(entry["time"]).timestamp()
        record = logging.makeLogRecord(
            {
                "name": str(entry["logger"]),
                "levelno": level,
                "levelname": logging.getLevelName(level),
                "msg": str(entry["message"]),
                "created": created,
                "msecs": created % 1 * 1000,
            }
        )
    except (AttributeError, KeyError, TypeError, ValueError):
        return None
    known = _RESERVED | {"time", "level", "logger"}
    vars(record).update({key: value for key, value in entry.items() if key not in known})
    return record


def write(record: logging.LogRecord) -> None:
    """Log a record of another process, if its level is high enough here."""
    logger = logging.getLogger(record.name)
    if logger.isEnabledFor(record.levelno):
        logger.handle(record)


def report_failure(lines: Sequence[str], *, exit_code: int) -> None:
    """Say why the command failed: as a log record where standard error carries JSON, else plainly.

    The record has the fields ``exit_code`` and ``errors``, by which a parent knows it.
    """
    if notices().quiet:
        fields = {"exit_code": exit_code, "errors": list(lines)}
        COMMAND.error("%s", "; ".join(lines), extra=fields)
        return
    for line in lines:
        sys.stderr.write(f"huddle: {line}\n".translate(SHOWN_CONTROLS))
    sys.stderr.flush()


def _number(level: LogLevel) -> int:
    return logging.getLevelNamesMapping()[level.name]


def _time(record: logging.LogRecord) -> str:
    moment = datetime.fromtimestamp(record.created, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _traceback(formatter: logging.Formatter, record: logging.LogRecord) -> str:
    if record.exc_info and record.exc_info[0] is not None:
        return formatter.formatException(record.exc_info)
    return record.exc_text or ""


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
    address : str
        Of the socket.

    Raises
    ------
    OSError
        If there is no journal.
    """

    def __init__(self, address: str = ADDRESS) -> None:
        import socket

        super().__init__()
        self._channel = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._channel.connect(address)
        except OSError:
            self._channel.close()
            raise

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record."""
        try:
            self._channel.send(entry(record, fields_of(record)))
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
