"""How commands declare what they take, and what several of them take.

A command is a function: what it takes by position are arguments, by keyword options. Its docstring
says of each the form and the help, in sections that are the panels of the help; it has examples,
and perhaps one with its output. What it does not describe is described here.

Parameters
----------
files : FILE
    Recordings (.h5). Several are estimated together.
file : FILE
    Recording (.h5).
path : BENCH
    Bench file (TOML); huddle init writes one.
bench : BENCH
    Bench file (TOML).
out : FILE
    Recording to write (.h5; default: named after bench and time).
json : FILE
    Write the result as JSON; - is standard output.
csv : FILE
    Write the result as CSV; - is standard output.
duration : TIME
    Length of the recording, such as 90s, 20min or 3h (default: from the bench file).
models : NAMES
    Noise models to draw, separated by commas: nlnm, nhnm, alnm, ahnm, or CSV files with a header
    such as: frequency (Hz), noise (µg/√Hz).
start : T
    Start of the time span to estimate: UTC such as 2026-11-21T03:00:00, or a time after the start
    of the recording such as 2h.
end : T
    End of the time span to estimate, as --start.
anyway
    Record even where the check list fails (see huddle check), or where some sensors of a port do
    not answer.
diagnostics
    Print the complete diagnosis of the test, by band.
speed : FACTOR
    Speed of the simulation relative to real time (default: from the bench file).

Files of other programs
-----------------------
response : FILE
    Instrument responses: RESP, StationXML or SACPZ files, or folders of them; repeatable. Each
    channel takes the response of its code and date.
response_for : PATTERN=FILE
    Response for channels of another code, as in 'XX.ABC.*=FILE'; repeatable. A sensor and its
    digitizer may be in two files.
channels : PATTERN
    Channels to take, such as 'HH?' or 'XX.ABC.*.HHZ,XX.DEF.*.HHZ'. Default: all but those of the
    instrument's state of health.
net : CODE
    Network in an SDS archive, or a pattern.
sta : CODE
    Station, or a pattern.
loc : CODE
    Location, or a pattern; -- if empty.

Log lines on standard error
---------------------------
log_level : LEVEL
    Lowest severity to write: debug, info, warning or error (default info).
log_format : FORMAT
    text, or json: one JSON object per line, and no other output on standard error; or journal:
    entries of systemd's journal (default text).
log_file : FILE
    Append log lines to this file (default: write none).
"""

# ruff: noqa: PLC0415 - what sets up logging is imported when a command runs

import ast
import inspect
import re
import sys
from collections.abc import Callable
from copy import copy
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias, TypeVar, get_args

import typer
from typer.models import ParameterInfo

from daq.bench.durations import parse_duration
from daq.bench.estimate_settings import OPTIONS, default_text, from_text
from estimator.records import dataclass
from tui.output.logs.options import LogFormat, LogLevel

ESTIMATE_PANEL = "Estimate (defaults come from the bench file)"
LOG_PANEL = "Log lines on standard error"
_SECTION = re.compile(r"^(\S.*)\n-{3,}\n", re.MULTILINE)
_ENTRY = re.compile(r"\n(?=\S)")
Command = TypeVar("Command", bound=Callable[..., object])

ESSENTIAL = frozenset({"methods", "segment", "band", "unit"})
"""Options of an estimate that every help shows."""


@dataclass(frozen=True, slots=True)
class Guide:
    """What a command shows first: example lines, parameters, and an example with its output."""

    lines: str = ""
    first: frozenset[str] = frozenset()
    worked: str = ""


_FIRST: dict[str, frozenset[str]] = {}
"""By the name of the function of a command."""


def command(*, first: str = "") -> Callable[[Command], Command]:
    """Declare a command.

    Parameters
    ----------
    first : str
        Names of the parameters that ``--help`` shows; all but those of an estimate and of log
        lines, if not given. ``--help-all`` shows all.
    """

    def keep(function: Command) -> Command:
        _FIRST[function.__name__] = frozenset(first.split())
        return function

    return keep


def _of_a_recording(out: Path | None) -> Path | None:
    """Raise typer.BadParameter if a name is not that of a recording."""
    if out is not None and out.suffix.lower() not in {".h5", ".hdf5"}:
        raise typer.BadParameter(f"{out}: expected a file name that ends in .h5")
    return out


def duration(value: str | float) -> float:
    """Read a duration from the command line, in seconds."""
    try:
        return parse_duration(value)
    except ValueError as error:
        raise typer.BadParameter(f"{value!r}: {error}") from None


OutOption: TypeAlias = Annotated[Path | None, typer.Option("--out", "-o")]
NEW_RECORDING = typer.Option("--out", "-o", callback=_of_a_recording)
DurationOption: TypeAlias = Annotated[
    float | None, typer.Option("--duration", "-d", parser=duration)
]
DetailsOption: TypeAlias = Annotated[bool, typer.Option("--details", "--diagnostics")]
SpeedOption: TypeAlias = Annotated[float | None, typer.Option(min=0.01)]


class _Described(NamedTuple):
    """What a docstring says of a parameter: the panel of the help, its form, and what it does."""

    panel: str | None = None
    form: str | None = None
    text: str | None = None


