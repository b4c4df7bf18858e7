"""Values of the options of an estimate: what is accepted, and how texts are read.

A check takes a value of the bench file and returns the value of the setting. What begins with
``to_`` takes the text of the command line and returns a value as of the bench file. Each raises
`ValueError` with what was expected.
"""

import difflib
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

from daq.bench.durations import stretch

METHODS = (
    *("auto", "two-channel", "three-channel", "three-sensor", "maximum-likelihood"),
    *("multi-part", "all"),
)
LEAST_SENSORS = {"auto": 1, "two-channel": 2, "multi-part": 2, "all": 2}
"""By method; the others need three."""
CLOCKS = ("refined", "arrivals", "nominal")
EQUALISATIONS = ("auto", "known", "estimated", "off")
TRENDS = ("none", "constant", "linear")
WINDOWS = (
    *("rectangular", "boxcar", "bartlett", "barthann", "blackman", "blackmanharris", "bohman"),
    *("cosine", "flattop", "hamming", "hann", "lanczos", "nuttall", "parzen", "taylor", "triang"),
)
PARAMETRIC_WINDOWS = (
    *("chebwin", "dpss", "exponential", "gaussian", "general_hamming", "kaiser", "tukey"),
)
"""Of one parameter each, as in ``kaiser,8``."""
_MAX_DIMENSION = 999
_LARGEST_ANGLE = 45.0


def number(value: object) -> float:
    """Return a finite number."""
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    raise ValueError("expected a number")


def to_number(text: str) -> float:
    """Return the number in a text."""
    try:
        return float(text)
    except ValueError:
        raise ValueError("expected a number") from None


def share(value: object) -> float:
    """Return a fraction from 0 to less than 1."""
    if 0 <= number(value) < 1:
        return number(value)
    raise ValueError("expected a fraction from 0 to less than 1")


def cov(value: object) -> float:
    """Return a number between 0 and 1."""
    if 0 < number(value) < 1:
        return number(value)
    raise ValueError("expected a number between 0 and 1, such as 0.05")


def not_negative(value: object) -> float:
    """Return a number from 0."""
    if number(value) >= 0:
        return number(value)
    raise ValueError("expected a number from 0")


def yes_or_no(value: object) -> bool:
    """Return true or false."""
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
    raise ValueError(expected_of(str(value).lower(), known))


