"""The options of an estimate, each declared once.

A field of `EstimateSettings` is a key of the bench file's ``[estimate]`` table, an option of every
command that estimates, and an attribute of the settings that the estimate reads. To add an option,
add a field here and use it in `daq.estimation`. This module imports nothing heavy, for
``huddle --help`` reads it.
"""

import difflib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from types import MappingProxyType
from typing import Annotated, Any, Literal, Protocol

from daq.bench.durations import format_duration, parse_duration

METHODS = ("two-channel", "three-channel", "three-sensor", "maximum-likelihood", "all")
CLOCKS = ("refined", "arrivals", "nominal")
EQUALISATIONS = ("auto", "known", "estimated", "off")
TRENDS = ("none", "constant", "linear")
WINDOWS = (
    "rectangular",
    "boxcar",
    "bartlett",
    "barthann",
    "blackman",
    "blackmanharris",
    "bohman",
    "cosine",
    "flattop",
    "hamming",
    "hann",
    "lanczos",
    "nuttall",
    "parzen",
    "taylor",
    "triang",
)
PARAMETRIC_WINDOWS = (
    "chebwin",
    "dpss",
    "exponential",
    "gaussian",
    "general_hamming",
    "kaiser",
    "tukey",
)
"""Of one parameter each, as in ``kaiser,8``."""
MIN_SEGMENT_SAMPLES = 4
"""Samples of a segment, for one frequency between 0 and half the sampling rate."""
_MAX_DIMENSION = 999


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
        Names on the command line; ``--yes/--no`` for a switch.
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
    check: Callable[[Any], object]
    flags: tuple[str, ...]
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


def _number(value: object) -> float:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    raise ValueError("expected a number")


def _to_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError("expected a number") from None


def _share(value: object) -> float:
    number = _number(value)
    if 0 <= number < 1:
        return number
    raise ValueError("expected a fraction from 0 to less than 1")


def _cov(value: object) -> float:
    number = _number(value)
    if 0 < number < 1:
        return number
    raise ValueError("expected a number between 0 and 1, such as 0.05")


def _yes_or_no(value: object) -> bool:
    if isinstance(value, bool):
        return value
    raise ValueError("expected true or false")


