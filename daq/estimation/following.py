"""Keeps an estimate up with recordings as they grow.

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
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.errors import CannotAlignError
from daq.estimation.segments import Pass
from daq.estimation.settings import Settings
from daq.estimation.snapshot import ChannelLabel, SensorState, Snapshot
from daq.recording.reader import Recording
from daq.units import canonical, conversion
from estimator.errors import InsufficientDataError
from estimator.methods import METHODS, self_noise
from estimator.spectra import CrossSpectra, scale
from estimator.windows import effective_averages, get_window

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daq.recording.reader import SensorRecord
    from estimator.self_noise import SelfNoise

    FloatArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]

Progress = Callable[[int, int], None]

_LIVE_TOLERANCE = 1e-6  # seconds rms that clocks may move before segments are taken again
_FINAL_TOLERANCE = 1e-7
_REVIEW = 1.25  # growth after which that is looked at
_FIRST_REVIEW = 8  # segments
_MOST_PASSES = 4


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
            self._passes = [Pass(recording, self.settings) for recording in self._recordings]
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
                self._passes[number] = Pass(each.recording, self.settings)
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


def _check_same(passes: list[Pass]) -> None:
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


def _labels(each: Pass) -> list[tuple[str, str, str]]:
    return [(sensor, channel.name, channel.unit) for sensor, channel in each.aligned.channels]


def _described(each: Pass) -> str:
    names = ", ".join(f"{sensor} {channel} in {unit}" for sensor, channel, unit in _labels(each))
    return f"{names} at {each.welch.sampling_rate:g} Hz"


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
