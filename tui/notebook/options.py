"""Options of an estimate as keyword arguments: the keys of the bench file's ``[estimate]`` table.

`daq.bench.estimate_settings` declares and checks them; here they get types.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TypeAlias, TypedDict

import numpy as np

from daq.bench.durations import instant
from daq.bench.estimate_settings import OPTIONS, table_keys
from daq.errors import WrongSettingError
from daq.estimation.settings import Settings, with_changes

Time: TypeAlias = "str | float | datetime"
"""UTC, or a time after the start of the recording: seconds, or a text such as ``2h``."""


class EstimateOptions(TypedDict, total=False):
    """Options of an estimate; the documentation of `huddle.estimate` explains each."""

    method: str | Sequence[str]
    segment: str | float
    overlap: float
    window: str | tuple[str, float]
    detrend: str
    correct: bool
    clocks: str
    equalise: str
    reject: bool
    bridge: float
    exclude: Sequence[str]
    octaves: bool
    dimension: int | str
    gains: Mapping[str, float]
    sampling_rates: Mapping[str, float]
    axis_tolerance: float | Mapping[str, float]
    gain_steadiness: float
    linearise: bool
    shared_noise: Sequence[tuple[str, str]]
    lean: Mapping[str, tuple[float, float]]
    unit: str
    band: tuple[float, float]
    target_cov: float
    target_cov_bin: float


def settings_of(settings: Settings, options: Mapping[str, object]) -> Settings:
    """Return settings with options replaced.

    Raises
    ------
    WrongSettingError
        If an option is unknown, has a wrong value, or does not fit the others.
    """
    return with_changes(settings, changes_of(options), called=called)


def changes_of(options: Mapping[str, object]) -> dict[str, object]:
    """Return the values of options, checked, by the name of their fields.

    Raises
    ------
    WrongSettingError
        If an option is unknown, or has a wrong value.
    """
    names = table_keys()
    changes = {names[_known(key)]: value for key, value in options.items()}
    return {name: _checked(name, value) for name, value in changes.items() if value is not None}


def called(name: str) -> str:
    """Return the keyword of an option, by the name of its field."""
    return OPTIONS[name].key or name


def moment(key: str, value: Time | None, created: datetime) -> datetime | None:
    """Return a time given as an instant.

    Raises
    ------
    WrongSettingError
        With what was expected.
    """
    if isinstance(value, datetime):
        return value if value.tzinfo else value.replace(tzinfo=UTC)
    try:
        return None if value is None else instant(str(value), created)
    except ValueError as error:
        raise WrongSettingError(f"{key}={error}") from None


_SAMPLING_RATES = frozenset({"sampling_rate", "sample_rate", "sampling_frequency", "rate", "sr"})


def _known(key: str) -> str:
    known = table_keys()
    if key in known:
        return key
    close = difflib.get_close_matches(key, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    if key in {"start", "end"}:
        hint = " (of recordings: huddle.estimate has it; cut samples that are in memory)"
    if key in _SAMPLING_RATES:
        hint = " (the sampling rate of arrays is fs)"
    raise WrongSettingError(f"option {key!r}: expected one of {', '.join(known)}{hint}")


def _checked(name: str, value: object) -> object:
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    try:
        return OPTIONS[name].check(value)
    except ValueError as error:
        raise WrongSettingError(f"{called(name)}={value!r}: {error}") from None
