"""What a store of spectra holds: settings, length of a stretch, sensors.

Settings that shape spectra are the same for all of a store. Those that only shape the answer
(method, unit, band, gains, …) can change from one answer to the next.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

from daq.bench.estimate_settings import OPTIONS, EstimateSettings
from daq.bench.units import canonical
from daq.errors import WrongArchiveError, WrongSettingError
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings

FORMAT = "huddle-archive"
FORMAT_VERSION = 1
STRETCHES = {"hour": 3600, "day": 86400}
"""Seconds; stretches begin at whole hours or days of UTC."""
SHAPING = (
    *("segment", "overlap", "window", "detrend", "clocks", "reject"),
    *("octaves", "equalise", "bridge", "exclude"),
)
"""Settings that shape spectra."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of a store.

    Attributes
    ----------
    settings : Settings
        Without start, end and sampling rate.
    stretch : str
        A key of `STRETCHES`.
    sampling_rate : float
        Of the common grid, in Hz.
    sensors : tuple
        Name of each sensor, with name and unit of its channels.
    """

    settings: Settings
    stretch: str
    sampling_rate: float
    sensors: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]

    def __post_init__(self) -> None:
        if self.settings.octaves:
            raise WrongSettingError(
                "--octaves: an archive keeps segments of one length; give --no-octaves, and a"
                " longer --segment for low frequencies"
            )
        if self.settings.segment > self.stretch_s:
            raise WrongSettingError(
                f"--segment {self.settings.segment:g} s: expected no longer than a stretch of the"
                f" archive ({self.stretch_s} s); choose --stretch day or shorter segments"
            )

    @classmethod
    def of(cls, each: Pass, settings: Settings, stretch: str) -> Self:
        """Return the plan of a store that begins with this recording."""
        return cls(
            # Filters and windows that depend on a recording would make days differ.
            settings=replace(
                settings, start=None, end=None, sampling_rate=None, equalise="off", bridge=0.0
            ),
            stretch=stretch,
            sampling_rate=each.aligned.sampling_rate,
            sensors=described(each),
        )

    @property
    def stretch_s(self) -> int:
        """Length of a stretch in seconds."""
        return STRETCHES[self.stretch]

    @property
    def dims(self) -> tuple[int, ...]:
        """Number of channels of each sensor."""
        return tuple(len(channels) for _, channels in self.sensors)

    def check_fits(self, each: Pass) -> None:
        """Refuse a recording of other sensors.

        Raises
        ------
        WrongArchiveError
            With what is different.
        """
        found = described(each)
        if found == self.sensors and each.aligned.sampling_rate == self.sampling_rate:
            return
        raise WrongArchiveError(
            f"{each.recording.path}: {_text(found)} at {each.aligned.sampling_rate:g} Hz; the"
            f" archive has {_text(self.sensors)} at {self.sampling_rate:g} Hz. Use another --store"
        )

    def changed(self, wanted: Mapping[str, object], stretch: str | None) -> Settings:
        """Return the settings for an answer: options given over those of the store.

        Raises
        ------
        WrongArchiveError
            If an option would need other spectra than the store has.
        """
        given = {name: value for name, value in wanted.items() if value is not None}
        other = [
            f"{OPTIONS[name].flags[0]} {_shown(given[name])} (the archive:"
            f" {_shown(getattr(self.settings, name))})"
            for name in SHAPING
            if name in given and given[name] != getattr(self.settings, name)
        ]
        if stretch not in {None, self.stretch}:
            other.append(f"--stretch {stretch} (the archive: {self.stretch})")
        if other:
            raise WrongArchiveError(
                f"other settings than the archive's: {', '.join(other)}. Leave them out, or start"
                " an archive of its own with --store"
            )
        return replace(self.settings, **given)  # type: ignore[arg-type]  # of several types

    def noise_settings(self, settings: Settings) -> Settings:
        """Return what the noise of stretches and days depends on: one method, and one grid."""
        methods = settings.methods[:1] if settings.methods[:1] != ("all",) else ("auto",)
        return replace(
            settings,
            methods=methods,
            unit=canonical(settings.unit or self.sensors[0][1][0][1]),
            **{name: getattr(self.settings, name) for name in (*SHAPING, "band")},
            target_cov=None,
            target_cov_bin=None,
        )

    def to_json(self) -> str:
        """Return the plan as text."""
        document = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "stretch": self.stretch,
            "sampling_rate": self.sampling_rate,
            "sensors": [
                {"name": name, "channels": [{"name": c, "unit": unit} for c, unit in channels]}
                for name, channels in self.sensors
            ],
            "settings": settings_document(self.settings),
        }
        return json.dumps(document, ensure_ascii=False, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str, source: str) -> Self:
        """Return the plan that `to_json` wrote.

        Raises
        ------
        WrongArchiveError
            If the text is none, or of a newer format.
        """
        try:
            found: dict[str, Any] = json.loads(text)
            if found.get("format") != FORMAT:
                raise WrongArchiveError(f"{source}: not an archive of huddle")
            version = int(found["format_version"])
            if version > FORMAT_VERSION:
                raise WrongArchiveError(
                    f"{source}: format version {version} is newer than {FORMAT_VERSION}, which this"
                    " version of huddle reads; update huddle"
                )
            STRETCHES[found["stretch"]]
            return cls(
                settings=settings_from(found["settings"]),
                stretch=found["stretch"],
                sampling_rate=float(found["sampling_rate"]),
                sensors=tuple(
                    (
                        str(sensor["name"]),
                        tuple((str(c["name"]), str(c["unit"])) for c in sensor["channels"]),
                    )
                    for sensor in found["sensors"]
                ),
            )
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise WrongArchiveError(
                f"{source}: not the description of an archive ({error!r}); restore the file, or"
                " start another archive with --store"
            ) from error


def settings_document(settings: Settings) -> dict[str, object]:
    """Return settings as JSON has them."""
    values = ((each.name, getattr(settings, each.name)) for each in fields(EstimateSettings))
    return {name: OPTIONS[name].show(value) for name, value in values if value is not None}


def settings_from(document: Mapping[str, Any]) -> Settings:
    """Return the settings of a `settings_document`.

    Raises
    ------
    KeyError, ValueError
        A name or a value is none of a setting.
    """
    checked = {name: OPTIONS[name].check(value) for name, value in document.items()}
    return Settings(**checked)  # type: ignore[arg-type]  # checked, of several types


def described(each: Pass) -> tuple[tuple[str, tuple[tuple[str, str], ...]], ...]:
    """Return the sensors of a recording as `Plan.sensors` has them."""
    sensors: dict[str, list[tuple[str, str]]] = {}
    for sensor, channel in each.aligned.channels:
        sensors.setdefault(sensor, []).append((channel.name, channel.unit))
    return tuple((name, tuple(channels)) for name, channels in sensors.items())


def _shown(value: object) -> str:
    return (", ".join(value) or "none") if isinstance(value, tuple) else f"{value}"


def _text(sensors: tuple[tuple[str, tuple[tuple[str, str], ...]], ...]) -> str:
    return ", ".join(
        f"{name} ({', '.join(f'{channel} in {unit}' for channel, unit in channels)})"
        for name, channels in sensors
    )
