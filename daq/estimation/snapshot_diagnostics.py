"""The part of a snapshot on the test itself: clocks, leakage, diagnosis of the averages."""

from __future__ import annotations

import math
from dataclasses import field
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from estimator.checks.advice import Untested
from estimator.checks.count_limits import CountLimits
from estimator.checks.loudness import Loudness
from estimator.likelihood.goodness_of_fit import ModelTest
from estimator.records import dataclass

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from estimator.checks.advice import Advice
    from estimator.checks.band import BandDiagnosis
    from estimator.checks.relative_response import RelativeResponse
    from estimator.checks.stability import Stability
    from estimator.likelihood.dimension import BandDimension
    from estimator.likelihood.multi_part import Beside, MultiPart
    from estimator.self_noise.result import SelfNoise

    FloatArray = NDArray[np.float64]


CLOCK_FACTOR = 4.0
"""What clocks add goes with the square of their error: twice its rms is allowed."""


PREDICTED_WITHIN = 1.2
"""Leakage at the edges of segments is predicted within 20 %."""


@dataclass(frozen=True, slots=True, eq=False)
class Synchronisation:
    """The error between the clocks, and its effect on the noise.

    Attributes
    ----------
    residual : mapping of str to float
        Seconds rms, by sensor.
    noise_bias : float64, shape (n_freqs, n_channels), or None
        What it is expected to add to the noise PSD, as a fraction of it; None where there is no
        estimate.
    removed : float64, shape (n_freqs, n_channels), or None
        What it may take away from the noise PSD at most, where the errors of other sensors are
        opposite, in unit**2/Hz; likewise.
    reference : str
        The sensor against which the motion measures clocks; empty where it does not.
    uneven : mapping of str to float
        Seconds rms by which the instants of polled sensors scatter, by sensor.
    """

    residual: Mapping[str, float] = field(default_factory=dict)
    noise_bias: FloatArray | None = None
    removed: FloatArray | None = None
    reference: str = ""
    uneven: Mapping[str, float] = field(default_factory=dict)

    @property
    def is_known(self) -> bool:
        """Whether the errors of all clocks are known."""
        return not any(map(math.isnan, self.residual.values()))


@dataclass(frozen=True, slots=True, eq=False)
class EdgeLeakage:
    """What unequal responses of sensors leak into the noise at the edges of segments.

    Attributes
    ----------
    left : float64, shape (n_freqs, n_channels)
        Expected in the noise PSD, in unit**2/Hz; may be negative.
    whole : float64, shape (n_freqs, n_channels)
        The same without equalisation.
    unseen : float64, shape (n_freqs, n_channels)
        What equalisation may have left that averages do not show, or windows that jump; likewise.
    trends : float64, shape (n_freqs, n_channels)
        What trends of the noise within segments may leak; likewise.
    share, whole_share : float64, shape (n_freqs, n_channels)
        What the first two are at least, over the noise estimate, in bands of third octaves.
    sources : tuple of str
        Where the responses come from that are equalised: "known" (the bench file) and
        "estimated"; empty where nothing is.
    unproven : tuple of int
        Sensors whose estimated filters are not used: they did not lower the noise of segments that
        they were not found from.
    """

    left: FloatArray = field(metadata={"key": "left_psd"})
    whole: FloatArray = field(metadata={"key": "without_equalisation_psd"})
    unseen: FloatArray = field(metadata={"key": "unseen_psd"})
    trends: FloatArray = field(metadata={"key": "trends_psd"})
    share: FloatArray = field(metadata={"key": "left_share"})
    whole_share: FloatArray = field(metadata={"key": "without_equalisation_share"})
    sources: tuple[str, ...] = ()
    unproven: tuple[int, ...] = ()

    @property
    def most(self) -> FloatArray:
        """What may be in the noise PSD at most, shape (n_freqs, n_channels)."""
        return self.of_responses + self.trends

    @property
    def of_responses(self) -> FloatArray:
        """The same without what trends of the noise may leak."""
        found = PREDICTED_WITHIN * np.maximum(self.left, 0.0) + self.unseen
        return np.where(np.isfinite(found), found, 0.0)


