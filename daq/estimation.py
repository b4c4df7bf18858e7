"""Follows a recording and estimates: the only module of this package that knows the estimator.

Theory of operation
-------------------
Segments lie on a fixed lattice of the common grid; one that touches a gap is left out, for every
sensor, and nothing else is. Each new segment is transformed once, with what is known about the
clocks by then. When what is known has become materially better for segments already taken (looked
at whenever their number has grown by a quarter), they are taken again.

``finish`` is one pass over the whole recording with the final clocks: a function of the file
alone. So what is shown when a run ends is what ``huddle estimate`` says about its file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from daq.alignment import AlignedRecording
from daq.errors import CannotAlignError
from daq.recording.reader import Recording
from daq.refinement import DelayMeter
from daq.units import canonical, conversion
from estimator.errors import InsufficientDataError
from estimator.methods import METHODS, self_noise
from estimator.rejection import Reason, SelectedSpectra
from estimator.spectra import CrossSpectra, WelchSettings, scale
from estimator.windows import effective_averages, get_window

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from datetime import datetime
    from pathlib import Path

    from numpy.typing import NDArray

    from daq.bench_model import Bench
    from daq.clock_model import ClockState
    from daq.recording.reader import SensorRecord
    from estimator.self_noise import SelfNoise

    FloatArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]

Progress = Callable[[int, int], None]
_Piece = TypeVar("_Piece")
_Read = TypeVar("_Read")

_VALUES_AT_ONCE = 1 << 19  # samples times channels read together: 4 MB
_LIVE_TOLERANCE = 1e-6  # seconds rms that clocks may move before segments are taken again
_FINAL_TOLERANCE = 1e-7
_REVIEW = 1.25  # growth after which that is looked at
_FIRST_REVIEW = 8  # segments
_MATERIAL_CONSTANT = 0.02  # samples of constant delay, of which a window forgives more
_MOST_PASSES = 4


@dataclass(frozen=True, slots=True)
class Settings:
    """What is estimated, and how.

    Attributes
    ----------
    segment : float
        Length of a segment in seconds.
    overlap, window, detrend
        As `estimator.spectra.WelchSettings` takes them.
    methods : tuple of str
        Names in `estimator.methods.METHODS`; ``("all",)`` for every method that applies.
    correct : bool
        Whether the small-sample bias is removed.
    unit : str or None
        Of the result; that of the first channel where not given.
    start, end : datetime or None
        Only what lies between; with time zone.
    band : (float, float) or None
        Frequencies in Hz in which `target_cov` is wanted; 0.05 to 0.45 of the rate if not given.
    target_cov : float or None
        Wanted coefficient of variation.
    sampling_rate : float or None
        Of the common grid in Hz; the lowest of the sensors' where not given.
    refine : bool
        Whether clocks are refined by the motion the sensors share.
    reject : bool
        Whether segments with a transient in any channel are left out (`estimator.rejection`).
    options : dict
        Further options of the methods.
    """

    segment: float = 10.0
    overlap: float = 0.5
    window: str = "hann"
    detrend: Literal["none", "constant", "linear"] = "constant"
    methods: tuple[str, ...] = ("three-sensor",)
    correct: bool = True
    unit: str | None = None
    start: datetime | None = None
    end: datetime | None = None
    band: tuple[float, float] | None = None
    target_cov: float | None = None
    sampling_rate: float | None = None
    refine: bool = True
    reject: bool = False
    options: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, bench: Bench | None) -> Settings:
        """Return what a bench file says, or what holds where there is none."""
        if bench is None:
            return cls()
        wanted = bench.estimate
        return cls(
            segment=wanted.segment,
            overlap=wanted.overlap,
            window=wanted.window,
            detrend=wanted.detrend,
            methods=(wanted.method,),
            correct=wanted.correct,
            band=wanted.band,
            target_cov=wanted.target_cov,
        )


@dataclass(frozen=True, slots=True)
class ChannelLabel:
    """Which channel a column of the result is, and its unit (of the motion, not of the PSD)."""

    sensor: str
    channel: str
    unit: str


@dataclass(frozen=True, slots=True)
class SensorState:
    """What the recording says about a sensor now."""

    name: str
    sampling_rate: float
    n_samples: int
    n_gaps: int
    n_missing: int
    last_seen: float
    """UTC of the last committed block, in seconds since 1970; NaN before the first."""


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
        Segments taken, and left out for gaps.
    n_effective : float
        Independent averages the segments are worth.
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
    diagnostics : dict
        ``transients``: number of segments left out as disturbed. ``synchronisation``: ``residual``
        between the clocks in seconds by sensor, and the fraction ``noise_bias``, shape
        (n_freqs, n_channels), that it is expected to add to the noise PSD.
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
    sensors: tuple[SensorState, ...]
    clocks: tuple[ClockState, ...]
    drift: FloatArray
    closed: bool
    diagnostics: dict[str, Any] = field(default_factory=dict)

    @property
    def data_psd(self) -> FloatArray:
        """PSD of what each channel recorded, shape (n_freqs, n_channels), in unit**2/Hz."""
        return np.ascontiguousarray(np.diagonal(self.csm, axis1=1, axis2=2).real)


class _Pass:
    """Segments of one recording, taken in order."""

    def __init__(self, recording: Recording, settings: Settings) -> None:
        self.recording = recording
        self.aligned = AlignedRecording(
            recording,
            sampling_rate=settings.sampling_rate,
            start_utc_ns=_utc_ns(settings.start),
            end_utc_ns=_utc_ns(settings.end),
        )
        rate = self.aligned.sampling_rate
        self.welch = WelchSettings(
            sampling_rate=rate,
            segment_length=round(settings.segment * rate),
            overlap=settings.overlap,
            window=settings.window,
            detrend=settings.detrend,
        )
        self.n_channels = len(self.aligned.channels)
        self.refine, self.reject = settings.refine, settings.reject
        self.restart()

    def restart(self) -> None:
        """Begin again, with the clocks as they are now."""
        self._undisturbed: SelectedSpectra | None = None
        if self.reject:
            self._undisturbed = SelectedSpectra(self.welch, self.n_channels)
        self._all = CrossSpectra(self.welch, self.n_channels)
        self.n_seen = 0
        self.taken_at: list[FloatArray] = []
        self.aligned.forget()
        self._meter: DelayMeter | None = None

    @property
    def spectra(self) -> CrossSpectra:
        """Spectra of the segments that count."""
        return self._all if self._undisturbed is None else self._undisturbed.spectra()

    @property
    def transients(self) -> int:
        """Segments left out because something disturbed them."""
        return 0 if self._undisturbed is None else self._undisturbed.counts[Reason.TRANSIENT]

    @property
    def n_complete(self) -> int:
        """Segments of the lattice that are available now."""
        beyond = self.aligned.n_available - self.welch.segment_length
        return max(0, beyond // self.welch.hop + 1)

    @property
    def elapsed(self) -> float:
        """Seconds of the grid that have been looked at."""
        if self.n_seen == 0:
            return 0.0
        length = (self.n_seen - 1) * self.welch.hop + self.welch.segment_length
        return length / self.welch.sampling_rate

    def advance(self, progress: Callable[[int], None] | None = None) -> None:
        """Take every segment that is complete."""
        hop, length = self.welch.hop, self.welch.segment_length
        at_once = max(1, _VALUES_AT_ONCE // (hop * self.n_channels))
        total = self.n_complete
        pieces = [
            (first, min(at_once, total - first)) for first in range(self.n_seen, total, at_once)
        ]

        def read(piece: tuple[int, int]) -> tuple[FloatArray, NDArray[np.bool_]]:
            first, count = piece
            return self.aligned.read(first * hop, (first + count - 1) * hop + length)

        for (first, count), (samples, valid) in zip(pieces, _ahead(read, pieces), strict=True):
            starts = np.arange(count) * hop
            missing = np.concatenate([[0], np.cumsum(~valid)])
            starts = starts[missing[starts + length] == missing[starts]]
            if self._undisturbed is None:
                self._all.add(samples, starts)
            else:
                self._undisturbed.add(samples, starts)
            self.taken_at.append(self._positions(np.arange(first, first + count)))
            self._measure(samples, starts, first * hop)
            self.n_seen += count
            if progress is not None:
                progress(count)

    def set_clocks(self) -> None:
        """Set the clocks by what the segments taken say."""
        if self._meter is not None:
            self.aligned.set_clocks()

    def is_outdated(self, tolerance: float) -> bool:
        """Whether clocks, as known now, differ from those that segments were taken by.

        By more than `tolerance` in seconds rms, that is; or whether delays could be measured now
        and could not yet when segments came one by one.
        """
        if not self.taken_at or self.aligned.is_exact:
            return False
        if self._meter is not None and not self._meter.has_frame:
            return self.n_seen >= self._meter.fewest
        before = np.concatenate(self.taken_at)
        moved = self._positions(np.arange(len(before))) - before
        moved -= moved.mean(axis=1, keepdims=True)  # all sensors alike: no delay between them
        constant = moved.mean(axis=0)
        varying = float(np.sqrt(np.mean((moved - constant) ** 2)))
        return varying > tolerance or bool(
            np.max(np.abs(constant)) * self.welch.sampling_rate > _MATERIAL_CONSTANT
        )

    def drift(self) -> FloatArray:
        """Return middles of segments in seconds, and every sensor's delay there."""
        n_sensors = len(self.aligned.dims)
        taken = np.concatenate(self.taken_at) if self.taken_at else np.empty((0, n_sensors))
        middle = np.arange(len(taken)) * self.welch.hop + self.welch.segment_length / 2
        return np.column_stack([middle / self.welch.sampling_rate, taken])

    def _measure(self, samples: FloatArray, starts: NDArray[np.int64], first: int) -> None:
        """Measure what delays are left, for the clocks' next setting."""
        measurable = self.aligned.measurable if self.refine else ()
        if not measurable:
            return
        if self._meter is None:
            edges = np.cumsum([0, *self.aligned.dims])
            columns = tuple(slice(int(edges[n]), int(edges[n + 1])) for n in measurable)
            window = get_window(self.welch.window, self.welch.segment_length)
            self._meter = DelayMeter(self.welch.sampling_rate, window, columns)
        delays, std = self._meter.measure(samples, starts)
        at = first + starts + self.welch.segment_length / 2
        self.aligned.learn(
            np.asarray(at, dtype=np.float64),
            delays,
            std=std,
            frame_delays=self._meter.frame_delays(),
        )

    def _positions(self, segments: NDArray[np.int64]) -> FloatArray:
        middle = segments * float(self.welch.hop) + self.welch.segment_length / 2
        return self.aligned.delays(np.asarray(middle, dtype=np.float64))


