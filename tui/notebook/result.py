"""An estimate as scripts and notebooks use it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.masks.mask_file import masks_named
from daq.bench.units import levels_db
from daq.errors import WrongSettingError
from daq.results import result as results
from daq.results.band_summary import held
from daq.results.sources import LoggedEvent, uncounted_events
from estimator.levels.bands import band_edges
from tui.notebook import text
from tui.output.extras import load
from tui.page.table import Table
from tui.wording.formatting import level, level_with_error

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from daq.bench.channel import Channel
    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from daq.estimation.snapshot_diagnostics import (
        SnapshotDiagnostics,
    )
    from daq.results.facts.fact import Fact
    from estimator.self_noise.result import SelfNoise
    from estimator.types import ComplexArray, FloatArray, IntArray


def figure(result: results.Result, *, models: Sequence[Mask], width: float) -> Figure:
    """Return a figure with an axis for each channel, sensors below each other."""
    pyplot = load("matplotlib.pyplot")
    from tui.page.drawing import look, stack, stack_height  # noqa: PLC0415
    from tui.report.figures.curves import noise_plots  # noqa: PLC0415 - loads matplotlib

    with look():
        plots = noise_plots(result, models)
        drawn: Figure = pyplot.figure(figsize=(width, stack_height(plots)), facecolor="white")
        stack(plots, drawn, margin=0.1)
    return drawn


def draw(axes: Axes, snapshot: Snapshot, models: Sequence[Mask]) -> None:
    """Draw the noise of every channel, with its interval, and noise models on axes that exist.

    Without noise, as of one sensor, the PSD of the samples.
    """
    noise = next(iter(snapshot.results.values()), None)
    psd = snapshot.data_psd if noise is None else noise.noise_psd
    frequency = snapshot.frequency[1:]  # the axis is logarithmic
    for column, label in enumerate(snapshot.channels):
        (line,) = axes.plot(frequency, levels_db(psd[1:, column]), label=label.name)
        if noise is not None:
            low, high = (levels_db(each[1:, column]) for each in (noise.low, noise.high))
            axes.fill_between(frequency, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    for mask in models:
        at = mask.points(frequency)
        at = at[(at >= frequency[0]) & (at <= frequency[-1])]
        axes.plot(at, levels_db(mask.at(at, snapshot.unit)), "--", color="0.4", label=mask.name)
    axes.set_xscale("log")
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel(f"dB re 1 ({snapshot.unit})²/Hz")


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
        Means over the band of the samples' PSD and of the noise PSD, and the interval of the
        latter, in unit**2/Hz.
    confidence : float
        Of the interval.
    """

    low_hz: float
    high_hz: float
    method: str
    channels: tuple[ChannelLabel, ...]
    data_psd: FloatArray
    noise_psd: FloatArray
    noise_low: FloatArray
    noise_high: FloatArray
    confidence: float = 0.95

    @property
    def noise_db(self) -> FloatArray:
        """`noise_psd` in dB re 1 unit**2/Hz; NaN where it is not positive."""
        return levels_db(self.noise_psd)

    def __repr__(self) -> str:
        values = zip(self.channels, self.data_psd, self.noise_psd, self.noise_high, strict=True)
        rows = (
            (label.sensor, label.channel, level(data), level_with_error(mean, high))
            for label, data, mean, high in values
        )
        right = ("data", self.method)
        title = (
            f"Self-noise, mean over {self.low_hz:.3g} to {self.high_hz:.3g} Hz, dB re 1"
            f" ({self.channels[0].unit})²/Hz, with its {100 * self.confidence:g} % interval"
        )
        table = Table.of(("sensor", "channel", *right), rows, right=right)
        return text.rendered([title, table])


