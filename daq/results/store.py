"""Writes the results of an estimate into its recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daq.recording.repair import write_results

if TYPE_CHECKING:
    from pathlib import Path

    from daq.estimation.snapshot import Snapshot
    from estimator.self_noise.band_means import FloatArray


def store_results(path: str | Path, snapshot: Snapshot) -> None:
    """Write the results of all methods to ``/results`` of a recording, in one pass.

    Earlier results are replaced. A crash leaves the recording with all results or with none.

    Raises
    ------
    RecordingError
        If a recorder is writing the file, or it cannot be written; it stays as it was.
    """
    write_results(path, {method: result_arrays(snapshot, method) for method in snapshot.results})


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