class Estimation:
    """The estimate from recordings, kept up with them as they grow.

    Parameters
    ----------
    paths : sequence of path
        Several recordings of the same sensors accumulate into one estimate.
    settings : Settings, optional
        What the bench in the first recording says, where not given.

    Raises
    ------
    RecordingError
        If a file cannot be read.
    CannotAlignError
        If the sensors cannot be brought onto one grid, or the recordings do not match.
    """

    def __init__(self, paths: Sequence[str | Path], settings: Settings | None = None) -> None:
        if not paths:
            raise CannotAlignError("no recording given; expected at least one")
        self._recordings: list[Recording] = []
        try:
            for path in paths:
                self._recordings.append(Recording.open(path))
            self.settings = Settings.of(self._recordings[0].bench) if settings is None else settings
            self._passes = [_Pass(recording, self.settings) for recording in self._recordings]
            _check_same(self._passes)
            self._unit = canonical(
                self.settings.unit or self._passes[0].aligned.channels[0][1].unit
            )
            self._response = self._responses()
        except BaseException:
            self.close()
            raise
        self._next_review = _FIRST_REVIEW

    def close(self) -> None:
        """Close the recordings."""
        for recording in self._recordings:
            recording.close()

    def __enter__(self) -> Estimation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def n_segments(self) -> int:
        """Segments taken so far."""
        return sum(each.spectra.n_segments for each in self._passes)

    @property
    def n_seen(self) -> int:
        """Segments looked at so far, those left out for gaps included."""
        return sum(each.n_seen for each in self._passes)

    def update(self) -> bool:
        """Take what has been committed since; return whether there was a new segment.

        Raises
        ------
        RecordingError
            If a file is damaged.
        """
        before = self.n_seen
        for each in self._passes:
            each.aligned.refresh()
            each.advance()
        seen = self.n_seen
        if seen >= self._next_review:
            self._next_review = math.ceil(_REVIEW * seen)
            for each in self._passes:
                each.set_clocks()
                if each.is_outdated(_LIVE_TOLERANCE):
                    each.restart()
                    each.advance()
        return seen > before

    def finish(self, progress: Progress | None = None) -> Snapshot:
        """Return the one result: the same while the recording was followed and afterwards.

        Parameters
        ----------
        progress : callable, optional
            Told how many segments are done, and of how many.

        Raises
        ------
        InsufficientDataError
            If no method can say anything; the message says why.
        """
        for number, each in enumerate(self._passes):
            each.aligned.refresh()
            if each.n_seen and not each.aligned.is_exact:
                self._passes[number] = _Pass(each.recording, self.settings)
        total = sum(each.n_complete for each in self._passes)
        done = self.n_seen

        def count(n: int) -> None:
            nonlocal done
            done += n
            if progress is not None:
                progress(done, total)

        for each in self._passes:
            each.advance(count)
            for _ in range(_MOST_PASSES - 1):
                each.set_clocks()
                if not each.is_outdated(_FINAL_TOLERANCE):
                    break
                total += each.n_seen
                each.restart()
                each.advance(count)
        snapshot = self.snapshot()
        if not snapshot.results:
            raise InsufficientDataError(self._why_nothing(snapshot))
        return snapshot

    def snapshot(self) -> Snapshot:
        """Return the estimate as it stands, from the segments taken so far."""
        first = self._passes[0]
        spectra = CrossSpectra(first.welch, first.n_channels)
        for each in self._passes:
            spectra.merge(each.spectra)
        n_segments = spectra.n_segments
        results: dict[str, SelfNoise] = {}
        refused: dict[str, str] = {}
        if n_segments == 0:
            shape = (len(first.welch.frequencies), first.n_channels, first.n_channels)
            csm = np.full(shape, np.nan, dtype=np.complex128)
            n_effective = 0.0
        else:
            csm = spectra.csm()
            if self._response is not None:
                csm = scale(csm, self._response)
            n_effective = self._n_effective()
            results, refused = self._methods(csm, n_effective)
        return Snapshot(
            frequency=first.welch.frequencies,
            csm=csm,
            results=results,
            refused=refused,
            channels=tuple(
                ChannelLabel(sensor, channel.name, self._unit)
                for sensor, channel in first.aligned.channels
            ),
            dims=first.aligned.dims,
            unit=self._unit,
            n_segments=n_segments,
            n_dropped=self.n_seen - n_segments,
            n_effective=n_effective,
            elapsed=sum(each.elapsed for each in self._passes),
            time_left=self._time_left(results, n_effective),
            start_utc_ns=first.aligned.start_utc_ns,
            sensors=tuple(_sensor_state(record) for record in self._recordings[-1].sensors),
            clocks=self._passes[-1].aligned.clocks,
            drift=self._passes[-1].drift(),
            closed=all(recording.closed for recording in self._recordings),
            diagnostics=self._diagnostics(csm, results),
        )

    def _diagnostics(self, csm: ComplexArray, results: dict[str, SelfNoise]) -> dict[str, Any]:
        """Say what is left between the clocks, and what it does to the noise estimate.

        A delay that varies by δ (rms) takes ``(ωδ)²`` of a channel's coherent power out of the
        common motion, and so into its noise.
        """
        aligned = self._passes[-1].aligned
        residual = np.array([state.residual for state in aligned.clocks])
        diagnostics: dict[str, Any] = {
            "transients": sum(each.transients for each in self._passes),
            "synchronisation": {
                "residual": dict(zip((s.sensor for s in aligned.clocks), residual, strict=True))
            },
        }
        if results and len(residual) == len(aligned.dims):
            noise = next(iter(results.values())).noise_psd
            coherent = np.diagonal(csm, axis1=1, axis2=2).real - noise
            delay = np.repeat(residual, aligned.dims)
            turn = 2 * np.pi * self._passes[0].welch.frequencies[:, None] * delay
            with np.errstate(invalid="ignore", divide="ignore"):
                diagnostics["synchronisation"]["noise_bias"] = turn**2 * coherent / np.abs(noise)
        return diagnostics

    def _n_effective(self) -> float:
        window = get_window(self.settings.window, self._passes[0].welch.segment_length)
        return sum(
            effective_averages(window, each.welch.hop, count)
            for each in self._passes
            if (count := each.spectra.n_segments)
        )

    def _methods(
        self, csm: ComplexArray, n_effective: float
    ) -> tuple[dict[str, SelfNoise], dict[str, str]]:
        wanted = tuple(METHODS) if "all" in self.settings.methods else self.settings.methods
        results: dict[str, SelfNoise] = {}
        refused: dict[str, str] = {}
        for method in wanted:
            try:
                with np.errstate(invalid="ignore", divide="ignore"):  # responses vanish at 0 Hz
                    results[method] = self_noise(
                        method,
                        csm,
                        dims=self._passes[0].aligned.dims,
                        n_effective=n_effective,
                        correct=self.settings.correct,
                        **self.settings.options,
                    )
            except InsufficientDataError as error:
                refused[method] = str(error)
        return results, refused

    def _time_left(self, results: dict[str, SelfNoise], n_effective: float) -> float | None:
        target = self.settings.target_cov
        if target is None or not results:
            return None
        welch = self._passes[0].welch
        band = self.settings.band or (0.0, 0.45 * welch.sampling_rate)
        inside = (welch.frequencies >= band[0]) & (welch.frequencies <= band[1])
        inside[0] = False
        cov = next(iter(results.values())).cov[inside]
        if not np.isfinite(cov).any():
            return None
        reached = float(np.nanmax(np.nanmedian(cov, axis=0)))
        # c.o.v. ~ 1 / √n, and averages come at a steady pace.
        missing = n_effective * max(0.0, (reached / target) ** 2 - 1)
        pace = self.n_segments * welch.hop / welch.sampling_rate / n_effective
        return missing * pace

    def _responses(self) -> ComplexArray | None:
        """Return what spectra are divided by: the response, and the way to the unit."""
        aligned, welch = self._passes[0].aligned, self._passes[0].welch
        frequency = welch.frequencies
        response = np.ones((len(frequency), len(aligned.channels)), dtype=np.complex128)
        for column, (_, channel) in enumerate(aligned.channels):
            with np.errstate(divide="ignore", invalid="ignore"):
                response[:, column] = 1 / conversion(channel.unit, self._unit, frequency)
            if channel.response is not None:
                response[:, column] *= channel.response.at(frequency)
        return None if np.all(response == 1) else response

    def _why_nothing(self, snapshot: Snapshot) -> str:
        names = ", ".join(str(recording.path) for recording in self._recordings)
        if snapshot.n_segments == 0:
            welch = self._passes[0].welch
            available = sum(each.aligned.n_available for each in self._passes)
            return (
                f"{names}: not one whole segment: {available / welch.sampling_rate:.3g} s with all"
                f" sensors, {snapshot.n_dropped} segments left out for gaps, and a segment takes"
                f" {self.settings.segment:g} s; record longer or choose a shorter segment"
            )
        return f"{names}: " + "; ".join(f"{name}: {why}" for name, why in snapshot.refused.items())


