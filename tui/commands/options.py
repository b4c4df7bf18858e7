"""Options that several commands share, each defined once; examples in the help of commands."""

# ruff: noqa: PLC0415 - what sets up logging is imported when a command runs

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeAlias, TypeVar

import typer

from daq.bench.durations import parse_duration
from daq.bench.estimate_settings import OPTIONS, default_text, from_text
from tui.output.logs.options import LogFormat, LogLevel

ESTIMATE_PANEL = "Estimate (defaults come from the bench file)"
Command = TypeVar("Command", bound=Callable[..., object])

ESSENTIAL = frozenset({"methods", "segment", "band", "unit"})
"""Options of an estimate that every help shows."""


@dataclass(frozen=True, slots=True)
class Guide:
    """What a command shows first: example lines, parameters, and an example with its output."""

    lines: tuple[str, ...]
    first: frozenset[str]
    worked: str


GUIDES: dict[str, Guide] = {}
"""By the name of the function of a command."""


def examples(*lines: str, first: str = "", worked: str = "") -> Callable[[Command], Command]:
    """Add examples to the help of a command.

    Parameters
    ----------
    *lines : str
        Commands.
    first : str
        Names of the parameters that ``--help`` shows; all but those of an estimate and of log
        lines, if not given. ``--help-all`` shows all.
    worked : str
        A command with its output, and what that means.
    """

    def keep(command: Command) -> Command:
        GUIDES[command.__name__] = Guide(lines, frozenset(first.split()), worked)
        return command

    return keep


def duration(value: str | float) -> float:
    """Read a duration from the command line, in seconds."""
    try:
        return parse_duration(value)
    except ValueError as error:
        raise typer.BadParameter(f"{value!r}: {error}") from None


FILES_PANEL = "Files of other programs"
"""Of options about responses and channels of these."""


def _of_files(flag: str, metavar: str, text: str) -> Any:  # noqa: ANN401 - as typer has it
    return typer.Option(flag, metavar=metavar, help=text, rich_help_panel=FILES_PANEL)


ResponseOption: TypeAlias = Annotated[
    list[Path] | None,
    _of_files(
        "--response",
        "FILE",
        "Instrument responses: RESP, StationXML or SACPZ files, or folders of them; repeatable."
        " Each channel takes the response of its code and date.",
    ),
]
ResponseForOption: TypeAlias = Annotated[
    list[str] | None,
    _of_files(
        "--response-for",
        "PATTERN=FILE",
        "Response for channels of another code, as in 'XX.ABC.*=FILE'; repeatable. A sensor and its"
        " digitizer may be in two files.",
    ),
]
ChannelsOption: TypeAlias = Annotated[
    list[str] | None,
    _of_files(
        "--channels",
        "PATTERN",
        "Channels to take, such as 'HH?' or 'XX.ABC.*.HHZ,XX.DEF.*.HHZ'. Default: all but those of"
        " the instrument's state of health.",
    ),
]
NetworkOption: TypeAlias = Annotated[
    str, _of_files("--net", "CODE", "Network in an SDS archive, or a pattern.")
]
StationOption: TypeAlias = Annotated[str, _of_files("--sta", "CODE", "Station, or a pattern.")]
LocationOption: TypeAlias = Annotated[
    str, _of_files("--loc", "CODE", "Location, or a pattern; -- if empty.")
]
BenchArgument: TypeAlias = Annotated[
    Path, typer.Argument(metavar="BENCH", help="Bench file (TOML); huddle init writes one.")
]
FileArgument: TypeAlias = Annotated[Path, typer.Argument(metavar="FILE", help="Recording (.h5).")]
FilesArgument: TypeAlias = Annotated[
    list[Path],
    typer.Argument(metavar="FILE", help="Recordings (.h5). Several are estimated together."),
]
OutOption: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="FILE",
        help="Recording to write (.h5; default: named after bench and time).",
    ),
]
JsonOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE", help="Write the result as JSON; - is standard output."),
]
CsvOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--csv", metavar="FILE", help="Write the result as CSV; - is standard output."),
]
DurationOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--duration",
        "-d",
        metavar="TIME",
        parser=duration,
        help="Length of the recording, such as 90s, 20min or 3h (default: from the bench file).",
    ),
]
ModelsOption: TypeAlias = Annotated[
    str,
    typer.Option(
        "--models",
        metavar="NAMES",
        help="Noise models to draw, separated by commas: nlnm, nhnm, alnm, ahnm, or CSV files"
        " with a header such as: frequency (Hz), noise (µg/√Hz).",
    ),
]
StartOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="T",
        help="Start of the time span to estimate: UTC such as 2026-11-21T03:00:00, or a time after"
        " the start of the recording such as 2h.",
    ),
]
EndOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--end", metavar="T", help="End of the time span to estimate, as --start."),
]
AnywayOption: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--anyway",
        help="Record even where the check list fails (see huddle check), or where some sensors of"
        " a port do not answer.",
    ),
]
DiagnosticsOption: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--details", "--diagnostics", help="Print the complete diagnosis of the test, by band."
    ),
]
SpeedOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--speed",
        metavar="FACTOR",
        min=0.01,
        help="Speed of the simulation relative to real time (default: from the bench file).",
    ),
]


