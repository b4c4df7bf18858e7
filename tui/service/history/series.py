"""The noise of each channel from run to run, tied together by serial numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Any

from daq.caveats import NO_CAVEATS, Caveats
from daq.results.change_test import DECIBEL, NORMAL_95, Change, changes
from tui.service.records.run_state import RecordedNoise, utc_text

Found = tuple[str, datetime, RecordedNoise, Caveats]
"""Name of the bench, time at which the run was due, the noise that the run found, its caveats."""

SCATTER = 0.1
"""Standard deviation in dB from run to run that is no change."""
FALSE_ALARMS = 0.01
_OF_CHANNEL = (
    *("sensor", "channel", "model", "serial_number", "unit", "method", "low_hz", "high_hz"),
)


@dataclass(frozen=True, slots=True)
class NoiseSeries:
    """One channel of one sensor in one band.

    Attributes
    ----------
    noise : tuple of RecordedNoise
        By time; the last says what the channel is called now.
    runs : tuple of (str, datetime)
        Bench and due time of the run of each.
    changes : tuple of Change
        By positions in `usable`.
    usable : tuple of int
        Positions of the noise that has an interval above zero: only these are tested.
    caveats : Caveats
        Of all its runs: runs are compared with their like only.
    """

    noise: tuple[RecordedNoise, ...]
    runs: tuple[tuple[str, datetime], ...]
    changes: tuple[Change, ...]
    usable: tuple[int, ...]
    caveats: Caveats = NO_CAVEATS

    @property
    def last(self) -> RecordedNoise:
        """The latest noise."""
        return self.noise[-1]

    @property
    def name(self) -> str:
        """Sensor and channel."""
        return f"{self.last.sensor}.{self.last.channel}"

    @property
    def sensor(self) -> str:
        """Sensor and its serial number, for people."""
        name = f"{self.last.sensor} {self.last.serial_number}".strip()
        return self.caveats.after(name)

    def due_of(self, position: int) -> datetime:
        """Return when the run at a position in `usable` was due."""
        return self.runs[self.usable[position]][1]

    def document(self) -> dict[str, Any]:
        """Return the series as JSON (docs/service.md)."""
        return {
            **{name: getattr(self.last, name) for name in _OF_CHANNEL},
            **self.caveats.keys,
            "runs": [
                {
                    "bench": bench,
                    "due": utc_text(due),
                    **{name: getattr(noise, name) for name in ("psd", "low", "high")},
                }
                for (bench, due), noise in zip(self.runs, self.noise, strict=True)
            ],
            "changes": [
                {
                    "since": utc_text(self.due_of(change.first)),
                    "found": utc_text(self.due_of(change.found)),
                    "shift_db": change.shift / DECIBEL,
                    "shift_low_db": (change.shift - NORMAL_95 * change.deviation) / DECIBEL,
                    "shift_high_db": (change.shift + NORMAL_95 * change.deviation) / DECIBEL,
                    "before_psd": math.exp(change.before),
                    "after_psd": math.exp(change.after),
                }
                for change in self.changes
            ],
        }


def history(
    found: Iterable[Found],
    *,
    band: tuple[float, float] | None = None,
    scatter: float = SCATTER,
    false_alarms: float = FALSE_ALARMS,
) -> list[NoiseSeries]:
    """Return the history of every channel, and where its noise has changed.

    Parameters
    ----------
    found : iterable of (str, datetime, RecordedNoise, Caveats)
        Bench, due time, noise and caveats of runs, of any benches. What a copy of a folder
        repeats counts once.
    band : (float, float), optional
        In Hz; all bands that were kept, if not given.
    scatter : float
        Standard deviation in dB from run to run that is no change.
    false_alarms : float
        Probability that a history without any change, of all these channels together, ever has an
        alarm.
    """
    collected: dict[tuple[object, ...], list[Found]] = {}
    for each in sorted(dict.fromkeys(found), key=lambda each: each[1]):
        noise = each[2]
        if band is None or _same_band(noise, band):
            collected.setdefault((_key(each[0], noise), each[3]), []).append(each)
    return [
        _series(own, scatter * DECIBEL, false_alarms / len(collected))
        for _, own in sorted(collected.items(), key=lambda item: str(item[0]))
    ]


def bands_of(found: Iterable[Found]) -> list[tuple[float, float]]:
    """Return the bands of which there is noise, in Hz."""
    return sorted({_rounded(noise.low_hz, noise.high_hz) for _, _, noise, _ in found})


def _key(bench: str, noise: RecordedNoise) -> tuple[object, ...]:
    sensor = noise.serial_number or f"{bench}/{noise.sensor}"
    band = _rounded(noise.low_hz, noise.high_hz)
    return (sensor, noise.channel, noise.unit, noise.method, band)


@lru_cache(maxsize=1024)
def _rounded(low_hz: float, high_hz: float) -> tuple[float, float]:
    return float(f"{low_hz:.3g}"), float(f"{high_hz:.3g}")


def _same_band(noise: RecordedNoise, band: tuple[float, float]) -> bool:
    return all(
        math.isclose(own, wanted, rel_tol=0.01)
        for own, wanted in zip((noise.low_hz, noise.high_hz), band, strict=True)
    )


def _series(found: Sequence[Found], scatter: float, false_alarms: float) -> NoiseSeries:
    runs, noise = tuple(each[:2] for each in found), tuple(each[2] for each in found)
    usable = tuple(n for n, each in enumerate(noise) if 0 < each.low <= each.psd <= each.high)
    levels = [math.log(noise[n].psd) for n in usable]
    # A standard deviation of zero would be beyond any measurement.
    deviations = [max(1e-6, math.hypot(_deviation(noise[n]), scatter)) for n in usable]
    found_changes = tuple(changes(levels, deviations, false_alarms=false_alarms))
    return NoiseSeries(noise, runs, found_changes, usable, caveats=found[0][3])


def _deviation(noise: RecordedNoise) -> float:
    """Return the standard deviation of the logarithm: of the wider side of the interval."""
    wider = max(noise.high / noise.psd, noise.psd / noise.low)
    return math.log(wider) / NORMAL_95
