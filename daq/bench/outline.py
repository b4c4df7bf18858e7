"""What an estimate takes of the bench in a recording, without checking all of the bench.

The text was checked when it was written. To read it again as a `daq.bench.model.Bench` loads
pydantic and builds its checks, which takes as long as a short estimate: that is left to who needs
limits or data sheets.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from daq.bench.estimate_settings import OPTIONS, EstimateSettings, table_keys
from daq.bench.sensitivity import Sensitivities, known_sensitivities
from daq.bench.tables.toml_text import checked_table
from estimator.records import dataclass


@dataclass(frozen=True, slots=True)
class BenchOutline:
    """The bench of a recording in outline.

    Attributes
    ----------
    name : str
    estimate : EstimateSettings
    positions : dict
        In metres, x, y and z, by sensor; None where it is not given.
    speed : float
        How many times as fast as life the (simulated) bench ran.
    is_simulated : bool
        Whether its ports are those of simulated devices, as `Bench.runs_simulated`.
    has_limits : bool
        Whether the whole bench has limits to judge by.
    sensitivities : Sensitivities
        By names of sensor and channel.
    """

    name: str
    estimate: EstimateSettings
    positions: Mapping[str, tuple[float, float, float] | None]
    speed: float
    is_simulated: bool
    has_limits: bool
    sensitivities: Sensitivities

    @classmethod
    def of_text(cls, text: str, estimate: str = "") -> BenchOutline | None:
        """Return the outline of a recorded bench.

        Parameters
        ----------
        text : str
            TOML; empty where no bench was recorded.
        estimate : str
            Settings as JSON that take the place of those of the text.

        Returns
        -------
        BenchOutline or None
            None without a bench, and where a later or damaged text is not understood.
        """
        if not text:
            return None
        try:
            table = checked_table(text)
            simulation = table.get("simulation", {})
            settings = json.loads(estimate) if estimate else table.get("estimate", {})
            return cls(
                name=str(table["name"]),
                estimate=_settings(settings),
                positions={str(each["name"]): _position(each) for each in table["sensors"]},
                speed=float(simulation.get("speed", 1.0)),
                is_simulated=bool(simulation.get("clock"))
                or float(simulation.get("speed", 1.0)) != 1.0,
                has_limits=bool(table.get("limits")),
                sensitivities=known_sensitivities(table),
            )
        except (ValueError, KeyError, TypeError, AttributeError):
            return None


def _settings(table: Mapping[str, Any]) -> EstimateSettings:
    names = table_keys()
    return EstimateSettings(
        **{names[key]: OPTIONS[names[key]].check(value) for key, value in table.items()}  # type: ignore[arg-type]  # checked
    )


def _position(sensor: Mapping[str, Any]) -> tuple[float, float, float] | None:
    if sensor.get("position") is None:
        return None
    x, y, z = map(float, sensor["position"])
    return x, y, z
