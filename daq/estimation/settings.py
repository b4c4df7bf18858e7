"""The settings of one estimate."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from daq.bench.estimate_settings import EstimateSettings

if TYPE_CHECKING:
    from datetime import datetime

    from daq.bench.model import Bench


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
    """

    start: datetime | None = None
    end: datetime | None = None
    sampling_rate: float | None = None

    @classmethod
    def of(cls, bench: Bench | None) -> Settings:
        """Return the settings of a bench file, or the defaults if there is none."""
        if bench is None:
            return cls()
        return cls(
            **{each.name: getattr(bench.estimate, each.name) for each in fields(EstimateSettings)}
        )