def one_of(value: object, known: Sequence[str]) -> str:
    """Return the value if it is one of the known names.

    Raises
    ------
    ValueError
        With the known names, and the closest one.
    """
    if isinstance(value, str) and value in known:
        return value
    close = difflib.get_close_matches(str(value).lower(), known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    raise ValueError(f"expected one of {', '.join(known)}{hint}")


def _methods(value: object) -> tuple[str, ...]:
    names = value if isinstance(value, (list, tuple)) and value else [value]
    return tuple(dict.fromkeys(one_of(name, METHODS) for name in names))


def _method_or_methods(value: tuple[str, ...]) -> object:
    return value[0] if len(value) == 1 else list(value)


def _clocks(value: object) -> str:
    return one_of(value, CLOCKS)


def _equalisation(value: object) -> str:
    return one_of(value, EQUALISATIONS)


def _trend(value: object) -> str:
    return one_of(value, TRENDS)


def _window(value: object) -> str:
    name, _, parameter = str(value).partition(",")
    if not isinstance(value, str) or name not in PARAMETRIC_WINDOWS:
        return one_of(value, WINDOWS)
    try:
        positive = 0 < float(parameter) < math.inf
    except ValueError:
        positive = False
    if not positive:
        raise ValueError(f"expected the window with a parameter above 0, such as {name},0.5")
    return value


def _unit(value: object) -> str:
    if isinstance(value, str) and value.strip():
        return value
    raise ValueError("expected a unit, such as m/s²")


def _band(value: object) -> tuple[float, float]:
    if isinstance(value, (list, tuple)) and len(value) == 2:
        low, high = map(_number, value)
        if 0 < low < high:
            return low, high
    raise ValueError("expected two increasing frequencies in Hz, such as 1 and 20")


def _to_band(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(":")]
    except ValueError:
        raise ValueError("expected two frequencies in Hz such as 1:20") from None


def _dimension(value: object) -> object:
    if value == "auto":
        return value
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MAX_DIMENSION:
        return value
    raise ValueError('expected "auto", or a number of dimensions such as 3')


def _to_dimension(text: str) -> object:
    return int(text) if text.isdecimal() and len(text) <= len(str(_MAX_DIMENSION)) else text


def _gains(value: object) -> dict[str, float]:
    if not isinstance(value, Mapping):
        raise ValueError('expected gains by sensor or channel, such as {B = 1.02, "C.X" = 0.99}')  # noqa: TRY004 - as other values
    for name, gain in value.items():
        if isinstance(gain, bool) or not isinstance(gain, (int, float)) or not gain:
            raise ValueError(f"expected a number other than 0, such as 1.02, for {name}")
    return {str(name): _number(gain) for name, gain in value.items()}


def _to_gains(texts: Sequence[str]) -> dict[str, float]:
    found: dict[str, float] = {}
    for text in texts:
        name, _, number = text.rpartition("=")
        if not name:
            raise ValueError("expected a sensor and a number as in B=1.02")
        if name in found:
            raise ValueError(f"{name} is given twice; expected it once")
        try:
            found[name] = float(number)
        except ValueError:
            raise ValueError("expected a sensor and a number as in B=1.02") from None
    return found


@dataclass(frozen=True, slots=True)
class EstimateSettings:
    """Settings of an estimate, with their defaults. `OPTIONS` explains each field."""

    methods: Annotated[
        tuple[str, ...],
        Option(
            "Method: two-channel, three-channel, three-sensor, maximum-likelihood; all: every"
            " method that applies; several: separated by commas.",
            check=_methods,
            flags=("--method", "-m"),
            metavar="METHOD",
            read=lambda text: text.split(","),
            show=_method_or_methods,
            text=",".join,
            key="method",
        ),
    ] = ("three-sensor",)
    segment: Annotated[
        float,
        Option(
            "Length of a segment, such as 10s or 2min. It sets the frequency resolution.",
            check=parse_duration,
            flags=("--segment",),
            metavar="TIME",
        ),
    ] = 10.0
    overlap: Annotated[
        float,
        Option(
            "Overlap between consecutive segments, as a fraction of their length.",
            check=_share,
            flags=("--overlap",),
            metavar="FRACTION",
            read=_to_number,
        ),
    ] = 0.5
    window: Annotated[
        str,
        Option(
            "Window of each segment: hann, blackman, rectangular, …; with a parameter: kaiser,8.",
            check=_window,
            flags=("--window",),
            metavar="NAME",
        ),
    ] = "hann"
    detrend: Annotated[
        Literal["none", "constant", "linear"],
        Option(
            "Trend removed from each segment: none, constant, linear.",
            check=_trend,
            flags=("--detrend",),
            metavar="TREND",
        ),
    ] = "constant"
    correct: Annotated[
        bool,
        Option(
            "Correct the bias of few averages.",
            check=_yes_or_no,
            flags=("--correction/--no-correction",),
        ),
    ] = True
    clocks: Annotated[
        Literal["refined", "arrivals", "nominal"],
        Option(
            "Time of samples: from arrival times, refined by the common motion (refined); from"
            " arrival times alone (arrivals); from the nominal rates (nominal).",
            check=_clocks,
            flags=("--clocks",),
            metavar="SOURCE",
        ),
    ] = "refined"
    equalise: Annotated[
        Literal["auto", "known", "estimated", "off"],
        Option(
            "Filter sensors before the window so that all have one response: by the poles and zeros"
            " of the bench file (known), by the responses that the averages show (estimated),"
            " where unequal responses matter (auto), or not at all (off).",
            check=_equalisation,
            flags=("--equalise",),
            metavar="MODE",
        ),
    ] = "auto"
    reject: Annotated[
        bool | None,
        Option(
            "Also exclude segments with transients. Clipped segments are excluded unless"
            " --no-reject is given; for segments with gaps see --bridge.",
            check=_yes_or_no,
            flags=("--reject/--no-reject",),
        ),
    ] = None
    bridge: Annotated[
        float,
        Option(
            "Use segments with gaps of up to this share of their length, by a window that is zero"
            " in them, where fewer than half of the segments have no gap; 0 excludes them always"
            " (default 0.6). Not with --octaves or --reject.",
            check=_share,
            flags=("--bridge",),
            metavar="SHARE",
            read=_to_number,
        ),
    ] = 0.6
    octaves: Annotated[
        bool,
        Option(
            "Estimate each octave with its own segment length: --segment in the top octave,"
            " doubled in each octave below.",
            check=_yes_or_no,
            flags=("--octaves/--no-octaves",),
        ),
    ] = False
    dimension: Annotated[
        int | Literal["auto"] | None,
        Option(
            "Dimensions of the common motion for maximum likelihood: a number, or auto for as many"
            " as the model test of each band requires; with four or more sensors by gradients of"
            " the motion where they explain it. Default: as many as a sensor has channels.",
            check=_dimension,
            flags=("--dimension",),
            metavar="N|auto",
            read=_to_dimension,
        ),
    ] = None
    gains: Annotated[
        Mapping[str, float],
        Option(
            "Response of a sensor (B=1.02) or a channel (B.X=1.02) relative to the others, for the"
            " two-channel method; may be repeated.",
            check=_gains,
            flags=("--gain",),
            metavar="SENSOR=G",
            read=_to_gains,
            show=dict,
            text=lambda gains: [f"{name}={gain!r}" for name, gain in gains.items()],
            repeated=True,
        ),
    ] = field(default_factory=dict)
    unit: Annotated[
        str | None,
        Option(
            "Unit of the motion, such as m/s², mm/s or µg. Spectra are in its square per Hz.",
            check=_unit,
            flags=("--unit",),
            metavar="UNIT",
        ),
    ] = None
    band: Annotated[
        tuple[float, float] | None,
        Option(
            "Band of interest in Hz, such as 1:20, for the table of results, the target c.o.v. and"
            " the effect of the clocks.",
            check=_band,
            flags=("--band",),
            metavar="LOW:HIGH",
            read=_to_band,
            show=list,
            text=lambda band: f"{band[0]!r}:{band[1]!r}",
        ),
    ] = None
    target_cov: Annotated[
        float | None,
        Option(
            "Target coefficient of variation of the noise in the band, such as 0.05.",
            check=_cov,
            flags=("--target-cov",),
            metavar="COV",
            read=_to_number,
        ),
    ] = None


def _declared() -> dict[str, Option]:
    return {each.name: each.type.__metadata__[0] for each in fields(EstimateSettings)}  # type: ignore[union-attr]  # all are Annotated


OPTIONS: Mapping[str, Option] = MappingProxyType(_declared())
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


def to_arguments(changes: Mapping[str, object]) -> list[str]:
    """Return settings, by field, as arguments of the command line; None means not given."""
    arguments: list[str] = []
    for name, value in changes.items():
        option = OPTIONS[name]
        flag = option.flags[0]
        if value is None:
            continue
        if option.is_switch:
            yes, _, no = flag.partition("/")
            arguments.append(yes if value else no)
        else:
            text = option.text(value)
            for each in text if isinstance(text, list) else [text]:
                arguments += [flag, each]
    return arguments


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


class _Channel(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def auxiliary(self) -> bool: ...


class _Sensor(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def sampling_rate(self) -> float: ...
    @property
    def channels(self) -> Sequence[_Channel]: ...


@dataclass(frozen=True, slots=True)
class Misfit:
    """An option that does not fit the sensors: its value, and what was expected."""

    name: str
    value: str
    expected: str


def misfits(settings: EstimateSettings, sensors: Sequence[_Sensor]) -> Iterator[Misfit]:
    """Yield the options that do not fit the sensors."""
    channels = [
        f"{sensor.name}.{channel.name}"
        for sensor in sensors
        for channel in sensor.channels
        if not channel.auxiliary
    ]
    rate = min(sensor.sampling_rate for sensor in sensors)
    if round(settings.segment * rate) < MIN_SEGMENT_SAMPLES:
        yield Misfit(
            "segment",
            format_duration(settings.segment),
            f"expected at least {format_duration(MIN_SEGMENT_SAMPLES / rate)},"
            f" {MIN_SEGMENT_SAMPLES} samples at {rate:g} Hz",
        )
    most = max_dimension(len(channels))
    by_factors = {"maximum-likelihood", "all"} & set(settings.methods)
    if by_factors and isinstance(settings.dimension, int) and settings.dimension > most:
        yield Misfit(
            "dimension",
            f"{settings.dimension}",
            f"expected at most {most}: {len(channels)} channels cannot separate more dimensions of"
            " motion from noise",
        )
    known = (*(sensor.name for sensor in sensors), *channels)
    for name, gain in settings.gains.items():
        try:
            one_of(name, known)
        except ValueError as error:
            yield Misfit("gains", f"{name}={gain:g}", str(error))


def max_dimension(n_channels: int) -> int:
    """Return the largest dimension q of motion that p channels identify: (p - q)² ≥ p."""
    return math.floor(n_channels - math.sqrt(n_channels) + 1e-12)


def shortest_duration(settings: EstimateSettings, sensors: Sequence[_Sensor]) -> tuple[int, float]:
    """Return the minimum number of segments of an estimate, and their duration in seconds.

    An estimate needs more averages than a sensor has channels.
    """
    fewest = 1 + max(sum(not c.auxiliary for c in sensor.channels) for sensor in sensors)
    return fewest, settings.segment * (1 + (fewest - 1) * (1 - settings.overlap))
