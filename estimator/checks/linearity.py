"""Whether sensors are linear: squares and cubes of a channel in what other sensors do not predict.

Some segments, apart from each other, are transformed with their squares and cubes. Of a channel x,
``x**2`` and ``x**3 - 3 s**2 x`` with s its standard deviation in that segment: the second has
nothing in common with x itself, so that the channel's own noise is not taken for a cube. At every
frequency the channels of the other sensors are regressed out of x, its square and its cube. What
is left of x is its noise and what is not linear; what is left of the square and the cube explains
the second. A block of neighbouring frequencies has one complex coefficient of each, which may be
those of a filter after the nonlinear stage.

Its evidence is Hotelling's: segments vary as they vary, whatever the correlation of neighbouring
frequencies, and however loud the segments are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.checks.instants import Dependence, dependences, without
from estimator.levels.pooled import blocks_of
from estimator.records import dataclass
from estimator.spectra.welch import WelchSettings
from estimator.spectra.windows import get_window
from estimator.types import ComplexArray, FloatArray, IntArray

MOST_SEGMENTS = 48
MOST_BINS = 200
MOST_PREDICTORS = 12
MOST_VALUES = 2_000_000
LEAST_LEFT = 12
"""Segments beyond the predictors without which nothing is tested."""
PEAK = 6.0
"""Standard deviations of a sample of a disturbed segment, which is left out."""
LOUD = 50.0
"""Power of a channel over what is left of it, from which it is tested: below, the fourth moment of
its own noise looks like a cube."""
CERTAIN = 5.0
"""Standard deviations of the evidence from which a channel is not linear."""
ROUNDS = 6
_TERMS = 2  # square and cube
_SUMS = 10  # of one kind of cube
_SEEN = 3.0  # standard errors from which on a cube is seen
_FAR = 4.0  # standard deviations of what others leave, beyond which a sample pulls


@dataclass(frozen=True, slots=True, eq=False)
class Nonlinear:
    """A channel that is not linear.

    Attributes
    ----------
    channel : int
    evidence : float
        In standard deviations of a normal variable.
    share : float
        Of the power of the channel that square and cube explain.
    explained : float64, shape (n_kept,)
        PSD that square and cube explain, in the channel's unit**2/Hz.
    """

    channel: int
    evidence: float
    share: float
    explained: FloatArray


class SquaresAndCubes:
    """Spectra of some segments with their squares and cubes.

    Parameters
    ----------
    welch : WelchSettings
    highest : float
        Frequency in Hz up to which averages are known.
    more : int
        Further frequencies, evenly spaced, and cubes of steps from sample to sample, for `bends`.
    most_values : int
        Values of the segments' spectra that are kept at all frequencies.
    """

    def __init__(
        self,
        welch: WelchSettings,
        highest: float,
        *,
        more: int = 0,
        most_values: int = MOST_VALUES,
    ) -> None:
        self._window = get_window(welch.window, welch.segment_length)
        known = np.flatnonzero(
            (welch.frequencies >= max(welch.lowest, welch.frequencies[1]))
            & (welch.frequencies <= min(highest, 0.95 * welch.sampling_rate / 2))
        )
        wanted = np.geomspace(known[0], known[-1], MOST_BINS) if len(known) else np.empty(0)
        even = known[np.linspace(0, len(known) - 1, min(len(known), more)).astype(np.int64)]
        chosen = {*np.round(wanted).astype(int).tolist(), *even.tolist()}
        self.bins: IntArray = np.array(sorted(chosen), np.int64)
        self.frequency = welch.frequencies[self.bins]
        self._density = 2 / (welch.sampling_rate * float(self._window @ self._window))
        self._scale: FloatArray | None = None
        self._spectra: list[NDArray[np.complex64]] = []
        self._whole: list[NDArray[np.complex64]] = []
        self._powers: list[FloatArray] = []
        self._means: list[FloatArray] = []
        self._past: list[FloatArray] = []
        self._first: FloatArray | float = 0.0
        self._most_values = most_values
        self._more, self._sums = more > 0, np.zeros((2, _SUMS, 1))
        self._frequencies, self._highest = welch.frequencies, float(self.frequency.max(initial=0))

    def add(self, samples: FloatArray, past: FloatArray | None = None) -> None:
        """Add a segment, (segment_length, n_channels), unless it is disturbed.

        `past`: seconds from the samples of each channel to those of the segment, which are
        interpolated between them.
        """
        mean = samples.mean(axis=0)
        centred = samples.T - mean[:, None]
        size = np.sqrt(np.mean(centred**2, axis=1))
        if not np.all(size > 0) or np.any(np.abs(centred).max(axis=1) > PEAK * size):
            return
        if self._scale is None:
            self._scale, self._first = size, mean
        x = centred / self._scale[:, None]
        square = x**2
        power = (square @ self._window**2) / (self._window @ self._window)
        terms: list[FloatArray] = [x, square, x * (square - 3 * power[:, None])]
        if self._more:
            step = np.diff(x, prepend=x[:, :1])
            of_steps = (step**2 @ self._window**2) / (self._window @ self._window)
            terms.append(step * (step**2 - 3 * of_steps[:, None]))
            power = np.stack([power, of_steps])
        self._powers.append(power)
        spectra = np.fft.rfft(np.stack(terms) * self._window).astype(np.complex64)
        self._spectra.append(spectra[:, :, self.bins].transpose(2, 1, 0))
        if len(self._whole) * spectra[0].size < self._most_values:
            self._whole.append(spectra[:1].copy())  # a view would keep squares and cubes
            self._means.append((mean - self._first) / self._scale)
            self._past.append(np.zeros(len(size)) if past is None else past)

    def nonlinear(self, sensor: IntArray) -> list[Nonlinear]:
        """Return the channels that are not linear, the one with the largest share first.

        Parameters
        ----------
        sensor : int64, shape (n_channels,)
            Sensor of each channel.

        Notes
        -----
        What one channel explains is regressed out of the other sensors before these are tested.
        Among those with evidence, the channel with the largest share is the cause: what is not
        linear is whole in what is left of it, and a part in what is left of the others.
        """
        found: list[Nonlinear] = []
        if self._scale is None or len(self._spectra) < LEAST_LEFT or not len(self.bins):
            return found
        spectra = np.array(self._spectra)
        block = blocks_of(self.frequency)
        while len(found) < ROUNDS:
            best: Nonlinear | None = None
            for each in range(int(sensor.max()) + 1):
                worst = _worst(spectra, sensor, each, block, [one.channel for one in found])
                if worst is not None and (best is None or worst.share > best.share):
                    best = worst
            if best is None:
                break
            scale = self._density * self._scale[best.channel] ** 2
            found.append(replace(best, explained=scale * best.explained))
        return found

    def gather(self, sensor: IntArray, *, least: int = 0) -> None:
        """Take the segments, if they are the `least`, into the sums of `bends`, and drop them.

        `sensor`: of each channel.
        """
        if len(self._spectra) < least:
            return
        spectra, powers = np.array(self._spectra), np.array(self._powers)
        self._spectra, self._powers = [], []
        if len(spectra) < LEAST_LEFT or not len(self.bins):
            return
        powers = powers.reshape(len(spectra), -1, len(sensor))
        found = np.zeros((len(powers[0]), _SUMS, len(sensor)))
        found[:, 0], found[:, 1] = (powers**2).sum(axis=0), powers.sum(axis=0)
        turned = 1 - np.cos(2 * np.pi * self.bins / len(self._window))
        for one in range(int(sensor.max()) + 1):
            own = np.flatnonzero(sensor == one)
            rest, left = _rest(spectra, sensor, own.tolist(), [])
            if left < LEAST_LEFT:
                continue
            r = rest[..., 0]
            x = spectra[:, :, own, 0].swapaxes(0, 1).astype(np.complex128)
            noise = np.maximum(np.mean(np.abs(r) ** 2, axis=1), np.finfo(np.float64).tiny)
            loud = np.mean(np.abs(x) ** 2, axis=1)
            heard = loud / (loud + noise)
            shares = np.ones(len(own)), turned @ heard / heard.sum(axis=0)
            for kind, q in enumerate(np.moveaxis(rest[..., 2:], -1, 0)):
                along = np.einsum("fkc,fkc,fc->kc", q.conj(), r, 1 / noise).real
                size = np.einsum("fkc,fkc,fc->kc", q.conj(), q, 1 / noise).real
                products = np.stack([along**2, along * size, size**2]).sum(axis=1)
                found[kind, 2:4, own] = np.stack([along.sum(axis=0), size.sum(axis=0)]).T
                found[kind, 4:7, own] = len(spectra) / left * products.T
                found[kind, 7, own] = shares[kind] * size.sum(axis=0)
            # what few segments leave, and what predicts them, are both too small
            pulled = (len(spectra) / left) ** 2 * self._pulled(x, r)
            found[0, 8:, own] = len(spectra) * np.stack([pulled, np.ones(len(own))]).T
        self._sums = self._sums[: len(found)] + found

    def _pulled(self, x: ComplexArray, rest: ComplexArray) -> FloatArray:
        """Return what samples far beyond what others leave take off a gain.

        As where a channel stands still for moments. 0 where frequencies are left out.
        """
        if len(self.bins) < self.bins[-1] - self.bins[0] + 1:
            return np.zeros(x.shape[2])
        n = len(self._window)
        both = np.zeros((2, n // 2 + 1, *x.shape[1:]), np.complex128)
        both[:, self.bins] = x - rest, rest  # what others predict, and what they leave
        whole = self._window > self._window.max() / 2
        predicted, left = np.fft.irfft(both, n, axis=1)[:, whole] / self._window[whole, None, None]
        size = np.median(np.abs(left), axis=(0, 1)) / 0.6745
        far = np.where(np.abs(left) > _FAR * size, left, 0.0)
        taken = np.einsum("tkc,tkc->c", far, predicted)
        whole_power = np.einsum("tkc,tkc->c", predicted, predicted)
        return np.asarray(taken / np.maximum(whole_power, np.finfo(np.float64).tiny))

    def bends(self, sensor: IntArray) -> FloatArray:
        """Return by how much what bends a channel may change its gain, as a standard uncertainty.

        Of the segments that were gathered, and of those that are there, which are dropped.

        Parameters
        ----------
        sensor : int64, shape (n_channels,)
            Sensor of each channel.

        Returns
        -------
        float64, shape (n_channels,)
            Relative, at the loudness of the segments; NaN where too few segments tell. A cube
            ``c x**3`` changes it by ``3 c s**2``, with s the standard deviation; a dead zone by
            twice what its cube does, and play by twice what a cube of steps from sample to sample
            does. One real c of all frequencies, with its standard error where it is seen, or else
            the larger of both. And what moments without motion take. It has a part of what
            another sensor bends.
        """
        self.gather(sensor)
        fourth, second, along, size, squares, products, sizes, parts, pulled, n = (
            self._sums.swapaxes(0, 1)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            cube = along / size
            left = np.maximum(squares - 2 * cube * products + cube**2 * sizes, 0.0)
            cube, error = np.abs(cube), np.sqrt(left) / size
            limit = np.where(cube > _SEEN * error, cube + error, np.maximum(cube, error))
            most = 6 / np.sqrt(3) * limit * fourth / second * parts / size  # rectangular
            most = np.sqrt(np.sum(most**2, axis=0) + (pulled[0] / n[0]) ** 2)
        return np.broadcast_to(np.minimum(most, 1.0), sensor.shape)

    def dependences(self, sensor: IntArray) -> list[Dependence]:
        """Return where noise depends on the motion otherwise, the clearest first.

        `explained` has the channel's unit**2/Hz, at all frequencies of the transform.
        """
        if self._scale is None or sum(map(len, self._whole)) < LEAST_LEFT:
            return []
        past = np.array(self._past)
        self._whole = [np.concatenate(self._whole)]
        found = dependences(
            self._whole[0],
            np.stack(self._means),
            self._frequencies,
            self._window,
            sensor,
            highest=self._highest,
            most_predictors=MOST_PREDICTORS,
            past=past if past.any() else None,
        )
        scale = self._density * self._scale**2
        return [replace(each, explained=scale[each.channel] * each.explained) for each in found]


def _worst(
    spectra: NDArray[np.complex64], sensor: IntArray, one: int, block: IntArray, known: list[int]
) -> Nonlinear | None:
    """Return the channel of a sensor with evidence and the largest share, besides `known`."""
    own = [c for c in np.flatnonzero(sensor == one).tolist() if c not in known]
    if not own:
        return None
    rest, left = _rest(spectra, sensor, own, known)
    if left < LEAST_LEFT:
        return None
    evidence, explained = _explained(rest, block, left)
    of_squares = explained.sum(axis=0)
    unexplained = (np.abs(rest[..., 0]) ** 2).sum(axis=(0, 1)) / left - of_squares
    power = (np.abs(spectra[:, :, own, 0]) ** 2).sum(axis=(0, 1)) / len(spectra)
    found = [
        Nonlinear(channel, float(evidence[n]), float(of_squares[n] / power[n]), explained[:, n])
        for n, channel in enumerate(own)
        if power[n] > LOUD * unexplained[n] and evidence[n] > CERTAIN
    ]
    return max(found, key=lambda each: each.share, default=None)


def _rest(
    spectra: NDArray[np.complex64], sensor: IntArray, own: list[int], known: list[int]
) -> tuple[ComplexArray, int]:
    """Return what others leave of channels, squares and cubes, and how many segments are beyond.

    Of the shape (n_freqs, n_segments, n, 3), for channels of one sensor.
    """
    others = np.flatnonzero(sensor != sensor[own[0]])[:MOST_PREDICTORS]
    further = [c for c in known if sensor[c] != sensor[own[0]]]
    left = len(spectra) - len(others) - _TERMS * len(further)
    predictors = np.concatenate(
        [spectra[:, :, others, 0], *(spectra[:, :, c, 1:] for c in further)], axis=2
    ).transpose(1, 0, 2)
    wanted = spectra[:, :, own].reshape(*spectra.shape[:2], -1).transpose(1, 0, 2)
    rest = without(predictors.astype(np.complex128), wanted.astype(np.complex128))
    return rest.reshape(*rest.shape[:2], len(own), -1), left


def _solved(matrix: ComplexArray, right: ComplexArray) -> ComplexArray:
    """Return solutions, the smallest where one segment alone has what there is."""
    try:
        return np.asarray(np.linalg.solve(matrix, right), np.complex128)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.pinv(matrix, hermitian=True) @ right, np.complex128)


def _explained(rest: ComplexArray, block: IntArray, left: int) -> tuple[FloatArray, FloatArray]:
    """Return the evidence of square and cube, (n,), and the power that they explain, (n_freqs, n).

    `rest` has the shape (n_freqs, n_segments, n, 3): what others leave of n channels and of both.
    """
    r, q = rest[..., 0], rest[..., 1:]
    n = r.shape[1]
    first = np.flatnonzero(np.diff(block, prepend=-1))
    size = np.sqrt(np.add.reduceat(np.sum(np.abs(q) ** 2, axis=1), first))
    q /= np.where(size > 0, size, 1.0)[block, None]
    variance = np.sum(np.abs(r) ** 2, axis=1) / left
    weight = 1 / np.maximum(variance, np.finfo(np.float64).tiny)
    u = np.add.reduceat(q.conj() * (r * weight[:, None])[..., None], first)
    U, V = u.sum(axis=1), np.einsum("bkci,bkcj->bcij", u, u.conj())
    G = np.einsum("fkci,fkcj->fcij", q.conj(), q)
    A = np.add.reduceat(G * weight[..., None, None], first)
    coefficient = _solved(A, U[..., None])[..., 0]
    share = (U.conj() * _solved(V, U[..., None])[..., 0]).real.sum(axis=2) / n
    share = np.clip(share * left / n, 0.0, 1 - 1e-9)
    degrees = left - _TERMS
    # P(Beta(2, degrees) > share); their logarithms add up (Fisher)
    log_p = degrees * np.log1p(-share) + np.log1p(degrees * share)
    half = len(first)  # degrees of freedom of -2 sum(log p), halved
    evidence = _normal(-log_p.sum(axis=0) / half, half)
    total = (U.conj() * coefficient).real.sum(axis=2)
    chance = np.einsum("bcii->bc", _solved(A, V)).real
    true = np.maximum(1 - chance / np.maximum(total, 1e-300), 0.0)[block]
    c = coefficient[block]
    power = np.einsum("fci,fcij,fcj->fc", c.conj(), G, c).real / left
    return evidence, true * power


def _normal(ratio: FloatArray, half: int) -> FloatArray:
    """Return a chi-squared variable of 2 `half` degrees of freedom, over these, as a normal one.

    By Wilson and Hilferty.
    """
    spread = 2 / (9 * 2 * half)
    return np.asarray((np.cbrt(ratio) - (1 - spread)) / np.sqrt(spread))
