"""Steadiness of the noise and of the responses, between parts of a recording.

Theory of operation
-------------------
Channels are whitened by the noise of the fit. U spans the motion, and P projects on the directions
beside it. In every part the residual ``P x`` is regressed on ``U* x``:

- What the regression leaves has ``n_k - q`` degrees of freedom of noise, whatever the motion of the
  part does, and whatever the responses do. So its level tells whether the *noise* is steady, for
  motion of any strength and colour. Levels are compared by Bartlett's test.
- The regression itself, ``D_k = P S_k U (U* S_k U)^-1``, is zero but for its scatter if *responses*
  are steady. The response ``1 + G_k`` of one sensor moves it to ``P G_k U``. Given ``U* x``,
  ``D_k`` is exactly normal. Its score for a real matrix ``G_k``, equal at all frequencies of a
  band, is compared with the information, for each sensor.

What could break the first test is motion of more dimensions than the fit has: it is noise to both.
What could break the second is noise that follows the motion, such as distortion.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum
from estimator.records import dataclass
from estimator.spectra.parts import Divided
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MIN_PARTS = 3
MIN_DEGREES = 2.0
"""Averages of a part beyond those that its regression takes, at least."""
VALUES_AT_ONCE = 1 << 17
"""Values of the matrices of all parts that are regressed together: 2 MB."""
SMALLEST_LEVEL = 1e-3
"""Of the noise of a part: estimates of few averages may be negative."""
LINEAR, DATED = 0.4, 3e-3
"""Errors of a size s: over s**2 (seen: .25 to .55 where .2 of the time is on one side), and s."""
RAMP = 4
"""Parts of a ramp, at least."""
ALIKE = 1e-6
"""Difference of chi-squared by rounding."""
COST = 4.0
"""Of each parameter of a change, in terms of chi-squared: simple changes are named."""
STEEPEST = 2 / 3
"""Power that leaks by a slope of one per bin where a Hann window is steepest, over the motion."""
BEYOND_GUSTS = 5.0
"""Motion and noise over noise, to which noise that changes does not come by scatter."""
FALSE_ALARM = 2e-3
"""Probability that steady responses of any sensor are found to change."""


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Residuals of some frequencies in every part, regressed on the motion of the part.

    Attributes
    ----------
    left : complex128, shape (n_parts, n_bins, n_channels, n_channels)
        Averages of what the regression leaves.
    covariance : float64, shape (n_parts, n_bins, n_channels, n_channels)
        Its real part per degree of freedom, whose expectation is the projector if the noise is
        steady.
    coefficients : complex128, shape (n_parts, n_bins, n_channels, n_factors)
        ``D_k``.
    along : complex128, of the same shape
        ``n_k P S_k U``: coefficients times motion.
    motion : complex128, shape (n_parts, n_bins, n_factors, n_factors)
        ``n_k U* S_k U``.
    of_motion : complex128, of the same shape
        Inverse of `motion`.
    directions : complex128, shape (n_bins, n_channels, n_factors)
        U.
    projector : complex128, shape (n_bins, n_channels, n_channels)
    averages : float64, shape (n_parts,)
        Of each part, less those of its regression.
    scale : float64, shape (n_bins, n_channels)
        From units to whitened channels.
    inverse : float64, shape (n_bins, n_channels, n_channels)
        From squares of residuals to the noise of channels.
    noise : float64, shape (n_parts, n_bins, n_channels)
        Noise of each part less that of the fit, over that of the fit.
    """

    left: ComplexArray
    coefficients: ComplexArray
    along: ComplexArray
    motion: ComplexArray
    of_motion: ComplexArray
    directions: ComplexArray
    projector: ComplexArray
    averages: FloatArray
    scale: FloatArray
    covariance: FloatArray
    inverse: FloatArray
    noise: FloatArray

    def explained(self, some: BoolArray) -> FloatArray:
        """Return what regressions of parts explain that these do not share.

        Of `some`, (n_parts, n_bins). Shape (n_parts, n_bins, n_channels), times the averages of
        each part: scatter alone explains one of the covariance for each direction of the motion.
        """
        along, M = self.along, self.motion
        if not some.all():
            along, M = (each * some[:, :, None, None] for each in (along, M))
        M = M.sum(axis=0)
        M[~some.any(axis=0)] = np.eye(M.shape[-1])
        mean = along.sum(axis=0) @ np.linalg.inv(M)
        beyond = self.along - mean @ self.motion
        return _diagonal(beyond, self.coefficients - mean) * some[..., None]

    def leaked(self, slopes: ComplexArray) -> FloatArray:
        """Return the power that leaks where responses have slopes per bin, (n_bins, n_channels).

        Of the averages: a third of their square, under a Hann window, and twice as much of bursts
        at its steepest place. There it is coherent with the motion.
        """
        motion = self.motion.sum(axis=0) / (self.averages + slopes.shape[2]).sum()
        return _diagonal(slopes @ motion, slopes) * STEEPEST

    def beside_fit(self) -> ComplexArray:
        """Return `along` without what is wrong with the fit, alike in all parts.

        Directions that are off add ``A M_k``, with M_k the motion of a part; noise that is off adds
        ``B n_k``. A is such that the sum is zero: the fit ends a little beside that, which counts
        110 dB above the noise. B, of variance c / n by scatter, counts where the motion of some
        parts is weaker than the noise.
        """
        M, (p, q) = self.motion, self.directions.shape[1:]
        n = self.averages + q
        total, inverse = n.sum(), np.linalg.inv(M.sum(axis=0))
        mean = self.along.sum(axis=0) @ inverse
        apart = np.tensordot(n, self.coefficients, axes=1) - total * mean
        # P diag(e) U of errors e, of which `inverse` over n is the covariance
        c = (np.einsum("fii,fii->f", self.inverse, self.projector).real - p) / ((p - q) * q)
        known = np.tensordot(n**2, self.of_motion, axes=1) - total**2 * inverse
        known += (total / np.where(c > 0, c, 1.0))[:, None, None] * np.eye(q)
        B = apart @ np.linalg.inv(known)
        A = mean - total * B @ inverse
        return np.asarray(self.along - n[:, None, None, None] * B - A @ M)


