"""Segments in which some channels have no samples: sums for each set of channels that have.

A matrix of averages whose elements rest on different segments is that of no motion: where motion
changes, common motion no longer cancels. So every set of channels has averages of its own, each
channel's noise is estimated in every set that holds it, and the estimates are combined
(`estimator.self_noise.result.combined`).
"""

from __future__ import annotations

import numpy as np

from estimator.spectra.segment_rejection import RejectionSettings, SelectedSpectra
from estimator.spectra.welch import CrossSpectra, WelchSettings
from estimator.types import BoolArray, FloatArray, IntArray

MOST_SETS = 16


class ChannelSets:
    """Cross-spectra by the columns of the channels that have all samples of a segment.

    Parameters
    ----------
    welch : WelchSettings
    short : float
        Share of a segment up to which missing samples are a short gap, and no concern here.
    rejection : RejectionSettings, optional
        Criteria for segments with transients, which are left out of each set by its own segments;
        default: none is.
    """

    def __init__(
        self, welch: WelchSettings, *, short: float, rejection: RejectionSettings | None = None
    ) -> None:
        self._welch, self._short, self._rejection = welch, short, rejection
        self._sums: dict[tuple[int, ...], CrossSpectra | SelectedSpectra] = {}

    @property
    def spectra(self) -> dict[tuple[int, ...], CrossSpectra]:
        """Spectra by columns, of the segments that count."""
        return {
            columns: each if isinstance(each, CrossSpectra) else each.spectra()
            for columns, each in self._sums.items()
        }

    @property
    def n_segments(self) -> int:
        """Segments taken, with those that transients are found in."""
        return sum(each.n_segments for each in self._sums.values())

    @property
    def n_disturbed(self) -> int:
        """Segments left out for transients."""
        tested = (each for each in self._sums.values() if isinstance(each, SelectedSpectra))
        return sum(each.counts.total() for each in tested)

    def lacking(self, n_channels: int) -> dict[int, int]:
        """Return how many of the segments that count each channel lacks, by its column, if any."""
        counts = {columns: each.n_segments for columns, each in self.spectra.items()}
        found = {
            column: sum(n for columns, n in counts.items() if column not in columns)
            for column in range(n_channels)
        }
        return {column: n for column, n in found.items() if n}

    def merge(self, other: ChannelSets) -> None:
        """Add the segments that count in another recording; these are not judged again."""
        for columns, spectra in other.spectra.items():
            before = self._sums.get(columns)
            known = CrossSpectra(self._welch, len(columns))
            if before is not None:
                known = before if isinstance(before, CrossSpectra) else before.spectra()
            self._sums[columns] = known + spectra

    def take(
        self, samples: FloatArray, present: BoolArray, clipped: BoolArray | None, starts: IntArray
    ) -> IntArray:
        """Take the segments at `starts` that some channels have whole; return which.

        `present` has the shape of `samples`. Only the first `MOST_SETS` sets of channels are taken.
        """
        groups: dict[tuple[int, ...], list[int]] = {}
        for start in starts.tolist():
            span = slice(start, start + self._welch.segment_length)
            if clipped is not None and clipped[span].any():
                continue
            here = present[span]
            if np.mean(~here.all(axis=1)) > self._short:
                columns = tuple(np.flatnonzero(here.all(axis=0)).tolist())
                if columns and (columns in self._sums or len(self._sums) < MOST_SETS):
                    groups.setdefault(columns, []).append(start)
                    if columns not in self._sums:
                        self._sums[columns] = self._new(len(columns))
        for columns, at in groups.items():
            self._sums[columns].add(np.ascontiguousarray(samples[:, columns]), np.array(at))
        return np.sort(np.array([start for at in groups.values() for start in at], np.int64))

    def _new(self, n_channels: int) -> CrossSpectra | SelectedSpectra:
        if self._rejection is not None:
            return SelectedSpectra(self._welch, n_channels, rejection=self._rejection)
        return CrossSpectra(self._welch, n_channels)
