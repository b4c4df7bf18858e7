"""An estimate as scripts and notebooks use it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.units import levels_db
from daq.errors import WrongSettingError
from daq.results.band_summary import band_of, channel_means
from daq.results.sources import uncounted_events
from estimator.levels.bands import band_edges
from tui.notebook import text
from tui.output.extras import load
from tui.wording.facts import known

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from daq.estimation.snapshot_diagnostics import (
        SnapshotDiagnostics,
    )
    from daq.results.sources import LoggedEvent
    from estimator.self_noise.result import SelfNoise
    from estimator.types import ComplexArray, FloatArray, IntArray
    from tui.wording.facts import Known


def figure(snapshot: Snapshot, settings: Settings, bench: Bench | None, width: float) -> Figure:
    """Return a figure with an axis for each channel, sensors below each other."""
    pyplot = load("matplotlib.pyplot")
    from tui.report.figures.curves import noise_plots  # noqa: PLC0415 - loads matplotlib
    from tui.report.figures.drawing import look, stack, stack_height  # noqa: PLC0415

    with look():
        plots = noise_plots(snapshot, settings, bench)
        drawn: Figure = pyplot.figure(figsize=(width, stack_height(plots)), facecolor="white")
        stack(plots, drawn, margin=0.1)
    return drawn


@dataclass(frozen=True, slots=True, eq=False)
class ChannelNoise:
    """Noise of one channel against frequency: arrays of shape (n_freqs,), PSD in unit**2/Hz."""

    sensor: str
    channel: str
    unit: str
    frequency: FloatArray
    data_psd: FloatArray
    noise_psd: FloatArray
    noise_low: FloatArray
    noise_high: FloatArray
    cov: FloatArray

    def __repr__(self) -> str:
        return (
            f"ChannelNoise({self.sensor} {self.channel}, ({self.unit})²/Hz,"
            f" {len(self.frequency)} frequencies from {self.frequency[0]:g} to"
            f" {self.frequency[-1]:g} Hz)"
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class BandNoise:
    """Mean noise of every channel in a band.

    Attributes
    ----------
    low_hz, high_hz : float
        Ends of the band.
    method : str
    channels : tuple of ChannelLabel
        Sensor, channel and unit of each value.
    data_psd, noise_psd, noise_low, noise_high : float64, shape (n_channels,)
        Means over the band of the samples' PSD and of the noise PSD, and the 95 % interval of the
        latter, in unit**2/Hz.
    """

    low_hz: float
    high_hz: float
    method: str
    channels: tuple[ChannelLabel, ...]
    data_psd: FloatArray
    noise_psd: FloatArray
    noise_low: FloatArray
    noise_high: FloatArray

    @property
    def noise_db(self) -> FloatArray:
        """`noise_psd` in dB re 1 unit**2/Hz; NaN where it is not positive."""
        return levels_db(self.noise_psd)

    def __repr__(self) -> str:
        return text.band(
            self.channels,
            self.data_psd,
            self.noise_psd,
            self.noise_high,
            span=(self.low_hz, self.high_hz),
            method=self.method,
        )


class Result:
    """Self-noise of every channel, as `huddle.self_noise` and `huddle.estimate` return it.

    Arrays have the axes frequency and channel; `channels` names the columns. With several methods,
    arrays are those of `method`; `with_method` selects another.

    Attributes
    ----------
    snapshot : Snapshot
        The complete result: clocks, gaps, octaves, diagnostics.
    settings : Settings
        Options of the estimate.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        settings: Settings,
        bench: Bench | None = None,
        recordings: Sequence[Path] = (),
    ) -> None:
        self.snapshot = snapshot
        self.settings = settings
        self._bench = bench
        self._recordings = tuple(recordings)

    @property
    def method(self) -> str:
        """Method of the arrays."""
        return next(iter(self.snapshot.results))

    @property
    def methods(self) -> tuple[str, ...]:
        """Methods that gave an estimate."""
        return tuple(self.snapshot.results)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return self.snapshot.sensor_names

    @property
    def channels(self) -> tuple[ChannelLabel, ...]:
        """Sensor, channel and unit of each column."""
        return self.snapshot.channels

    @property
    def unit(self) -> str:
        """Unit of the motion; spectra are in its square per Hz."""
        return self.snapshot.unit

    @property
    def frequency(self) -> FloatArray:
        """In Hz, shape (n_freqs,)."""
        return self.snapshot.frequency

    @property
    def noise_psd(self) -> FloatArray:
        """One-sided noise PSD in unit**2/Hz, shape (n_freqs, n_channels).

        Not clipped, so it can be negative; NaN where there is no estimate.
        """
        return self._noise.noise_psd

    @property
    def noise_low(self) -> FloatArray:
        """Lower end of the 95 % interval, shape (n_freqs, n_channels)."""
        return self._noise.low

    @property
    def noise_high(self) -> FloatArray:
        """Upper end of the 95 % interval, shape (n_freqs, n_channels)."""
        return self._noise.high

    @property
    def cov(self) -> FloatArray:
        """Coefficient of variation of `noise_psd`, shape (n_freqs, n_channels)."""
        return self._noise.cov

    @property
    def flags(self) -> IntArray:
        """Sums of `estimator.self_noise.result.Flag`, shape (n_freqs, n_channels)."""
        return self._noise.flags

    @property
    def data_psd(self) -> FloatArray:
        """One-sided PSD of the samples in unit**2/Hz, shape (n_freqs, n_channels)."""
        return self.snapshot.data_psd

    @property
    def csm(self) -> ComplexArray:
        """Cross-spectral matrix, shape (n_freqs, n_channels, n_channels), in unit**2/Hz."""
        return self.snapshot.csm

    @property
    def n_segments(self) -> int:
        """Segments in the estimate."""
        return self.snapshot.n_segments

    @property
    def effective_averages(self) -> float:
        """Independent averages that the segments are worth."""
        return self.snapshot.n_effective

    @property
    def diagnostics(self) -> SnapshotDiagnostics:
        """What the samples show of the test: coherence, orientations, delays, the model test."""
        return self.snapshot.diagnostics

    @property
    def facts(self) -> tuple[Known, ...]:
        """What is known of the test beyond its numbers, the worst first.

        Each has its typed ``fact`` with numbers, and its ``words``; ``str()`` gives sentences.
        """
        return known(self.snapshot, self.settings)

    @property
    def advice(self) -> tuple[str, ...]:
        """The facts that invalidate or delay the result, and what to do, in sentences."""
        return tuple(str(each) for each in self.facts if each.needs_action)

    @property
    def events(self) -> tuple[LoggedEvent, ...]:
        """Samples that sensors lost, or repeated, without counting them: when, and what to check.

        What was noticed while recording has `RecordingFile.events`.
        """
        return uncounted_events(self.snapshot.clocks)

    @property
    def _noise(self) -> SelfNoise:
        return self.snapshot.results[self.method]

    def __repr__(self) -> str:
        return text.result(self.snapshot, self.settings)

    def __getitem__(self, label: tuple[str, str]) -> ChannelNoise:
        """Return one channel, by sensor and channel: ``result["A", "X"]``."""
        for column, each in enumerate(self.channels):
            if (each.sensor, each.channel) == label:
                return ChannelNoise(
                    each.sensor,
                    each.channel,
                    each.unit,
                    self.frequency,
                    self.data_psd[:, column],
                    self.noise_psd[:, column],
                    self.noise_low[:, column],
                    self.noise_high[:, column],
                    self.cov[:, column],
                )
        known = ", ".join(f'"{each.sensor}", "{each.channel}"' for each in self.channels)
        raise KeyError(f"{label!r}: expected a sensor and a channel, one of: {known}")

    def with_method(self, method: str) -> Result:
        """Return the estimate by another of `methods`.

        Raises
        ------
        WrongSettingError
            If there is none by that method.
        """
        if method not in self.snapshot.results:
            why = self.snapshot.refused.get(method)
            raise WrongSettingError(
                f"method={method!r}: {why or 'not estimated'}; there is {', '.join(self.methods)}"
            )
        results = {method: self.snapshot.results[method]} | self.snapshot.results
        snapshot = replace(self.snapshot, results=results)
        return Result(snapshot, self.settings, self._bench, self._recordings)

    def band(self, low: float | None = None, high: float | None = None) -> BandNoise:
        """Return the mean noise of every channel in a band.

        Parameters
        ----------
        low, high : float, optional
            In Hz; as the option ``band`` of the estimate, or all usable frequencies, if not given.

        Raises
        ------
        BandError
            If no frequency lies in the band.
        """
        usual = band_of(self.settings, self.snapshot)
        band = (usual[0] if low is None else low, usual[1] if high is None else high)
        means = channel_means(self._noise, self.snapshot, self.settings, band)
        inside = slice(*band_edges(self.frequency, band))
        width = np.gradient(self.frequency)[inside]
        return BandNoise(
            *band,
            self.method,
            self.channels,
            np.average(self.data_psd[inside], axis=0, weights=width),
            np.array([float(each.mean[0]) for each in means]),
            np.array([float(each.low[0]) for each in means]),
            np.array([float(each.high[0]) for each in means]),
        )

    def plot(self, *, width: float = 7.0) -> Figure:
        """Draw PSD of samples and noise, with its interval, against frequency.

        Needs matplotlib: ``pip install 'huddle-bench[report]'``.

        Parameters
        ----------
        width : float
            Of the figure, in inches.
        """
        from tui.notebook.result import figure  # noqa: PLC0415 - loads matplotlib

        return figure(self.snapshot, self.settings, self._bench, width)

    def to_xarray(self) -> xr.Dataset:
        """Return the spectra with the dimensions estimate, sensor, channel and frequency.

        The dimension ``estimate`` names the method. NaN where a sensor has no channel of a name
        that others have. Attributes say by which program, with which settings and from which span
        of time, and what each flag means. Needs xarray: ``pip install 'huddle-bench[notebook]'``.
        """
        from tui.notebook.tables import to_xarray  # noqa: PLC0415 - loads xarray
        from tui.output.json_document import provenance  # noqa: PLC0415 - seldom needed

        return to_xarray(self.snapshot, provenance(self.snapshot, self.settings))

    def to_frame(self) -> pd.DataFrame:
        """Return the spectra as a tidy table: a row a method, channel and frequency.

        Needs pandas: ``pip install 'huddle-bench[notebook]'``.
        """
        from tui.notebook.tables import to_frame  # noqa: PLC0415 - loads pandas

        return to_frame(self.snapshot)

    def to_dict(self) -> dict[str, Any]:
        """Return what ``huddle estimate --json`` writes; of arrays without recordings.

        Raises
        ------
        RecordingError
            If a recording cannot be read any more.
        """
        from daq.results.decision.limits import judge  # noqa: PLC0415 - seldom needed
        from daq.results.sources import sources  # noqa: PLC0415
        from tui.output.json_document import document  # noqa: PLC0415

        return document(
            self.snapshot,
            self.settings,
            sources=sources(self._recordings),
            verdict=judge(self._bench, self.snapshot, self.settings),
        )
