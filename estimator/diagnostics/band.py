"""What one band of frequencies shows of the test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.likelihood.goodness_of_fit import BandTest
    from estimator.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class BandDiagnosis:
    """One band: medians over its frequencies.

    Attributes
    ----------
    low, high : float
        Of its frequencies, Hz.
    coherence : float
        Median of the least coherence between like channels of any two sensors that have signal.
    condition : float
        Of the worst ``S_jk``.
    dimension : float
        Effective dimension of the motion.
    snr : float64, shape (n_channels,)
        Motion over noise, PSD by PSD.
    noise_lost : bool, shape (n_channels,)
        Whether a channel's noise is lost in its own scatter at most frequencies, as that of a quiet
        sensor among noisy ones: its SNR is not known, and may be high.
    test : BandTest
        Of the common-motion model.
    shared : float64, shape (n_sensors, n_sensors)
        Share of the motion that each two sensors have in common, of
        `estimator.diagnostics.shared_motion`; NaN for sensors without signal.
    n_frequencies : int
    """

    low: float
    high: float
    coherence: float
    condition: float
    dimension: float
    snr: FloatArray
    noise_lost: BoolArray
    test: BandTest
    shared: FloatArray
    n_frequencies: int
