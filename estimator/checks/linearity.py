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
"""Values of the segments' spectra that are kept at all frequencies."""
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
    """

    def __init__(self, welch: WelchSettings, highest: float) -> None:
        self._window = get_window(welch.window, welch.segment_length)
        known = np.flatnonzero(
            (welch.frequencies >= max(welch.lowest, welch.frequencies[1]))
            & (welch.frequencies <= min(highest, 0.95 * welch.sampling_rate / 2))
        )
        wanted = np.geomspace(known[0], known[-1], MOST_BINS) if len(known) else np.empty(0)
        self.bins: IntArray = np.array(sorted(set(np.round(wanted).astype(int).tolist())), np.int64)
        self.frequency = welch.frequencies[self.bins]
        self._density = 2 / (welch.sampling_rate * float(self._window @ self._window))
        self._scale: FloatArray | None = None
        self._spectra: list[NDArray[np.complex64]] = []
        self._whole: list[NDArray[np.complex64]] = []
        self._powers: list[FloatArray] = []
        self._means: list[FloatArray] = []
        self._past: list[FloatArray] = []
        self._first: FloatArray | float = 0.0
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
        self._powers.append(power)
        terms = np.stack([x, square, x * (square - 3 * power[:, None])])
        terms *= self._window
        spectra = np.fft.rfft(terms).astype(np.complex64)
        self._spectra.append(spectra[:, :, self.bins].transpose(2, 1, 0))
        if len(self._whole) * spectra[0].size < MOST_VALUES:
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

    def bends(self, sensor: IntArray) -> FloatArray:
        """Return by how much what bends a channel may change its gain, as a standard uncertainty.

        Parameters
        ----------
        sensor : int64, shape (n_channels,)
            Sensor of each channel.

        Returns
        -------
        float64, shape (n_channels,)
            Relative, at the loudness of the segments. A cube ``c x**3`` changes it by
            ``3 c s**2``, with s the standard deviation; a dead zone by twice what its cube does.
            One real c of all frequencies, or its standard error, where that is larger. It has
            a part of what another sensor bends.
        """
        found = np.zeros(len(sensor))
        if self._scale is None or len(self._spectra) < LEAST_LEFT or not len(self.bins):
            return found
        spectra = np.array(self._spectra)
        power = np.array(self._powers)
        loudness = (power**2).sum(axis=0) / power.sum(axis=0)
        for one in range(int(sensor.max()) + 1):
            own = np.flatnonzero(sensor == one)
            rest, left = _rest(spectra, sensor, own.tolist(), [])
            if left < LEAST_LEFT:
                continue
            r, q = rest[..., 0], rest[..., 2]
            weight = 1 / np.maximum(np.mean(np.abs(r) ** 2, axis=1), np.finfo(np.float64).tiny)
            along = np.einsum("fkc,fkc,fc->kc", q.conj(), r, weight).real
            size = np.einsum("fkc,fkc,fc->kc", q.conj(), q, weight).real
            whole = np.maximum(size.sum(axis=0), np.finfo(np.float64).tiny)
            cube = along.sum(axis=0) / whole
            error = np.sqrt(len(r[0]) / left * np.sum((along - cube * size) ** 2, axis=0)) / whole
            most = 6 * np.maximum(np.abs(cube), error) * loudness[own]
            found[own] = np.fmin(most / np.sqrt(3), 1.0)  # of a rectangular distribution
        return found

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
    return rest.reshape(*rest.shape[:2], len(own), 1 + _TERMS), left


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
