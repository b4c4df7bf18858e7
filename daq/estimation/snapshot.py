"""The estimate at one moment, as front ends see it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import field
from functools import wraps
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from daq.bench.sensitivity import Sensitivities
from daq.caveats import NO_CAVEATS, Caveats
from daq.clocks.clock_model import ClockSource, ClockState
from daq.estimation.snapshot_diagnostics import (
    SnapshotDiagnostics,
    added_by_clocks,
)
from daq.protocols.block import Event
from daq.recording.interface import ReadableSensor
from daq.recording.sensor_state import STATE_AFTER
from estimator.checks.advice import Names
from estimator.checks.instants import Form
from estimator.errors import InsufficientDataError
from estimator.records import Hertz, Seconds, Share, dataclass
from estimator.self_noise.result import SelfNoise
from estimator.spectra.multiresolution import Band
from estimator.spectra.parts import Parts
from estimator.spectra.segment_rejection import Reason

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Derive = TypeVar("Derive", bound=Callable[..., Any])


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
    sampling_rate: Hertz
    n_samples: int = field(metadata={"key": "samples"})
    n_gaps: int = field(metadata={"key": "gaps"})
    n_missing: int = field(metadata={"key": "missing_samples"})
    last_seen: float = field(metadata={"key": "last_seen_utc_s"})
    """UTC of the last committed block, in seconds since 1970; NaN before the first."""
    is_lost: bool = False
    """Whether the sensor has sent nothing, or was lost after its last block."""
    n_damaged: int = field(default=0, metadata={"key": "damaged_blocks"})
    """Number of its blocks whose checksum is wrong; the estimate leaves them out as gaps."""
    began: float = field(default=float("nan"), metadata={"key": "began_utc_s"})
    """UTC of the first sample to within the delay of its block, as `last_seen`."""

    @classmethod
    def of(cls, record: ReadableSensor, events: Iterable[Event] = ()) -> SensorTotals:
        """Return the totals of a sensor of a recording."""
        first, last = record.blocks[:1], record.blocks[-1:]["utc_ns"]
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
            began=float(first["utc_ns"][0]) * 1e-9
            - float(first["n_samples"][0]) / record.sampling_rate
            if len(first)
            else float("nan"),
            n_damaged=record.n_damaged,
            is_lost=not len(last) or (bool(states) and states[-1].is_lost),
        )


@dataclass(frozen=True, slots=True)
class Octave:
    """What frequencies up to `high` (Hz) rest on, where each octave has its own segments."""

    low: Hertz
    high: Hertz
    segment: Seconds
    n_segments: int = field(metadata={"key": "segments"})
    n_effective: float = field(metadata={"key": "effective_averages"})
    left_out: Mapping[Reason, int] = field(
        default_factory=dict, metadata={"key": "excluded_by_reason"}
    )
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


class Overlap(NamedTuple):
    """Two recordings, by name, that cover the same time, in ns of UTC.

    Segments there count in the first, and not in the second.
    """

    counted: str
    repeated: str
    begin_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class RejectedSegment:
    """A segment that is left out for a transient, the largest of which is in channel `column`."""

    begin: Seconds
    """From the first grid sample on, as `end`."""
    end: Seconds
    column: int


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

    n_segments: int = field(metadata={"key": "segments"})
    lost: Share
    leakage: FloatArray = field(metadata={"key": "leakage_share"})


@dataclass(frozen=True, slots=True, eq=False)
class SharedRounding:
    """The rounding to counts that channels of several sensors share.

    Attributes
    ----------
    most, lacking : float64, shape (n_freqs, n_channels)
        What each channel shares with another, at most, and what its noise PSD lacks by all; in
        unit**2/Hz.
    """

    most: FloatArray
    lacking: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class NonlinearChannel:
    """A channel that is not linear.

    Attributes
    ----------
    column : int
    evidence : float
        That it is not, in standard deviations.
    explained : float64, shape (n_freqs,)
        What squares and cubes of the channel add to its noise PSD, in unit**2/Hz.
    """

    column: int
    evidence: float
    explained: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class DependentChannel:
    """A channel whose noise depends on its motion at the same instant.

    Attributes
    ----------
    column : int
    band : tuple of (float, float)
        Hz.
    form : Form
    evidence : float
        That it does, in standard deviations.
    size : float
        Standard deviation of the instants in seconds, or of the gain; 0 of other forms.
    most : float64, shape (n_freqs,)
        By how much its noise PSD may be too high for that, in unit**2/Hz.
    """

    column: int
    band: tuple[float, float]
    form: Form
    evidence: float
    size: float
    most: FloatArray


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
        Self-noise by name of the method, of those that give a result.
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
        Seconds from the start to the end of the examined span.
    start_utc_ns : int
        UTC of the first grid sample.
    sensors, clocks : tuple
    drift : float64, shape (n_segments, 1 + n_sensors)
        Middle of each examined segment, in seconds from `start_utc_ns`, and the lag of each
        sensor's clock then, in seconds. Of the last recording.
    closed : bool
        Whether the recordings are complete.
    left_out : mapping of Reason to int
        How many segments were left out, by reason.
    octaves : tuple of Octave
        Rising; empty where all frequencies rest on the same segments.
    diagnostics : SnapshotDiagnostics
    no_segment : NoSegment or None
        None where a segment counts, or too few would be complete.
    quantisation_psd : float64, shape (n_freqs, n_channels), or None
        Noise of rounding to counts or digits, in unit**2/Hz; NaN for channels without. Of a
        finished estimate.
    rounded_alike : SharedRounding or None
        What channels of several sensors share of it. Of a finished estimate.
    nonlinear : tuple of NonlinearChannel
        Channels that are not linear, the one with the largest evidence first. Of a finished
        estimate.
    dependent : tuple of DependentChannel
        Channels whose noise depends on their motion otherwise, the clearest first. Of a finished
        estimate.
    bends : float64, shape (n_channels,), or None
        Relative standard uncertainty of gains by what may bend channels; None if not tested.
    linearised : bool
        Whether what is not linear is taken off their noise.
    bridged : Bridged or None
        None where no segment with gaps counts.
    left_open : tuple of str
        Names of recordings whose recorder was killed. Of a finished estimate.
    overlaps : tuple of Overlap
        Recordings that cover the same time.
    not_estimated : tuple of str
        Sensors that sent nothing, and those that a live estimate leaves out to limit its memory.
    across_axes : tuple of float
        Share of the motion's PSD, across axes that may be off, by which the noise of each sensor
        may be off; empty: not at all.
    rounding : float
        Share of the data's PSD by which the noise may be off, because cross-spectra were rounded.
    between : float64, shape (n_freqs, n_channels), or None
        What the noise of an archive has, in unit**2/Hz, over that of stretches estimated alone.
    of_days : float64, shape (n_channels,), or None
        Standard deviation that the loudness of days adds to the logarithm of the noise there.
    sensitivities : mapping of (str, str) to KnownSensitivity
        What is known of sensitivities, by names of sensor and channel; not in it: nothing.
    caveats : Caveats
        What must be read before its numbers.
    channel_segments : tuple of int
        Segments behind the noise of each channel, where some channels have no samples in some
        segments; empty where all rest on the same ones.
    shortened : mapping of str to (float, float)
        By how many seconds sensors that begin late, and that end early, shorten the span, by name
        of the sensor. Of all recordings together.
    parts : Parts or None
        The same averages in parts of time. Of a finished estimate; None where they are not kept.
    rejected : tuple of RejectedSegment
        Segments that all channels have, but that are left out for transients: at most the latest
        20,000 of a recording or an octave. Of a finished estimate.
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
    rounded_alike: SharedRounding | None = None
    nonlinear: tuple[NonlinearChannel, ...] = ()
    dependent: tuple[DependentChannel, ...] = ()
    bends: FloatArray | None = None
    linearised: bool = False
    bridged: Bridged | None = None
    left_open: tuple[str, ...] = ()
    overlaps: tuple[Overlap, ...] = ()
    not_estimated: tuple[str, ...] = ()
    across_axes: tuple[float, ...] = ()
    rounding: float = 0.0
    between: FloatArray | None = None
    of_days: FloatArray | None = None
    sensitivities: Sensitivities = field(default_factory=dict)
    caveats: Caveats = NO_CAVEATS
    channel_segments: tuple[int, ...] = ()
    shortened: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    parts: Parts | None = None
    rejected: tuple[RejectedSegment, ...] = ()
    derived: dict[tuple[object, ...], Any] = field(default_factory=dict, init=False, repr=False)
    """What `once` has derived of it; a changed copy begins anew."""

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Names of the sensors whose channels are estimated, in the order of `dims`."""
        return tuple(dict.fromkeys(label.sensor for label in self.channels))

    @property
    def names(self) -> Names:
        """For advice, which refers to sensors and channels by number."""
        chosen = ("auto",) if self.diagnostics.dimensions else ()
        return Names(
            self.sensor_names,
            tuple(label.name for label in self.channels),
            self.dims,
            frozenset((*self.results, *chosen)),
            self.start_utc_ns,
            frozenset(c.sensor for c in self.clocks if c.source is ClockSource.SAMPLE_INSTANTS),
        )

    @property
    def not_in_memory(self) -> tuple[str, ...]:
        """Names of the sensors that sent samples, and that a live estimate leaves out."""
        left = (each for each in self.sensors if each.name in self.not_estimated)
        return tuple(each.name for each in left if each.n_samples)

    @property
    def added_by_clocks(self) -> FloatArray | None:
        """What the clocks may have added to the noise PSD at most, shape (n_freqs, n_channels).

        In unit**2/Hz: no more than the noise itself, 0 where it is not known; None before there is
        an estimate.
        """
        return added_by_clocks(self.diagnostics.synchronisation, self.results)

    @property
    def removed(self) -> FloatArray | None:
        """What the clocks may have taken away from the noise PSD at most; as `added_by_clocks`."""
        found = self.diagnostics.synchronisation.removed
        return None if found is None else np.nan_to_num(found)

    @property
    def data_psd(self) -> FloatArray:
        """PSD of what each channel recorded, shape (n_freqs, n_channels), in unit**2/Hz."""
        return np.ascontiguousarray(np.diagonal(self.csm, axis1=1, axis2=2).real)


class NoResultError(InsufficientDataError):
    """No method gives a result for any channel.

    Parameters
    ----------
    message : str
    snapshot : Snapshot
        Of the whole recording, with the advice on what is wrong.
    """

    def __init__(self, message: str, snapshot: Snapshot) -> None:
        super().__init__(message)
        self.snapshot = snapshot


def once(derive: Derive) -> Derive:
    """Return a function, or method, that derives each thing once of what has a dict ``derived``."""

    @wraps(derive)
    def kept(of: Any, *given: object) -> Any:  # noqa: ANN401 - as `derive` states
        key = (derive.__name__, *given)
        if key not in of.derived:
            of.derived[key] = derive(of, *given)
        return of.derived[key]

    return cast("Derive", kept)
