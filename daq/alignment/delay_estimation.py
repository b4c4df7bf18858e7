"""Delays between sensors from the motion they share, segment by segment.

Theory of operation
-------------------
What sensor j reads is predicted from the reference sensor's channels by the averaged relative
response ``P = S_j0 S_00^-1`` (any orientation, gain and response is in it; the convention is
``S_pq = E[X_p conj(X_q)]``). Within one segment, sensor j lags that prediction by the one delay τ
that maximises

    J(τ) = Re Σ_f  (P X_0)^H  R^-1  X_j  exp(iωτ),      R = S_jj - P S_0j,

which is least squares weighted by what the prediction leaves over: frequencies without coherent
signal do not count. The maximum is searched for on a grid and polished by Newton's method. Its
variance is ``κ / (2 s² Σ ω² (P X_0)^H R^-1 P X_0)``, with κ for the correlation of neighbouring
frequencies under the window, and s the share of that sum which P's own noise does not account for.

P is averaged over segments already freed of their delays. The first batch does so by iteration and
thereby defines a frame; later batches are measured in that frame, which makes the delays of a whole
recording comparable. The frame's own delay is the one that makes P most nearly real.

The reference is the first sensor, unless that one shares the motion with fewer of the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Self

import numpy as np

from daq.alignment.resampling import USABLE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]
    ComplexArray = NDArray[np.complex128]

_FIRST_ITERATIONS = 5
_NEWTON_STEPS = 3
_MIN_SEGMENTS = 6  # in the first batch, per channel of the reference: P is a mean of those
_SHARED = 0.1  # samples to which most segments tell the delay of sensors that share a motion
_REFERENCES = 3  # sensors tried as the reference: more would cost too much where none is coherent
_SIGNIFICANT = 50.0  # 2 E / κ: a peak of seven standard deviations
_LONGEST = 32.0  # samples either way
_CLEAR = 1.5  # times as high as the peak nearest zero: those of one line are about as high
_OUTSTANDING = 2.0  # times as high as all within _LONGEST: noise alone is 1.5 at most
_FREQUENCIES_AT_ONCE = 1024
_RIDGE = 1e-10  # of the mean power: keeps a dead channel from stopping everything


@dataclass(slots=True, eq=False)
class _Frame:
    """Spectral sums of one sensor and the reference, freed of delays."""

    reference: ComplexArray
    crossed: ComplexArray
    own: ComplexArray
    n_segments: int

    @classmethod
    def of(cls, x0: ComplexArray, xj: ComplexArray, reference: ComplexArray | None = None) -> Self:
        """Sum spectra, shape (n_freqs, n_segments, n_channels); `reference` if it is known."""
        if reference is None:
            reference = _products(x0, x0)
        return cls(reference, _products(xj, x0), _products(xj, xj), x0.shape[1])

    def add(self, other: _Frame) -> None:
        """Add the sums of further segments."""
        self.reference += other.reference
        self.crossed += other.crossed
        self.own += other.own
        self.n_segments += other.n_segments


@dataclass(slots=True, eq=False)
class DelayEstimator:
    """Measures each sensor's delay against one of them.

    Attributes
    ----------
    sampling_rate : float
    window : float64, shape (segment_length,)
    columns : tuple of slice
        Which columns of the samples belong to each sensor, the preferred reference first.
    """

    sampling_rate: float
    window: FloatArray
    columns: tuple[slice, ...]
    _reference: int = 0
    _frames: dict[int, _Frame] = field(default_factory=dict)

    @property
    def fewest(self) -> int:
        """Segments of one batch that can define a frame."""
        reference: slice = self.columns[0]
        return _MIN_SEGMENTS * int(reference.stop - reference.start)

    @property
    def has_frame(self) -> bool:
        """Whether a batch has defined the frame."""
        return bool(self._frames)

    @property
    def omega(self) -> FloatArray:
        """Angular frequencies that are looked at, from the first above zero."""
        length = len(self.window)
        count = int(USABLE * length)
        return np.arange(1.0, count + 1.0) * (2 * np.pi * self.sampling_rate / length)

    def measure(self, samples: FloatArray, starts: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return each segment's delays and their standard deviations.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
        starts : int64, shape (n_segments,)
            Rows at which segments begin.

        Returns
        -------
        delays, std : float64, shape (n_segments, n_sensors)
            In seconds; positive if the sensor lags the reference, whose own are all zero. NaN and
            infinite where the coherent motion is too weak to tell.
        """
        shape = (len(starts), len(self.columns))
        delays, std = np.full(shape, np.nan), np.full(shape, np.inf)
        if len(starts) == 0 or (not self.has_frame and len(starts) < self.fewest):
            return delays, std
        sensors = self._spectra(samples, starts)
        if self.has_frame:
            x0 = sensors[self._reference]
            found = {
                number: self._delays(frame, x0, sensors[number])
                for number, frame in self._frames.items()
            }
        else:
            self._reference, found = self._begun(sensors)
            x0 = sensors[self._reference]
        delays[:, self._reference] = std[:, self._reference] = 0.0
        for number, (tau, spread) in found.items():
            frame, xj = self._frames.get(number), sensors[number]
            known = np.isfinite(spread)
            if frame is None or known.any():
                used = known if known.any() else np.ones(len(starts), dtype=bool)
                advanced = self._advanced(xj[:, used], np.where(known, tau, 0.0)[used])
                new = _Frame.of(x0[:, used], advanced)
                if frame is None:
                    self._frames[number] = new
                else:
                    frame.add(new)
            delays[:, number], std[:, number] = np.where(known, tau, np.nan), spread
        return delays, std

    def _begun(
        self, sensors: list[ComplexArray]
    ) -> tuple[int, dict[int, tuple[FloatArray, FloatArray]]]:
        """Return the reference, and delays and standard deviations of the others against it."""
        best: tuple[int, dict[int, tuple[FloatArray, FloatArray]]] = (0, {})
        most = -1
        for reference, x0 in enumerate(sensors[:_REFERENCES]):
            power = _products(x0, x0)
            found = {
                number: self._first_delays(x0, xj, power)
                for number, xj in enumerate(sensors)
                if number != reference
            }
            spreads = [float(np.median(spread)) for _, spread in found.values()]
            n_shared = sum(spread * self.sampling_rate < _SHARED for spread in spreads)
            if n_shared > most:
                best, most = (reference, found), n_shared
            if 2 * n_shared >= len(found):  # no other group of sensors is larger
                break
        return best

    def _first_delays(
        self, x0: ComplexArray, xj: ComplexArray, power: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Measure delays in the frame of these segments, which the delays define in turn.

        `power` is the sum of x0's own products.
        """
        tau, spread = np.zeros(x0.shape[1]), np.full(x0.shape[1], np.inf)
        for _ in range(_FIRST_ITERATIONS):
            frame = _Frame.of(x0, self._advanced(xj, tau), power)
            tau, spread = self._delays(frame, x0, xj)
            tau = np.where(np.isfinite(spread), tau, 0.0)
            tau -= tau.mean()
        return tau, spread

    def frame_delays(self) -> FloatArray:
        """Return the delay of each sensor's frame, that of a real relative response, in seconds."""
        delays = np.zeros(len(self.columns))
        for number, frame in self._frames.items():
            response, left = _prediction(frame)
            # A rotation with gains is real: the sum of squares turns with twice the delay.
            squares = np.einsum("fpq,fpq->f", response, response)
            size = np.einsum("fpq,fpq->f", response, response.conj()).real
            own = np.einsum("fpp->f", frame.own).real / frame.n_segments
            # How much of the sensor is predicted, as a weight that noise cannot raise.
            with np.errstate(divide="ignore", invalid="ignore"):
                weight = np.maximum(1 - np.einsum("fpp->f", left).real / own, 0.0)
                turned = np.nan_to_num(weight * squares / size)  # nothing, of no signal
            delay = self._constant(turned) / 2
            # Squares are the same half a segment farther; responses alternate there.
            other = delay - math.copysign(len(self.window) / 2 / self.sampling_rate, delay)
            here, there = (self._met(response, weight, tau) for tau in (delay, other))
            delays[number] = other if there > _OUTSTANDING * here else delay
        return delays

    def _met(self, response: ComplexArray, weight: FloatArray, tau: float) -> float:
        """Return how much of a relative response is the same at all frequencies, freed of τ."""
        turned = _turn(self.omega, np.array([tau]))[:, :, None]
        return float(
            np.linalg.norm((np.nan_to_num(weight)[:, None, None] * response * turned).sum(0))
        )

    def _spectra(self, samples: FloatArray, starts: IntArray) -> list[ComplexArray]:
        """Return the spectra of each sensor, shape (n_freqs, n_segments, n_channels)."""
        length = len(self.window)
        frames = np.lib.stride_tricks.sliding_window_view(samples, length, axis=0)[starts]
        frames -= frames.mean(axis=-1, keepdims=True)
        frames *= self.window
        spectra = np.fft.rfft(frames, axis=-1)[:, :, 1 : len(self.omega) + 1].transpose(2, 0, 1)
        # The numbers of one sensor lie side by side, so that products of them are fast.
        return [np.ascontiguousarray(spectra[:, :, columns]) for columns in self.columns]

    def _advanced(self, spectra: ComplexArray, tau: FloatArray) -> ComplexArray:
        return np.asarray(spectra * _turn(self.omega, tau)[:, :, None])

    def _delays(
        self, frame: _Frame, x0: ComplexArray, xj: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Measure delays in a frame, shapes (n_segments,): where J is largest."""
        omega = self.omega
        response, left = _prediction(frame)
        weight = np.linalg.inv(left)
        predicted = np.matmul(x0, response.transpose(0, 2, 1))
        weighted = np.matmul(predicted.conj(), weight)
        crossed = np.einsum("fsp,fsp->fs", weighted, xj)
        energy = np.einsum("fsp,fsp->fs", weighted, predicted).real
        tau = self._peak(crossed)
        # Neighbouring frequencies share samples of the window: κ of them count as one.
        w2 = self.window**2
        kappa = len(w2) * float(w2 @ w2) / float(w2.sum()) ** 2
        total = energy.sum(axis=0)
        met = (crossed * _turn(omega, tau)).real.sum(axis=0)
        informative = omega**2 @ energy
        # Of P's own noise, which predicts nothing: the mean of Wishart matrices has d0 dj / n.
        spurious = x0.shape[2] * xj.shape[2] / frame.n_segments * float(omega @ omega)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.maximum(1 - spurious / informative.mean(), 0.0)
            std = np.sqrt(kappa / (2 * informative)) / share
        # What P leaves over is scattered itself: the mean of an inverse Wishart matrix.
        freedom = max(frame.n_segments - x0.shape[2], 1)
        std *= math.sqrt(freedom / max(freedom - xj.shape[2] - 1, 1))
        known = (2 * total / kappa > _SIGNIFICANT) & (met > 0.3 * total)
        return tau, np.where(known, std, np.inf)

    def _peak(self, crossed: ComplexArray) -> FloatArray:
        """Return the τ at which Re Σ crossed exp(iωτ) is largest, for every column."""
        reach = min(self._n_grid // 2 - 1, int(_LONGEST / self.sampling_rate / self._step))
        even, odd = (np.zeros((crossed.shape[1], reach + 1)) for _ in range(2))
        # Of so few τ a product with the transform's matrix costs less than the transform.
        for first in range(0, len(crossed), _FREQUENCIES_AT_ONCE):
            some = crossed[first : first + _FREQUENCIES_AT_ONCE]
            cosine, sine = _fourier(self._n_grid, first + 1, reach + 1)
            even += some.real.T @ cosine[: len(some)]
            odd += some.imag.T @ sine[: len(some)]
        near = np.concatenate([(even + odd)[:, :0:-1], even - odd], axis=1)
        return self._polished(crossed, (np.argmax(near, axis=1) - reach) * self._step)

    @property
    def _n_grid(self) -> int:
        """Grid points of τ in a segment: a fraction of a period of the highest frequency."""
        return _fast_length(4 * len(self.window))

    @property
    def _step(self) -> float:
        """Seconds between grid points of τ."""
        return float(2 * np.pi / self.omega[0] / self._n_grid)

    def _constant(self, crossed: ComplexArray) -> float:
        """Return the τ at which Re Σ crossed exp(iωτ) has the peak that it is likely to have.

        The one nearest zero, where arrival times have it: motion that is nearly one line has
        others, as high. So another one within `_LONGEST` must be clearly higher, and one farther
        off must be so high that noise cannot be the reason.
        """
        step, middle = self._step, self._n_grid // 2
        height = np.fft.fftshift(np.fft.irfft(np.append(0, crossed), n=self._n_grid))
        peaks = np.flatnonzero((height[1:-1] > height[:-2]) & (height[1:-1] >= height[2:])) + 1
        away = np.abs(peaks - middle) * step * self.sampling_rate
        if not (away < _LONGEST).any():
            return 0.0
        best = peaks[np.argmin(away)]
        near, far = (
            max(peaks[away < limit].tolist(), key=height.item)
            for limit in (_LONGEST, len(self.window) / 2)
        )
        if height[near] > _CLEAR * height[best]:
            best = near
        if height[far] > _OUTSTANDING * height[near]:
            best = far
        return float(self._polished(crossed[:, None], np.array([(best - middle) * step]))[0])

    def _polished(self, crossed: ComplexArray, tau: FloatArray) -> FloatArray:
        omega = self.omega
        for _ in range(_NEWTON_STEPS):
            turned = crossed * _turn(omega, tau)
            curvature = omega**2 @ turned.real
            step = (omega @ turned.imag) / np.where(curvature > 0, curvature, np.inf)
            tau = tau - np.clip(step, -1 / self.sampling_rate, 1 / self.sampling_rate)
        return tau


@cache
def _fast_length(n: int) -> int:
    """Return the least length from `n` whose prime factors are 2, 3 and 5: fast to transform."""
    while n != math.gcd(n, 2**64 * 3**40 * 5**28):
        n += 1
    return n


@lru_cache(maxsize=4)
def _fourier(n: int, first: int, count: int) -> tuple[FloatArray, FloatArray]:
    """Return cosine and sine of 2π f t / n for `_FREQUENCIES_AT_ONCE` f, and t from 0."""
    turns = np.outer(np.arange(first, first + _FREQUENCIES_AT_ONCE), np.arange(count)) % n
    angle = 2 * np.pi / n * np.arange(n)
    return np.cos(angle)[turns], np.sin(angle)[turns]


def _turn(omega: FloatArray, tau: FloatArray) -> ComplexArray:
    """Return exp(iωτ), shape (n_freqs, n_segments)."""
    # Frequencies are evenly spaced: powers of one factor, sixteen at a time.
    block = 16
    count = -(-len(omega) // block)
    fine = np.exp(1j * omega[0] * np.outer(np.arange(1, block + 1), tau))
    coarse = np.exp(1j * omega[0] * block * np.outer(np.arange(count), tau))
    turned = coarse[:, None] * fine[None]
    return np.asarray(turned.reshape(count * block, len(tau))[: len(omega)])


def _products(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    return np.asarray(np.matmul(a.transpose(0, 2, 1), b.conj()))


def _prediction(frame: _Frame) -> tuple[ComplexArray, ComplexArray]:
    """Relative response P, shape (n_freqs, dj, d0), and what it leaves over, per segment."""
    reference = _ridged(frame.reference)
    response = np.linalg.solve(reference.transpose(0, 2, 1), frame.crossed.transpose(0, 2, 1))
    response = response.transpose(0, 2, 1)
    left = frame.own - response @ frame.crossed.conj().transpose(0, 2, 1)
    freedom = max(frame.n_segments - response.shape[2], 1)
    return np.asarray(response), np.asarray(_ridged(left, frame.own) / freedom)


def _ridged(matrix: ComplexArray, scale: ComplexArray | None = None) -> ComplexArray:
    power = np.einsum("fpp->f", matrix if scale is None else scale).real / matrix.shape[1]
    ridge = _RIDGE * power + np.finfo(np.float64).tiny
    return np.asarray(matrix + ridge[:, None, None] * np.eye(matrix.shape[1]))