def estimate(
    paths: Sequence[str | Path],
    settings: Settings | None = None,
    *,
    progress: Progress | None = None,
) -> Snapshot:
    """Estimate the self-noise from finished recordings (or from what there is of a growing one).

    Parameters
    ----------
    paths : sequence of path
        Several recordings of the same sensors accumulate into one estimate.
    settings : Settings, optional
        What the bench in the first recording says, where not given.
    progress : callable, optional
        Told how many segments are done, and of how many.

    Raises
    ------
    RecordingError, CannotAlignError
        If a file cannot be read, or its sensors not be aligned.
    InsufficientDataError
        If there is too little for any of the methods.
    """
    with Estimation(paths, settings) as estimation:
        return estimation.finish(progress)


def _ahead(read: Callable[[_Piece], _Read], pieces: Sequence[_Piece]) -> Iterator[_Read]:
    """Read pieces in order, the next one while the one before is worked on."""
    if len(pieces) < 2:
        yield from map(read, pieces)
        return
    with ThreadPoolExecutor(1) as pool:
        coming = pool.submit(read, pieces[0])
        for following in pieces[1:]:
            piece = coming.result()
            coming = pool.submit(read, following)
            yield piece
        yield coming.result()


def _check_same(passes: list[_Pass]) -> None:
    first = passes[0]
    for other in passes[1:]:
        same = (
            other.welch == first.welch
            and other.aligned.dims == first.aligned.dims
            and _labels(other) == _labels(first)
        )
        if not same:
            raise CannotAlignError(
                f"{other.recording.path} does not match {first.recording.path}:"
                f" {_described(other)} against {_described(first)};"
                " one estimate takes recordings of the same sensors at one sampling rate"
            )


def _labels(each: _Pass) -> list[tuple[str, str, str]]:
    return [(sensor, channel.name, channel.unit) for sensor, channel in each.aligned.channels]


def _described(each: _Pass) -> str:
    names = ", ".join(f"{sensor} {channel} in {unit}" for sensor, channel, unit in _labels(each))
    return f"{names} at {each.welch.sampling_rate:g} Hz"


def _utc_ns(instant: datetime | None) -> int | None:
    if instant is None:
        return None
    return math.floor(instant.timestamp()) * 10**9 + instant.microsecond * 1000


def _sensor_state(record: SensorRecord) -> SensorState:
    blocks = record.blocks
    return SensorState(
        name=record.name,
        sampling_rate=record.sampling_rate,
        n_samples=record.n_samples,
        n_gaps=len(record.gaps),
        n_missing=int(record.gaps["missing"].sum()),
        last_seen=float(blocks["utc_ns"][-1]) * 1e-9 if len(blocks) else float("nan"),
    )
