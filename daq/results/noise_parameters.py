"""Noise of every channel as parameters: terms, Allan deviation, quantisation, data sheet."""

from __future__ import annotations

import enum
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import canonical, conversion
from daq.results.band_summary import band_of, correlation_of
from estimator.errors import InsufficientDataError
from estimator.levels.bands import band_edges, third_octaves
from estimator.levels.contributions import by_chance
from estimator.levels.interval import NORMAL_95
from estimator.records import dataclass

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.bench.model import Bench, DataSheet
    from daq.estimation.snapshot import ChannelLabel
    from daq.results.band_summary import Estimate, Levels, Spectrum
    from estimator.noise_parameters.allan import AllanDeviation
    from estimator.noise_parameters.fit import NoiseParameters
    from estimator.types import FloatArray

QUANTISATION_SHARE = 0.5
"""Share of the noise from which on it is said that most of it is quantisation."""
THIRD = 2 ** (1 / 6)
"""Half a third of an octave: a density is the mean over so much to either side."""


class SheetQuantity(enum.StrEnum):
    """What a data sheet states."""

    NOISE_DENSITY = "noise-density"
    """In unit/√Hz, at a frequency."""
    INTEGRATED_NOISE = "integrated-noise"
    """In unit rms, in a band."""
    DYNAMIC_RANGE = "dynamic-range"
    """In dB, of a sine of full scale above the noise in a band."""


class SheetOutcome(enum.StrEnum):
    """A measured value beside the data sheet's."""

    MEETS = "meets"
    """The whole interval is as good as stated, or better."""
    FALLS_SHORT = "falls-short"
    """The whole interval is worse than stated."""
    NOT_DECIDED = "not-decided"
    """The interval holds the stated value."""
    UNKNOWN = "unknown"
    """There is no estimate."""


@dataclass(frozen=True, slots=True)
class SheetComparison:
    """One value of a data sheet.

    Attributes
    ----------
    quantity : SheetQuantity
    low_hz, high_hz : float
        Band in which it was measured.
    unit : str
        Of the values.
    stated : float
        Of the data sheet.
    measured : float
        Of the estimate.
    low, high : float
        Its 95 % interval.
    outcome : SheetOutcome
    """

    quantity: SheetQuantity
    low_hz: float
    high_hz: float
    unit: str
    stated: float
    measured: float
    low: float
    high: float
    outcome: SheetOutcome


@dataclass(frozen=True, slots=True, eq=False)
class ChannelParameters:
    """The noise of one channel as parameters.

    Attributes
    ----------
    label : ChannelLabel
    parameters : NoiseParameters or None
        None where there are too few frequencies with an estimate; `refused` says why.
    allan : AllanDeviation or None
    refused : str
    quantisation_psd : float
        Mean over the band, in unit**2/Hz; NaN where samples are not whole numbers.
    quantisation_share : float
        Of the mean noise in the band; NaN where either is not known.
    comparisons : tuple of SheetComparison
        With the data sheet in the bench file.
    """

    label: ChannelLabel
    parameters: NoiseParameters | None
    allan: AllanDeviation | None
    refused: str
    quantisation_psd: float
    quantisation_share: float
    comparisons: tuple[SheetComparison, ...]


def noise_parameters(
    estimate: Estimate, bench: Bench | None = None
) -> tuple[ChannelParameters, ...]:
    """Return the noise of every channel as parameters, by the method that judges.

    They are fitted to the whole usable spectrum: slopes show over decades, not in a band. None of
    a snapshot in which that method has no result.
    """
    snapshot = estimate.snapshot
    # every estimate asks for the shares of quantisation below, few for these
    from estimator.noise_parameters.allan import allan_deviation  # noqa: PLC0415
    from estimator.noise_parameters.fit import fit  # noqa: PLC0415

    noise = estimate.noise
    if noise is None:
        return ()
    frequency, correlation = snapshot.frequency, correlation_of(estimate.settings)
    band = band_of(replace(estimate.settings, band=None), snapshot)
    spectrum = estimate.spectrum(estimate.method)
    edges = third_octaves(frequency, *band)
    levels = spectrum.levels(edges)
    bounds = _bounds(noise.noise_psd, levels, edges)
    shares = quantisation_shares(estimate)
    found = []
    for column, label in enumerate(snapshot.channels):
        psd, cov = noise.noise_psd[:, column], noise.cov[:, column]
        parameters = allan = None
        refused = ""
        try:
            bound = bounds[:, column]
            parameters = fit(frequency, psd, cov, correlation, band=band, bound=bound)
            allan = allan_deviation(frequency, psd, cov, correlation, parameters, bound=bound)
            parameters, allan = _with_factor(parameters, allan, float(levels.deviation[column]))
        except InsufficientDataError as error:
            refused = str(error)
        sheet = _data_sheet(bench, label)
        found.append(
            ChannelParameters(
                label,
                parameters,
                allan,
                refused,
                *shares[column],
                ()
                if sheet is None
                else tuple(
                    _compared(sheet, label, frequency, psd, spectrum=spectrum, column=column)
                ),
            )
        )
    return tuple(found)


def _bounds(psd: FloatArray, levels: Levels, edges: NDArray[np.int64]) -> FloatArray:
    """Return by how much noise may be off beside its scatter, (n_freqs, n_channels).

    As the intervals of its bands have it. Where an interval excludes the estimate, all of it.
    """
    low, high = levels.ends(factor=False)
    inner_low, inner_high = levels.of_scatter.interval()
    inside, sizes = slice(edges[0], edges[-1]), np.diff(edges)
    known = np.isfinite(psd[inside])
    total, count = (
        np.add.reduceat(each, edges[:-1] - edges[0], axis=0)
        for each in (np.where(known, psd[inside], 0.0), known.astype(np.float64))
    )
    mean = total / np.maximum(count, 1.0)
    with np.errstate(invalid="ignore"):
        off = np.fmax(inner_low - np.fmax(low, 0.0), high - inner_high)
    off = np.where(mean > high, mean, np.where(np.isinf(high), high, np.fmax(off, 0.0)))
    found = np.zeros(psd.shape)
    found[inside] = np.repeat(np.where(np.isnan(off), 0.0, off), sizes, axis=0)
    return found


