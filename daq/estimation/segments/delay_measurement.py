"""Measures the delays between sensors in segments, for the next setting of their clocks.

While a recording is followed, segments come one by one. A few are then measured together, because
the prediction of one sensor by another costs as much for one segment as for many.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.clocks.delay_estimation import MIN_SEGMENTS, REFERENCES, DelayEstimator
from daq.clocks.departures import departing
from estimator.median import median
from estimator.spectra.welch import SegmentSpectra, WelchSettings
from estimator.spectra.windows import gap_window, get_window, without_trend

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_HELD = 6  # segments that are measured together while a recording is followed
_SHOWN = 0.5  # samples; a delay that must show in any segment
_FAR_OFF, _LEAST_OFF = 6.0, 1e-6  # standard deviations, of so many s at least
_TOGETHER = 24  # segments whose spectra are measured together
_HELD_VALUES = 1 << 19  # samples times channels that may wait for that: 4 MB


class DelayMeasurement:
    """Delays in the segments of one pass.

    Parameters
    ----------
    aligned : AlignedRecording
        Learns the delays.
    welch : WelchSettings
        Of the segments.
    is_wanted : bool
        Whether clocks may be refined by what is measured.
    """

    def __init__(self, aligned: AlignedRecording, welch: WelchSettings, *, is_wanted: bool) -> None:
        self._aligned, self._welch, self._is_wanted = aligned, welch, is_wanted
        self._meter: DelayEstimator | None = None
        self._held: list[tuple[FloatArray, IntArray, IntArray]] = []
        self._held_spectra: list[tuple[NDArray[np.complex128], IntArray]] = []
        self._spreads: list[float] = []

    @property
    def has_begun(self) -> bool:
        """Whether any segment was to be measured."""
        return self._meter is not None

    @property
    def measures(self) -> bool:
        """Whether the delays of segments are wanted."""
        return self._is_wanted and bool(self._aligned.measurable)

    @property
    def fewest(self) -> int:
        """Segments to take together so that delays can be measured, some of them with gaps."""
        needed = self.measures and (self._meter is None or not self._meter.has_tried)
        return 2 * MIN_SEGMENTS * max(self._aligned.dims) if needed else 0

    @property
    def awaited(self) -> int:
        """Segments with which delays could be measured first; 0 where they are, or need not be."""
        return 0 if self._meter is None or self._meter.has_tried else self._meter.min_segments

    def measure(
        self, samples: FloatArray, starts: IntArray, begin: IntArray, *, together: bool
    ) -> None:
        """Measure what delays are left in segments.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
            Not changed later.
        starts, begin : int64, shape (n_segments,)
            First row of each segment, and its first grid sample.
        together : bool
            Whether the segments may wait for others, until the clocks are set.
        """
        meter = self._wanted_meter()
        if meter is None:
            return
        if not meter.has_tried or (meter.has_frame and not together):
            self._learn(samples, starts, begin)
            return
        self._held.append((samples, starts, begin))
        n_values = sum(each.size for each, _, _ in self._held)
        fewest = max(_HELD, meter.fewest)
        if sum(len(rows) for _, rows, _ in self._held) >= fewest or n_values >= _HELD_VALUES:
            self.learn_held()

    def measure_spectra(self, spectra: NDArray[np.complex128], begin: IntArray) -> None:
        """Measure what delays are left in segments, by their spectra from 0 Hz on.

        Few segments wait for others.
        """
        if self._wanted_meter() is None:
            return
        self._held_spectra.append((spectra, begin))
        if sum(len(each) for each, _ in self._held_spectra) >= max(_TOGETHER, self.fewest):
            self._learn_held_spectra()

    @property
    def precision(self) -> float | None:
        """Standard deviation of a delay, usually, in s; None if none is known."""
        return float(median(np.array(self._spreads))) if self._spreads else None

    def suspects(self, single: SegmentSpectra) -> IntArray | None:
        """Return which of the kept segments may be off the clocks that they were taken by.

        None where most segments would not show it, or too few are measured.
        """
        self._learn_held_spectra()
        if self._meter is None or not self._meter.has_frame:
            return None
        spectra = single.values().astype(np.complex128).transpose(1, 0, 2)
        rate, length = self._welch.sampling_rate, self._welch.segment_length
        omega = np.asarray(2 * np.pi * rate / length * single.bins, dtype=np.float64)
        reference, others = self._meter.compared
        found = np.zeros(spectra.shape[1], dtype=np.bool_)
        for columns in others:
            departs = departing(
                spectra[:, :, reference], spectra[:, :, columns], omega, precise=_SHOWN / rate
            )
            if departs is None:
                return None
            found |= departs
        return np.flatnonzero(found)

    def are_off(self, spectra: NDArray[np.complex128]) -> bool:
        """Return whether any segment has a delay that the clocks have not."""
        if self._meter is None:
            return False
        delays, std = self._meter.measure_spectra(spectra)
        measured = np.isin(np.arange(delays.shape[1]), self._meter.measured)
        off = ~(np.abs(delays) <= _FAR_OFF * np.maximum(std, _LEAST_OFF)) | ~np.isfinite(std)
        return bool(off[:, measured].any())

    def _wanted_meter(self) -> DelayEstimator | None:
        if not self.measures:
            return None
        if self._meter is None:
            edges = np.cumsum([0, *self._aligned.dims])
            sensors = self._aligned.measurable
            columns = tuple(slice(int(edges[n]), int(edges[n + 1])) for n in sensors)
            window = get_window(self._welch.window, self._welch.segment_length)
            rate, fixed = self._welch.sampling_rate, self._aligned.stated_reference is not None
            most = 1 if fixed else REFERENCES
            self._meter = DelayEstimator(rate, window, columns, most, hop=self._welch.hop)
        return self._meter

    def measure_with_gaps(
        self,
        samples: FloatArray,
        usable: BoolArray,
        starts: IntArray,
        begin: IntArray,
        *,
        most: float,
        together: bool,
    ) -> None:
        """Measure what delays are left in segments with gaps.

        Those of which gaps take more than the share `most` are left out. The other parameters are
        those of `measure`.
        """
        length = self._welch.segment_length
        segments, taken = [np.empty((0, samples.shape[1]))], []
        for start, at in zip(starts.tolist(), begin.tolist(), strict=True):
            span = slice(start, start + length)
            segment = around_gaps(
                self._aligned, self._welch, samples[span], usable[span], at, most=most
            )
            if segment is not None:
                segments.append(segment)
                taken.append(at)
        rows = np.arange(len(taken)) * length
        self.measure(np.concatenate(segments), rows, np.array(taken, np.int64), together=together)

    def _learn_held_spectra(self) -> None:
        if self._meter is None or not self._held_spectra:
            return
        held, self._held_spectra = self._held_spectra, []
        begin = np.concatenate([begin for _, begin in held])
        self._tell(begin, *self._meter.measure_spectra(np.concatenate([one for one, _ in held])))

    def learn_held(self) -> None:
        """Measure delays in the segments that wait for others: the clocks are about to be set."""
        self._learn_held_spectra()
        if not self._held:
            return
        held, self._held = self._held, []
        before = np.cumsum([0, *(len(samples) for samples, _, _ in held)])
        self._learn(
            np.concatenate([samples for samples, _, _ in held]),
            np.concatenate([rows + n for (_, rows, _), n in zip(held, before, strict=False)]),
            np.concatenate([begin for _, _, begin in held]),
        )

    def _learn(self, samples: FloatArray, starts: IntArray, begin: IntArray) -> None:
        if self._meter is not None:
            self._tell(begin, *self._meter.measure(samples, starts))

    def _tell(self, begin: IntArray, delays: FloatArray, std: FloatArray) -> None:
        known = np.isfinite(std) & (std > 0)
        if known.any():
            self._spreads.append(float(median(std[known])))
        at = begin + self._welch.segment_length / 2
        self._aligned.learn(
            np.asarray(at, dtype=np.float64), delays, std=std, frame_delays=self._frame_delays
        )

    def _frame_delays(self) -> FloatArray:
        """Return delays of frames; the clocks, about to be set, know all segments before."""
        self.learn_held()
        return np.empty(0) if self._meter is None else self._meter.frame_delays()


def around_gaps(
    aligned: AlignedRecording,
    welch: WelchSettings,
    samples: FloatArray,
    usable: BoolArray,
    begin: int,
    *,
    most: float,
) -> FloatArray | None:
    """Return a segment; one with gaps without its trend, and zero in them.

    It holds what no clock restarts in, around its middle: a delay across a restart would be that of
    neither side. None if gaps and the rest take more than the share `most` of it.

    Parameters
    ----------
    aligned : AlignedRecording
    welch : WelchSettings
    samples : float64, shape (segment_length, n_channels)
    usable : bool, shape (segment_length,)
    begin : int
        Its first grid sample.
    most : float
    """
    length = welch.segment_length
    low, high = aligned.epoch_around(begin + length / 2)
    place = begin + np.arange(length)
    whole = usable & (place >= low) & (place <= high)
    if whole.all():
        return samples
    weight = gap_window(whole, length)
    if np.count_nonzero(weight < 1) > most * length:
        return None
    return without_trend(samples, weight, welch.detrend)
