"""Settings of an estimate that follow from the responses, rates and lengths of foreign files."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.durations import format_duration
from daq.bench.estimate_settings import EstimateSettings
from daq.bench.units import is_motion, order_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.bench.channel import Channel
    from daq.bench.option_fit import SampledSensor
    from daq.bench.response import PolesZeros, Response

PERIODS = 10
"""Periods of the lower corner in a segment: the window of Hann resolves two."""
BINS = 4
"""Lowest frequency of the band in bins, beyond the leakage of the mean."""
SEGMENTS, SAMPLES = 20, 200
"""Least of a recording (without overlap), and least of a segment."""
_HALF_POWER, _ABOUT = 0.5, 1.02
_USED = 0.4
"""Of the sampling rate: above it digitizers filter."""
_LOWEST, _POINTS = 1e-4, 4001
_ACCELERATION = 2


def from_files(
    sensors: Sequence[SampledSensor], seconds: float
) -> tuple[EstimateSettings, dict[str, str]]:
    """Return the settings that fit sensors of foreign files, and the reason of each chosen one.

    Parameters
    ----------
    sensors : sequence of sensors
        With the responses and units of their channels.
    seconds : float
        Length of the shortest sensor.

    Returns
    -------
    EstimateSettings
        With `segment`, `unit` and `band`, where what was read decides them.
    dict of str to str
        By field: the value and why, for people.
    """
    channels = [each for sensor in sensors for each in sensor.channels if not each.auxiliary]
    rate = min(sensor.sampling_rate for sensor in sensors)
    found, reasons = EstimateSettings(), {}
    low, high = _pass_band(channels, rate)
    wanted = max(PERIODS / low if low else 0.0, SAMPLES / rate)
    segment = _rounded_down(min(wanted, seconds / SEGMENTS))
    if segment > found.segment:
        found = replace(found, segment=segment)
        why = f"lower corner {1 / low:.3g} s" if low else f"{rate:g} Hz"
        reasons["segment"] = f"segment {format_duration(segment)} ({why})"
    units = {each.unit for each in channels}
    if all(map(is_motion, units)) and (
        len(units) > 1 or any(order_of(unit) < _ACCELERATION for unit in units)
    ):
        found = replace(found, unit="m/s²")
        reasons["unit"] = f"unit m/s² (samples: {', '.join(sorted(units))})"
    band = (_digits(max(low or 0.0, BINS / found.segment)), _digits(high or 0.0))
    if band[0] < band[1]:
        found = replace(found, band=band)
        reasons["band"] = (
            f"band {band[0]:g}:{band[1]:g} Hz (response within 3 dB, rate {rate:g} Hz)"
        )
    return found, reasons


def still_chosen(
    reasons: Mapping[str, str], suggested: EstimateSettings, settings: EstimateSettings
) -> dict[str, str]:
    """Return the reasons of suggested fields that `settings` has kept."""
    return {
        name: text
        for name, text in reasons.items()
        if getattr(settings, name) == getattr(suggested, name)
    }


def _pass_band(channels: Sequence[Channel], rate: float) -> tuple[float | None, float | None]:
    """Return the band in Hz in which all responses are within 3 dB of their sensitivity.

    None as the lower end where they reach down to 0.1 mHz, and as the upper end where a channel
    has no response, or none that holds within the rate.
    """
    at = np.geomspace(_LOWEST, rate / 2, _POINTS)
    low, high = 0.0, _USED * rate
    for each in channels:
        if each.response is None:
            return None, None
        passes = _passes(each.response, at)
        middle = int(np.searchsorted(at, each.response.frequency))
        if middle >= len(at) or not passes[middle]:
            return None, None
        stops = at[~passes]
        low = max(low, float(stops[stops < at[middle]].max(initial=0.0)))
        high = min(high, float(stops[stops > at[middle]].min(initial=high)))
    return low or None, high if channels else None


def _passes(response: PolesZeros | Response, at: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    with np.errstate(all="ignore"):
        power = np.abs(response.at(at)) ** 2
        return np.asarray(power >= _HALF_POWER * (1 - 1e-9))


def _rounded_down(seconds: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, … that is not above, but for 2 % of a corner."""
    most = seconds * _ABOUT
    if most < 1:
        return 0.0
    decade = 10.0 ** math.floor(math.log10(most))
    return max(step * decade for step in (1, 2, 5) if step * decade <= most)


def _digits(value: float) -> float:
    return float(f"{value:.3g}")
