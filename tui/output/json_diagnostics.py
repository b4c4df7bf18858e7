"""The diagnostics of a result as JSON: each key by hand, with its unit in its name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq.results.sources import uncounted_events
from estimator.checks.shared_noise import MAX_CHANNELS
from estimator.self_noise.result import Flag

if TYPE_CHECKING:
    from daq.clocks.clock_model import ClockSetting, ClockState
    from daq.estimation.snapshot import Octave, SensorTotals, Snapshot
    from daq.estimation.snapshot_diagnostics import (
        Diagnosis,
        EdgeLeakage,
        FrequencyDiagnosis,
        Synchronisation,
    )
    from daq.protocols.block import Uncounted
    from estimator.checks.band import BandDiagnosis
    from estimator.checks.relative_response import RelativeResponse
    from estimator.checks.stability import Scatter, Stability
    from estimator.likelihood.dimension import BandDimension
    from estimator.likelihood.goodness_of_fit import BandTest


def diagnostics_document(snapshot: Snapshot) -> dict[str, Any]:
    """Return what the samples show of the test (docs/json.md)."""
    found = snapshot.diagnostics
    bridged = snapshot.bridged
    document: dict[str, Any] = {
        "start_utc_ns": snapshot.start_utc_ns,
        "elapsed_s": snapshot.elapsed,
        "is_closed": snapshot.closed,
        "excluded_segments": snapshot.n_dropped,
        "excluded_by_reason": snapshot.left_out,
        "bridged": None
        if bridged is None
        else {
            "segments": bridged.n_segments,
            "lost_share": bridged.lost,
            "leakage_share": bridged.leakage,
        },
        "octaves": [_octave(each) for each in snapshot.octaves],
        "flags": {flag.name: flag.value for flag in Flag},
        "refused": snapshot.refused,
        "sensors": [_sensor(each) for each in snapshot.sensors],
        "clocks": [_clock(each) for each in snapshot.clocks],
        "events": [
            {
                "utc_ns": each.utc_ns,
                "sensor": each.sensor,
                "kind": each.kind,
                "text": each.text,
            }
            for each in uncounted_events(snapshot.clocks)
        ],
        "drift_s": snapshot.drift,
        "synchronisation": _synchronisation(found.synchronisation),
        "untested": found.untested,
    }
    if found.edge_leakage is not None:
        document["edge_leakage"] = _edge_leakage(found.edge_leakage)
    if found.dimensions:
        document["dimensions"] = [dimension_document(each) for each in found.dimensions]
    if found.diagnosis is not None:
        document |= _diagnosis(found.diagnosis, snapshot)
    for key, by_column in (
        ("clipped_share", found.counts.clipped),
        ("repeated_share", found.counts.repeated),
        ("wraps_at_bits", {n: one.bits for n, one in found.counts.wrapped.items()}),
        ("stood_still_s", found.stood_still),
    ):
        if by_column:
            document[key] = {snapshot.channels[n].name: value for n, value in by_column.items()}
    return document


def _octave(each: Octave) -> dict[str, Any]:
    return {
        "low_hz": each.low,
        "high_hz": each.high,
        "segment_s": each.segment,
        "segments": each.n_segments,
        "effective_averages": each.n_effective,
        "excluded_by_reason": each.left_out,
    }


def _sensor(each: SensorTotals) -> dict[str, Any]:
    return {
        "name": each.name,
        "sampling_rate_hz": each.sampling_rate,
        "samples": each.n_samples,
        "gaps": each.n_gaps,
        "missing_samples": each.n_missing,
        "damaged_blocks": each.n_damaged,
        "began_utc_s": each.began,
        "last_seen_utc_s": each.last_seen,
        "is_lost": each.is_lost,
    }


def _clock(each: ClockState) -> dict[str, Any]:
    return {
        "sensor": each.sensor,
        "source": each.source,
        "shared_clock": each.shared_clock or None,
        "offset_source": each.offset_source,
        "offset_s": each.offset,
        "rate_ppm": each.ppm,
        "rate_std_ppm": each.ppm_std,
        "wander_ppm": each.wander_ppm,
        "residual_s": each.residual,
        "restarts": each.n_epochs - 1,
        "is_refined": each.refined,
        "corrected_s": each.corrected,
        "drifts": each.drifts,
        "is_unchecked": each.unchecked,
        "is_understood": each.is_understood,
        "slips": [slip_document(slip) for slip in each.slips],
        "settings": [setting_document(one) for one in each.settings],
    }


def slip_document(slip: Uncounted) -> dict[str, Any]:
    """Return samples that were lost without being counted as JSON."""
    return {"utc_ns": slip.utc_ns, "within_s": slip.within, "samples": slip.n_samples}


def setting_document(setting: ClockSetting) -> dict[str, Any]:
    """Return a step of stated UTC as JSON."""
    return {"utc_ns": setting.utc_ns, "step_s": setting.step}


def _synchronisation(found: Synchronisation) -> dict[str, Any]:
    document: dict[str, Any] = {
        "residual_s": found.residual,
        "reference": found.reference or None,
    }
    if found.noise_bias is not None:
        document |= {"noise_bias_share": found.noise_bias, "removed_psd": found.removed}
    return document


def _edge_leakage(found: EdgeLeakage) -> dict[str, Any]:
    return {
        "left_psd": found.left,
        "without_equalisation_psd": found.whole,
        "unseen_psd": found.unseen,
        "left_share": found.share,
        "without_equalisation_share": found.whole_share,
        "sources": found.sources,
        "unproven": found.unproven,
    }


def dimension_document(each: BandDimension) -> dict[str, Any]:
    """Return the dimensions of the motion in a band as JSON."""
    return {
        "low_hz": each.low,
        "high_hz": each.high,
        "dimensions": each.n_factors,
        "usual_dimensions": each.usual,
        "is_accepted": each.accepted,
        "test": _test(each.test),
        "tried": [_test(test) for test in each.tried],
        "cov": each.cov,
        "usual_cov": each.usual_cov,
        "sensors": each.n_sensors,
        "are_gradients": each.gradients,
    }


def _test(test: BandTest) -> dict[str, Any]:
    return {
        "statistic": test.statistic,
        "degrees": test.degrees,
        "p_value": test.p_value,
        "frequencies": test.n_frequencies,
        "spread": test.spread,
    }


def _diagnosis(found: Diagnosis, snapshot: Snapshot) -> dict[str, Any]:
    sensors = snapshot.sensor_names
    return {
        "tested_dimensions": found.n_factors,
        "bands": [_band(each) for each in found.bands],
        "responses": [_response(each) for each in found.responses],
        "shared_noise_searched": len(snapshot.channels) <= MAX_CHANNELS,
        "stability": None if found.stability is None else _stability(found.stability),
        "pairs": [(sensors[one], sensors[two]) for one, two in found.pairs],
        "per_frequency": _per_frequency(found.per_frequency),
    }


def _band(each: BandDiagnosis) -> dict[str, Any]:
    return {
        "low_hz": each.low,
        "high_hz": each.high,
        "coherence": each.coherence,
        "condition": each.condition,
        "dimension": each.dimension,
        "snr": each.snr,
        "noise_lost": each.noise_lost,
        "test": _test(each.test),
        "shared": each.shared,
        "frequencies": each.n_frequencies,
    }


def _response(each: RelativeResponse) -> dict[str, Any]:
    return {
        "first": each.first,
        "second": each.second,
        "low_hz": each.low,
        "high_hz": each.high,
        "matrix": each.matrix,
        "rotation": each.rotation,
        "rotation_deg": each.rotation_deg,
        "rotation_error_deg": each.rotation_error_deg,
        "horizontal_deg": each.horizontal_deg,
        "angle_error_deg": each.angle_error_deg,
        "gains": each.gains,
        "gain_errors": each.gain_errors,
        "nonorthogonality_deg": each.nonorthogonality_deg,
        "nonorthogonality_error_deg": each.nonorthogonality_error_deg,
        "reversed_channels": each.reversed_channels,
        "delay_s": each.delay,
        "delay_error_s": each.delay_error,
        "is_ambiguous": each.is_ambiguous,
        "coherence": each.coherence,
    }


def _stability(found: Stability) -> dict[str, Any]:
    return {
        "low_hz": found.low,
        "high_hz": found.high,
        "parts": _scatter(found.parts),
        "runs": None if found.runs is None else _scatter(found.runs),
        "inflation": found.inflation,
        "segments": found.n_segments,
        "disturbed": found.disturbed,
        "excess_share": found.excess,
        "channel": found.channel,
    }


def _scatter(found: Scatter) -> dict[str, Any]:
    return {
        "parts": found.n_parts,
        "deviation_share": found.deviation,
        "expected_share": found.expected,
    }


def _per_frequency(found: FrequencyDiagnosis) -> dict[str, Any]:
    return {
        "coherence": found.coherence,
        "condition": found.condition,
        "dimension": found.dimension,
        "snr": found.snr,
        "statistic": found.statistic,
        "degrees": found.degrees,
        "p_value": found.p_value,
    }