def _diagonal(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Return the real diagonal of ``a b*``."""
    return np.asarray(
        np.einsum("...pa,...pa->...p", a.real, b.real)
        + np.einsum("...pa,...pa->...p", a.imag, b.imag)
    )


def whitening(at: Maximum, psd: FloatArray) -> FloatArray:
    """Return the scales from units to whitened channels, shape (n_bins, n_channels)."""
    share = (np.abs(at.eigenvectors) ** 2 @ at.eigenvalues[:, :, None])[:, :, 0]
    return np.asarray(np.sqrt((np.einsum("fpp->fp", at.rest).real + share) / psd))


def slopes_of(
    maximum: Maximum, bins: IntArray, psd: FloatArray, frequency: FloatArray
) -> ComplexArray:
    """Return slopes of responses per bin, as coefficients of a `Regression`; 0 where not known.

    `maximum` and `psd` are those of all frequencies, neighbours of which may lie bins apart.
    """
    here, ends = maximum.take(bins), []
    U, P, scale = here.eigenvectors, here.projector, whitening(here, psd[bins])
    known = maximum.converged & ~maximum.singular & (psd > 0).all(axis=1)
    beside = [np.clip(bins + step, 0, len(psd) - 1) for step in (-1, 1)]
    beside = [np.where(known[near], near, bins) for near in beside]
    for near in beside:
        at = maximum.take(near)
        V = (scale / whitening(at, psd[near]))[:, :, None] * at.eigenvectors
        ends.append(P @ V @ np.linalg.inv(U.conj().swapaxes(1, 2) @ V))
    apart = (frequency[beside[1]] - frequency[beside[0]]) / np.diff(frequency).min()
    return np.asarray((ends[1] - ends[0]) / np.maximum(apart, 1.0)[:, None, None])


def regression(parts: Divided, at: Maximum, psd: FloatArray) -> Regression:
    """Regress the residuals of every part on its motion.

    `psd`, shape (n_bins, n_channels), is that of the averages that were fitted: these may lack
    parts, whose motion differs by scatter.
    """
    n, q = parts.averages, at.n_factors
    U, scale = at.eigenvectors, whitening(at, psd)
    S = parts.csm * (scale[:, :, None] * scale[:, None, :])
    across = U.conj().swapaxes(1, 2) @ (S @ U)
    across = (across + across.conj().swapaxes(2, 3)) / 2
    beside = at.projector
    PS = beside @ S  # beside has more digits than 1 - U U*, where a channel is nearly motion
    PSU, of_motion = PS @ U, np.linalg.inv(across)
    D = PSU @ of_motion
    left = PS @ beside - D @ PSU.conj().swapaxes(2, 3)
    covariance = left.real * (n / (n - q))[:, None, None, None]
    inverse = fisher.covariance(np.abs(beside) ** 2)
    excess = np.einsum("kfpp->kfp", covariance) - np.einsum("fpp->fp", beside).real
    return Regression(
        left=left,
        covariance=covariance,
        inverse=inverse,
        noise=(inverse @ excess[..., None])[..., 0],
        coefficients=D,
        along=n[:, None, None, None] * PSU,
        motion=n[:, None, None, None] * across,
        of_motion=np.asarray(of_motion / n[:, None, None, None]),
        directions=U,
        projector=beside,
        averages=n - q,
        scale=scale,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PartLevels:
    """Noise of parts as a fraction of the mean, over some frequencies.

    Attributes
    ----------
    level : float64, shape (n_parts, n_channels)
    degrees : float64, shape (n_parts, n_channels)
        Complex degrees of freedom: the variance of a level is their inverse.
    """

    level: FloatArray
    degrees: FloatArray

    @property
    def statistic(self) -> FloatArray:
        """Return Bartlett's statistic, chi-squared with n_parts - 1 degrees; (n_channels,)."""
        nu, level = self.degrees, np.maximum(self.level, SMALLEST_LEVEL)
        total = nu.sum(axis=0)
        mean = (nu * level).sum(axis=0) / total
        found = 2 * (total * np.log(mean) - (nu * np.log(level)).sum(axis=0))
        more = ((1 / (2 * nu)).sum(axis=0) - 1 / (2 * total)) / (3 * (len(nu) - 1))
        return np.asarray(found / (1 + more))

    @property
    def deviation(self) -> FloatArray:
        """Return the standard deviation between parts, shape (n_channels,)."""
        return np.asarray(self.level.std(axis=0, ddof=1))

    @property
    def expected(self) -> FloatArray:
        """Return that of steady noise, shape (n_channels,)."""
        return np.asarray(np.sqrt(np.mean(1 / self.degrees, axis=0)))


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """Neighbouring frequencies of a band, of which the information of every sensor is made.

    Attributes
    ----------
    beside : complex128, shape (n_bins, n_channels, n_channels)
        P, by the scales of both channels.
    along : complex128, shape (n_bins, n_channels, n_factors)
        U over the scales.
    slopes : complex128, of the same shape
        Of responses per bin, by the scales.
    motion : complex128, shape (n_parts, n_bins, n_factors, n_factors)
    noise : float64, shape (n_parts, n_channels)
        Noise less that of the fit: mean over frequencies.
    weight, averages : float64, shape (n_parts,)
        Of its scores, and of the parts.
    scale : float64, shape (n_bins, n_channels)
    """

    beside: ComplexArray
    along: ComplexArray
    slopes: ComplexArray
    motion: ComplexArray
    noise: FloatArray
    weight: FloatArray
    averages: FloatArray
    scale: FloatArray

    def information(self, one: slice, others: Sequence[slice]) -> FloatArray:
        """Return that of a sensor's channels and neighbours', (n_parts, d*d, sum of their d*d)."""
        first = others[0].start
        felt = self.along[:, first : others[-1].stop] @ self.motion
        felt = felt @ self.along[:, one].conj().swapaxes(1, 2)
        found = []
        for d, alike in itertools.groupby(others, lambda each: each.stop - each.start):
            columns = list(alike)
            some = slice(columns[0].start, columns[-1].stop)
            towards = felt[:, :, some.start - first : some.stop - first]
            found.append(_products(self.beside[:, one, some], towards, d))
        return np.concatenate(found, axis=2) * self.weight[:, None, None]

    def weighted_motion(self) -> ComplexArray:
        """Return the motion of all parts together, of which the weight is in the first one's."""
        found = np.tensordot(self.weight / self.weight[0], self.motion, axes=1)
        return np.asarray(found[None])

    def scores(self, change: FloatArray) -> FloatArray:
        """Return the scores of a change, (n_channels, n_channels) in and (n_parts, ...) out."""
        return self._of(self.beside @ change @ self.along @ self.motion).real

    def leaks(self) -> ComplexArray:
        """Return scores of leakage as by slopes, (n_parts, n_channels, n_channels)."""
        return self._of(self.slopes @ self.motion)

    def _of(self, X: ComplexArray) -> ComplexArray:
        along = self.along.swapaxes(0, 1).reshape(self.along.shape[1], -1).conj().T
        X = X.swapaxes(1, 2).reshape(len(X), -1, len(along))
        return np.asarray(self.weight[:, None, None] * (X @ along))

    def by_noise(self, noise: FloatArray, a: IntArray, b: IntArray) -> FloatArray:
        """Return scores of ``to, from`` by noise less that of the fit, (n_parts, n_channels) in.

        Of shape (n_parts, n_pairs): that of ``n_k P N_k U``; and as the directions follow scatter,
        they are off by ``E = P C M**-1``, of the sums of products C with the motion and M of the
        motion, which makes the mean of the scores that of ``(C_k - E M_k) E*``.
        """
        P, UU = self.beside, self.along @ self.along.conj().swapaxes(1, 2)
        by_one = (P[:, a] * UU[:, :, b].swapaxes(1, 2)).real.sum(axis=0)
        share = np.linalg.inv(self.motion.sum(axis=0)) @ self.motion
        own = np.einsum("kfaa->kf", share).real[:, :, None] * noise[:, None]
        own -= np.einsum("jfab,kfba,jp->kfp", share, share, noise, optimize=True).real
        square = self.scale[:, b, None] * self.scale[:, None]
        off = (P[:, a] * P[:, b].conj()).real / square**2
        found = (self.averages[:, None] * noise) @ by_one.T + np.einsum("kfp,fip->ki", own, off)
        return np.asarray(self.weight[:, None] * found)


class ResponseScores:
    """Scores of changes of every sensor's response in every part, summed over frequencies.

    Information of pairs of sensors is made when it is asked for: that of each sensor alone tells
    whether its response is steady.

    Parameters
    ----------
    dims : tuple of int
    score : float64, shape (n_parts, n)
        Of pairs of channels within sensors.
    own : list of float64, shape (n_parts, d*d, d*d)
        Information of each sensor.
    pieces : tuple of _Piece, optional
        From which that of pairs of sensors is made.
    information : float64, shape (n_parts, n, n), optional
        Instead.
    """

    def __init__(
        self,
        dims: tuple[int, ...],
        score: FloatArray,
        own: Sequence[FloatArray] = (),
        pieces: tuple[_Piece, ...] = (),
        information: FloatArray | None = None,
    ) -> None:
        self.dims, self.score, self._own, self._pieces = dims, score, own, pieces
        self._information = information

    @classmethod
    def of(
        cls,
        found: Regression,
        dims: tuple[int, ...],
        pieces: Sequence[tuple[slice, float]],
        slopes: ComplexArray,
    ) -> list[ResponseScores]:
        """Return those of pieces: their frequencies, and the variance of their sums.

        With neighbours correlated, over that of independent ones. `slopes` are as of `leaked`.
        """
        P, s, n = found.projector, found.scale, found.averages + found.directions.shape[2]
        beside, along = P * (s[:, :, None] * s[:, None, :]), found.directions / s[:, :, None]
        slopes = s[:, :, None] * slopes
        scores = (s[:, :, None] * found.beside_fit()).swapaxes(1, 2)
        (to, of), sensors = _within(dims), _sensors(dims)
        every = []
        for some, more in pieces:
            weight, noise = np.full(len(n), 2 / more), found.noise[:, some].mean(axis=1)
            motion, parts = found.motion[:, some], (beside[some], along[some], slopes[some])
            piece = _Piece(*parts, motion, noise, weight, n, s[some])
            across = piece.along.swapaxes(0, 1).reshape(len(s.T), -1).conj().T
            score = (scores[:, :, some].reshape(-1, len(across)) @ across).real
            own = [piece.information(each, [each]) for each in sensors]
            score = 2 / more * score.reshape(len(n), *s.shape[1:], -1)[:, to, of]
            every.append(cls(dims, score, own, (piece,)))
        return every

    @property
    def kept(self) -> float:
        """Share of a change that is seen: directions of each frequency follow its own averages."""
        lost = [each.along.shape[2] / each.averages.sum() for each in self._pieces]
        return max(1 - float(np.mean(lost)), 0.5)

    @property
    def information(self) -> FloatArray:
        """Information of all sensors, shape (n_parts, n, n)."""
        if self._information is None:
            edges = _sensors(self.dims)
            found = np.zeros((*self.score.shape, self.score.shape[1]))
            for piece in self._pieces:
                found += np.concatenate([piece.information(i, edges) for i in edges], axis=1)
            self._information = found
        return self._information

    def _place(self, sensor: int) -> slice:
        squares = np.cumsum([0, *(d * d for d in self.dims)])
        return slice(squares[sensor], squares[sensor + 1])

    def sensor(self, sensor: int) -> tuple[FloatArray, FloatArray]:
        """Return score (n_parts, d*d) and information (n_parts, d*d, d*d) of a sensor."""
        own = self._place(sensor)
        known = self._information
        return self.score[:, own], self._own[sensor] if known is None else known[:, own, own]

    def __add__(self, other: ResponseScores) -> ResponseScores:
        own = [a + b for a, b in zip(self._own, other._own, strict=True)]
        score, pieces = self.score + other.score, self._pieces + other._pieces
        return ResponseScores(self.dims, score, own, pieces)

    def beside_noise(self, channels: BoolArray) -> ResponseScores:
        """Return the scores without what noise of some channels adds that is not that of the fit.

        It is as much as a response that changes where motion is weak.
        """
        score, size = self.score.copy(), sum(len(each.along) for each in self._pieces)
        total = sum(len(each.along) * each.noise for each in self._pieces) / size
        noise = np.where(channels, total, 0.0)
        for each in self._pieces:
            score -= each.by_noise(noise, *_within(self.dims))
        return ResponseScores(self.dims, score, self._own, self._pieces)

    def weighted(self, level: FloatArray) -> ResponseScores:
        """Return the scores where the noise has `level` in each part, shape (n_parts,)."""
        own = [each / level[:, None, None] for each in self._own]
        pieces = tuple(replace(each, weight=each.weight / level) for each in self._pieces)
        return ResponseScores(self.dims, self.score / level[:, None], own, pieces)

    def centred(self) -> ResponseScores:
        """Return the scores beside the mean of responses over all parts, which is that of the fit.

        The fit is of other averages where parts were left out.
        """
        alike = [
            replace(each, motion=each.weighted_motion(), weight=each.weight[:1])
            for each in self._pieces
        ]
        total = ResponseScores(self.dims, self.score[:1], pieces=tuple(alike)).information[0]
        mean = np.zeros((sum(self.dims),) * 2)
        to, of = _within(self.dims)
        inverse = np.linalg.pinv(total, rcond=1e-9, hermitian=True)
        mean[to, of] = inverse @ self.score.sum(axis=0)
        score = self.score - sum(each.scores(mean)[:, to, of] for each in self._pieces)
        return ResponseScores(self.dims, score, self._own, self._pieces)

    def without(self, sensors: Sequence[int]) -> ResponseScores:
        """Return what is left of the scores after the changes of some sensors are fitted."""
        if not sensors:
            return self
        own = np.concatenate([np.arange(self.score.shape[1])[self._place(i)] for i in sensors])
        score, information = self.score.copy(), self.information.copy()
        for k, each in enumerate(self.information):
            inverse = np.linalg.pinv(each[np.ix_(own, own)], rcond=1e-9, hermitian=True)
            taken = each[:, own] @ inverse
            score[k] -= taken @ self.score[k, own]
            information[k] -= taken @ each[own]
        return ResponseScores(self.dims, score, information=information)

    def test(self, sensor: int, known: Sequence[int] = ()) -> tuple[float, float]:
        """Return chi-squared and degrees of a sensor, beside those known to change."""
        return _chi_squared(*self.without(known).sensor(sensor))

    def leaked(self, sensor: int, known: Sequence[int] = ()) -> float:
        """Return what leakage at the edges of bursts may add to `test`, if all is coherent."""
        to, of = (each[self._place(sensor)] for each in _within(self.dims))
        leaks = np.sum([each.leaks()[:, to, of] for each in self._pieces], axis=0)
        _, own = self.without(known).sensor(sensor)
        return sum(_chi_squared(each, own)[0] for each in (leaks.real, leaks.imag)) * STEEPEST


def _sensors(dims: Sequence[int]) -> list[slice]:
    """Return the channels of each sensor."""
    return [slice(*each) for each in itertools.pairwise(np.cumsum([0, *dims]).tolist())]


def _within(dims: Sequence[int]) -> tuple[IntArray, IntArray]:
    """Return the pairs of channels of each sensor: to, from."""
    sensor = np.repeat(np.arange(len(dims)), dims)
    to, of = np.nonzero(sensor[:, None] == sensor)
    return to, of


def _products(beside: ComplexArray, motion: ComplexArray, d: int) -> FloatArray:
    """Return real parts of ``beside[f, a, c] motion[k, f, e, b]``, summed over f.

    As [k, (a, b), (c, e)], for c and e of one sensor of d channels: by a matrix product for each of
    the real and imaginary parts of all frequencies.
    """
    n_parts, n_bins, p, b = motion.shape
    a, n = beside.shape[1], p // d
    left = np.concatenate([beside.real, -beside.imag]).reshape(2 * n_bins, a, n, d)
    right = np.concatenate([motion.real, motion.imag], axis=1).reshape(n_parts, -1, n, d, b)
    found = np.matmul(
        left.transpose(2, 1, 3, 0).reshape(n, a * d, -1),
        right.transpose(2, 1, 0, 3, 4).reshape(n, 2 * n_bins, -1),
    )
    found = found.reshape(n, a, d, n_parts, d, b).transpose(3, 1, 5, 0, 2, 4)
    return np.asarray(found.reshape(n_parts, a * b, p * d))


def _chi_squared(score: FloatArray, information: FloatArray) -> tuple[float, float]:
    total = information.sum(axis=0)
    if not np.isfinite(total).all():
        return math.nan, math.nan
    basis = _basis(total)
    values, vectors = np.linalg.eigh(basis.T @ information @ basis)
    known = values > 1e-9  # of one
    along = (vectors.swapaxes(1, 2) @ (score @ basis)[:, :, None])[:, :, 0]
    statistic = np.sum(along**2 / np.where(known, values, np.inf))
    return float(statistic), float(known.sum() - basis.shape[1])


def _basis(total: FloatArray) -> FloatArray:
    """Return a basis in which the information of all parts is 1."""
    root = np.sqrt(np.maximum(np.diag(total), np.finfo(np.float64).tiny))
    values, vectors = np.linalg.eigh(total / root[:, None] / root)
    known = values > 1e-9 * values[-1]
    return np.asarray(vectors[:, known] / np.sqrt(values[known]) / root[:, None])


@dataclass(frozen=True, slots=True)
class ResponseChange:
    """A change of a sensor's response.

    Attributes
    ----------
    sensor : int
    channel : int or None
        Channel whose gain changes; None: all channels of the sensor.
    is_turn : bool
        Whether the sensor turns.
    size : float
        Change of the gain over the gain before, or radians.
    error : float
        Standard error of the size.
    begin, end : float
        Seconds from the start: between these it changes. Equal for a step.
    statistic, degrees : float
        Chi-squared statistic of the test, and its degrees of freedom.
    band : (float, float) or None
        Frequencies that alone show it, Hz: `size` is then the standard deviation of a response.
    is_least : bool
        Whether it is larger if it is within the first or the last part of time, as it may be.
    """

    sensor: int
    channel: int | None
    is_turn: bool
    size: float
    error: float
    begin: float
    end: float
    statistic: float
    degrees: float
    band: tuple[float, float] | None = None
    is_least: bool = False

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty of the size: of a linear fit, beside that of the date.

        Infinite where the size is a least one.
        """
        if self.is_least:
            return math.inf
        return math.hypot(self.error, LINEAR * self.size**2, DATED * self.size)


def patterns(d: int) -> list[tuple[int | None, bool, FloatArray]]:
    """Return gains of all channels, of each, and turns: unit matrices, flattened."""
    found: list[tuple[int | None, bool, FloatArray]] = [(None, False, np.eye(d).reshape(1, -1))]
    if d > 1:
        found += [(a, False, np.eye(d * d)[[a * d + a]]) for a in range(d)]
        turns = []
        for a in range(d):
            for b in range(a + 1, d):
                turn = np.zeros((d, d))
                turn[a, b], turn[b, a] = 1, -1
                turns.append(turn.reshape(-1))
        found.append((None, True, np.array(turns)))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Course:
    """A step, or a ramp, of a response over the parts, between two times.

    `heights`, shape (n, n_parts), are fitted apart: one from 0 to 1; of a step within a part, that
    of the parts behind it, and that of the part, which is a share of it.
    """

    begin: float
    end: float
    heights: FloatArray

    def between(self, share: float) -> _Course:
        """Return the step within a part after this share of it."""
        at = self.begin + share * (self.end - self.begin)
        return _Course(at, at, self.heights[:1] + (1 - share) * self.heights[1:])


def _courses(begin: FloatArray, end: FloatArray) -> list[_Course]:
    """Return steps, also within parts, and ramps over several parts."""
    n, place, found = len(begin), np.arange(len(begin)), []
    for at in range(
        1, n
    ):  # within the first or last part, any step is one at its border, and larger
        first, last = float(begin[at]), float(end[at])
        found.append(_Course(first, first, np.array([place >= at], np.float64)))
        if at < n - 1:
            found.append(_Course(first, last, np.array([place > at, place == at], np.float64)))
    for low in range(n - RAMP + 1):
        for high in range(low + RAMP, n + 1):
            height = np.clip((place - low + 0.5) / (high - low), 0, 1)
            found.append(_Course(float(begin[low]), float(end[high - 1]), height[None]))
    return found


def response_change(
    scores: ResponseScores,
    sensor: int,
    begin: FloatArray,
    end: FloatArray,
    first_channel: int,
    *,
    kept: float,
) -> ResponseChange:
    """Return the one change of a sensor's response that explains most of its scores.

    These have what is `kept` of it.
    """
    score, information = scores.sensor(sensor)
    statistic, degrees = _chi_squared(score, information)
    d = scores.dims[sensor]
    forms, courses = patterns(d), _courses(begin, end)
    best, pattern, course = -math.inf, forms[0], courses[0]
    size, error = 0.0, math.inf
    total = np.linalg.pinv(information.sum(axis=0), rcond=1e-9, hermitian=True)
    for each in courses:
        c = each.heights
        # The mean of the response over the recording is that of the fit.
        own = np.tensordot(c, information, axes=1)
        known = np.tensordot(c[:, None] * c, information, axes=1) - own[:, None] @ total @ own
        along = c @ score
        for one in forms:
            rows, here = one[2], each
            n = len(rows)
            matrix = (rows @ known @ rows.T).swapaxes(1, 2).reshape(len(c) * n, -1)
            variance = np.linalg.pinv(matrix, hermitian=True)
            gained = along @ rows.T
            found = (variance @ gained.ravel()).reshape(gained.shape)
            if len(c) > 1:
                share = 1 - found[0] @ found[1] / max(found[0] @ found[0], 1e-300)
                if not 0 < share < 1:
                    continue
                here = each.between(float(share))
            gain = float((found * gained).sum()) - COST * n
            gain -= COST if here.begin < here.end else 0.0
            if gain > best + ALIKE:
                best, pattern, course = gain, one, here
                size = float(np.linalg.norm(found[0]) if one[1] else found[0, 0]) / kept
                error = math.sqrt(float(np.trace(variance[:n, :n])) / n) / kept
    channel, is_turn, _ = pattern
    weight = np.einsum("kii->k", information)
    height = float(weight @ course.heights[0]) / weight.sum()
    before = 1 - size * height  # gains relative to the mean
    return ResponseChange(
        sensor=sensor,
        channel=None if channel is None else first_channel + channel,
        is_turn=is_turn,
        size=size if is_turn else size / before,
        error=error,
        begin=course.begin,
        end=course.end,
        statistic=statistic,
        degrees=degrees,
        is_least=course.begin == course.end and not end[0] < course.begin < begin[-1],
    )


def variance_of_changes(scores: ResponseScores, sensor: int) -> FloatArray:
    """Return the variance of a sensor's response between parts, shape (d,).

    As a fraction of the PSD of motion that is alike in all its channels: without what the scatter
    of the scores adds, and 0 at least.
    """
    score, information = scores.sensor(sensor)
    d = scores.dims[sensor]
    weight = np.einsum("kii->k", information)
    added = np.zeros(d)
    for s, each, share in zip(score, information, weight / weight.sum(), strict=True):
        inverse = np.linalg.pinv(each, rcond=1e-9, hermitian=True)
        g = (inverse @ s).reshape(d, d)
        spread = np.diag(inverse).reshape(d, d)
        added += share * (g**2 - spread).sum(axis=1)
    return np.maximum(added, 0.0)
