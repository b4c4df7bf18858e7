"""The options of an estimate, each declared once.

A field of `EstimateSettings` is a key of the bench file's ``[estimate]`` table, an option of every
command that estimates, and an attribute of the settings that the estimate reads. To add an option,
add a field here and use it in `daq.estimation`. This module imports nothing heavy, for
``huddle --help`` reads it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, field, fields, replace
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, Literal

from daq.bench import option_values as values
from daq.bench.durations import format_duration, parse_duration
from estimator.records import dataclass


@dataclass(frozen=True, slots=True)
class Option:
    """Declaration of one option of an estimate: its help, check, and forms.

    Attributes
    ----------
    help : str
        What the option does, for people.
    check : callable
        Turns a value of the bench file into the value of the setting. Raises `ValueError` with what
        was expected.
    flags : tuple of str
        Names on the command line, if not by the field's; ``--yes/--no`` for a switch.
    metavar : str
        What the help shows for the value; empty for a switch.
    read : callable
        Turns the text of the command line into a value as of the bench file; a list of texts, where
        the option is `repeated`. Raises `ValueError` with what was expected.
    show : callable
        Turns the value of the setting into a value of the bench file.
    text : callable
        Turns the value of the setting into the text of the command line; the inverse of `read` and
        `check`.
    key : str
        Name in the bench file, if not the field's.
    repeated : bool
        Whether the command line takes the option several times.
    """

    help: str
    check: Callable[[Any], object] = values.yes_or_no
    flags: tuple[str, ...] = ()
    metavar: str = ""
    read: Callable[[Any], object] = str
    show: Callable[[Any], object] = lambda value: value
    text: Callable[[Any], str | list[str]] = str
    key: str = ""
    repeated: bool = False

    @property
    def is_switch(self) -> bool:
        """Whether the option takes no value."""
        return not self.metavar


@dataclass(frozen=True, slots=True)
class EstimateSettings:
    """Settings of an estimate, with their defaults. `OPTIONS` explains each field."""

    methods: Annotated[
        tuple[str, ...],
        Option(
            "Method: auto; two-channel, three-channel, three-sensor, maximum-likelihood, multi-part"
            " (two sensors, from motion that changes); all: every method that applies; several:"
            " separated by commas. auto is maximum likelihood with as"
            " many dimensions of the motion as the data show, where the sensors leave room for"
            " them (four with two or three channels, six with one; up to 96 channels), else"
            " three-sensor, with levels by maximum likelihood; of two sensors multi-part.",
            check=values.methods,
            flags=("--method", "-m"),
            metavar="METHOD",
            read=lambda text: text.split(","),
            show=values.method_or_methods,
            text=",".join,
            key="method",
        ),
    ] = ("auto",)
    segment: Annotated[
        float,
        Option(
            "Length of a segment, such as 10s or 2min. It sets the frequency resolution.",
            check=parse_duration,
            metavar="TIME",
        ),
    ] = 10.0
    overlap: Annotated[
        float,
        Option(
            "Overlap between consecutive segments, as a fraction of their length.",
            check=values.share,
            metavar="FRACTION",
            read=values.to_number,
        ),
    ] = 0.5
    window: Annotated[
        str,
        Option(
            "Window of each segment: hann, blackman, rectangular, …; with a parameter: kaiser,8.",
            check=values.window,
            metavar="NAME",
        ),
    ] = "hann"
    detrend: Annotated[
        Literal["none", "constant", "linear"],
        Option(
            "Trend removed from each segment: none, constant, linear.",
            check=partial(values.one_of, known=values.TRENDS),
            metavar="TREND",
        ),
    ] = "constant"
    correct: Annotated[
        bool,
        Option(
            "Correct the bias of few averages.",
            flags=("--correction/--no-correction",),
        ),
    ] = True
    clocks: Annotated[
        Literal["refined", "arrivals", "nominal"],
        Option(
            "Time of samples: from arrival times, refined by the common motion (refined); from"
            " arrival times alone (arrivals); from the nominal rates (nominal).",
            check=partial(values.one_of, known=values.CLOCKS),
            metavar="SOURCE",
        ),
    ] = "refined"
    equalise: Annotated[
        Literal["auto", "known", "estimated", "off"],
        Option(
            "Filter sensors before the window so that all have one response: by the poles and zeros"
            " of the bench file (known), by the responses that the averages show (estimated),"
            " where unequal responses matter (auto), or not at all (off).",
            check=partial(values.one_of, known=values.EQUALISATIONS),
            metavar="MODE",
        ),
    ] = "auto"
    reject: Annotated[
        bool | None,
        Option(
            "Also exclude segments with transients. Clipped segments are excluded unless"
            " --no-reject is given; for segments with gaps see --bridge.",
        ),
    ] = None
    bridge: Annotated[
        float,
        Option(
            "Use segments with gaps of up to this share of their length, by a window that is zero"
            " in them, where fewer than half of the segments have no gap; 0 excludes them always."
            " Not with --octaves or --reject.",
            check=values.share,
            metavar="SHARE",
            read=values.to_number,
        ),
    ] = 0.6
    exclude: Annotated[
        tuple[str, ...],
        Option(
            "Stretch of time of which no segment is used, such as a lorry that passed: two instants"
            " in UTC, or two times after the start of the recording (0s/60s); may be repeated.",
            check=values.stretches,
            metavar="START/END",
            read=list,
            show=list,
            text=list,
            repeated=True,
        ),
    ] = ()
    linearise: Annotated[
        bool,
        Option(
            "Subtract what squares and cubes of a channel explain of its noise, where it is not"
            " linear. Without, it widens the interval.",
        ),
    ] = False
    octaves: Annotated[
        bool,
        Option(
            "Estimate each octave with its own segment length: --segment in the top octave,"
            " doubled in each octave below.",
        ),
    ] = False
    dimension: Annotated[
        int | Literal["auto"] | None,
        Option(
            "Dimensions of the common motion for maximum likelihood: a number, or auto for as many"
            " as the model test of each band requires; with four or more sensors, auto uses"
            " gradients of the motion where they explain it. Default: auto with method auto, else"
            " as many as a sensor has channels.",
            check=values.dimension,
            metavar="N|auto",
            read=values.to_dimension,
        ),
    ] = None
    gains: Annotated[
        Mapping[str, float],
        Option(
            "Response of a sensor (B=1.02) or a channel (B.X=1.02) relative to the others, for the"
            " two-channel method; may be repeated.",
            check=values.gains,
            flags=("--gain",),
            metavar="SENSOR=G",
            read=values.to_gains,
            show=dict,
            text=lambda gains: [f"{name}={gain!r}" for name, gain in gains.items()],
            repeated=True,
        ),
    ] = field(default_factory=dict)
    sampling_rates: Annotated[
        Mapping[str, float],
        Option(
            "Rate in Hz at which a sensor sampled (B=100.9), in place of the recorded one; may be"
            " repeated.",
            check=values.sampling_rates,
            flags=("--sampling-rate",),
            metavar="SENSOR=HZ",
            read=values.to_gains,
            show=dict,
            text=lambda rates: [f"{name}={rate!r}" for name, rate in rates.items()],
            repeated=True,
        ),
    ] = field(default_factory=dict)
    axis_tolerance: Annotated[
        Mapping[str, float],
        Option(
            "Angle in degrees, rms, by which axes of sensors with one or two channels may be off:"
            " of all of them (0.2), or of a sensor (B=0.2; may be repeated). Motion across an axis"
            " widens the intervals. Default: 1.",
            check=values.axis_tolerance,
            metavar="DEGREES",
            read=values.to_axis_tolerance,
            show=values.number_or_table,
            text=lambda angles: [
                f"{n}={angle!r}" if n else repr(angle) for n, angle in angles.items()
            ],
            repeated=True,
        ),
    ] = field(default_factory=dict)
    gain_steadiness: Annotated[
        float,
        Option(
            "Change of a gain in percent, for motion of ten times the power, that method multi-part"
            " allows for (default 0.1).",
            check=values.not_negative,
            metavar="PERCENT",
            read=values.to_number,
            text=repr,
        ),
    ] = 0.1
    shared_noise: Annotated[
        tuple[tuple[str, str], ...],
        Option(
            "Two of three or more sensors whose noise may be shared (A:B), as by a cable or a"
            " supply, for method multi-part; may be repeated.",
            check=values.pairs,
            metavar="A:B",
            read=lambda texts: [text.split(":") for text in texts],
            show=lambda pairs: [list(pair) for pair in pairs],
            text=lambda pairs: [":".join(pair) for pair in pairs],
            repeated=True,
        ),
    ] = ()
    lean: Annotated[
        Mapping[str, tuple[float, float]],
        Option(
            "Known lean of a sensor with one or two channels, in degrees: of its axis or plane,"
            " towards two directions that all sensors have in common; may be repeated. What remains"
            " is its axis tolerance (default then: 0.1).",
            check=values.lean,
            metavar="SENSOR=A,B",
            read=values.to_lean,
            show=lambda leans: {name: list(angles) for name, angles in leans.items()},
            text=lambda leans: [f"{n}={a!r},{b!r}" for n, (a, b) in leans.items()],
            repeated=True,
        ),
    ] = field(default_factory=dict)
    unit: Annotated[
        str | None,
        Option(
            "Unit of the motion, such as m/s², mm/s or µg. Spectra are in its square per Hz.",
            check=values.unit,
            metavar="UNIT",
        ),
    ] = None
    band: Annotated[
        tuple[float, float] | None,
        Option(
            "Band of interest in Hz, such as 1:20, for the table of results, the target c.o.v. and"
            " the effect of the clocks.",
            check=values.band,
            metavar="LOW:HIGH",
            read=values.to_band,
            show=list,
            text=lambda band: f"{band[0]!r}:{band[1]!r}",
        ),
    ] = None
    target_cov: Annotated[
        float | None,
        Option(
            "Target coefficient of variation of the noise in the worst third of an octave of the"
            " band, such as 0.05. With limits, how long a test takes is until they are decided.",
            check=values.cov,
            metavar="COV",
            read=values.to_number,
        ),
    ] = None
    target_cov_bin: Annotated[
        float | None,
        Option(
            "Target coefficient of variation of the noise at single frequencies of the band, in"
            " place of --target-cov.",
            check=values.cov,
            metavar="COV",
            read=values.to_number,
        ),
    ] = None


def _declared() -> Iterator[tuple[str, Option]]:
    for each in fields(EstimateSettings):
        option: Option = each.type.__metadata__[0]  # type: ignore[union-attr]  # all are Annotated
        name = each.name.replace("_", "-")
        flag = f"--{name}/--no-{name}" if option.is_switch else f"--{name}"
        yield each.name, replace(option, flags=option.flags or (flag,))


OPTIONS: Mapping[str, Option] = MappingProxyType(dict(_declared()))
"""Every option, by the name of its field."""


def table_keys() -> dict[str, str]:
    """Return the field of each key of the bench file's table."""
    return {option.key or name: name for name, option in OPTIONS.items()}


def to_table(settings: EstimateSettings) -> dict[str, object]:
    """Return what differs from the defaults, as a table of the bench file."""
    table: dict[str, object] = {}
    for each in fields(EstimateSettings):
        option, value = OPTIONS[each.name], getattr(settings, each.name)
        default = each.default if each.default_factory is MISSING else each.default_factory()
        if value != default:
            table[option.key or each.name] = option.show(value)
    return table


def from_text(name: str, text: str | Sequence[str]) -> object:
    """Return the value of an option from the text of the command line.

    Raises
    ------
    ValueError
        With what was expected.
    """
    option = OPTIONS[name]
    return option.check(option.read(text))


def default_text(name: str) -> str:
    """Return the default of an option as text; empty if it has none."""
    value = getattr(EstimateSettings(), name)
    option = OPTIONS[name]
    if option.is_switch or not value:
        return ""
    return format_duration(value) if option.metavar == "TIME" else str(option.show(value))
