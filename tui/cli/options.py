"""Options that several commands share, each defined once."""

import inspect
from collections.abc import Callable
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from daq.bench.durations import parse_duration

_MOST_DIGITS = 3  # of a dimension: no bench has a thousand channels


class Method(StrEnum):
    """Self-noise methods, and all of them."""

    TWO_CHANNEL = "two-channel"
    THREE_CHANNEL = "three-channel"
    THREE_SENSOR = "three-sensor"
    MAXIMUM_LIKELIHOOD = "maximum-likelihood"
    ALL = "all"


class Clocks(StrEnum):
    """What is believed of when samples were taken."""

    REFINED = "refined"
    ARRIVALS = "arrivals"
    NOMINAL = "nominal"


class Detrend(StrEnum):
    """What is taken out of each segment before it is transformed."""

    NONE = "none"
    CONSTANT = "constant"
    LINEAR = "linear"


def duration(value: str | float) -> float:
    """Read a duration from the command line, in seconds."""
    try:
        return parse_duration(value)
    except ValueError as error:
        raise typer.BadParameter(f"{value!r}: {error}") from None


def factors(value: str | None) -> int | str | None:
    """Read how many factors the common motion has: a number, or ``auto``."""
    if value is None or value == "auto":
        return value
    if value.isdecimal() and len(value) <= _MOST_DIGITS:
        return int(value)
    raise typer.BadParameter(f"--dimension {value!r}: expected a number such as 3, or auto")


def frequencies(value: str | None) -> tuple[float, float] | None:
    """Read a band of frequencies such as ``1:20``, in Hz."""
    if value is None:
        return None
    try:
        low, high = (float(part) for part in value.split(":"))
    except ValueError:
        low, high = 0.0, 0.0
    if not 0 < low < high:
        raise typer.BadParameter(f"--band {value!r}: expected two frequencies in Hz such as 1:20")
    return low, high


def gains(values: list[str] | None) -> dict[str, float] | None:
    """Read gains such as ``B=1.02`` or ``B.X=1.02``."""
    if not values:
        return None
    found: dict[str, float] = {}
    for value in values:
        name, _, number = value.rpartition("=")
        if name in found:
            raise typer.BadParameter(f"--gain {value!r}: {name} has {found[name]:g} already")
        try:
            found[name] = float(number)
        except ValueError:
            name = ""
        if not name:
            raise typer.BadParameter(f"--gain {value!r}: expected a sensor and number as in B=1.02")
    return found


