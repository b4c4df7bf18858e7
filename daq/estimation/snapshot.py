"""The estimate at one moment, as front ends see it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from daq.recording.sensor_state import STATE_AFTER
from estimator.diagnostics.kinds import Untested
from estimator.errors import InsufficientDataError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from daq.protocols.block import Event
    from daq.recording.interface import ReadableSensor
    from daq.timing.clock_model import ClockState
    from estimator.diagnostics.advice import Advice
    from estimator.diagnostics.band import BandDiagnosis
    from estimator.diagnostics.relative_response import RelativeResponse
    from estimator.diagnostics.stability import Stability
    from estimator.likelihood.dimension import BandDimension
    from estimator.self_noise.result import SelfNoise
    from estimator.spectra.multiresolution import Band
    from estimator.spectra.segment_rejection import Reason

    FloatArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]


MOST_ADDED = 4.0
"""What clocks add goes with the square of what is left between them: twice its rms is allowed."""


PREDICTED_WITHIN = 1.2
"""Leakage at the edges of segments is predicted within 20 %."""


@dataclass(frozen=True, slots=True)
class ChannelLabel:
    """Which channel a column of the result is, and its unit (of the motion, not of the PSD)."""

    sensor: str
    channel: str
    unit: str

    @property
    def name(self) -> str:
        """Sensor and channel, as in ``A.X``: to be read, not to be taken apart."""
        return f"{self.sensor}.{self.channel}"


@dataclass(frozen=True, slots=True)
class SensorTotals:
    """How much of a sensor has been recorded so far."""

    name: str
    sampling_rate: float
    n_samples: int
    n_gaps: int
    n_missing: int
    last_seen: float
    """UTC of the last committed block, in seconds since 1970; NaN before the first."""
    is_lost: bool = False
    """Whether the sensor has sent nothing, or was lost after its last block."""
    n_damaged: int = 0
    """Number of its blocks whose checksum is wrong; the estimate leaves them out as gaps."""

    @classmethod
    def of(cls, record: ReadableSensor, events: Iterable[Event] = ()) -> SensorTotals:
        """Return the totals of a sensor of a recording."""
        last = record.blocks[-1:]["utc_ns"]
        last_ns = int(record.blocks[-1:]["monotonic_ns"][0]) if len(last) else -1
        states = [
            STATE_AFTER[event.kind]
            for event in events
            if event.sensor == record.name
            and event.kind in STATE_AFTER
            and event.received.monotonic_ns > last_ns
        ]
        return cls(
            name=record.name,
            sampling_rate=record.sampling_rate,
            n_samples=record.n_samples,
            n_gaps=len(record.gaps),
            n_missing=int(record.gaps["missing"].sum()),
            last_seen=float(last[0]) * 1e-9 if len(last) else float("nan"),
            n_damaged=record.n_damaged,
            is_lost=not len(last) or (bool(states) and states[-1].is_lost),
        )


@dataclass(frozen=True, slots=True)
class Octave:
    """What frequencies up to `high` (Hz) rest on, where each octave has its own segments."""

    low: float
    high: float
    segment: float
    """Seconds."""
    n_segments: int
    n_effective: float
    left_out: Mapping[Reason, int] = field(default_factory=dict)
    """Its segments that do not count, by reason; clipped ones count as gaps."""

    @classmethod
    def of(cls, band: Band) -> Octave:
        """Return what the frequencies of a band rest on."""
        return cls(
            low=float(band.frequencies[0]),
            high=float(band.frequencies[-1]),
            segment=band.settings.segment_length / band.settings.sampling_rate,
            n_segments=band.n_segments,
            n_effective=band.n_effective,
            left_out=dict(band.left_out),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Synchronisation:
    """What is left between the clocks, and its effect on the noise.

    Attributes
    ----------
    residual : mapping of str to float
        Seconds rms, by sensor.
    noise_bias : float64, shape (n_freqs, n_channels), or None
        What it is expected to add to the noise PSD, as a fraction of it; None where there is no
        estimate.
    """

    residual: Mapping[str, float] = field(default_factory=dict)
    noise_bias: FloatArray | None = None


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
        What equalisation may have left that averages do not show; likewise.
    share, whole_share : float64, shape (n_freqs, n_channels)
        What the first two are at least, over the noise estimate, in bands of third octaves.
    sources : tuple of str
        Where the responses come from that are equalised: "known" (the bench file) and
        "estimated"; empty where nothing is.
    """

    left: FloatArray
    whole: FloatArray
    unseen: FloatArray
    share: FloatArray
    whole_share: FloatArray
    sources: tuple[str, ...] = ()

    @property
    def most(self) -> FloatArray:
        """What may be in the noise PSD at most, shape (n_freqs, n_channels)."""
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
    added = MOST_ADDED * share * psd
    return np.where(np.isfinite(added), np.clip(added, 0.0, psd), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class FrequencyDiagnosis:
    """The diagnosis at every frequency of a snapshot.

    Attributes
    ----------
    coherence, condition : float64, shape (n_freqs, n_pairs)
        As in `estimator.diagnostics.diagnose.Diagnostics`, and so are `dimension` and `snr`.
    dimension : float64, shape (n_freqs,)
    snr : float64, shape (n_freqs, n_channels)
    statistic, degrees, p_value : float64, shape (n_freqs,)
        Of the model test: `estimator.likelihood.goodness_of_fit.ModelTest`.
    """

    coherence: FloatArray
    condition: FloatArray
    dimension: FloatArray
    snr: FloatArray
    statistic: FloatArray
    degrees: FloatArray
    p_value: FloatArray


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
    """What is known of the test itself.

    Attributes
    ----------
    synchronisation : Synchronisation
    dimensions : tuple of BandDimension
        Where the dimension of the motion was chosen by band; rising.
    clipped : mapping of int to float
        Share of samples at the end of the range, by column of the channel; without channels that
        have none.
    stood_still : mapping of int to float
        Seconds for which a channel had a constant count though it has a signal otherwise; likewise.
    diagnosis : Diagnosis or None
        None where there is too little to diagnose. While a recording grows it may be that of some
        segments before: it takes too long to be made for every snapshot.
    untested : Untested or None
        Why the model of one common motion was tested in no band; None where it was.
    edge_leakage : EdgeLeakage or None
        None where it is not known.
    """

    synchronisation: Synchronisation = field(default_factory=Synchronisation)
    dimensions: tuple[BandDimension, ...] = ()
    clipped: Mapping[int, float] = field(default_factory=dict)
    stood_still: Mapping[int, float] = field(default_factory=dict)
    diagnosis: Diagnosis | None = None
    untested: Untested | None = Untested.UNFINISHED
    edge_leakage: EdgeLeakage | None = None

    @property
    def advice(self) -> tuple[Advice, ...]:
        """Advice on the test; none before it is diagnosed."""
        return () if self.diagnosis is None else self.diagnosis.advice


def added(diagnostics: SnapshotDiagnostics, results: Mapping[str, SelfNoise]) -> FloatArray | None:
    """Return `Snapshot.added`."""
    clocks, edges = added_by_clocks(diagnostics.synchronisation, results), diagnostics.edge_leakage
    if edges is None or not results:
        return clocks
    psd = np.abs(next(iter(results.values())).noise_psd)
    known = np.where(np.isfinite(psd), psd, 0.0)
    return np.minimum(edges.most + (0.0 if clocks is None else clocks), known)


@dataclass(frozen=True, slots=True)
class NoSegment:
    """Why no segment counts, though several would be complete.

    Attributes
    ----------
    reason : Reason
        Why most of them were left out.
    segment : float
        Their length in seconds.
    sensor : str
        The sensor with the most gaps.
    longest : float
        Its longest stretch without a gap, in seconds.
    """

    reason: Reason
    segment: float
    sensor: str
    longest: float


@dataclass(frozen=True, slots=True, eq=False)
class Bridged:
    """Segments that count though they have gaps.

    Attributes
    ----------
    n_segments : int
    lost : float
        Mean part of a segment's energy that gaps take.
    leakage : float64, shape (n_freqs, n_channels)
        What their windows bring in from other frequencies, as a fraction of the noise.
    """

    n_segments: int
    lost: float
    leakage: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The estimate at one moment, with everything a front end shows.

    Attributes
    ----------
    frequency : float64, shape (n_freqs,)
        In Hz.
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Cross-spectral matrix in unit**2/Hz; ``csm[f, p, q] = E[X_p conj(X_q)]``. NaN before the
        first segment.
    results : dict
        Self-noise by name of the method; without those that cannot say anything (yet).
    refused : dict
        Why, by name of the method.
    channels : tuple of ChannelLabel
    dims : tuple of int
        Number of channels of each sensor.
    n_segments, n_dropped : int
        Segments taken, and left out; with octaves those of the highest.
    n_effective : float
        Independent averages the segments are worth; with octaves those of the highest.
    elapsed : float
        Seconds from the start to the end of what was looked at.
    start_utc_ns : int
        UTC of the first grid sample.
    sensors, clocks : tuple
    drift : float64, shape (n_segments, 1 + n_sensors)
        Middle of each segment looked at, in seconds from `start_utc_ns`, and by how much each
        sensor's own count of time then lags, in seconds: what the clocks do. Of the last recording.
    closed : bool
        Whether nothing more will come.
    left_out : mapping of Reason to int
        How many segments were left out, by reason.
    octaves : tuple of Octave
        Rising; empty where all frequencies rest on the same segments.
    diagnostics : SnapshotDiagnostics
    no_segment : NoSegment or None
        None where a segment counts, or too few would be complete.
    quantisation_psd : float64, shape (n_freqs, n_channels), or None
        Noise of counting in whole numbers, in unit**2/Hz; NaN for channels that do not. Of a
        finished estimate.
    bridged : Bridged or None
        None where no segment with gaps counts.
    """

    frequency: FloatArray
    csm: ComplexArray
    results: dict[str, SelfNoise]
    refused: dict[str, str]
    channels: tuple[ChannelLabel, ...]
    dims: tuple[int, ...]
    unit: str
    n_segments: int
    n_dropped: int
    n_effective: float
    elapsed: float
    start_utc_ns: int
    sensors: tuple[SensorTotals, ...]
    clocks: tuple[ClockState, ...]
    drift: FloatArray
    closed: bool
    left_out: Mapping[Reason, int] = field(default_factory=dict)
    octaves: tuple[Octave, ...] = ()
    diagnostics: SnapshotDiagnostics = field(default_factory=SnapshotDiagnostics)
    no_segment: NoSegment | None = None
    quantisation_psd: FloatArray | None = None
    bridged: Bridged | None = None

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors whose channels are estimated, in the order of `dims`."""
        return tuple(dict.fromkeys(label.sensor for label in self.channels))

    @property
    def added_by_clocks(self) -> FloatArray | None:
        """What the clocks may have added to the noise PSD at most, shape (n_freqs, n_channels).

        In unit**2/Hz: no more than the noise itself, 0 where it is not known; None before there is
        an estimate.
        """
        return added_by_clocks(self.diagnostics.synchronisation, self.results)

    @property
    def added(self) -> FloatArray | None:
        """What clocks and the edges of segments may have added to the noise PSD at most.

        Shape and unit as of `added_by_clocks`.
        """
        return added(self.diagnostics, self.results)

    @property
    def data_psd(self) -> FloatArray:
        """PSD of what each channel recorded, shape (n_freqs, n_channels), in unit**2/Hz."""
        return np.ascontiguousarray(np.diagonal(self.csm, axis1=1, axis2=2).real)


class NoResultError(InsufficientDataError):
    """No method can say anything of any channel.

    Parameters
    ----------
    message : str
    snapshot : Snapshot
        Of the whole recording, with the advice on what is wrong.
    """

    def __init__(self, message: str, snapshot: Snapshot) -> None:
        super().__init__(message)
        self.snapshot = snapshot