def added_by_clocks(
    synchronisation: Synchronisation, results: Mapping[str, SelfNoise]
) -> FloatArray | None:
    """Return `Snapshot.added_by_clocks`."""
    share = synchronisation.noise_bias
    if share is None or not results:
        return None
    psd = np.abs(next(iter(results.values())).noise_psd)
    with np.errstate(invalid="ignore"):  # of a noise of zero
        added = CLOCK_FACTOR * share * psd
    return np.where(np.isfinite(added), np.clip(added, 0.0, psd), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyDiagnosis:
    """The diagnosis at every frequency of a snapshot.

    Attributes
    ----------
    coherence, condition : float64, shape (n_freqs, n_pairs)
        Of each pair, as in `estimator.checks.diagnose.Diagnostics`.
    dimension : float64, shape (n_freqs,)
        Effective dimension of the motion.
    snr : float64, shape (n_freqs, n_channels)
        PSD of the motion over PSD of the noise.
    statistic, degrees, p_value : float64, shape (n_freqs,)
        Of the model test: `estimator.likelihood.goodness_of_fit.ModelTest`.
    """

    coherence: FloatArray
    condition: FloatArray
    dimension: FloatArray
    snr: FloatArray
    statistic: FloatArray
    degrees: FloatArray
    IN_JSON: ClassVar[Mapping[str, str]] = {"p_value": "p_value"}

    @property
    def p_value(self) -> FloatArray:
        """Of the model test, shape (n_freqs,)."""
        return ModelTest(self.statistic, self.degrees).p_value


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What the averages show of the test.

    Attributes
    ----------
    n_factors : int
        Dimensions of the motion in the model tested.
    pairs : tuple of (int, int)
        Pairs of sensors, from 0.
    bands : tuple of BandDiagnosis
        Rising.
    responses : tuple of RelativeResponse
        Where each octave has its own segments, of the octave in which sensors are most coherent.
    advice : tuple of Advice
        Worst first within each octave.
    per_frequency : FrequencyDiagnosis
    stability : Stability or None
        None with too few segments, where each octave has its own, or with rejection.
    """

    n_factors: int
    pairs: tuple[tuple[int, int], ...]
    bands: tuple[BandDiagnosis, ...]
    responses: tuple[RelativeResponse, ...]
    advice: tuple[Advice, ...]
    per_frequency: FrequencyDiagnosis
    stability: Stability | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SnapshotDiagnostics:
    """Clocks, leakage and diagnosis of a test.

    Attributes
    ----------
    synchronisation : Synchronisation
    dimensions : tuple of BandDimension
        Where the dimension of the motion was chosen by band; rising.
    counts : CountLimits
        Channels whose counts are clipped, wrap, repeat or lack codes.
    stood_still : mapping of int to float
        Seconds for which a channel had a constant count or a straight line though it has a signal
        otherwise, by column; without channels that had none.
    diagnosis : Diagnosis or None
        None where there is too little to diagnose. While a recording grows it may be that of some
        segments before: it takes too long to be made for every snapshot.
    untested : Untested or None
        Why the model of one common motion was tested in no band; None where it was.
    edge_leakage : EdgeLeakage or None
        None where it is not known.
    multi_part : MultiPart or None
        What motion that changes says by itself; None of an estimate without it.
    beside : Beside or None
        What it says of the noise of three sensors or more, by another method.
    """

    synchronisation: Synchronisation = field(default_factory=Synchronisation)
    dimensions: tuple[BandDimension, ...] = ()
    counts: CountLimits = field(default_factory=CountLimits)
    stood_still: Mapping[int, float] = field(default_factory=dict)
    diagnosis: Diagnosis | None = None
    untested: Untested | None = Untested.UNFINISHED
    edge_leakage: EdgeLeakage | None = None
    multi_part: MultiPart | None = None
    beside: Beside | None = None

    @property
    def faulty(self) -> set[int]:
        """Columns of channels whose samples are wrong."""
        return {*self.counts.faulty, *self.stood_still}

    @property
    def advice(self) -> tuple[Advice, ...]:
        """Advice on the test; none before it is diagnosed."""
        return () if self.diagnosis is None else self.diagnosis.advice

    def inflation_at(self, frequency: FloatArray) -> FloatArray:
        """Return the variance of averages over that of steady noise, shape (n_freqs,)."""
        steady = self._stability
        return np.ones(len(frequency)) if steady is None else steady.inflation_at(frequency)

    @property
    def loudness(self) -> Loudness | None:
        """Changes of the loudness of the noise; None where it is not known, or none changes."""
        found = None if self._stability is None else self._stability.loudness
        return found if found is not None and found.size.any() else None

    @property
    def _stability(self) -> Stability | None:
        return None if self.diagnosis is None else self.diagnosis.stability
