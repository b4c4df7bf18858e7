"""Writes the results of an estimate into its recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from daq.estimation.snapshot import Snapshot
from daq.recording.reader import Recording
from daq.recording.repair import write_results
from daq.results.decision.verdict import TestVerdict
from estimator.decision.verdict import Verdict
from estimator.types import FloatArray


def store_results(
    path: str | Path,
    snapshot: Snapshot,
    verdict: TestVerdict | None = None,
    about: Mapping[str, str] | None = None,
) -> None:
    """Write the results of all methods to ``/results`` of a recording, in one pass.

    Earlier results are replaced. A crash leaves the recording with all results or with none. The
    verdict on the limits of the bench stands beside the result of every method. `about` becomes
    attributes of ``/results``.

    Raises
    ------
    RecordingError
        If a recorder is writing the file, or it cannot be written; it stays as it was.
    """
    stored = {} if verdict is None else {"verdict": verdict.verdict.value}
    results = {method: result_arrays(snapshot, method) for method in snapshot.results}
    write_results(
        path,
        {method: (arrays, own | stored) for method, (arrays, own) in results.items()},
        about,
    )


def stored_verdict(recording: Recording) -> tuple[bool, Verdict | None]:
    """Return whether a recording holds a result, and the verdict that was stored with it.

    The verdict is None where the bench had no limits, or an earlier version wrote the result.
    """
    attributes = recording.result_attributes()
    words = {str(each["verdict"]) for each in attributes.values() if "verdict" in each}
    known = [Verdict(word) for word in words if word in set(Verdict)]
    return bool(attributes), known[0] if len(known) == 1 else None


def result_arrays(snapshot: Snapshot, method: str) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """Return the arrays and attributes of ``/results/<method>``.

    Arrays are float64: ``frequency`` in Hz, shape (n_freqs,); PSD in unit**2/Hz and ``cov``, shape
    (n_freqs, n_channels).
    """
    noise = snapshot.results[method]
    arrays = {
        "frequency": snapshot.frequency,
        "data_psd": snapshot.data_psd,
        "noise_psd": noise.noise_psd,
        "noise_psd_low": noise.low,
        "noise_psd_high": noise.high,
        "cov": noise.cov,
    }
    attributes = {
        "segments": snapshot.n_segments,
        "effective_averages": snapshot.n_effective,
        "channels": [f"{label.sensor}.{label.channel}" for label in snapshot.channels],
        "unit": snapshot.unit,
    }
    return arrays, attributes