def _docstring(of: Any) -> str:  # noqa: ANN401 - a function, or a module
    """Return a docstring; from the source, if Python was started with -OO."""
    if sys.flags.optimize < 2:
        return of.__doc__ or ""
    source: Any = ast.parse(inspect.getsource(of))
    return ast.get_docstring(source if inspect.ismodule(of) else source.body[0]) or ""


def _sections(docstring: str) -> tuple[str, dict[str, str]]:
    """Return a docstring as far as its first section, and the sections by their titles."""
    text, *sections = _SECTION.split(inspect.cleandoc(docstring))
    bodies = (each.strip() for each in sections[1::2])
    return text.strip(), dict(zip(sections[::2], bodies, strict=True))


def _described(sections: dict[str, str]) -> dict[str, _Described]:
    """Return what sections say by parameter."""
    found = {}
    for title, body in sections.items():
        for entry in _ENTRY.split(body):
            head, _, lines = entry.partition("\n")
            name, _, form = head.partition(" : ")
            panel = None if title == "Parameters" else title
            found[name] = _Described(panel, form or None, " ".join(lines.split()))
    return found


def declared(function: Callable[..., None]) -> tuple[Callable[..., None], str, Guide]:
    """Return a command as typer takes it, its help as far as the first section, and its guide."""
    text, sections = _sections(_docstring(function))
    lines, worked = (sections.pop(title, "") for title in ("Examples", "Worked example"))
    described = _described(_sections(_docstring(sys.modules[__name__]))[1]) | _described(sections)
    signature = inspect.signature(function, eval_str=True)
    taken = [_declared(each, described) for each in signature.parameters.values()]

    @wraps(function)
    def run(**given: Any) -> None:  # noqa: ANN401 - values of options
        function(**given)

    vars(run)["__signature__"] = signature.replace(parameters=taken)
    return run, text, Guide(re.sub(r"\n +", " ", lines), _FIRST[function.__name__], worked)


def _declared(given: inspect.Parameter, described: dict[str, _Described]) -> inspect.Parameter:
    """Return a parameter with its form and help, unless it has them."""
    kind, *more = (
        get_args(given.annotation)
        if hasattr(given.annotation, "__metadata__")
        else (given.annotation,)
    )
    about: Any = next((copy(each) for each in more if isinstance(each, ParameterInfo)), None)
    if about is None:
        is_option = given.kind is given.KEYWORD_ONLY
        about = typer.Option() if is_option else typer.Argument()
    if kind is bool and about.default is ...:  # typer would add --no-NAME
        about.default = f"--{given.name.replace('_', '-')}"
    if about.help is None and not about.hidden:
        about.rich_help_panel, about.metavar, about.help = described.get(given.name, _Described())
    return given.replace(annotation=Annotated[kind, about])


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


_SPAN = [
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=str | None)
    for name in ("start", "end")
]


def with_estimate_options(
    command: Callable[..., None], *, has_span: bool = False
) -> Callable[..., None]:
    """Give a command all options of an estimate, and on request start and end of a time span.

    The command receives their values as ``**wanted``, by field of
    `daq.bench.estimate_settings.EstimateSettings`; None where an option is not given. A parameter
    of the command with the name of a field takes the place of that option.
    """
    first, *others = inspect.signature(command, eval_str=True).parameters.values()
    own = [each for each in others if each.kind is not each.VAR_KEYWORD]
    own += _SPAN if has_span else []
    added = [name for name in OPTIONS if name not in {each.name for each in own}]

    @wraps(command)
    def with_options(*own: Any, **given: Any) -> None:  # noqa: ANN401 - values of options
        wanted = {name: read_option(name, given.pop(name, None)) for name in added}
        command(*own, **given, **wanted)

    signature = inspect.Signature([first, *own, *map(_parameter, added)])
    vars(with_options)["__signature__"] = signature
    return with_options


with_spanned_options = partial(with_estimate_options, has_span=True)
"""Of a command that estimates recordings, or a part of them."""
LogLevelOption: TypeAlias = Annotated[LogLevel, typer.Option(show_default=False)]
LogFormatOption: TypeAlias = Annotated[LogFormat, typer.Option(show_default=False)]


def with_logging(function: Callable[..., None], *, to_file: bool = False) -> Callable[..., None]:
    """Add options of log lines to a command: on standard error, or in a file only."""
    usual: dict[str, tuple[Any, Any]] = {
        "log_level": (LogLevelOption, LogLevel.INFO),
        "log_format": (LogFormatOption, LogFormat.TEXT),
        **({"log_file": (Path | None, None)} if to_file else {}),
    }
    added = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=value, annotation=kind)
        for name, (kind, value) in usual.items()
    ]
    own = inspect.signature(function, eval_str=True)

    @wraps(function)
    def logged(*args: Any, **given: Any) -> None:  # noqa: ANN401 - values of options
        from tui.output.logs.lines import configure

        level, style, *file = (given.pop(name, value) for name, (_, value) in usual.items())
        configure(level, style, file=next(iter(file), None), screen=not to_file)
        function(*args, **given)

    vars(logged)["__signature__"] = own.replace(parameters=[*own.parameters.values(), *added])
    return logged


with_log_file = partial(with_logging, to_file=True)
"""Of a command that uses the whole screen."""
