"""A finished estimate, or a calibration, as the JSON that ``--json`` writes.

docs/json.md describes it for people, ``tui/resources/result-2.schema.json`` for programs, and
`tui.output.documents` declares its keys.
"""

from __future__ import annotations

import json
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal, cast

from daq.bench.estimate_settings import table_keys
from daq.protocols.block import Quantity
from daq.results.clock_effect import relative_time
from daq.results.facts.fact import Fact, Finding
from daq.results.sources import Source, conditions, uncounted_events
from daq.results.uncertainty_budget import level_budget
from estimator.checks.advice import Advice, Rank
from estimator.checks.shared_noise import MAX_CHANNELS
from estimator.records import json_keys
from estimator.self_noise.result import Flag
from tui import __version__
from tui.output.calibration import channels_of
from tui.output.json_values import json_text, label_document, plain
from tui.output.noise_parameters import noise_parameters_document
from tui.wording.formatting import utc
from tui.wording.verdict_text import Decision

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.estimation.snapshot import Snapshot
    from daq.estimation.snapshot_diagnostics import Synchronisation
    from daq.results.calibration import Calibration
    from daq.results.noise_parameters import ChannelParameters
    from daq.results.result import Result
    from tui.output.documents import (
        BandMeanDocument,
        CalibrationDocument,
        CaveatsDocument,
        DiagnosticsDocument,
        EstimateDocument,
        FactDocument,
        FindingDocument,
        RecordingDocument,
        SynchronisationDocument,
        VerdictDocument,
    )


SCHEMA_VERSION = 2
"""Rises when a key is removed or changes its meaning; new keys do not change it."""


def result_document(snapshot: Snapshot, method: str) -> EstimateDocument:
    """Return one method's result as the JSON that ``--json`` writes."""
    noise = snapshot.results[method]
    data = snapshot.data_psd
    return {
        "method": method,
        "segments": snapshot.n_segments,
        "effective_averages": snapshot.n_effective,
        "frequency_hz": snapshot.frequency,
        "channels": [
            {
                **label_document(label),
                "data_psd": data[:, column],
                "noise_psd": noise.noise_psd[:, column],
                "noise_psd_low": noise.low[:, column],
                "noise_psd_high": noise.high[:, column],
                "cov": noise.cov[:, column],
                "flags": noise.flags[:, column],
            }
            for column, label in enumerate(snapshot.channels)
        ],
        "diagnostics": diagnostics_document(snapshot),
    }


def document(
    result: Result, noise_parameters: Sequence[ChannelParameters] | None = None
) -> dict[str, Any]:
    """Return the JSON of a result: of its one method, or of all of them under ``results``.

    Parameters
    ----------
    result : Result
        A finished estimate.
    noise_parameters : sequence of ChannelParameters or None
        Of every channel, where they were asked for.
    """
    snapshot, sources = result.snapshot, result.sources
    documents = [result_document(snapshot, method) for method in snapshot.results]
    whole = {
        "schema_version": SCHEMA_VERSION,
        "software": {"name": "huddle-bench", "version": __version__},
        "run_id": sources[-1].recording.run_id if sources else None,
        "recordings": [_recording(source) for source in sources],
        "settings": _settings(result),
    }
    whole |= documents[0] if len(documents) == 1 else {"results": documents}
    whole |= verdict_document(result)
    whole["facts"] = facts_document(result.all_facts)
    whole["band_means"] = _band_means(result)
    if noise_parameters is not None:
        whole["noise_parameters"] = noise_parameters_document(noise_parameters)
    return whole


def provenance(result: Result, *, with_recordings: bool = True) -> dict[str, str]:
    """Return what made an estimate and what is known of it, as texts for files of other programs.

    Checksums of recordings take as long as reading them.
    """
    snapshot = result.snapshot
    start_ns = snapshot.start_utc_ns
    recordings = [
        {"file": each.path.name, "run_id": each.recording.run_id, "sha256": each.sha256 or None}
        for each in (result.sources if with_recordings else ())
    ]
    return {
        "title": "Self-noise of sensors, from a huddle test",
        "source": f"huddle-bench {__version__}",
        "time_coverage_start": utc(start_ns, 9),
        "time_coverage_end": utc(start_ns + round(snapshot.elapsed * 1e9), 9),
        "history": f"estimated by huddle-bench {__version__}",
        "confidence_of_intervals": "0.95",
        "unit_of_densities": f"({snapshot.unit})²/Hz",
        "verdict": "none" if result.verdict is None else result.verdict.verdict.value,
        "facts": json_text(facts_document(result.all_facts)),
        **{key: str(holds).lower() for key, holds in snapshot.caveats.keys.items()},
        "flags": json.dumps({str(flag.name).lower(): int(flag) for flag in Flag}),
        "settings": json.dumps(_settings(result), ensure_ascii=False),
        "recordings": json.dumps(recordings, ensure_ascii=False),
    }


