"""The estimate at one moment, as front ends see it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.recording.interface import ReadableSensor
    from daq.timing.clock_model import ClockState
    from estimator.self_noise.result import SelfNoise
    from estimator.spectra.multiresolution import Band

    FloatArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class ChannelLabel:
    """Which channel a column of the result is, and its unit (of the motion, not of the PSD)."""

    sensor: str
    channel: str
    unit: str


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

    @classmethod
    def of(cls, record: ReadableSensor) -> SensorTotals:
        """Return the totals of a sensor of a recording."""
        last = record.blocks[-1:]["utc_ns"]
        return cls(
            name=record.name,
            sampling_rate=record.sampling_rate,
            n_samples=record.n_samples,
            n_gaps=len(record.gaps),
            n_missing=int(record.gaps["missing"].sum()),
            last_seen=float(last[0]) * 1e-9 if len(last) else float("nan"),
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
    left_out: dict[str, int] = field(default_factory=dict)
    """Its segments that do not count: "gap" (or clipped), and "transient"."""

    @classmethod
    def of(cls, band: Band) -> Octave:
        """Return what the frequencies of a band rest on."""
        return cls(
            low=float(band.frequencies[0]),
            high=float(band.frequencies[-1]),
            segment=band.settings.segment_length / band.settings.sampling_rate,
            n_segments=band.n_segments,
            n_effective=band.n_effective,
            left_out={reason.value: count for reason, count in band.left_out.items()},
        )


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
    time_left : float or None
        Seconds until the target c.o.v. is reached; None where there is no target or no estimate.
    start_utc_ns : int
        UTC of the first grid sample.
    sensors, clocks : tuple
    drift : float64, shape (n_segments, 1 + n_sensors)
        Middle of each segment looked at, in seconds from `start_utc_ns`, and by how much each
        sensor's own count of time then lags, in seconds: what the clocks do. Of the last recording.
    closed : bool
        Whether nothing more will come.
    left_out : dict
        How many segments were left out, by reason: "gap", "clipped", "transient".
    octaves : tuple of Octave
        Rising; empty where all frequencies rest on the same segments.
    diagnostics : dict
        ``synchronisation``: ``residual`` between the clocks in seconds by sensor, and the fraction
        ``noise_bias``, shape (n_freqs, n_channels), that it is expected to add to the noise PSD.
        ``dimension``: tuple of `estimator.likelihood.dimension.BandDimension`, where it was chosen.
        Of a finished estimate also ``clipped``, the share of samples that stand at the end of the
        range by channel ("B.X") where there are any, and what
        `daq.estimation.diagnosis.diagnosis` returns.
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
    time_left: float | None
    start_utc_ns: int
    sensors: tuple[SensorTotals, ...]
    clocks: tuple[ClockState, ...]
    drift: FloatArray
    closed: bool
    left_out: dict[str, int] = field(default_factory=dict)
    octaves: tuple[Octave, ...] = ()
    diagnostics: dict[str, Any] = field(default_factory=dict)

    @property
    def data_psd(self) -> FloatArray:
        """PSD of what each channel recorded, shape (n_freqs, n_channels), in unit**2/Hz."""
        return np.ascontiguousarray(np.diagonal(self.csm, axis1=1, axis2=2).real)