class Result:
    """Self-noise of every channel, as `huddle.self_noise` and `huddle.estimate` return it.

    Arrays have the axes frequency and channel; `channels` names the columns. With several methods,
    arrays are those of `method`; `with_method` selects another.

    Attributes
    ----------
    result : daq.results.result.Result
        What follows from the estimate: band, means, precision, verdict, facts.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        settings: Settings,
        bench: Bench | None = None,
        recordings: Sequence[Path] = (),
        recorded: Mapping[str, Channel] | None = None,
    ) -> None:
        self.result = results.Result(snapshot, settings, bench, tuple(recordings))
        self._recorded = recorded

    @property
    def snapshot(self) -> Snapshot:
        """The complete result: clocks, gaps, octaves, diagnostics."""
        return self.result.snapshot

    @property
    def settings(self) -> Settings:
        """Options of the estimate."""
        return self.result.settings

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
    def facts(self) -> tuple[Fact, ...]:
        """What is known of the test beyond its numbers, the worst first.

        Each has its typed ``fact`` with numbers, and its ``words``; ``str()`` gives sentences.
        """
        return self.result.facts

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
    def bench(self) -> Bench | None:
        """The bench in the recording, if it was one."""
        return self.result.bench

    @property
    def recordings(self) -> tuple[Path, ...]:
        """The recordings that were estimated; none for arrays."""
        return self.result.recordings

    @property
    def _noise(self) -> SelfNoise:
        return self.snapshot.results[self.method]

    def __repr__(self) -> str:
        return text.text(self.result)

    def _repr_html_(self) -> str:
        return text.html(self.result)

    def __getitem__(self, label: tuple[str, str]) -> ChannelNoise:
        """Return one channel, by sensor and channel: ``result["A", "X"]``."""
        for column, each in enumerate(self.channels):
            if (each.sensor, each.channel) == label:
                noise = self.noise_psd, self.noise_low, self.noise_high, self.cov
                own = (values[:, column] for values in (self.data_psd, *noise))
                return ChannelNoise(*label, each.unit, self.frequency, *own)
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
        return Result(snapshot, self.settings, self.bench, self.recordings, self._recorded)

    def interval(self, confidence: float = 0.95) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the interval of the noise at every frequency, at any confidence.

        With everything that widens it. With 0.95 they are `noise_low` and `noise_high`.

        Parameters
        ----------
        confidence : float
            Between 0 and 1.

        Returns
        -------
        low, high : float64, shape (n_freqs, n_channels)
        """
        quantile = _quantile(confidence)
        edges = np.arange(len(self.frequency) + 1)
        return self.result.spectrum(self.method).levels(edges).ends(quantile)

    def band(
        self, low: float | None = None, high: float | None = None, *, confidence: float = 0.95
    ) -> BandNoise:
        """Return the mean noise of every channel in a band.

        Parameters
        ----------
        low, high : float, optional
            In Hz; as the option ``band`` of the estimate, or all usable frequencies, if not given.
        confidence : float
            Of the interval, between 0 and 1.

        Raises
        ------
        BandError
            If no frequency lies in the band.
        """
        usual = self.result.band
        band = (usual[0] if low is None else low, usual[1] if high is None else high)
        edges = band_edges(self.frequency, band)
        found = self.result.spectrum(self.method).levels(edges)
        noise_low, noise_high = found.ends(_quantile(confidence))
        inside = slice(*edges)
        width = np.gradient(self.frequency)[inside]
        return BandNoise(
            *band,
            self.method,
            self.channels,
            np.average(self.data_psd[inside], axis=0, weights=width),
            held(found.mean, *found.ends())[0],
            noise_low[0],
            noise_high[0],
            confidence,
        )

    def plot(
        self, *, ax: Axes | None = None, models: str | Sequence[str] = (), width: float = 7.0
    ) -> Figure:
        """Draw PSD of samples and noise, with its interval, against frequency.

        Needs matplotlib (extra ``report``).

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Draw the noise of every channel there, in place of a figure with an axis for each.
        models : str or sequence of str
            Noise models to draw: ``"nlnm"``, ``"nhnm"``, ``"alnm"``, ``"ahnm"``, or CSV files.
        width : float
            Of the figure, in inches.
        """
        masks = masks_named(models if isinstance(models, str) else ",".join(models))
        for mask in masks:
            mask.check_unit(self.unit)
        if ax is None:
            return figure(self.result, models=masks, width=width)
        draw(ax, self.snapshot, masks)
        drawn = ax.get_figure(root=True)
        if drawn is None:
            raise WrongSettingError("ax: axes of no figure; expected axes of a figure")
        return drawn

    def to_xarray(self) -> xr.Dataset:
        """Return the spectra with the dimensions estimate, trace and frequency.

        The dimension ``estimate`` names the method, ``trace`` sensor and channel, which are
        coordinates too. ``csm_real`` and ``csm_imag`` are the cross-spectral matrix, with
        ``coherence``; ``response_amplitude`` and ``response_phase`` what the samples were divided
        by to be motion. Attributes say by which program, with which settings and from which span
        of time, and what each flag means. Units are those of the CF conventions. Needs xarray
        (extra ``notebook``).
        """
        from tui.notebook.tables import to_xarray  # noqa: PLC0415 - loads xarray
        from tui.output.json_document import provenance  # noqa: PLC0415 - seldom needed

        said = provenance(self.result, with_recordings=False)
        return to_xarray(self.snapshot, said, self._recorded, matrix=True)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write what `to_xarray` returns as netCDF, or as Zarr if the name ends in ``.zarr``.

        The attributes of the file have the SHA-256 of the recordings, too. A file that was there is
        replaced when the new one is complete. `huddle.load` reads it. Needs h5netcdf (extra
        ``notebook``) or zarr (extra ``zarr``).
        """
        from tui.notebook.curve_files import write_dataset  # noqa: PLC0415 - seldom needed
        from tui.output.json_document import provenance  # noqa: PLC0415

        said = provenance(self.result)
        write_dataset(self.to_xarray().assign_attrs(said), path)

    def to_frame(self) -> pd.DataFrame:
        """Return the spectra as a tidy table: a row a method, channel and frequency.

        Needs pandas (extra ``notebook``).
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
        from tui.output.json_document import document  # noqa: PLC0415 - seldom needed
        from tui.output.json_values import plain  # noqa: PLC0415

        found: dict[str, Any] = plain(document(self.result))
        return found


def _quantile(confidence: float) -> float:
    """Return the standard deviations to either end of an interval.

    Raises
    ------
    WrongSettingError
        The confidence is not between 0 and 1.
    """
    if not 0 < confidence < 1:
        raise WrongSettingError(f"confidence={confidence!r}: expected a fraction such as 0.95")
    return NormalDist().inv_cdf(0.5 + confidence / 2)
