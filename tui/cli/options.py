"""Options that several commands share, each defined once."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from daq.bench.durations import parse_duration
from daq.bench.estimate_settings import OPTIONS, default_text, from_text

_ESTIMATE_PANEL = "Estimate (defaults come from the bench file)"


def duration(value: str | float) -> float:
    """Read a duration from the command line, in seconds."""
    try:
        return parse_duration(value)
    except ValueError as error:
        raise typer.BadParameter(f"{value!r}: {error}") from None


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
        rich_help_panel=_ESTIMATE_PANEL,
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
    first, *others = inspect.signature(command).parameters.values()
    own = [each for each in others if each.kind is not each.VAR_KEYWORD]
    added = [name for name in OPTIONS if name not in {each.name for each in own}]

    @wraps(command)
    def with_options(**given: Any) -> None:  # noqa: ANN401 - values of options
        wanted = {name: read_option(name, given.pop(name)) for name in added}
        command(**given, **wanted)

    signature = inspect.Signature([first, *own, *map(_parameter, added)])
    vars(with_options)["__signature__"] = signature
    return with_options
