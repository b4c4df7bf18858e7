"""Options of log lines, for commands that run for long."""

# ruff: noqa: PLC0415 - what sets up logging is imported when a command runs

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from tui.output.logs.options import LogFormat, LogLevel

_PANEL = "Log lines on standard error"

LogLevelOption: TypeAlias = Annotated[
    LogLevel,
    typer.Option(
        "--log-level",
        metavar="LEVEL",
        rich_help_panel=_PANEL,
        help="Lowest severity to write: debug, info, warning or error (default info).",
        show_default=False,
    ),
]
LogFormatOption: TypeAlias = Annotated[
    LogFormat,
    typer.Option(
        "--log-format",
        metavar="FORMAT",
        rich_help_panel=_PANEL,
        help="text, or json: one JSON object per line, and no other output on standard error;"
        " or journal: entries of systemd's journal (default text).",
        show_default=False,
    ),
]
LogFileOption: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--log-file",
        metavar="FILE",
        rich_help_panel=_PANEL,
        help="Append log lines to this file (default: write none).",
    ),
]


def _to_standard_error(
    *, log_level: LogLevelOption = LogLevel.INFO, log_format: LogFormatOption = LogFormat.TEXT
) -> None:
    from tui.output.logs.lines import configure

    configure(log_level, log_format)


def _to_file(
    *,
    log_level: LogLevelOption = LogLevel.INFO,
    log_format: LogFormatOption = LogFormat.TEXT,
    log_file: LogFileOption = None,
) -> None:
    from tui.output.logs.lines import configure

    configure(log_level, log_format, file=log_file, screen=False)


def with_logging(command: Callable[..., None]) -> Callable[..., None]:
    """Add options of log lines on standard error to a command."""
    return _with(_to_standard_error, command)


def with_log_file(command: Callable[..., None]) -> Callable[..., None]:
    """Add options of log lines in a file to a command that uses the whole screen."""
    return _with(_to_file, command)


def _with(set_up: Callable[..., None], command: Callable[..., None]) -> Callable[..., None]:
    added = inspect.signature(set_up).parameters
    own = inspect.signature(command)

    @wraps(command)
    def logging_command(*args: Any, **given: Any) -> None:  # noqa: ANN401 - values of options
        set_up(**{name: given.pop(name) for name in added})
        command(*args, **given)

    signature = own.replace(parameters=[*own.parameters.values(), *added.values()])
    vars(logging_command)["__signature__"] = signature
    return logging_command
