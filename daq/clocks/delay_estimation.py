"""Delays between sensors from their common motion, segment by segment.

Theory of operation
-------------------
The averaged relative response ``P = S_j0 S_00^-1`` predicts sensor j from the reference sensor's
channels, for any orientation, gain and response (the convention is ``S_pq = E[X_p conj(X_q)]``).
The delay of sensor j against this prediction, within one segment, is the τ that maximises

    J(τ) = Re Σ_f  (P X_0)^H  R^-1  X_j  exp(iωτ),      R = S_jj - P S_0j.

This is least squares weighted by the residuals of the prediction: frequencies without coherent
signal have no weight. The maximum is searched for on a grid and refined by Newton's method. Its
variance is ``κ / 2 Σ ω² (P X_0)^H R^-1 P X_0 / C²``, where κ accounts for the correlation of
neighbouring frequencies by the window, and C is the curvature of J, at most the share of the sum
that is not noise of P.

Where responses differ, what a window cuts off of a loud moment at its edge is not what P predicts
of it. To first order in the length of responses it is ``i/2π dP/df D``, with D the spectrum of the
reference under the window's derivative: this is part of the prediction. Without it a burst at the
edge of a segment looks like a delay.

P is averaged over segments after correction of their delays. The first batch of segments with
motion does this by iteration and thereby defines a frame; later batches are measured in that frame,
so that the delays of a recording are comparable. The frame's own delay is the one for which P is
closest to real.

The reference is the first sensor, unless another sensor shares the motion with more sensors.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from daq.clocks.quantiles import median
from daq.clocks.resampling import USABLE

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

_FIRST_ITERATIONS = 5
_SETTLED = 1e-3  # standard deviations by which no delay moves any more
_NEWTON_STEPS = 3
MIN_SEGMENTS = 6
"""Segments of the first batch for each channel of the reference: P is their mean."""
_SHARED = 0.1  # samples; precision of delays in most segments, for sensors with common motion
REFERENCES = 3
"""Maximum number of sensors tried as reference, to bound the cost."""
_ALIKE = 2.0  # standard deviations of its height, by which a peak may be lower than the highest
_WEAK = 0.15  # share from which on noise may make any of several peaks the highest
_SIGNIFICANT = 50.0  # 2 E / κ: a peak of seven standard deviations
_LONGEST = 32.0  # samples, in both directions
_BEYOND = 0.1  # share of the sum that is not noise of P: below, all may be noise
_FAR_SIGNIFICANT = 400.0  # the same of a peak farther away, of which there are many more
_MET = 0.3  # share of the predicted motion that a peak explains
_CLEAR = 1.5  # ratio to the peak nearest zero: the peaks of one line are about equal
_OUTSTANDING = 2.0  # ratio to all peaks within _LONGEST: noise reaches at most 1.5
_FREQUENCIES_AT_ONCE = 1024
_SLOPE = 3  # frequencies on either side, from which the slope of P is known
_RIDGE = 1e-10  # fraction of the mean power: keeps matrices regular with a dead channel


@dataclass(slots=True, eq=False)
class _Frame:
    """Spectral sums of one sensor and the reference, after correction of delays."""

    reference: ComplexArray
    crossed: ComplexArray
    own: ComplexArray
    n_segments: int

    @classmethod
    def of(cls, x0: ComplexArray, xj: ComplexArray, reference: ComplexArray | None = None) -> Self:
        """Sum spectra (n_freqs, n_segments, n_channels); `reference` is S_00 if known."""
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
    """Measures the delays of sensors against one of them.

    Attributes
    ----------
    sampling_rate : float
        In Hz.
    window : float64, shape (segment_length,)
    columns : tuple of slice
        Columns of the samples of each sensor, with the preferred reference first.
    n_candidates : int
        Sensors tried as reference.
    hop : int
        Samples from one segment to the next; 0: they share none.
    is_wide : bool
        Whether delays of up to half a segment are searched for where none is nearer, once there is
        a frame: times may be off by that much.
    """

    sampling_rate: float
    window: FloatArray
    columns: tuple[slice, ...]
    n_candidates: int = REFERENCES
    hop: int = 0
    is_wide: bool = False
    has_tried: bool = field(default=False, init=False)
    """Whether any batch was large enough to define the frame, with motion in it or without."""
    _reference: int = 0
    _frames: dict[int, _Frame] = field(default_factory=dict)

    @property
    def min_segments(self) -> int:
        """Minimum number of segments in the batch that defines the frame."""
        reference: slice = self.columns[0]
        return MIN_SEGMENTS * int(reference.stop - reference.start)

    @property
    def has_frame(self) -> bool:
        """Whether a batch with motion has defined the frame."""
        return bool(self._frames)

    @property
    def measured(self) -> tuple[int, ...]:
        """Sensors that have a frame: not the reference."""
        return tuple(self._frames)

    @property
    def compared(self) -> tuple[slice, tuple[slice, ...]]:
        """Columns of the reference, and of each sensor that has a frame."""
        return self.columns[self._reference], tuple(self.columns[n] for n in self._frames)

    @property
    def omega(self) -> FloatArray:
        """Angular frequencies used, in rad/s, from the first above zero."""
        length = len(self.window)
        count = int(USABLE * length)
        return np.arange(1.0, count + 1.0) * (2 * np.pi * self.sampling_rate / length)

    def measure(self, samples: FloatArray, starts: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return each segment's delays and their standard deviations.

        Parameters
        ----------
        samples : float64, shape (n_samples, n_channels)
        starts : int64, shape (n_segments,)
            First row of each segment.

        Returns
        -------
        delays, std : float64, shape (n_segments, n_sensors)
            In s; positive if the sensor lags the reference, whose delays are zero. NaN and infinity
            if the coherent motion is too weak, infinity if any of several delays is likely. Where
            `is_wide`, the deviation is NaN where the motion is strong, and the sensor does not
            follow it.
        """
        if not self._is_enough(len(starts)):
            return self._unknown(len(starts))
        return self._measured(self._spectra(samples, starts))

    def measure_spectra(self, spectra: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return what `measure` does, from spectra of the segments under the window.

        Parameters
        ----------
        spectra : complex128, shape (n_segments, n_freqs, n_channels)
            From 0 Hz on, of samples without trend.
        """
        if not self._is_enough(len(spectra)):
            return self._unknown(len(spectra))
        return self._measured(spectra[:, :, one] for one in self.columns)

    @property
    def fewest(self) -> int:
        """Minimum number of segments of the next batch."""
        return 1 if self.has_frame else self.min_segments

    def _is_enough(self, n_segments: int) -> bool:
        return n_segments >= self.fewest

    def _unknown(self, n_segments: int) -> tuple[FloatArray, FloatArray]:
        shape = (n_segments, len(self.columns))
        return np.full(shape, np.nan), np.full(shape, np.inf)

    def _measured(self, spectra: Iterable[ComplexArray]) -> tuple[FloatArray, FloatArray]:
        """Measure delays from the spectra of each sensor, (n_segments, n_freqs, n_channels)."""
        references = (self._reference,) if self.has_frame else tuple(range(self.n_candidates))
        sensors: list[ComplexArray] = []
        edges: dict[int, ComplexArray] = {}
        for number, each in enumerate(spectra):
            if number in references:
                edges[number] = self._used(self._at_edges(each))
            sensors.append(self._used(each))
        n_segments = sensors[0].shape[1]
        delays, std = self._unknown(n_segments)
        if self.has_frame:
            x0, d0 = sensors[self._reference], edges[self._reference]
            found = {
                number: self._delays(frame, (x0, d0), sensors[number])
                for number, frame in self._frames.items()
            }
        else:
            self.has_tried = True
            self._reference, found = self._with_reference(sensors, edges)
            x0, d0 = sensors[self._reference], edges[self._reference]
            if not any(np.isfinite(spread).any() for _, spread in found.values()):
                return delays, std
        delays[:, self._reference] = std[:, self._reference] = 0.0
        for number, (tau, spread) in found.items():
            frame, xj = self._frames.get(number), sensors[number]
            known = np.isfinite(spread)
            if frame is None or known.any():
                fewest = 1 if frame else x0.shape[2] + xj.shape[2] + 1  # P and R are regular
                enough = np.count_nonzero(known) >= fewest
                used = known if enough else np.ones(n_segments, dtype=bool)
                advanced = self._advanced(xj[:, used], np.where(known, tau, 0.0)[used])
                new = _Frame.of(x0[:, used], advanced)
                if frame or enough:  # else P is not regular
                    new = _Frame.of(x0[:, used], advanced - self._cut(frame or new, d0[:, used]))
                if frame is None:
                    self._frames[number] = new
                else:
                    frame.add(new)
            delays[:, number], std[:, number] = tau, spread
        return delays, std

    def _with_reference(
        self, sensors: list[ComplexArray], edges: dict[int, ComplexArray]
    ) -> tuple[int, dict[int, tuple[FloatArray, FloatArray]]]:
        """Return the reference, and the others' delays and standard deviations against it."""
        best: tuple[int, dict[int, tuple[FloatArray, FloatArray]]] = (0, {})
        most = -1
        for reference, x0 in enumerate(sensors[: self.n_candidates]):
            power = _products(x0, x0)
            found = {
                number: self._first_delays((x0, edges[reference]), xj, power)
                for number, xj in enumerate(sensors)
                if number != reference
            }
            spreads = [median(spread) for _, spread in found.values()]
            n_shared = sum(spread * self.sampling_rate < _SHARED for spread in spreads)
            if n_shared > most:
                best, most = (reference, found), n_shared
            if 2 * n_shared >= len(found):  # no other group of sensors is larger
                break
        return best

    def _first_delays(
        self, reference: tuple[ComplexArray, ComplexArray], xj: ComplexArray, power: ComplexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Measure delays and the frame of these segments, by iteration.

        `power` is the sum of the products of the reference.
        """
        x0, d0 = reference
        cut = np.zeros_like(xj)
        tau, spread = np.zeros(x0.shape[1]), np.full(x0.shape[1], np.inf)
        if not self._moves(_Frame.of(x0, xj, power)):
            return tau + np.nan, spread
        is_last = False
        for number in range(_FIRST_ITERATIONS):
            before, frame = tau, _Frame.of(x0, self._advanced(xj, tau) - cut, power)
            # At first P is a mean over unknown delays, and its peaks are low.
            tau, spread = self._delays(frame, reference, xj, doubt_cycles=is_last)
            cut = self._cut(frame, d0)
            is_still = np.isnan(tau)
            tau = np.where(np.isfinite(spread), tau, 0.0)
            tau -= tau.mean()
            if is_last:
                tau[is_still] = np.nan
                break
            settled = bool((np.abs(tau - before) <= _SETTLED * spread).all())
            is_last = settled or number == _FIRST_ITERATIONS - 2
        return tau, spread

    def frame_delays(self) -> FloatArray:
        """Return the delay of each sensor's frame in s: without it, P is closest to real."""
        delays = np.zeros(len(self.columns))
        for number, frame in self._frames.items():
            response, left = _prediction(frame)
            # A rotation with gains is real: the phase of the sum of squares is twice the delay's.
            squares = np.einsum("fpq,fpq->f", response, response)
            size = np.einsum("fpq,fpq->f", response, response.conj()).real
            own = np.einsum("fpp->f", frame.own).real / frame.n_segments
            # Weight: the predicted share of the sensor, which noise does not increase.
            with np.errstate(divide="ignore", invalid="ignore"):
                weight = np.maximum(1 - np.einsum("fpp->f", left).real / own, 0.0)
                turned = np.nan_to_num(weight * squares / size)  # zero without signal
            delay = self._constant(turned) / 2
            # Squares do not distinguish delays half a segment apart; responses do, by their sign.
            other = delay - math.copysign(len(self.window) / 2 / self.sampling_rate, delay)
            here, there = (self._met(response, weight, tau) for tau in (delay, other))
            delays[number] = other if there > _OUTSTANDING * here else delay
        return delays

    def _met(self, response: ComplexArray, weight: FloatArray, tau: float) -> float:
        """Return the share of a relative response, without τ, that is equal at all frequencies."""
        turned = _turn(self.omega, np.array([tau]))[:, :, None]
        return float(
            np.linalg.norm((np.nan_to_num(weight)[:, None, None] * response * turned).sum(0))
        )

    def _spectra(self, samples: FloatArray, starts: IntArray) -> Iterator[ComplexArray]:
        """Yield the spectra of each sensor, shape (n_segments, n_freqs, n_channels)."""
        frames = np.lib.stride_tricks.sliding_window_view(samples, len(self.window), axis=0)
        for columns in self.columns:  # one by one, to bound memory
            own = frames[:, columns][starts]
            own -= own.mean(axis=-1, keepdims=True)
            own *= self.window
            yield np.fft.rfft(own, axis=-1).swapaxes(1, 2)

    def _used(self, spectra: ComplexArray) -> ComplexArray:
        """Return spectra at the frequencies used, (n_freqs, n_segments, n_channels)."""
        used = spectra[:, 1 : len(self.omega) + 1].swapaxes(0, 1)
        return np.ascontiguousarray(used)  # makes products fast

    def _at_edges(self, spectra: ComplexArray) -> ComplexArray:
        """Return spectra under the window's derivative, per s, from those under the window."""
        window, n = self.window, len(self.window)
        slope = (np.roll(window, -1) - np.roll(window, 1)) * self.sampling_rate / 2
        ratio = np.where(window > 0, slope, 0.0) / np.where(window > 0, window, 1.0)
        return np.fft.rfft(np.fft.irfft(spectra, n, axis=1) * ratio[:, None], axis=1)

    def _cut(self, frame: _Frame, d0: ComplexArray) -> ComplexArray:
        """Return what the edges of segments add to the prediction by P, of the shape of xj."""
        return _by(d0, self._slope(_prediction(frame)[0]))

    def _slope(self, response: ComplexArray) -> ComplexArray:
        """Return ``i/2π dP/df`` in s, by lines through neighbouring frequencies."""
        n, step = len(response), self.sampling_rate / len(self.window)
        padded = np.pad(response, ((_SLOPE, _SLOPE), (0, 0), (0, 0)), mode="edge")
        lags = range(1, _SLOPE + 1)
        total = sum(k * (padded[_SLOPE + k :][:n] - padded[_SLOPE - k :][:n]) for k in lags)
        return np.asarray(total * (0.5j / (2 * np.pi * step * sum(k**2 for k in lags))))

    def _advanced(self, spectra: ComplexArray, tau: FloatArray) -> ComplexArray:
        return np.asarray(spectra * _turn(self.omega, tau)[:, :, None])

    def _delays(
        self,
        frame: _Frame,
        reference: tuple[ComplexArray, ComplexArray],
        xj: ComplexArray,
        *,
        doubt_cycles: bool = True,
    ) -> tuple[FloatArray, FloatArray]:
        """Measure delays in a frame, shapes (n_segments,): the maxima of J.

        `doubt_cycles`: whether peaks that are equal but for noise count as equal.
        """
        omega, (x0, d0) = self.omega, reference
        response, left = _prediction(frame)
        weight = np.linalg.inv(left)
        predicted = _by(x0, response) + _by(d0, self._slope(response))
        weighted = np.matmul(predicted.conj(), weight)
        crossed = np.einsum("fsp,fsp->fs", weighted, xj)
        energy = np.einsum("fsp,fsp->fs", weighted, predicted).real
        # Neighbouring frequencies share samples of the window: κ of them count as one.
        w2 = self.window**2
        kappa = len(w2) * float(w2 @ w2) / float(w2.sum()) ** 2
        total = energy.sum(axis=0)
        informative = omega**2 @ energy
        spurious = self._spurious(frame)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.maximum(1 - spurious / informative.mean(), 0.0)
            alike = _ALIKE * np.sqrt(kappa / total) / share
        alike = np.minimum(np.nan_to_num(alike, nan=1.0), 1.0) * doubt_cycles
        tau, is_one = self._peak(crossed, alike)
        turned = (crossed * _turn(omega, tau)).real
        met = turned.sum(axis=0)
        # Where a segment is quiet, P predicts the reference's noise, which says nothing of a delay.
        curvature = np.minimum(omega**2 @ turned, share * informative)
        with np.errstate(divide="ignore", invalid="ignore"):
            std = np.sqrt(kappa * informative / 2) / np.maximum(curvature, 0.0)
        # R is an estimate too: correct by the mean of an inverse Wishart matrix.
        freedom = max(frame.n_segments - x0.shape[2], 1)
        inflated = freedom / max(freedom - xj.shape[2] - 1, 1)
        std *= math.sqrt(inflated)
        known = (2 * total / kappa > _SIGNIFICANT) & (met > _MET * total) & (share > _BEYOND)
        known &= is_one | (alike < _WEAK)  # else the cycle is chosen by chance
        # What P predicts without its noise, which no sensor follows. Of few segments that is hardly
        # known: as much as R is off by is taken off beside.
        by_noise = inflated * x0.shape[2] * xj.shape[2] / freedom * len(omega)
        # Nor does any follow P's share of the reference's own noise, which is all there is where
        # the motion stops: at most one, in the units of R, at each frequency and channel.
        by_noise += xj.shape[2] * len(omega)
        meant = total / inflated - by_noise
        far = ~known & (2 * meant / kappa > _FAR_SIGNIFICANT) & (self.is_wide and self.has_frame)
        if far.any():
            tau[far] = self._highest(crossed[:, far])
            met = (crossed * _turn(omega, tau)).real.sum(axis=0)
            known |= far & (met > _MET * total)
        std = np.where(known, std, np.inf)
        tau = np.where(known | (2 * meant / kappa > _SIGNIFICANT), tau, np.nan)
        return tau, np.where(far & ~known & (met <= _MET * meant), np.nan, std)

    def _moves(self, frame: _Frame) -> bool:
        """Return whether more of the segments of a frame is predicted than noise predicts of P."""
        response, left = _prediction(frame)
        predicted = response @ frame.crossed.conj().transpose(0, 2, 1)
        energy = np.trace(np.linalg.solve(left, predicted), axis1=1, axis2=2).real
        mean = float(self.omega**2 @ energy) / frame.n_segments
        return mean * (1 - _BEYOND) > self._spurious(frame)

    def _spurious(self, frame: _Frame) -> float:
        """Return the share of P's noise, which predicts nothing, in what `omega`² weights.

        ``d0 dj / n``, times the mean of ``R^-1`` over that of a known R (complex Wishart).
        """
        w, n = self.window, frame.n_segments
        dj, d0 = frame.crossed.shape[1:]
        lags = range(self.hop, len(w), self.hop) if self.hop else ()
        shared = sum(float(w[:-lag] @ w[lag:]) ** 2 for lag in lags)
        left = n / (1 + 2 * shared / float(w @ w) ** 2) - d0 - dj
        inflation = (n - d0) / left if left > 0 else math.inf
        return float(d0 * dj / n * float(self.omega @ self.omega) * inflation)

    def _highest(self, crossed: ComplexArray) -> FloatArray:
        """Return the τ of the highest peak of every column, up to half a segment away."""
        height = np.fft.irfft(np.pad(crossed, ((1, 0), (0, 0))), n=self._n_grid, axis=0)
        at = np.argmax(height, axis=0)
        at = np.where(at > self._n_grid // 2, at - self._n_grid, at)
        return self._polished(crossed, np.asarray(at * self._step, np.float64))

    def _peak(self, crossed: ComplexArray, alike: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return the τ that maximises Re Σ crossed exp(iωτ) for every column, and if it is alone.

        Of peaks that are lower by less than the share `alike`, shape (n_segments,), the nearest to
        zero: those of hum, a few cycles apart, are equal but for noise.
        """
        reach = min(self._n_grid // 2 - 1, int(_LONGEST / self.sampling_rate / self._step))
        even, odd = (np.zeros((crossed.shape[1], reach + 1)) for _ in range(2))
        # For so few τ a product with the transform's matrix costs less than the transform.
        for first in range(0, len(crossed), _FREQUENCIES_AT_ONCE):
            some = crossed[first : first + _FREQUENCIES_AT_ONCE]
            cosine, sine = _fourier(self._n_grid, first + 1, reach + 1)
            even += some.real.T @ cosine[: len(some)]
            odd += some.imag.T @ sine[: len(some)]
        near = np.concatenate([(even + odd)[:, :0:-1], even - odd], axis=1)
        highest = np.argmax(near, axis=1)
        middle = near[:, 1:-1]
        high = middle >= (1 - alike[:, None]) * near.max(axis=1, keepdims=True)
        peaks = high & (middle >= near[:, :-2]) & (middle >= near[:, 2:]) & (middle > 0)
        away = np.where(peaks, np.abs(np.arange(1 - reach, reach)), reach + 1)
        nearest = np.where(peaks.any(axis=1), np.argmin(away, axis=1) + 1, highest)
        is_one = np.count_nonzero(peaks, axis=1) < 2
        return self._polished(crossed, (nearest - reach) * self._step), is_one

    @property
    def _n_grid(self) -> int:
        """Number of grid points of τ, less than a period of the highest frequency apart."""
        return _fast_length(4 * len(self.window))

    @property
    def _step(self) -> float:
        """Interval between grid points of τ, in s."""
        return float(2 * np.pi / self.omega[0] / self._n_grid)

    def _constant(self, crossed: ComplexArray) -> float:
        """Return the τ of the most likely peak of Re Σ crossed exp(iωτ).

        Arrival times make τ nearly zero, and nearly monochromatic motion has other peaks of equal
        height. So the peak nearest zero is chosen, unless another one within `_LONGEST` is clearly
        higher, or a more distant one is too high for noise.
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
    """Return the smallest length from `n` on with prime factors 2, 3 and 5: fast to transform."""
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


def _by(x0: ComplexArray, response: ComplexArray) -> ComplexArray:
    """Return spectra (n_freqs, n_segments, n) times responses (n_freqs, m, n)."""
    return np.asarray(np.matmul(x0, response.transpose(0, 2, 1)))


def _products(a: ComplexArray, b: ComplexArray) -> ComplexArray:
    return np.asarray(np.matmul(a.transpose(0, 2, 1), b.conj()))


def _prediction(frame: _Frame) -> tuple[ComplexArray, ComplexArray]:
    """Return P, shape (n_freqs, dj, d0), and the residual matrix R per segment."""
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