def _recording(source: Source) -> RecordingDocument:
    bench = source.recording.outline
    return {
        "file": source.path.name,
        "run_id": source.recording.run_id,
        "sha256": source.sha256 or None,
        "signed_by": source.signed_by or None,
        "bytes": source.n_bytes,
        "state": source.state,
        "software": source.recording.software,
        "operator": source.recording.operator or None,
        "location": source.recording.location or None,
        **cast("CaveatsDocument", source.recording.caveats.keys),
        "bench": None if bench is None else bench.name,
        "conditions": [
            {
                "sensor": each.sensor or None,
                "quantity": each.quantity,
                "unit": each.quantity.unit if isinstance(each.quantity, Quantity) else None,
                "lowest": each.lowest,
                "highest": each.highest,
                "readings": each.n_readings,
            }
            for each in conditions([source])
        ],
        "started": source.started.isoformat(),
        "last_block": source.last.isoformat(),
        "sensors": [
            {
                "name": sensor.name,
                "model": sensor.model or None,
                "serial_number": sensor.serial_number or None,
                "driver": sensor.driver or None,
                "sampling_rate_hz": sensor.sampling_rate,
                "temperature_c": sensor.temperature,
                "channels": [
                    {
                        "name": channel.name,
                        "unit": channel.unit,
                        "counts_per_unit": channel.sensitivity,
                        "direction": channel.direction,
                        "auxiliary": channel.auxiliary,
                    }
                    for channel in sensor.channels
                ],
            }
            for sensor in source.recording.sensors
        ],
    }


def _settings(result: Result) -> dict[str, Any]:
    """Return the options of the estimate under their names in the bench file."""
    snapshot = result.snapshot

    def value_of(name: str) -> object:
        value = getattr(result.settings, name)
        return value.isoformat() if isinstance(value, datetime) else plain(value)

    return {
        **{key: value_of(name) for key, name in table_keys().items()},
        "method": list(snapshot.results) or list(result.settings.methods),
        "unit": snapshot.unit,
        "start": value_of("start"),
        "end": value_of("end"),
        "sampling_rate_hz": 2 * float(snapshot.frequency[-1]),
    }


def _band_means(result: Result) -> list[BandMeanDocument]:
    """Return the mean noise of every channel in the band of the tables, by every method."""
    snapshot = result.snapshot
    if not snapshot.results:
        return []
    band, data = result.band, result.data.tolist()
    documents: list[BandMeanDocument] = []
    for method in snapshot.results:
        found, means = result.levels(method, band), result.means(method)
        for column, label in enumerate(snapshot.channels):
            mean, total = means[column], level_budget(found, column, label, band)
            documents.append(
                {
                    **label_document(label),
                    "method": method,
                    "low_hz": band[0],
                    "high_hz": band[1],
                    "data_psd": data[column],
                    "noise_psd": total.value,
                    "noise_psd_low": total.interval[0],
                    "noise_psd_high": total.interval[1],
                    "standard_uncertainty": total.standard,
                    "k": total.k,
                    "expanded_uncertainty": total.expanded,
                    "scatter_low": None if mean.scatter is None else float(mean.scatter[0][0]),
                    "scatter_high": None if mean.scatter is None else float(mean.scatter[1][0]),
                    "contributions": [
                        {"source": source, "below": float(below[0]), "above": float(above[0])}
                        for source, (below, above) in mean.parts.items()
                    ],
                }
            )
    return documents


def verdict_document(result: Result) -> VerdictDocument:
    """Return the verdict on the limits of the bench file; null where it has none."""
    found, decision = result.verdict, Decision.of(result)
    if found is None or decision is None:
        return {
            "decision": None,
            "verdict": None,
            "obstacles": [],
            "sensitivities": [],
            "record_for": None,
            "limits": [],
        }
    prediction = found.prediction if found.verdict == "not-decided" else None
    return {
        "decision": decision,
        "verdict": found.verdict,
        "obstacles": list(found.obstacles),
        "sensitivities": [
            {
                "sensor": each.sensors[0],
                "channel": name.removeprefix(f"{each.sensors[0]}."),
                "gain": gain,
                "error": error,
                "against": list(each.against),
                "cause": each.cause,
            }
            for each in found.sensitivities
            for name, gain, error in zip(
                each.channels, each.gains, each.standard_errors, strict=True
            )
        ],
        "record_for": None
        if prediction is None
        else plain(prediction)
        | {
            "slowest": {
                "channel": found.limits[prediction.slowest].name,
                "frequency_hz": prediction.frequency,
            },
        },
        "limits": [
            plain(each)
            | {
                "k": found.k,
                "margin_db": each.margin_db,
                "margin_low_db": each.margin_low_db,
                "margin_high_db": each.margin_high_db,
            }
            for each in found.limits
        ],
    }


