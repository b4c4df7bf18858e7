"""Calibration results as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq.results.clock_effect import relative_time
from tui.output.calibration import channels_of
from tui.output.json_values import plain

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot
    from daq.results.calibration import Calibration
    from estimator.responses.calibration import SensorCalibration
    from estimator.responses.derived_quantities import Value


def calibration_document(found: Calibration, snapshot: Snapshot) -> dict[str, Any]:
    """Return a calibration as JSON (docs/json.md)."""
    names = snapshot.sensor_names
    curves = {each.sensor: each for each in found.curves}
    document = {
        "reference": names[found.reference],
        "is_absolute": bool(found.certificates),
        "certificates": [
            {
                "value": each.value,
                "expanded_uncertainty": each.expanded_uncertainty,
                "k": each.k,
                "date": None if each.date is None else each.date.isoformat(),
                "number": each.number,
            }
            for each in found.certificates
        ],
        "confidence": found.confidence,
        "refused": {names[sensor]: why for sensor, why in found.refused.items()},
        "sensors": [
            {
                "sensor": names[each.sensor],
                "channels": channels_of(snapshot, each.sensor),
                "band_hz": [each.low, each.high],
                "is_ambiguous": each.is_ambiguous,
                "excess": each.excess,
                "dof": each.dof,
                "relative_time": relative_time(
                    snapshot, names[each.sensor], names[found.reference]
                ),
                **{
                    key: {"value": value.value.tolist(), "standard_error": value.error.tolist()}
                    for key, value in _values(each).items()
                },
                "curve": {
                    "frequency_hz": curves[each.sensor].frequency.tolist(),
                    "real": curves[each.sensor].matrix.real.tolist(),
                    "imag": curves[each.sensor].matrix.imag.tolist(),
                    "standard_error": curves[each.sensor].error.tolist(),
                },
            }
            for each in found.sensors
        ],
        "budgets": [
            {
                "sensor": each.sensor,
                "channel": each.channel,
                "quantity": each.quantity,
                "is_absolute": each.is_absolute,
                "band_hz": [each.low, each.high],
                "value": each.value,
                "components": [
                    {
                        "source": part.source,
                        "type": part.kind,
                        "distribution": part.distribution,
                        "relative_standard_uncertainty": part.relative,
                        "degrees_of_freedom": part.dof,
                    }
                    for part in each.components
                ],
                "combined_relative": each.combined,
                "effective_degrees_of_freedom": each.dof,
                "k": each.k,
                "expanded_uncertainty": each.expanded,
            }
            for each in found.budgets
        ],
    }
    return {key: plain(value) for key, value in document.items()}


def _values(each: SensorCalibration) -> dict[str, Value]:
    return {
        "matrix": each.matrix,
        "gain": each.gain,
        "cross_axis": each.cross_axis,
        "rotation_deg": each.rotation_deg,
        "angle_deg": each.angle_deg,
        "orthogonality_deg": each.orthogonality_deg,
        "delay": each.delay,
        "skew": each.skew,
    }
