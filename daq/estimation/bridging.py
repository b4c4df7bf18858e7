"""What segments with gaps do to the estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.estimation.snapshot import Bridged

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.estimation.segments.segment_pass import Pass
    from estimator.self_noise.result import SelfNoise


def bridged(passes: Sequence[Pass], results: Mapping[str, SelfNoise]) -> Bridged | None:
    """Return how many segments with gaps count, and what their windows bring in."""
    with_gaps = [(each, each.leakage) for each in passes if each.n_bridged]
    if not with_gaps or not results:
        return None
    noise = next(iter(results.values())).noise_psd
    counts = np.array([each.n_bridged for each, _ in with_gaps])
    leakages = [leakage for _, leakage in with_gaps if leakage is not None]
    total = sum(each.n_segments for each in passes)
    biases = np.array([each.bias(noise) for each in leakages])
    return Bridged(
        n_segments=int(counts.sum()),
        lost=float(np.average([each.lost for each in leakages], weights=counts)),
        leakage=np.einsum("r,rfc->fc", counts / total, biases),
    )


def widened(result: SelfNoise, found: Bridged | None) -> SelfNoise:
    """Return an estimate whose interval includes what segments with gaps bring in."""
    if found is None:
        return result
    psd = np.abs(result.noise_psd)
    too_high = np.clip(np.nan_to_num(found.leakage), 0.0, 1.0) * psd
    too_low = np.clip(np.nan_to_num(-found.leakage), 0.0, 1.0) * psd
    return replace(result, low=result.low - too_high, high=result.high + too_low)