def quantisation_shares(estimate: Estimate) -> list[tuple[float, float]]:
    """Return each channel's mean quantisation noise in the band, and its share of the noise."""
    snapshot = estimate.snapshot
    noise = estimate.noise
    if noise is None or snapshot.quantisation_psd is None:
        return [(math.nan, math.nan)] * len(snapshot.channels)
    inside = slice(*band_edges(snapshot.frequency, estimate.band))
    width = np.gradient(snapshot.frequency)[inside]
    shares = []
    for column in range(len(snapshot.channels)):
        step, psd = snapshot.quantisation_psd[inside, column], noise.noise_psd[inside, column]
        known = np.isfinite(step) & np.isfinite(psd)
        if not known.any():
            shares.append((math.nan, math.nan))
            continue
        level = float(np.average(step[known], weights=width[known]))
        whole = float(np.average(psd[known], weights=width[known]))
        shares.append((level, level / whole if whole > 0 else math.nan))
    return shares


def _data_sheet(bench: Bench | None, label: ChannelLabel) -> DataSheet | None:
    key = label.sensor, label.channel
    sheets = {} if bench is None else {each.name: each.data_sheet for each in bench.sensors}
    sheet = sheets.get(label.sensor)
    if bench is None or sheet is None or (sheet.channels and label.channel not in sheet.channels):
        return None
    if sheet.unit is not None or key not in bench.channels:
        return sheet
    return sheet.model_copy(update={"unit": bench.channels[key].unit})


def _with_factor(
    parameters: NoiseParameters, allan: AllanDeviation, deviation: float
) -> tuple[NoiseParameters, AllanDeviation]:
    """Return terms and Allan deviation of a PSD that is known but for a factor.

    All terms have it in common, and the Allan deviation has its root.
    """
    values = parameters.values
    low, high = by_chance(allan.deviation, allan.low, allan.high, NORMAL_95 * deviation / 2)
    covariance = parameters.covariance + np.outer(values, values) * deviation**2
    errors = np.sqrt(np.diag(covariance))
    return (
        replace(parameters, errors=errors, covariance=covariance),
        replace(allan, low=low, high=high),
    )


def _compared(
    sheet: DataSheet,
    label: ChannelLabel,
    frequency: FloatArray,
    own: FloatArray,
    *,
    spectrum: Spectrum,
    column: int,
) -> list[SheetComparison]:
    unit = canonical(sheet.unit or label.unit)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.abs(conversion(label.unit, unit, frequency)) ** 2
    width = np.gradient(frequency)

    def mean(low: float, high: float) -> tuple[float, float, float]:
        edges = np.searchsorted(frequency, (low, high), side="left")
        edges = np.array([edges[0], max(edges[1], edges[0] + 1)])
        inside = slice(*edges)
        if low < frequency[1] / 2 or high > frequency[-1] or edges[1] >= len(frequency):
            return math.nan, math.nan, math.nan
        if not np.isfinite(own[inside] * factor[inside]).all():
            return math.nan, math.nan, math.nan
        found = spectrum.levels(edges)
        ends = (found.mean, *found.ends())
        weight = width[inside] * np.maximum(np.abs(own[inside]), np.finfo(float).tiny)
        ratio = float(np.average(factor[inside], weights=weight))
        middle, lower, upper = (float(end[0, column]) * ratio for end in ends)
        return middle, lower, upper

    rows = []
    for at, stated in sheet.noise_density:
        band = (at / THIRD, at * THIRD)
        values = tuple(_root(value) for value in mean(*band))
        rows.append(_compare(SheetQuantity.NOISE_DENSITY, band, f"({unit})/√Hz", stated, values))
    for low, high, stated in sheet.integrated_noise:
        values = tuple(_root(value * (high - low)) for value in mean(low, high))
        rows.append(_compare(SheetQuantity.INTEGRATED_NOISE, (low, high), unit, stated, values))
    for low, high, stated in sheet.dynamic_range:
        rms = [_root(value * (high - low)) for value in mean(low, high)]
        sine = (sheet.full_scale or math.nan) / math.sqrt(2)
        middle, worst, best = (
            20 * math.log10(sine / v) if 0 < v < math.inf else math.inf if v == 0 else -v
            for v in (rms[0], rms[2], rms[1])
        )
        rows.append(
            _compare(SheetQuantity.DYNAMIC_RANGE, (low, high), "dB", stated, (middle, worst, best))
        )
    return rows


def _root(power: float) -> float:
    return power if math.isnan(power) else math.sqrt(max(power, 0.0))


def _compare(
    quantity: SheetQuantity,
    band: tuple[float, float],
    unit: str,
    stated: float,
    values: tuple[float, ...],
) -> SheetComparison:
    measured, low, high = values
    if quantity is SheetQuantity.DYNAMIC_RANGE:
        falls_short, meets = high < stated, low >= stated
    else:
        falls_short, meets = low > stated, high <= stated
    outcome = (
        SheetOutcome.UNKNOWN
        if math.isnan(measured)
        else SheetOutcome.FALLS_SHORT
        if falls_short
        else SheetOutcome.MEETS
        if meets
        else SheetOutcome.NOT_DECIDED
    )
    return SheetComparison(quantity, *band, unit, stated, measured, low, high, outcome)
