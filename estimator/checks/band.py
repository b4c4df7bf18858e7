"""Diagnosis of one frequency band."""

from __future__ import annotations

from dataclasses import field
from typing import TYPE_CHECKING

from estimator.records import dataclass

if TYPE_CHECKING:
    from estimator.likelihood.goodness_of_fit import BandTest
    from estimator.records import Hertz
    from estimator.types import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class BandDiagnosis:
    """One band: medians over its frequencies.

    Attributes
    ----------
    low, high : float
        Lowest and highest frequency, Hz.
    coherence : float
        Median of the smallest coherence between like channels of two sensors with signal.
    condition : float
        Condition number of the worst ``S_jk``.
    dimension : float
        Effective dimension of the motion.
    snr : float64, shape (n_channels,)
        PSD of the motion over PSD of the noise.
    noise_lost : bool, shape (n_channels,)
        Whether a channel's noise is below its standard error at most frequencies, as for a quiet
        sensor among noisy ones: its SNR is then unknown, and may be high.
    test : BandTest
        Test of the common-motion model.
    shared : float64, shape (n_sensors, n_sensors)
        Share of the motion that two sensors have in common, from
        `estimator.checks.shared_motion`; NaN for sensors without signal.
    n_frequencies : int
    """

    low: Hertz
    high: Hertz
    coherence: float
    condition: float
    dimension: float
    snr: FloatArray
    noise_lost: BoolArray
    test: BandTest
    shared: FloatArray
    n_frequencies: int = field(metadata={"key": "frequencies"})