def facts_document(facts: Sequence[Fact]) -> list[FactDocument]:
    """Return what is known of a test beyond its numbers, the worst first."""
    return [
        {
            "kind": each.name,
            "rank": each.rank,
            "sensors": list(each.sensors),
            "channels": list(each.channels),
            "band_hz": each.band,
            "time_utc_ns": each.time_utc_ns,
            "method": each.method or None,
            "numbers": _numbers(each),
            "line": each.words.line,
            "explanation": each.words.explanation,
            "action": each.words.action or None,
        }
        for each in facts
    ]


_LEVELS: Mapping[Rank, Literal["problem", "warning", "note"]] = {
    Rank.INVALIDATES: "problem",
    Rank.DELAYS: "warning",
    Rank.TO_KNOW: "note",
}
"""Ranks of findings in JSON."""


def _numbers(fact: Fact) -> dict[str, Any]:
    """Return the fields of a fact beyond those of all; findings with theirs."""
    if isinstance(fact, Finding):
        return {"findings": [_finding(each) for each in fact.findings]}
    return _beyond(Fact, fact)


def _beyond(base: type[Fact | Advice], found: Fact | Advice) -> dict[str, Any]:
    return {key: value for key, value in plain(found).items() if key not in json_keys(base)}


def _finding(advice: Advice) -> FindingDocument:
    return {
        "kind": advice.name,
        "level": _LEVELS[advice.rank],
        "sensors": list(advice.sensors),
        "band_hz": advice.band,
        "numbers": _beyond(Advice, advice),
    }


def calibration_document(found: Calibration, snapshot: Snapshot) -> CalibrationDocument:
    """Return a calibration as JSON (docs/json.md)."""
    names = snapshot.sensor_names
    curves = {each.sensor: each for each in found.curves}
    return {
        "reference": names[found.reference],
        "is_absolute": bool(found.certificates),
        "certificates": found.certificates,
        "confidence": found.confidence,
        "refused": {names[sensor]: why for sensor, why in found.refused.items()},
        "without_noise": [label.name for label in found.without_noise],
        "untested": list(found.untested),
        "sensors": [
            plain(each)
            | {
                "sensor": names[each.sensor],
                "channels": channels_of(snapshot, each.sensor),
                "band_hz": [each.low, each.high],
                "relative_time": relative_time(
                    snapshot, names[each.sensor], names[found.reference]
                ),
                "curve": {
                    "frequency_hz": curves[each.sensor].frequency,
                    "real": curves[each.sensor].matrix.real,
                    "imag": curves[each.sensor].matrix.imag,
                    "standard_error": curves[each.sensor].error,
                },
            }
            for each in found.sensors
        ],
        "budgets": found.budgets,
    }


def diagnostics_document(snapshot: Snapshot) -> DiagnosticsDocument:
    """Return what the samples show of the test (docs/json.md)."""
    found = snapshot.diagnostics
    document: DiagnosticsDocument = {
        "start_utc_ns": snapshot.start_utc_ns,
        "elapsed_s": snapshot.elapsed,
        "is_closed": snapshot.closed,
        "excluded_segments": snapshot.n_dropped,
        "excluded_by_reason": snapshot.left_out,
        "bridged": snapshot.bridged,
        "octaves": snapshot.octaves,
        "flags": {str(flag.name): flag.value for flag in Flag},
        "refused": snapshot.refused,
        "sensors": snapshot.sensors,
        "clocks": [
            plain(each) | {"shared_clock": each.shared_clock or None, "restarts": each.n_epochs - 1}
            for each in snapshot.clocks
        ],
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
        sensors, stability = snapshot.sensor_names, found.diagnosis.stability
        document |= {
            "tested_dimensions": found.diagnosis.n_factors,
            "bands": found.diagnosis.bands,
            "responses": found.diagnosis.responses,
            "shared_noise_searched": len(snapshot.channels) <= MAX_CHANNELS,
            "stability": None
            if stability is None
            else plain(stability) | {"inflation": stability.inflation},
            "pairs": [(sensors[one], sensors[two]) for one, two in found.diagnosis.pairs],
            "per_frequency": found.diagnosis.per_frequency,
        }
    names, counts = [label.name for label in snapshot.channels], found.counts
    if counts.clipped:
        document["clipped_share"] = {names[n]: share for n, share in counts.clipped.items()}
    if counts.repeated:
        document["repeated_share"] = {names[n]: share for n, share in counts.repeated.items()}
    if counts.wrapped:
        document["wraps_at_bits"] = {names[n]: one.bits for n, one in counts.wrapped.items()}
    if found.stood_still:
        document["stood_still_s"] = {names[n]: s for n, s in found.stood_still.items()}
    return document


def _synchronisation(found: Synchronisation) -> SynchronisationDocument:
    document: SynchronisationDocument = {
        "residual_s": found.residual,
        "reference": found.reference or None,
    }
    if found.noise_bias is not None:
        document |= {"noise_bias_share": found.noise_bias, "removed_psd": found.removed}
    return document
