"""The segments of recordings one by one, as far as they are kept."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.estimation.noise_estimates import responses
from estimator.checks.stability import SegmentCourse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation.equalisation import Equalisation
    from daq.estimation.noise_estimates import Channels
    from daq.estimation.segments.segment_pass import Pass
    from estimator.spectra.segment_spectra import SegmentSpectra


def keep_few(spectra: Sequence[SegmentSpectra | None]) -> None:
    """Keep no more segments of all recordings together than of a single one."""
    kept = [each for each in spectra if each is not None]
    every = max((single.every for single in kept), default=1)
    while len(kept) > 1:
        for single in kept:
            single.thin(every)
        if sum(map(len, kept)) <= max(kept[0].most, len(kept)):
            return
        every *= 2


def segment_course(
    passes: Sequence[Pass], channels: Channels, unit: str, equalisation: Equalisation
) -> SegmentCourse | None:
    """Return the segments of all recordings, or None where not all segments are kept.

    Times count from the start of the first recording. What the filters of `equalisation` do to the
    segments is taken out, as from the averages.
    """
    spectra, times, runs = [], [], []
    every = max((each.single.every for each in passes if each.single is not None), default=1)
    origin = passes[0].aligned.start_utc_ns
    for run, each in enumerate(passes):
        if each.single is None or each.n_bridged:
            return None
        some = slice(None, None, every // each.single.every)
        found, at = each.single.values()[some], each.kept_at[some]
        later = (each.aligned.start_utc_ns - origin) * 1e-9
        spectra.append(found)
        times.append(later + at / each.welch.sampling_rate)
        runs.append(np.full(len(found), run))
    first = passes[0]
    if first.single is None or not sum(map(len, spectra)):
        return None
    bins = first.single.bins
    response = responses(first.welch.frequencies[bins], channels, unit)
    filters = equalisation.response(first.welch.frequencies[bins])
    if filters is not None:
        response = response * filters
    response = np.where(response == 0, np.nan, response)  # as `scale` has it
    joined = spectra[0] if len(spectra) == 1 else np.concatenate(spectra)
    with np.errstate(invalid="ignore"):  # where a response is not known
        joined = np.divide(joined, response.astype(np.complex64), dtype=np.complex64)
    return SegmentCourse(
        spectra=joined,
        bins=bins,
        times=np.concatenate(times),
        runs=np.concatenate(runs),
    )