def expected_of(value: str, known: Sequence[str]) -> str:
    """Return the known words as an expectation, with the closest one."""
    close = difflib.get_close_matches(value, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return f"expected one of {', '.join(known) or '(none)'}{hint}"


def methods(value: object) -> tuple[str, ...]:
    """Return names of methods, each once."""
    names = value if isinstance(value, (list, tuple)) and value else [value]
    return tuple(dict.fromkeys(one_of(name, METHODS) for name in names))


def method_or_methods(value: tuple[str, ...]) -> object:
    """Return one name, or a list of several."""
    return value[0] if len(value) == 1 else list(value)


def window(value: object) -> str:
    """Return the name of a window, with its parameter; also of a tuple, as scipy takes it."""
    if isinstance(value, (list, tuple)) and len(value) == 2 and isinstance(value[0], str):
        value = f"{value[0]},{float(value[1])!r}" if isinstance(value[1], (int, float)) else value
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


def unit(value: object) -> str:
    """Return a unit."""
    if isinstance(value, str) and value.strip():
        return value
    raise ValueError("expected a unit, such as m/s²")


def band(value: object) -> tuple[float, float]:
    """Return two increasing frequencies in Hz."""
    if isinstance(value, (list, tuple)) and len(value) == 2:
        low, high = map(number, value)
        if 0 < low < high:
            return low, high
    raise ValueError("expected two increasing frequencies in Hz, such as 1 and 20")


def to_band(text: str) -> list[float]:
    """Return the frequencies in a text."""
    try:
        return [float(part) for part in text.split(":")]
    except ValueError:
        raise ValueError("expected two frequencies in Hz such as 1:20") from None


def dimension(value: object) -> object:
    """Return a number of dimensions, or auto."""
    if value == "auto":
        return value
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MAX_DIMENSION:
        return value
    raise ValueError('expected "auto", or a number of dimensions such as 3')


def to_dimension(text: str) -> object:
    """Return the number of dimensions in a text."""
    return int(text) if text.isdecimal() and len(text) <= len(str(_MAX_DIMENSION)) else text


def gains(value: object) -> dict[str, float]:
    """Return gains by sensor or channel."""
    if not isinstance(value, Mapping):
        raise ValueError('expected gains by sensor or channel, such as {B = 1.02, "C.X" = 0.99}')  # noqa: TRY004 - as other values
    for name, gain in value.items():
        if isinstance(gain, bool) or not isinstance(gain, (int, float)) or not gain:
            raise ValueError(f"expected a number other than 0, such as 1.02, for {name}")
    return {str(name): number(gain) for name, gain in value.items()}


def sampling_rates(value: object) -> dict[str, float]:
    """Return sampling rates in Hz by sensor."""
    if not isinstance(value, Mapping) or not all(number(rate) > 0 for rate in value.values()):
        raise ValueError("expected rates above 0 Hz by sensor, such as {B = 100.9}")
    return {str(name): number(rate) for name, rate in value.items()}


def pairs(value: object) -> tuple[tuple[str, str], ...]:
    """Return pairs of sensors."""
    given = value if isinstance(value, (list, tuple)) else [value]
    found = [tuple(map(str, each)) for each in given if isinstance(each, (list, tuple))]
    if len(found) < len(given) or any(len(set(each)) != 2 for each in found):
        raise ValueError('expected pairs of sensors, such as [["A", "B"]] or A:B')
    return tuple((each[0], each[1]) for each in found)


def stretches(value: object) -> tuple[str, ...]:
    """Return stretches of time, as they are given."""
    given = value if isinstance(value, (list, tuple)) else [value]
    for each in given:
        stretch(str(each), datetime.fromtimestamp(0, UTC))
    return tuple(map(str, given))


def to_gains(texts: Sequence[str]) -> dict[str, float]:
    """Return the gains in texts such as B=1.02."""
    found = _by_name(texts, 1, "expected a sensor and a number as in B=1.02")
    return {name: gain for name, (gain,) in found.items()}


def axis_tolerance(value: object) -> dict[str, float]:
    """Return angles in degrees by sensor; the empty name is for all others."""
    given = value if isinstance(value, Mapping) else {"": value}
    for angle in given.values():
        if not 0 <= number(angle) <= _LARGEST_ANGLE:
            raise ValueError("expected an angle from 0 to 45 degrees, or angles by sensor")
    return {str(name): number(angle) for name, angle in given.items()}


def to_axis_tolerance(texts: Sequence[str]) -> dict[str, float]:
    """Return the angles in texts such as 0.2 or A=0.2."""
    found = to_gains([text if "=" in text else f"*={text}" for text in texts])
    return {"" if name == "*" else name: angle for name, angle in found.items()}


def lean(value: object) -> dict[str, tuple[float, float]]:
    """Return two angles in degrees by sensor."""
    found = {}
    for name, angles in value.items() if isinstance(value, Mapping) else ((None, None),):
        if not isinstance(angles, (list, tuple)) or len(angles) != 2:
            raise ValueError("expected two angles by sensor, such as {B = [0.3, -0.1]}")
        first, second = map(number, angles)
        if max(abs(first), abs(second)) > _LARGEST_ANGLE:
            raise ValueError("expected angles from -45 to 45 degrees")
        found[str(name)] = (first, second)
    return found


def to_lean(texts: Sequence[str]) -> dict[str, list[float]]:
    """Return the angles in texts such as B=0.3,-0.1."""
    return _by_name(texts, 2, "expected a sensor and two angles as in B=0.3,-0.1")


def _by_name(texts: Sequence[str], n: int, expected: str) -> dict[str, list[float]]:
    """Return the `n` numbers of each name, of texts such as B=0.3,-0.1."""
    found: dict[str, list[float]] = {}
    for text in texts:
        name, _, numbers = text.rpartition("=")
        if name in found:
            raise ValueError(f"{name} is given twice; expected it once")
        try:
            found[name] = [float(each) for each in numbers.split(",")]
        except ValueError:
            raise ValueError(expected) from None
        if not name or len(found[name]) != n:
            raise ValueError(expected)
    return found


def number_or_table(angles: Mapping[str, float]) -> object:
    """Return one angle if it is that of all sensors, or angles by sensor."""
    return angles[""] if set(angles) == {""} else dict(angles)
