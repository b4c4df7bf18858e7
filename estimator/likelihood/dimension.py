"""Dimension of the common motion by band: the smallest that the model test accepts.

It is smaller than the number of channels of a sensor if the motion lacks a dimension. It is larger
if the sensors do not measure one motion exactly and are numerous enough: rotation and gradients are
then further factors of the same model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.likelihood.factor_analysis import max_factors, maximise
from estimator.likelihood.goodness_of_fit import HANN_HALF, BandTest, ModelTest, model_test, pool
from estimator.likelihood.maximum_likelihood import standard_error
from estimator.likelihood.prior import expected_noise, kinds, maximise_expecting
from estimator.self_noise.coherency import (
    check_averages,
    check_dims,
    check_frequency,
    coherency,
    testable,
)
from estimator.self_noise.live_channels import presence

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray, IntArray

LEVEL = 0.05
"""A dimension is accepted when its pooled p value is above this. An unneeded factor costs
precision, a missing one is a bias: one band in twenty pays rather than all risk it."""
SURE = 0.01
"""Below this p value a band that nothing explains is not left to chance."""
ENOUGH_SENSORS = 5
"""Sensors from which on further dimensions leave enough to tell the noise of each apart."""
LEAST_BINS = 8
MOST_BINS = 64
"""Frequencies of a band that are tested: of more, every second, third, …"""


@dataclass(frozen=True, slots=True)
class BandDimension:
    """The dimension chosen for one band, and its cost in precision.

    Attributes
    ----------
    low, high : float
        Of the band's frequencies, Hz.
    n_factors : int
        Dimension of the common motion.
    usual : int
        Channels of the largest sensor, the dimension taken otherwise.
    accepted : bool
        False if even the most factors that can be identified do not explain the band, and where it
        is undetermined.
    test : BandTest
        Of the chosen dimension.
    tried : tuple of BandTest
        Of 0, 1, … `n_factors` factors.
    cov : float
        Median c.o.v. of the noise at one frequency with `n_factors`; infinite where that many
        leave the noise undetermined.
    usual_cov : float
        The same with the usual dimension; NaN if that could not be fitted.
    n_sensors : int
        Sensors that have a signal of their own.
    gradients : bool
        Whether the further dimensions are the motion's gradients, see
        `estimator.likelihood.gradients`.
    """

    low: float
    high: float
    n_factors: int
    usual: int
    accepted: bool
    test: BandTest
    tried: tuple[BandTest, ...]
    cov: float
    usual_cov: float
    n_sensors: int = ENOUGH_SENSORS
    gradients: bool = False

    @property
    def is_undetermined(self) -> bool:
        """Whether the averages are explained, but by more than so few sensors can tell apart.

        Further dimensions leave four sensors too few directions without motion to tell the noise of
        all of them: the model then fits wrong noise as well as the true one.
        """
        return self.n_factors > self.usual and self.n_sensors < ENOUGH_SENSORS

    @property
    def is_biased(self) -> bool:
        """Whether no dimension explains the band, beyond what chance does to one in a hundred."""
        return not self.accepted and self.test.p_value < SURE


def bands(frequency: FloatArray, *, per_octave: int = 3, least: int = LEAST_BINS) -> IntArray:
    """Divide frequencies into bands of constant ratio, none with fewer than `least` of them.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz, rising; zero goes with the first band.
    per_octave : int
    least : int
        Frequencies; the last band takes up what does not make one.

    Returns
    -------
    int64, shape (n_freqs,)
        Number of the band, from 0, never falling.
    """
    first = [0]
    while True:
        begin = first[-1]
        f = max(float(frequency[begin]), float(frequency[min(1, len(frequency) - 1)]) / 2)
        end = int(np.searchsorted(frequency, f * 2 ** (1 / per_octave), side="left"))
        end = max(end, begin + least)
        if len(frequency) - end < least:
            break
        first.append(end)
    number = np.zeros(len(frequency), np.int64)
    number[first[1:]] = 1
    return np.cumsum(number)


def choose_dimension(
    csm: ComplexArray,
    frequency: FloatArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    band: IntArray | None = None,
    level: float = LEVEL,
    neighbours: FloatArray | None = None,
) -> tuple[IntArray, tuple[BandDimension, ...]]:
    """Choose the dimension of the common motion in every band.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, channels grouped by sensor.
    frequency : float64, shape (n_freqs,)
        Hz, rising.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
        Independent averages; more than channels.
    band : int64, shape (n_freqs,), optional
        Number of the band of each frequency, never falling; `bands` by default.
    level : float
        Of the pooled model test.
    neighbours : float64, shape (n_lags,), optional
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.

    Returns
    -------
    n_factors : int64, shape (n_freqs,)
        For ``maximum_likelihood(…, n_factors=n_factors)``.
    choices : tuple of BandDimension
        One a band.

    Raises
    ------
    InvalidMatrixError
        As `estimator.self_noise.coherency.coherency` says, or if `frequency` or `band` do not fit.
    InsufficientDataError
        If there are fewer than three sensors that have signal, or averages are no more
        than channels, or not finite.

    Notes
    -----
    Beyond ``max(dims)`` factors the likelihood carries the weak prior of
    `estimator.likelihood.prior`, in the test as in the estimate. Three sensors are given
    no more than ``max(dims)``: whatever one of them feels alone is noise to the other two, so
    further factors would take noise for motion; the test can only warn. Channels that are dead,
    or copies of earlier ones, count for nothing here: a fourth sensor of such channels is none.
    """
    check_dims(dims)
    check_averages(n_effective)
    given = coherency(csm, dims)
    frequency = check_frequency(frequency, len(csm))
    there = presence(given, dims)
    kind = kinds(given, dims)[list(there.channels)]
    given, n_channels = given.part(list(there.channels)), len(there.channels)
    if len(there.sensors) < 3:
        raise InsufficientDataError(
            f"{len(there.sensors)} sensors have a signal of their own: at least 3 are needed"
        )
    if n_effective <= n_channels:
        raise InsufficientDataError(
            f"{n_effective:.1f} averages of {n_channels} channels: more averages than channels "
            "are needed"
        )
    number = bands(frequency) if band is None else np.asarray(band)
    if number.shape != frequency.shape or np.any(np.diff(number) < 0):
        raise InvalidMatrixError("band: expected one number a frequency, never falling")
    matrix = testable(given, frequency)
    usual = max(dims)
    most = _most_testable(n_channels)
    most = most if len(there.sensors) > 3 else min(usual, most)
    stride = {int(b): -(-int(np.sum(number == b)) // MOST_BINS) for b in np.unique(number)}
    taken = np.concatenate([np.flatnonzero(number == b)[::step] for b, step in stride.items()])
    search = _Search(
        matrix[taken],
        given.psd[taken],
        number=number[taken],
        usual=usual,
        kind=kind,
        n_effective=n_effective,
    )
    r = HANN_HALF if neighbours is None else neighbours
    open_bands = list(stride)
    tried: dict[int, list[BandTest]] = {b: [] for b in open_bands}
    cov: dict[int, float] = {}
    usual_cov: dict[int, float] = {}
    for q in range(most + 1):
        fit = search.fit(q, open_bands if q != usual else list(tried))
        for b in open_bands:
            distant = r[stride[b] - 1 :: stride[b]]
            tried[b].append(pool(fit.test, fit.number == b, neighbours=distant))
            cov[b] = fit.median_cov(b)
        open_bands = [b for b in open_bands if not tried[b][-1].p_value > level]
        if q == usual:
            usual_cov = {b: fit.median_cov(b) for b in tried}
            search.expect(fit, open_bands)
        if not open_bands and q >= usual:
            break
    choices = tuple(
        BandDimension(
            low=float(frequency[number == b][0]),
            high=float(frequency[number == b][-1]),
            n_factors=len(tests) - 1,
            usual=usual,
            accepted=b not in open_bands
            and not (len(tests) - 1 > usual and len(there.sensors) < ENOUGH_SENSORS),
            n_sensors=len(there.sensors),
            test=tests[-1],
            tried=tuple(tests),
            cov=cov[b],
            usual_cov=usual_cov.get(b, float("nan")),
        )
        for b, tests in tried.items()
    )
    chosen = {b: len(tests) - 1 for b, tests in tried.items()}
    return np.array([chosen[int(b)] for b in number]), choices


def _most_testable(n_channels: int) -> int:
    """Most factors that leave the test a degree of freedom."""
    most = int(max_factors(n_channels))
    return most if (n_channels - most) ** 2 > n_channels else most - 1


@dataclass(frozen=True, slots=True)
class _Fit:
    """One dimension in some bands; a row a frequency of these."""

    number: IntArray
    psi: FloatArray
    cov: FloatArray
    test: ModelTest

    def median_cov(self, band: int) -> float:
        """Median c.o.v. in one band, infinite where the noise is undetermined; NaN for none."""
        known = self.cov[(self.number == band) & np.isfinite(self.psi).all(axis=1)]
        return float(np.median(np.nan_to_num(known, nan=np.inf))) if len(known) else float("nan")


class _Search:
    """The averages in their bands, and how one dimension does in some of these."""

    def __init__(
        self,
        matrix: ComplexArray,
        psd: FloatArray,
        *,
        number: IntArray,
        usual: int,
        kind: IntArray,
        n_effective: float,
    ) -> None:
        self._matrix = matrix
        self._psd = psd
        self._number = number
        self._usual = usual
        self._kind = kind
        self._n_effective = n_effective
        self._expected = 1 / psd  # in units of the coherency matrix

    def fit(self, q: int, some: list[int]) -> _Fit:
        """Maximise the likelihood of q factors in some bands."""
        rows = np.flatnonzero(np.isin(self._number, some))
        if q <= self._usual:
            maximum = maximise(self._matrix[rows], q)
        else:
            maximum = maximise_expecting(
                self._matrix[rows],
                q,
                self._expected[rows],
                kind=self._kind,
                n_effective=self._n_effective,
            )
        error = standard_error(maximum, n_effective=self._n_effective)
        return _Fit(
            number=self._number[rows],
            psi=maximum.psi,
            cov=error / maximum.psi,
            test=model_test(maximum, n_effective=self._n_effective),
        )

    def expect(self, fit: _Fit, open_bands: list[int]) -> None:
        """Take the noise of the bands that are explained for what to expect of the others."""
        usual = ~np.isin(self._number, open_bands)
        self._expected = expected_noise(fit.psi * self._psd, usual, self._kind) / self._psd
