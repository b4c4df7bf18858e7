"""The diagnostics of a result as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq.results.sources import uncounted_events
from estimator.checks.shared_noise import MAX_CHANNELS
from estimator.self_noise.result import Flag
from tui.output.json_values import plain

if TYPE_CHECKING:
    from daq.clocks.clock_model import ClockState
    from daq.estimation.snapshot import Snapshot
    from daq.estimation.snapshot_diagnostics import (
        Diagnosis,
        Synchronisation,
    )
    from estimator.checks.stability import Stability


def diagnostics_document(snapshot: Snapshot) -> dict[str, Any]:
    """Return what the samples show of the test (docs/json.md)."""
    found = snapshot.diagnostics
    document: dict[str, Any] = {
        "start_utc_ns": snapshot.start_utc_ns,
        "elapsed_s": snapshot.elapsed,
        "is_closed": snapshot.closed,
        "excluded_segments": snapshot.n_dropped,
        "excluded_by_reason": snapshot.left_out,
        "bridged": snapshot.bridged,
        "octaves": snapshot.octaves,
        "flags": {flag.name: flag.value for flag in Flag},
        "refused": snapshot.refused,
        "sensors": snapshot.sensors,
        "clocks": [_clock(each) for each in snapshot.clocks],
        "events": uncounted_events(snapshot.clocks),
        "drift_s": snapshot.drift,
        "synchronisation": _synchronisation(found.synchronisation),
        "untested": found.untested,
    }
    if found.edge_leakage is not None:
        document["edge_leakage"] = found.edge_leakage
    if found.dimensions:
        document["dimensions"] = found.dimensions
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


def _clock(each: ClockState) -> dict[str, Any]:
    declared: dict[str, Any] = plain(each)
    return declared | {"shared_clock": each.shared_clock or None, "restarts": each.n_epochs - 1}


def _synchronisation(found: Synchronisation) -> dict[str, Any]:
    document: dict[str, Any] = {
        "residual_s": found.residual,
        "reference": found.reference or None,
    }
    if found.noise_bias is not None:
        document |= {"noise_bias_share": found.noise_bias, "removed_psd": found.removed}
    return document


def _diagnosis(found: Diagnosis, snapshot: Snapshot) -> dict[str, Any]:
    sensors = snapshot.sensor_names
    return {
        "tested_dimensions": found.n_factors,
        "bands": found.bands,
        "responses": found.responses,
        "shared_noise_searched": len(snapshot.channels) <= MAX_CHANNELS,
        "stability": None if found.stability is None else _stability(found.stability),
        "pairs": [(sensors[one], sensors[two]) for one, two in found.pairs],
        "per_frequency": found.per_frequency,
    }


def _stability(found: Stability) -> dict[str, Any]:
    return {
        "low_hz": found.low,
        "high_hz": found.high,
        "parts": found.parts,
        "runs": found.runs,
        "inflation": found.inflation,
        "segments": found.n_segments,
        "disturbed": found.disturbed,
        "excess_share": found.excess,
        "channel": found.channel,
    }
