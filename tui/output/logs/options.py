"""Levels and formats of log lines, as options name them."""

from __future__ import annotations

from enum import StrEnum


class LogFormat(StrEnum):
    """How log lines are written."""

    TEXT = "text"
    """Time, level, logger, message."""
    JSON = "json"
    """One JSON object per line: ``time``, ``level``, ``logger``, ``message``, and typed fields."""
    JOURNAL = "journal"
    """Entries of systemd's journal with typed fields, and nothing on standard error."""


class LogLevel(StrEnum):
    """Lowest severity that is written."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"