BenchArgument: TypeAlias = Annotated[
    Path, typer.Argument(metavar="BENCH", help="Bench file (TOML); [b]huddle init[/b] writes one.")
]
FileArgument: TypeAlias = Annotated[Path, typer.Argument(metavar="FILE", help="Recording (.h5).")]
FilesArgument: TypeAlias = Annotated[
    list[Path], typer.Argument(metavar="FILE", help="Recordings (.h5); several are put together.")
]
OutOption: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="FILE",
        help="Recording to write (.h5); named by bench and time where not given.",
    ),
]
JsonOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE", help="Write the result as JSON; - is standard output."),
]
CsvOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--csv", metavar="FILE", help="Write the curves as CSV; - is standard output."),
]
DurationOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--duration",
        "-d",
        metavar="TIME",
        parser=duration,
        help="As in 90s, 20min, 3h; where not given, as the bench file says.",
    ),
]
MethodOption: TypeAlias = Annotated[
    Method | None,
    typer.Option(
        "--method",
        "-m",
        metavar="METHOD",
        help="two-channel, three-channel, three-sensor, maximum-likelihood, or all.",
    ),
]
SegmentOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--segment", metavar="TIME", parser=duration, help="Length of one segment, as in 10s, 2min."
    ),
]
OverlapOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--overlap",
        metavar="SHARE",
        min=0,
        max=0.99,
        help="By which segments overlap, as in 0.5.",
    ),
]
WindowOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--window",
        metavar="NAME",
        help="Any window of scipy: hann, or with a parameter as in kaiser,8.",
    ),
]
DetrendOption: TypeAlias = Annotated[
    Detrend | None,
    typer.Option(
        "--detrend", metavar="HOW", help="Taken out of each segment: none, constant, linear."
    ),
]
NoCorrectionOption: TypeAlias = Annotated[
    bool, typer.Option("--no-correction", help="Leave the small-sample bias in.")
]
ClocksOption: TypeAlias = Annotated[
    Clocks | None,
    typer.Option(
        "--clocks",
        metavar="HOW",
        help="Set by arrival times and the common motion (refined), by arrival times alone "
        "(arrivals), or not at all: samples at face value (nominal).",
    ),
]
StartOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--start",
        metavar="T",
        help="From here: UTC as in 2026-11-21T03:00:00, or after the start as in 2h.",
    ),
]
EndOption: TypeAlias = Annotated[
    str | None, typer.Option("--end", metavar="T", help="To here: likewise.")
]
UnitOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--unit", metavar="UNIT", help="As in m/s², mm/s, µg: spectra are in UNIT²/Hz."),
]
BandOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--band", metavar="LOW:HIGH", help="Band of the table, in Hz, as in 1:20."),
]
RejectOption: TypeAlias = Annotated[
    bool | None,
    typer.Option(
        "--reject/--no-reject",
        help="Leave out segments with transients; without either those that are clipped. "
        "Gaps always are.",
        show_default=False,
    ),
]
OctavesOption: TypeAlias = Annotated[
    bool | None,
    typer.Option(
        "--octaves/--no-octaves",
        help="Each octave with its own segments: --segment in the highest, doubling downwards.",
        show_default=False,
    ),
]
DimensionOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--dimension",
        metavar="auto|N",
        help="Dimensions of the common motion (maximum likelihood); auto: as the data demand.",
    ),
]
GainOption: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--gain",
        metavar="SENSOR=G",
        help="Known relative response for the two-channel method; alike where not given.",
    ),
]
DiagnosticsOption: TypeAlias = Annotated[
    bool, typer.Option("--diagnostics", help="Show all that is known of the test, band by band.")
]
SpeedOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--speed",
        metavar="FACTOR",
        min=0.01,
        help="How many times as fast as life; where not given, as the bench file says.",
    ),
]


def _estimate(
    *,
    method: MethodOption = None,
    segment: SegmentOption = None,
    overlap: OverlapOption = None,
    window: WindowOption = None,
    detrend: DetrendOption = None,
    no_correction: NoCorrectionOption = False,
    clocks: ClocksOption = None,
    reject: RejectOption = None,
    octaves: OctavesOption = None,
    dimension: DimensionOption = None,
    gain: GainOption = None,
    start: StartOption = None,
    end: EndOption = None,
    unit: UnitOption = None,
    band: BandOption = None,
) -> dict[str, Any]:
    """Return what is wanted of an estimate: fields of Settings, None where not given."""
    return {
        "method": method,
        "segment": segment,
        "overlap": overlap,
        "window": window,
        "detrend": detrend,
        "correct": False if no_correction else None,
        "clocks": clocks,
        "reject": reject,
        "octaves": octaves,
        "dimension": factors(dimension),
        "gains": gains(gain),
        "start": start,
        "end": end,
        "unit": unit,
        "band": frequencies(band),
    }


def with_estimate_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of an estimate; it gets what they ask for as ``wanted``."""
    shared = inspect.signature(_estimate).parameters
    first, *others = inspect.signature(command).parameters.values()

    @wraps(command)
    def with_options(**given: Any) -> None:  # noqa: ANN401 - values of options
        wanted = _estimate(**{name: given.pop(name) for name in shared})
        command(**given, **wanted)

    own = [each for each in others if each.kind is not each.VAR_KEYWORD]
    vars(with_options)["__signature__"] = inspect.Signature([first, *shared.values(), *own])
    return with_options
