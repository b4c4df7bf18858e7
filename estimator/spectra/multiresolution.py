"""Long segments for low frequencies, short ones for high frequencies, in one pass.

The samples pass through a cascade of stages, each at half the sampling rate of the one above. All
stages use segments of the same number of samples, so that those of each stage are twice as long in
time, and half as many, as those of the stage above. Each stage contributes the octave from 0.2 to
0.4 of its rate; the top stage extends up to half its rate, the bottom one down to 0. The filter
between stages prevents aliasing into the used octave; its response in that octave is divided out.

Disturbed segments are excluded separately at each stage, by comparison with earlier segments of
equal length: a knock may disturb the highest octave and not the lowest.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.spectra.segment_rejection import Reason, RejectionSettings, SelectedSpectra
from estimator.spectra.welch import CrossSpectra, WelchSettings

if TYPE_CHECKING:
    from estimator.types import BoolArray, ComplexArray, FloatArray

LOW, HIGH = 0.2, 0.4  # octave of a stage, as fractions of its rate
TAPS = 89  # odd; stop-band from 0.3 of the rate above, 120 dB down
KAISER_BETA = 12.3


@dataclass(frozen=True, slots=True)
class Band:
    """Contribution of one stage.

    Attributes
    ----------
    settings : WelchSettings
        Settings of the stage, with its own sampling rate.
    frequencies : float64, shape (n_freqs,)
        In Hz, ascending.
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided, in unit**2/Hz.
    n_segments : int
    n_effective : float
    left_out : Counter of Reason
        Excluded segments of this stage: incomplete (GAP) or disturbed.
    """

    settings: WelchSettings
    frequencies: FloatArray
    csm: ComplexArray
    n_segments: int
    n_effective: float
    left_out: Counter[Reason] = field(default_factory=Counter)


class MultiResolution:
    """Cross-spectra of consecutive samples, octave by octave.

    Parameters
    ----------
    settings : WelchSettings
        Settings of the top stage, with the shortest segments.
    n_channels : int
    n_stages : int
        Number of stages; the longest segments are ``2**(n_stages - 1)`` times as long as the
        shortest.
    rejection : RejectionSettings, optional
        Criteria for disturbed segments; default: only incomplete segments are excluded.
    """

    def __init__(
        self,
        settings: WelchSettings,
        n_channels: int,
        *,
        n_stages: int,
        rejection: RejectionSettings | None = None,
    ) -> None:
        if n_stages < 1:
            raise EstimatorError(f"{n_stages} stages: at least one is needed")
        if settings.segment_length < 16:
            raise EstimatorError(
                f"segment length {settings.segment_length}: an octave needs 16 samples or more"
            )
        self._stages = [
            _Stage(
                replace(settings, sampling_rate=settings.sampling_rate / 2**level),
                n_channels,
                rejection,
            )
            for level in range(n_stages)
        ]

    def add(self, samples: FloatArray, complete: BoolArray | None = None) -> None:
        """Add the next samples.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
            Contiguous with the previous samples, including gaps.
        complete : bool, shape (n_samples,), optional
            False if any sensor has a gap; these samples are not used.
        """
        samples = np.array(samples, dtype=np.float64)
        if complete is None:
            complete = np.ones(len(samples), dtype=bool)
        self._stages[0].check(samples)
        if complete.shape != samples.shape[:1]:
            raise EstimatorError(
                f"completeness of shape {complete.shape}, expected {samples.shape[:1]}"
            )
        samples[~complete] = 0  # might be NaN, which would spread through the filter
        for stage in self._stages:
            stage.take(samples, complete)
            if stage is not self._stages[-1]:
                samples, complete = stage.halve(samples, complete)

    @property
    def n_segments(self) -> int:
        """Number of accepted segments of the top stage."""
        return self._stages[0].total().n_segments

    @classmethod
    def like(cls, other: MultiResolution) -> MultiResolution:
        """Return an empty accumulator with the same settings and channels, to merge into."""
        top = other._stages[0]
        return cls(top.settings, top.n_channels, n_stages=len(other._stages))

    def merge(self, other: MultiResolution) -> None:
        """Add the accepted segments of another recording.

        Raises
        ------
        EstimatorError
            If settings, stages or channels differ, or this accumulator rejects segments itself.
        """
        if len(other._stages) != len(self._stages):
            raise EstimatorError(f"{len(other._stages)} stages, expected {len(self._stages)}")
        for own, added in zip(self._stages, other._stages, strict=True):
            own.merge(added)

    def bands(self, least_effective: float = 1.0) -> tuple[Band, ...]:
        """Return the contributions of the stages, in ascending order of frequency.

        Parameters
        ----------
        least_effective : float
            Minimum number of effective averages of a stage. Stages with fewer are excluded, and the
            lowest remaining stage extends down to 0.

        Raises
        ------
        InsufficientDataError
            If no stage has this number of averages.
        """
        least = max(least_effective, 1.0)
        used = [stage for stage in self._stages if stage.total().n_effective >= least]
        if not used:
            raise InsufficientDataError(
                f"no segment length has {least_effective:g} effective averages yet"
            )
        bands = []
        for level in reversed(range(len(used))):
            stage = used[level]
            frequencies = stage.settings.frequencies
            rate = stage.settings.sampling_rate
            inside = np.ones(len(frequencies), dtype=bool)
            if level > 0:
                inside &= frequencies <= HIGH * rate
            if level < len(used) - 1:
                inside &= frequencies > LOW * rate
            gain = np.prod(
                [_response(frequencies[inside], above.settings) for above in used[:level]], axis=0
            )
            spectra = stage.total()
            csm = spectra.csm()[inside] / np.reshape(gain, (-1, 1, 1)) ** 2
            bands.append(
                Band(
                    stage.settings,
                    frequencies[inside],
                    csm,
                    spectra.n_segments,
                    spectra.n_effective,
                    Counter(
                        {
                            Reason.GAP: stage.incomplete,
                            Reason.TRANSIENT: stage.judged - spectra.n_segments,
                        }
                    ),
                )
            )
        return tuple(bands)


class _Stage:
    """Adds segments at one rate, and computes the samples of the next stage."""

    def __init__(
        self, settings: WelchSettings, n_channels: int, rejection: RejectionSettings | None
    ) -> None:
        self.settings = settings
        self.n_channels = n_channels
        self.incomplete = 0
        self.judged = 0
        self._begun = False
        self._spectra = CrossSpectra(settings, n_channels)
        self._undisturbed: SelectedSpectra | None = None
        if rejection is not None:
            self._undisturbed = SelectedSpectra(settings, n_channels, rejection=rejection)
        self._total: CrossSpectra | None = None
        self._samples = np.zeros((0, n_channels))  # start of the next segment
        self._complete = np.zeros(0, dtype=bool)
        # before the first sample, the filter treats the input as a gap
        self._tail = np.zeros((TAPS - 1, n_channels)), np.zeros(TAPS - 1, dtype=bool)

    def check(self, samples: FloatArray) -> None:
        """Raise the errors of `take`."""
        self._spectra.check(samples, np.zeros(0, dtype=np.int64))

    def total(self) -> CrossSpectra:
        """Return the spectra of the accepted segments."""
        if self._undisturbed is None:
            return self._spectra
        if self._total is None:
            self._total = self._undisturbed.spectra()
        return self._total

    def merge(self, other: _Stage) -> None:
        """Add the segments of the same stage of another recording."""
        if self._undisturbed is not None:
            raise EstimatorError("segments of another recording cannot be judged by these")
        self._spectra.merge(other.total())
        self.incomplete += other.incomplete
        self.judged += other.judged

    def take(self, samples: FloatArray, complete: BoolArray) -> None:
        """Test and add the segments completed by these samples."""
        self._samples = np.concatenate([self._samples, samples])
        self._complete = np.concatenate([self._complete, complete])
        n = (len(self._samples) - self.settings.segment_length) // self.settings.hop + 1
        if n <= 0:
            return
        starts = np.arange(n) * self.settings.hop
        missing = np.concatenate([[0], np.cumsum(~self._complete)])
        whole = missing[starts + self.settings.segment_length] == missing[starts]
        if not self._begun:  # segments before the first sample are not lost
            first = int(np.argmax(self._complete)) if self._complete.any() else len(self._complete)
            self.incomplete -= int(np.sum(starts < first))
            self._begun = first <= starts[-1]
        self.incomplete += n - int(whole.sum())
        self.judged += int(whole.sum())
        if self._undisturbed is None:
            self._spectra.add(self._samples, starts[whole])
        else:
            self._undisturbed.add(self._samples, starts[whole])
            self._total = None
        self._samples = self._samples[n * self.settings.hop :]
        self._complete = self._complete[n * self.settings.hop :]

    def halve(self, samples: FloatArray, complete: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Return the new samples at half the rate."""
        from scipy.signal import upfirdn  # noqa: PLC0415 - takes a second to import

        samples = np.concatenate([self._tail[0], samples])
        complete = np.concatenate([self._tail[1], complete])
        n = max(0, (len(samples) - TAPS) // 2 + 1)
        self._tail = samples[2 * n :], complete[2 * n :]
        if n == 0:
            return samples[:0], complete[:0]
        filtered = upfirdn(_taps(), samples, down=2, axis=0)[TAPS // 2 : TAPS // 2 + n]
        missing = np.concatenate([[0], np.cumsum(~complete)])
        first = 2 * np.arange(n)
        return np.asarray(filtered), missing[first + TAPS] == missing[first]


def _taps() -> FloatArray:
    """Return the half-band low-pass filter, with unit gain at 0 Hz."""
    n = np.arange(TAPS) - TAPS // 2
    taps = np.sinc(n / 2) * np.kaiser(TAPS, KAISER_BETA)
    return np.asarray(taps / taps.sum())


def _response(frequencies: FloatArray, settings: WelchSettings) -> FloatArray:
    """Return the gain of the filter after a stage; real, because the filter is symmetric."""
    n = np.arange(TAPS) - TAPS // 2
    phase = 2 * np.pi * frequencies[:, None] / settings.sampling_rate * n
    return np.asarray(np.cos(phase) @ _taps())