def _parameter(name: str) -> inspect.Parameter:
    """Return an option of an estimate as a parameter of a command."""
    option, default = OPTIONS[name], default_text(name)
    kind: Any = bool if option.is_switch else list[str] if option.repeated else str
    declared = typer.Option(
        *option.flags,
        metavar=option.metavar or None,
        help=f"{option.help} Default: {default}." if default else option.help,
        rich_help_panel=ESTIMATE_PANEL,
        show_default=False,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[kind | None, declared],
    )


def read_option(name: str, given: Any) -> object:  # noqa: ANN401 - text, texts, or yes or no
    """Return the value of a field of EstimateSettings; None if it is not given."""
    if given is None or given == []:
        return None
    if OPTIONS[name].is_switch:
        return bool(given)
    try:
        return from_text(name, given)
    except ValueError as error:
        flag = OPTIONS[name].flags[0]
        shown = ", ".join(given) if isinstance(given, list) else given
        raise typer.BadParameter(f"{flag} {shown!r}: {error}") from None


def with_estimate_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command all options of an estimate.

    The command receives their values as ``**wanted``, by field of
    `daq.bench.estimate_settings.EstimateSettings`; None where an option is not given. A parameter
    of the command with the name of a field takes the place of that option.
    """
    first, *others = inspect.signature(command, eval_str=True).parameters.values()
    own = [each for each in others if each.kind is not each.VAR_KEYWORD]
    added = [name for name in OPTIONS if name not in {each.name for each in own}]

    @wraps(command)
    def with_options(*own: Any, **given: Any) -> None:  # noqa: ANN401 - values of options
        wanted = {name: read_option(name, given.pop(name, None)) for name in added}
        command(*own, **given, **wanted)

    signature = inspect.Signature([first, *own, *map(_parameter, added)])
    vars(with_options)["__signature__"] = signature
    return with_options


LOG_PANEL = "Log lines on standard error"

LogLevelOption: TypeAlias = Annotated[
    LogLevel,
    typer.Option(
        "--log-level",
        metavar="LEVEL",
        rich_help_panel=LOG_PANEL,
        help="Lowest severity to write: debug, info, warning or error (default info).",
        show_default=False,
    ),
]
LogFormatOption: TypeAlias = Annotated[
    LogFormat,
    typer.Option(
        "--log-format",
        metavar="FORMAT",
        rich_help_panel=LOG_PANEL,
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
        rich_help_panel=LOG_PANEL,
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
    own = inspect.signature(command, eval_str=True)

    @wraps(command)
    def logging_command(*args: Any, **given: Any) -> None:  # noqa: ANN401 - values of options
        set_up(**{name: given.pop(name) for name in added if name in given})
        command(*args, **given)

    signature = own.replace(parameters=[*own.parameters.values(), *added.values()])
    vars(logging_command)["__signature__"] = signature
    return logging_command
