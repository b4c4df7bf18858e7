"""What one band of frequencies shows of the test."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.likelihood.goodness_of_fit import BandTest
    from estimator.types import FloatArray


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
    test : BandTest
        Of the common-motion model.
    """

    low: float
    high: float
    coherence: float
    condition: float
    dimension: float
    snr: FloatArray
    test: BandTest
