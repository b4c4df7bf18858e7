"""The settings of one estimate."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.durations import stretch
from daq.bench.estimate_settings import EstimateSettings
from daq.bench.option_fit import misfits
from daq.errors import WrongSettingError
from estimator.errors import EstimatorError
from estimator.levels.contributions import across
from estimator.likelihood.dimension import has_room
from estimator.records import dataclass
from estimator.spectra.windows import get_window

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from datetime import datetime

    from daq.bench.model import Bench, Sensor
    from daq.bench.outline import BenchOutline
    from daq.recording.interface import ReadableSensor

_LONG_WINDOW = 4096  # samples, in which every window with a parameter that has one is possible
DIMENSIONS = 3
"""Of the motion of a floor."""
AXIS_TOLERANCE, OF_KNOWN_LEAN = 1.0, 0.1
"""Degrees, rms, if nothing else is given: of any lean, and of what remains of a known one."""
NEEDED = {
    "dimension": "maximum-likelihood",
    "gains": "two-channel",
    "shared_noise": "multi-part",
}
"""Options that are for one method."""


@dataclass(frozen=True, slots=True)
class Settings(EstimateSettings):
    """What is estimated, and how.

    The options of a bench file and of the command line are fields of
    `daq.bench.estimate_settings.EstimateSettings`.

    Attributes
    ----------
    start, end : datetime or None
        Only what lies between is estimated; with time zone.
    sampling_rate : float or None
        Of the common grid in Hz; the lowest of the sensors', if not given.
    calibrates : bool
        Whether gains are wanted: all segments then tell what may bend channels, which takes about
        as long as the rest.
    """

    start: datetime | None = None
    end: datetime | None = None
    sampling_rate: float | None = None
    calibrates: bool = False

    def at(self, created: datetime) -> Settings:
        """Return settings that exclude instants, of a recording that began at `created`."""
        stretches = (stretch(each, created) for each in self.exclude)
        instants = tuple(f"{begin.isoformat()}/{end.isoformat()}" for begin, end in stretches)
        return replace(self, exclude=instants)

    def for_sensors(self, dims: tuple[int, ...]) -> Settings:
        """Return settings with a method in place of ``auto``, by the channels of each sensor.

        Maximum likelihood needs room for more dimensions than a sensor has channels. Two sensors,
        and those that share noise, take motion that changes; no method gives the noise of one.
        """
        if "auto" not in self.methods:
            return self
        if len(dims) < 3 or self.shared_noise:
            return replace(self, methods=("multi-part",) if len(dims) > 1 else ())
        roomy = has_room(dims)
        chosen = "maximum-likelihood" if roomy else "three-sensor"
        methods = (chosen if name == "auto" else name for name in self.methods)
        dimension = "auto" if roomy and self.dimension is None else self.dimension
        return replace(self, methods=tuple(dict.fromkeys(methods)), dimension=dimension)

    def axis_tolerances(self, sensors: Sequence[str], dims: tuple[int, ...]) -> tuple[float, ...]:
        """Return the angle by which axes of each sensor may be off, rms, in radians.

        Beyond a known lean. Zero for sensors whose partners sense all three dimensions of motion.
        """
        found = []
        for name, seen in zip(sensors, _seen(dims), strict=True):
            usual = OF_KNOWN_LEAN if name in self.lean else AXIS_TOLERANCE
            angle = self.axis_tolerance.get(name, self.axis_tolerance.get("", usual))
            found.append(0.0 if seen else math.radians(angle))
        return tuple(found)

    def across_axes(self, sensors: Sequence[str], dims: tuple[int, ...]) -> tuple[float, ...]:
        """Return the share of the motion's PSD by which the noise of each sensor may be off."""
        leans = np.radians([self.lean.get(name, (0.0, 0.0)) for name in sensors])
        tolerances = np.array(self.axis_tolerances(sensors, dims))
        share = across(tolerances, leans if self.lean else None)
        return tuple(np.where(_seen(dims), 0.0, share).tolist())

    @classmethod
    def of(cls, bench: Bench | BenchOutline | None) -> Settings:
        """Return the settings of a bench file, or the defaults if there is none.

        A test with limits lasts until they are decided: its bench file sets no other target.
        """
        if bench is None:
            return cls()
        found = cls(
            **{each.name: getattr(bench.estimate, each.name) for each in fields(EstimateSettings)}
        )
        return replace(found, target_cov=None, target_cov_bin=None) if bench.has_limits else found


def _seen(dims: tuple[int, ...]) -> list[bool]:
    """Return of which sensors the partners sense all dimensions of motion."""
    others = (sorted((*dims[:n], *dims[n + 1 :]), reverse=True)[:2] for n in range(len(dims)))
    return [min(each, default=DIMENSIONS) >= DIMENSIONS for each in others]


class ConflictingOptionError(WrongSettingError):
    """An option does not fit the others, or the sensors; `option` is the name of its field."""

    def __init__(self, message: str, option: str) -> None:
        super().__init__(message)
        self.option = option


def with_changes(
    settings: Settings, changes: Mapping[str, object], *, called: Callable[[str], str]
) -> Settings:
    """Return settings with options replaced.

    A dimension, gains or shared noise without a method ask for the method that takes them.

    Parameters
    ----------
    settings : Settings
    changes : mapping of str to object
        Checked values by field of `EstimateSettings`; None where an option is not given.
    called : callable
        Returns what a user calls an option.

    Raises
    ------
    ConflictingOptionError
        If options contradict each other.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    settings = replace(settings, **given)  # type: ignore[arg-type]  # of several types
    try:
        get_window(settings.window, _LONG_WINDOW)
    except EstimatorError as error:
        raise ConflictingOptionError(str(error), "window") from None
    for name, needed in NEEDED.items():
        if name not in given or {needed, "all"} & set(settings.methods):
            continue
        if "methods" in given:
            raise ConflictingOptionError(
                f"{called(name)} is for the {needed} method, not for {', '.join(settings.methods)}",
                name,
            )
        settings = replace(settings, methods=(needed,))
    return settings


def check_fit(
    settings: Settings,
    sensors: Sequence[Sensor | ReadableSensor],
    *,
    called: Callable[[str], str],
) -> None:
    """Refuse options that do not fit the sensors.

    Parameters
    ----------
    settings : Settings
    sensors : sequence of sensors
    called : callable
        Returns what a user calls an option.

    Raises
    ------
    ConflictingOptionError
        With what would fit.
    """
    if not any(not channel.auxiliary for sensor in sensors for channel in sensor.channels):
        return  # that is refused with the file's name
    for misfit in misfits(settings, sensors):
        raise ConflictingOptionError(
            f"{called(misfit.name)} {misfit.value}: {misfit.expected}", misfit.name
        )
