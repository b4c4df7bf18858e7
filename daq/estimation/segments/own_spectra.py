"""Spectra of segments on the grid from each sensor's own samples, where that is precise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from daq.clocks.grid import OwnSamples
from daq.estimation.segments.flatline import stands_still
from daq.estimation.settings import Settings
from estimator.records import dataclass
from estimator.spectra.shifted_windows import order_of, shifted_spectra
from estimator.spectra.welch import WelchSettings, trends

FloatArray = NDArray[np.float64]


def need_samples_of_grid(settings: Settings) -> bool:
    """Return whether segments need samples on the grid, whatever the clocks.

    Octaves and the search for transients do, and windows that cannot be shifted by a fraction of a
    sample.
    """
    return settings.window != "hann" or settings.octaves or bool(settings.reject)


@dataclass(frozen=True, slots=True, eq=False)
class OwnSpectra:
    """Spectra of whole segments.

    Attributes
    ----------
    spectra : complex128, shape (n_segments, n_freqs, n_channels)
    raw : float64, shape (n_samples, n_channels)
        Samples of the hops, each sensor's from the first segment on.
    products : float64, optional
        Sum over `spectra`, as `CrossSpectra.products` returns it.
    """

    spectra: NDArray[np.complex128]
    raw: FloatArray
    products: FloatArray | None = None

    @classmethod
    def of(cls, sensors: list[OwnSamples], welch: WelchSettings) -> OwnSpectra | None:
        """Return the spectra; None where a clock drifts by more than the series takes."""
        length, n_segments = welch.segment_length, len(sensors[0].rows)
        orders = [order_of(float(np.abs(own.drift).max()), length) for own in sensors]
        n_channels = sum(own.samples.shape[1] for own in sensors)
        spectra = np.empty((n_segments, length // 2 + 1, n_channels), np.complex128)
        raw = np.empty((n_channels, n_segments * welch.hop)).T
        basis = trends(welch.detrend, length)
        column = 0
        for own, order in zip(sensors, orders, strict=True):
            if order is None:
                return None
            columns = slice(column, column + own.samples.shape[1])
            column = columns.stop
            few = own.samples[: len(raw)]  # a slow clock may have one sample less
            raw[: len(few), columns], raw[len(few) :, columns] = few, few[-1]
            samples = own.samples.T
            if welch.detrend != "none":  # the rounding of a mean is no signal
                samples[stands_still(own.samples)] = 0.0
            found = spectra[:, :, columns]
            shifted_spectra(
                samples, own.rows, own.shift, own.drift, order=order, trends=basis, out=found
            )
        return cls(spectra, raw)
